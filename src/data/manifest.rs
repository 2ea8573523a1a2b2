//! A pairs manifest: images, depth and measured poses of one's own robot in one CSV file, a row for each measurement.
//!
//! | column | meaning |
//! |---|---|
//! | `system` | which system measured |
//! | `sequence` | which recording; optional, default `sequence` |
//! | `source`, `target` | frame numbers i and i + 1 (or any later one), whole numbers |
//! | `source_image`, `target_image` | PNG or JPEG, rectified; paths below the manifest's folder |
//! | `fx`, `fy`, `cx`, `cy` | intrinsics, px, pixel centres at integer coordinates; the same in a sequence |
//! | `x`, `y`, `z`, `qx`, `qy`, `qz`, `qw` | measured `ⁱT̂ᵢ₊₁`, m and unit quaternion |
//! | `true_x` … `true_qw` | the true one; optional, needed to train and to judge |
//! | `depth` | depth of the target image, 16-bit PNG, metres x 256; optional |
//! | `source_time`, `target_time` | s; optional |
//!
//! A manifest is read as drives are: each sequence becomes a [`Drive`].

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::Deserialize;

use super::calibration::Calibration;
use super::drive::{Drive, FrameFiles, LARGEST_FRAME};
use crate::error::{Error, Place, Result};
use crate::files::is_plain;
use crate::geometry::{Pinhole, Pose};
use crate::systems::pose_from_quaternion;

/// Largest difference of two statements of one true pose, m and rad.
const SAME_TRUTH: f64 = 1e-6;

/// Longer motions between two frames are mistakes, m.
const LARGEST_MOTION_M: f64 = 1e4;

/// Motions of a drive by source and target frame, `source_from_target`.
pub type Motions = BTreeMap<(usize, usize), Pose>;

/// What a manifest says of a drive beside its images.
#[derive(Clone, Debug, Default)]
pub struct Listed {
    /// Depth maps by target frame.
    pub depth: FrameFiles,
    /// Measured motions by system.
    pub measurements: BTreeMap<String, Motions>,
    /// True motions.
    pub true_motions: Motions,
}

/// A manifest that was read.
#[derive(Clone, Debug)]
pub struct Manifest {
    path: PathBuf,
    sequences: BTreeMap<String, Sequence>,
}

#[derive(Clone, Debug)]
struct Sequence {
    intrinsics: [f64; 4],
    images: FrameFiles,
    timestamps_s: BTreeMap<usize, f64>,
    listed: Listed,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    system: String,
    #[serde(default = "default_sequence")]
    sequence: String,
    source: usize,
    target: usize,
    source_image: PathBuf,
    target_image: PathBuf,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    x: f64,
    y: f64,
    z: f64,
    qx: f64,
    qy: f64,
    qz: f64,
    qw: f64,
    true_x: Option<f64>,
    true_y: Option<f64>,
    true_z: Option<f64>,
    true_qx: Option<f64>,
    true_qy: Option<f64>,
    true_qz: Option<f64>,
    true_qw: Option<f64>,
    depth: Option<PathBuf>,
    source_time: Option<f64>,
    target_time: Option<f64>,
}

fn default_sequence() -> String {
    "sequence".to_owned()
}

/// Axes of a vehicle (x forward, y left, z up) at the camera's own place into those of the camera.
pub fn camera_axes_from_vehicle() -> Pose {
    let rotation = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    Pose::new(Rotation3::from_matrix_unchecked(rotation), Vector3::zeros())
}

impl Manifest {
    /// Reads a manifest; no image is opened.
    ///
    /// # Errors
    /// Names the line and column: a column is missing or unknown, a value is no number, a quaternion is not of unit
    /// length, frames do not follow one another, a measurement stands there twice, or two rows contradict each other.
    pub fn load(path: &Path) -> Result<Self> {
        let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
        // A line ends with its line feed, so that lines of Windows files are counted right.
        let mut reader = csv::ReaderBuilder::new()
            .terminator(csv::Terminator::Any(b'\n'))
            .trim(csv::Trim::All)
            .from_reader(std::io::BufReader::new(file));
        let header = reader.headers().map_err(|error| broken(path, &csv::StringRecord::new(), &error))?.clone();
        let mut manifest = Self { path: path.to_owned(), sequences: BTreeMap::new() };
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut record = csv::StringRecord::new();
        while reader.read_record(&mut record).map_err(|error| broken(path, &header, &error))? {
            let row: Row = record.deserialize(Some(&header)).map_err(|error| broken(path, &header, &error))?;
            let place = Place::Line(record.position().map_or(0, csv::Position::line) as usize);
            manifest.add(row, folder, &place)?;
        }
        if manifest.sequences.is_empty() {
            return Err(Error::malformed(path, Place::Whole, "no row", "a header and a row for each measurement"));
        }
        Ok(manifest)
    }

    /// Names of its sequences.
    pub fn sequences(&self) -> impl Iterator<Item = &str> {
        self.sequences.keys().map(String::as_str)
    }

    /// Names of the systems that measured, in alphabetical order.
    pub fn systems(&self) -> Vec<&str> {
        let names = self.sequences.values().flat_map(|sequence| sequence.listed.measurements.keys());
        let mut names: Vec<&str> = names.map(String::as_str).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    /// Whether every row has a depth map.
    pub fn has_depth(&self) -> bool {
        self.sequences.values().all(|Sequence { listed, .. }| {
            let pairs = listed.measurements.values().flat_map(BTreeMap::keys);
            pairs.into_iter().all(|(_, target)| listed.depth.contains_key(target))
        })
    }

    /// A sequence as a drive; the size of its images is that of the first that can be read.
    ///
    /// # Errors
    /// There is no such sequence, or none of its images can be read.
    pub fn drive(&self, name: &str, camera_from_vehicle: &Pose) -> Result<Drive> {
        let sequence = self.sequences.get(name).ok_or_else(|| {
            let known: Vec<&str> = self.sequences().take(8).collect();
            Error::config(
                "data",
                format!("`{name}` is no sequence of {}, which holds {}", self.path.display(), known.join(", ")),
            )
        })?;
        // The first that can be read: a broken one costs its own pairs.
        let mut images = sequence.images.values();
        let first = image_size(images.next().expect("a row names two images"));
        let (width, height) = first.or_else(|error| images.find_map(|image| image_size(image).ok()).ok_or(error))?;
        let [fx, fy, cx, cy] = sequence.intrinsics;
        let calibration = Calibration {
            camera2: Pinhole { fx, fy, cx, cy, width, height },
            camera2_from_camera0: Pose::identity(),
            camera2_from_velodyne: *camera_from_vehicle,
            camera2_from_vehicle: *camera_from_vehicle,
            camera3_from_camera2: None,
        };
        Ok(Drive {
            name: name.to_owned(),
            calibration,
            images: sequence.images.clone(),
            right_images: FrameFiles::new(),
            scans: FrameFiles::new(),
            oxts_poses: BTreeMap::new(),
            timestamps_s: sequence.timestamps_s.clone(),
            problems: Vec::new(),
            listed: Some(sequence.listed.clone()),
        })
    }

    fn add(&mut self, row: Row, folder: &Path, place: &Place) -> Result<()> {
        let path = self.path.clone();
        let malformed = |found: String, expected: &str| Error::malformed(&path, place.clone(), found, expected);
        for (column, name) in [("system", &row.system), ("sequence", &row.sequence)] {
            if !is_plain(name) {
                let expected = "letters, digits, - and _, for it names files and columns";
                return Err(malformed(format!("`{column}` = `{name}`"), expected));
            }
        }
        if row.target <= row.source || row.target > LARGEST_FRAME {
            let found = format!("source {}, target {}", row.source, row.target);
            return Err(malformed(found, &format!("a target frame after its source, at most {LARGEST_FRAME}")));
        }
        let intrinsics = [row.fx, row.fy, row.cx, row.cy];
        if intrinsics.iter().any(|value| !value.is_finite()) || row.fx <= 0.0 || row.fy <= 0.0 {
            return Err(malformed(format!("intrinsics {intrinsics:?}"), "finite ones, fx and fy above zero"));
        }
        let measured = [row.x, row.y, row.z, row.qx, row.qy, row.qz, row.qw];
        let measured = pose_from_numbers(measured, &path, place)?;
        if measured.translation.norm() > LARGEST_MOTION_M {
            let found = format!("a motion of {:.1e} m", measured.translation.norm());
            return Err(malformed(found, "at most 10 km between two frames"));
        }
        let truth = [row.true_x, row.true_y, row.true_z, row.true_qx, row.true_qy, row.true_qz, row.true_qw];
        let truth = match truth.iter().flatten().count() {
            0 => None,
            7 => Some(pose_from_numbers(truth.map(|value| value.expect("counted")), &path, place)?),
            count => {
                return Err(malformed(format!("{count} of the 7 values true_x … true_qw"), "all of them, or none"));
            }
        };
        let sequence = self.sequences.entry(row.sequence).or_insert_with(|| Sequence {
            intrinsics,
            images: FrameFiles::new(),
            timestamps_s: BTreeMap::new(),
            listed: Listed::default(),
        });
        if sequence.intrinsics != intrinsics {
            let expected = format!("{:?} as in the rows of this sequence before", sequence.intrinsics);
            return Err(malformed(format!("intrinsics {intrinsics:?}"), &expected));
        }
        for (frame, image) in [(row.source, &row.source_image), (row.target, &row.target_image)] {
            let image = folder.join(image);
            let known = sequence.images.entry(frame).or_insert_with(|| image.clone());
            if *known != image {
                let expected = format!("{} as in a row before", known.display());
                return Err(malformed(format!("image {} of frame {frame}", image.display()), &expected));
            }
        }
        let times = [(row.source, row.source_time), (row.target, row.target_time)];
        for (frame, time) in times.into_iter().filter_map(|(frame, time)| Some((frame, time?))) {
            if !time.is_finite() || *sequence.timestamps_s.entry(frame).or_insert(time) != time {
                return Err(malformed(format!("time {time} of frame {frame}"), "one finite time for each frame"));
            }
        }
        let listed = &mut sequence.listed;
        if let Some(depth) = row.depth.filter(|depth| !depth.as_os_str().is_empty()) {
            let depth = folder.join(depth);
            let known = listed.depth.entry(row.target).or_insert_with(|| depth.clone());
            if *known != depth {
                let expected = format!("{} as in a row before", known.display());
                return Err(malformed(format!("depth {} of frame {}", depth.display(), row.target), &expected));
            }
        }
        let pair = (row.source, row.target);
        if let Some(truth) = truth {
            let known = listed.true_motions.entry(pair).or_insert(truth);
            if Pose::error(known, &truth).abs().max() > SAME_TRUTH {
                let expected = "that of a row before: a pair of frames has one";
                return Err(malformed(format!("another true pose of frames {} and {}", pair.0, pair.1), expected));
            }
        }
        let measurements = listed.measurements.entry(row.system.clone()).or_default();
        if measurements.insert(pair, measured).is_some() {
            let found = format!("{} frames {} and {} again", row.system, pair.0, pair.1);
            return Err(malformed(found, "each pair of a system once"));
        }
        Ok(())
    }
}

fn pose_from_numbers(numbers: [f64; 7], path: &Path, place: &Place) -> Result<Pose> {
    let [x, y, z, quaternion @ ..] = numbers;
    if numbers.iter().any(|number| !number.is_finite()) {
        return Err(Error::malformed(path, place.clone(), format!("a pose of {numbers:?}"), "finite numbers"));
    }
    pose_from_quaternion(Vector3::new(x, y, z), quaternion, path, place)
}

/// An error of the CSV reader, by line and column name.
fn broken(path: &Path, header: &csv::StringRecord, error: &csv::Error) -> Error {
    let line = error.position().map_or(1, csv::Position::line) as usize;
    let found = match error.kind() {
        csv::ErrorKind::Deserialize { err, .. } => {
            let column = err.field().and_then(|field| header.get(field as usize));
            column.map_or_else(|| err.kind().to_string(), |column| format!("`{column}`: {}", err.kind()))
        }
        _ => error.to_string(),
    };
    Error::malformed(path, Place::Line(line), found, "a row of a pairs manifest (docs/own_data.md)")
}

/// Width and height of an image file, px.
fn image_size(path: &Path) -> Result<(usize, usize)> {
    let reader = image::ImageReader::open(path).map_err(Error::io("read", path))?;
    let reader = reader.with_guessed_format().map_err(Error::io("read", path))?;
    let (width, height) = reader
        .into_dimensions()
        .map_err(|error| Error::malformed(path, Place::Whole, error.to_string(), "a complete PNG or JPEG image"))?;
    Ok((width as usize, height as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "system,sequence,source,target,source_image,target_image,fx,fy,cx,cy,x,y,z,qx,qy,qz,qw,true_x,true_y,true_z,true_qx,true_qy,true_qz,true_qw,depth";
    const ROW: &str = "vo,lab,0,1,0.png,1.png,60,60,48,24,0,0,1,0,0,0,1,0,0,1.1,0,0,0,1,1_depth.png";

    fn read(text: &str) -> Result<Manifest> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pairs.csv");
        std::fs::write(&path, text).unwrap();
        Manifest::load(&path)
    }

    #[test]
    fn rows_become_sequences() {
        let second =
            ROW.replace(",0,1,0.png,1.png", ",1,2,1.png,2.png").replace(",0,0,1.1,0,0,0,1,1_depth", ",,,,,,,,");
        let second = second.trim_end_matches(".png").to_owned();
        let manifest = read(&format!("{HEADER}\r\n{ROW}\r\n{second}\r\n")).unwrap();
        assert_eq!(manifest.sequences().collect::<Vec<_>>(), ["lab"]);
        assert_eq!(manifest.systems(), ["vo"]);
        assert!(!manifest.has_depth());
        let Sequence { images, listed, .. } = &manifest.sequences["lab"];
        assert_eq!((images.len(), listed.measurements["vo"].len(), listed.true_motions.len()), (3, 2, 1));
        assert_eq!(listed.true_motions[&(0, 1)].translation.z, 1.1);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let twice = format!("{ROW}\n{ROW}");
        let other_truth = format!("{ROW}\n{}", ROW.replace("vo", "icp").replace("1.1", "1.2"));
        for (text, words) in [
            (ROW.replace(",60,60", ",sixty,60"), ["line 2", "`fx`: invalid float"]),
            (ROW.replace(",60,60", ",-60,60"), ["line 2", "fx and fy above zero"]),
            (ROW.replace("lab,0,1", "lab,1,1"), ["line 2", "source 1, target 1"]),
            (ROW.replace("0,0,1,0,0,0,1,0", "0,0,1,0,0,0,2,0"), ["line 2", "length 2"]),
            (ROW.replace("1.1,", ","), ["line 2", "6 of the 7 values"]),
            (ROW.replace("vo", "v/o"), ["line 2", "`system` = `v/o`"]),
            (twice, ["line 3", "vo frames 0 and 1 again"]),
            (other_truth, ["line 3", "another true pose"]),
            (String::new(), ["pairs.csv", "no row"]),
        ] {
            let message = read(&format!("{HEADER}\n{text}\n")).unwrap_err().to_string();
            assert!(words.iter().all(|word| message.contains(word)), "{message}\nexpected: {words:?}");
        }
        let message = read(&format!("{}\n{ROW}\n", HEADER.replace("fx", "focal"))).unwrap_err().to_string();
        assert!(message.contains("`focal`"), "{message}");
    }
}
