//! A pairs manifest: images, depth and measured poses of one's own robot in one CSV file, a row for each measurement.
//!
//! | column | meaning |
//! |---|---|
//! | `system` | which system measured |
//! | `sequence` | which recording; optional, default `sequence` |
//! | `source`, `target` | frame numbers i and i + 1 (or any later one), whole numbers |
//! | `source_image`, `target_image` | PNG or JPEG; paths below the manifest's folder |
//! | `fx`, `fy`, `cx`, `cy` | intrinsics, px, pixel centres at integer coordinates; the same in a sequence |
//! | `x`, `y`, `z`, `qx`, `qy`, `qz`, `qw` | measured `ⁱT̂ᵢ₊₁`, m and unit quaternion |
//! | `true_x` … `true_qw` | the true one; optional, needed to train and to judge |
//! | `depth` | depth of the target image, 16-bit PNG, metres x 256; optional |
//! | `depth_factor` | steps of a metre in `depth`; optional, default 256; the same in a sequence |
//! | `k1`, `k2`, `p1`, `p2`, `k3` | radial-tangential distortion of images and depth as stored, OpenCV's order; optional: they have none; the same in a sequence |
//! | `source_time`, `target_time` | s; optional |
//!
//! A manifest is read as drives are: each sequence becomes a [`Recording`].

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::calibration::Calibration;
use super::image::size_of_first;
use super::layout::Layout;
use super::manifest_row::{Columns, ManifestCamera, ManifestRow};
use super::recording::{FrameFiles, Listed, Recording};
use super::undistortion::Undistortion;
use crate::error::{Error, Place, Result, excerpt};
use crate::files::{Form, Row, Table, is_plain, read_text};
use crate::geometry::{Lens, OWN_INTRINSICS, Pinhole, Pose};
use crate::time::Time;

/// Largest difference of two statements of one true pose, m and rad.
const SAME_TRUTH: f64 = 1e-6;

/// A manifest that was read.
#[derive(Clone, Debug)]
pub struct Manifest {
    path: PathBuf,
    sequences: BTreeMap<String, Sequence>,
}

#[derive(Clone, Debug)]
struct Sequence {
    /// fx fy cx cy, k1 k2 p1 p2 k3, and steps of a metre in depth maps.
    camera: ManifestCamera,
    images: FrameFiles,
    depth: FrameFiles,
    times: BTreeMap<usize, Time>,
    listed: Listed,
}

impl Manifest {
    /// Reads a manifest; no image is opened.
    ///
    /// # Errors
    /// Names the line and column: a column is missing or unknown, a value is no number, a quaternion is not of unit
    /// length, frames do not follow one another, a measurement stands there twice, or two rows contradict each other.
    pub fn load(path: &Path) -> Result<Self> {
        let text = read_text(path)?;
        let columns = Columns::names();
        let form = Form { columns: &columns, widths: &[], described: "the columns of docs/own_data.md" };
        let mut table = Table::open(&text, path, &form)?;
        let layout = Columns::find(&table.header)?;
        let mut manifest = Self { path: path.to_owned(), sequences: BTreeMap::new() };
        let folder = path.parent().unwrap_or(Path::new(""));
        while let Some(row) = table.next()? {
            manifest.add(&layout.read(&row)?, folder, &row)?;
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
        self.sequences.values().all(|Sequence { listed, depth, .. }| {
            let pairs = listed.measurements.values().flat_map(BTreeMap::keys);
            pairs.into_iter().all(|(_, target)| depth.contains_key(target))
        })
    }

    /// Whether a row has a depth map.
    pub fn has_some_depth(&self) -> bool {
        self.sequences.values().any(|sequence| !sequence.depth.is_empty())
    }

    /// A sequence as a recording; the size of its images is that of the first that can be read.
    ///
    /// # Errors
    /// There is no such sequence, or none of its images can be read.
    pub fn recording(&self, name: &str, camera_from_vehicle: Option<&Pose>) -> Result<Recording> {
        let sequence = self.sequences.get(name).ok_or_else(|| {
            let known: Vec<&str> = self.sequences().take(8).collect();
            Error::config(
                "data",
                format!("`{name}` is no sequence of {}, which holds {}", self.path.display(), known.join(", ")),
            )
        })?;
        let [width, height] = size_of_first(sequence.images.values())?;
        let ManifestCamera { intrinsics: [fx, fy, cx, cy], distortion, depth_factor } = sequence.camera;
        let malformed = |found: String, expected: &str| {
            Error::malformed(&self.path, Place::Field(name.to_owned()), found, expected)
        };
        let camera = Pinhole { fx, fy, cx, cy, width, height };
        camera.require_centre().map_err(|found| malformed(found, OWN_INTRINSICS))?;
        let Some((camera, lens)) = Undistortion::of(&Lens { camera, distortion }) else {
            return Err(malformed(format!("distortion {distortion:?}, by which rays cross"), "k1 k2 p1 p2 k3"));
        };
        let calibration = Calibration::of_camera(camera, camera_from_vehicle);
        Ok(Recording {
            images: sequence.images.clone(),
            depth: sequence.depth.clone(),
            depth_steps_per_metre: depth_factor as f32,
            lens,
            times: sequence.times.clone(),
            listed: Some(sequence.listed.clone()),
            sources: vec![self.path.clone()],
            ..Recording::new(Layout::Manifest, name, calibration)
        })
    }

    fn add(&mut self, measured: &ManifestRow, folder: &Path, row: &Row) -> Result<()> {
        for (column, name) in [("system", measured.system), ("sequence", measured.sequence)] {
            if !is_plain(name) {
                let expected = "letters, digits, - and _, for it names files and columns";
                return Err(row.broken(format!("`{column}` = {}", excerpt(name)), expected));
            }
        }
        let pair @ [source, target] = measured.frames;
        if target <= source {
            return Err(row.broken(format!("source {source}, target {target}"), "a target frame after its source"));
        }
        let camera = measured.camera;
        let sequence = self.sequences.entry(measured.sequence.to_owned()).or_insert_with(|| Sequence {
            camera,
            images: FrameFiles::new(),
            times: BTreeMap::new(),
            depth: FrameFiles::new(),
            listed: Listed::default(),
        });
        if sequence.camera != camera {
            let expected = format!("{} as in the rows of this sequence before", sequence.camera);
            return Err(row.broken(camera.to_string(), &expected));
        }
        for (frame, image) in pair.into_iter().zip(measured.images) {
            same_file(&mut sequence.images, frame, folder, image).map_err(|known| {
                row.broken(format!("image {} of frame {frame}", excerpt(image)), &format!("{known} as in a row before"))
            })?;
        }
        for (frame, time) in pair.into_iter().zip(measured.times).filter_map(|(frame, time)| Some((frame, time?))) {
            let known = *sequence.times.entry(frame).or_insert(time);
            if known != time {
                return Err(row.broken(format!("time {time} of frame {frame}"), &format!("{known} as in a row before")));
            }
        }
        if let Some(depth) = measured.depth {
            same_file(&mut sequence.depth, target, folder, depth).map_err(|known| {
                row.broken(
                    format!("depth {} of frame {target}", excerpt(depth)),
                    &format!("{known} as in a row before"),
                )
            })?;
        }
        let listed = &mut sequence.listed;
        if let Some(truth) = measured.true_source_from_target {
            let known = listed.true_motions.entry((source, target)).or_insert(truth);
            if Pose::error(known, &truth).abs().max() > SAME_TRUTH {
                let expected = "that of a row before: a pair of frames has one";
                return Err(row.broken(format!("another true pose of frames {source} and {target}"), expected));
            }
        }
        let measurements = listed.measurements.entry(measured.system.to_owned()).or_default();
        if measurements.insert((source, target), measured.source_from_target).is_some() {
            let found = format!("{} frames {source} and {target} again", excerpt(measured.system));
            return Err(row.broken(found, "each pair of a system once"));
        }
        Ok(())
    }
}

/// Keeps the file of a frame; that of a row before, where it is another.
fn same_file(files: &mut FrameFiles, frame: usize, folder: &Path, name: &str) -> Result<(), String> {
    let file = folder.join(name);
    let known = files.entry(frame).or_insert_with(|| file.clone());
    if *known == file { Ok(()) } else { Err(known.display().to_string()) }
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
    fn times_are_the_images_own_to_the_nanosecond() {
        let timed = |times: &str| read(&format!("{HEADER},source_time,target_time\n{ROW},{times}\n"));
        let times = timed("1403636579.763555584,1.403636579813555456e9").unwrap().sequences["lab"].times.clone();
        let nanoseconds = [(0, 1_403_636_579_763_555_584), (1, 1_403_636_579_813_555_456)];
        assert_eq!(times, nanoseconds.map(|(frame, time)| (frame, Time::from_nanoseconds(time))).into());
        let message = timed("1403636579763555584,").unwrap_err().to_string();
        assert!(message.contains("line 2: found `source_time` = `1403636579763555584`; expected seconds"), "{message}");
    }

    #[test]
    fn what_is_wrong_is_named() {
        let twice = format!("{ROW}\n{ROW}");
        let other_truth = format!("{ROW}\n{}", ROW.replace("vo", "icp").replace("1.1", "1.2"));
        for (text, words) in [
            (ROW.replace(",60,60", ",sixty,60"), ["line 2", "`fx` = `sixty`; expected a finite number"]),
            (ROW.replace(",60,60", ",-60,60"), ["line 2", "fx and fy above zero"]),
            (ROW.replace("lab,0,1", "lab,1,1"), ["line 2", "source 1, target 1"]),
            (ROW.replace("0,0,1,0,0,0,1,0", "0,0,1,0,0,0,2,0"), ["line 2", "length 2"]),
            (ROW.replace("1.1,", ","), ["line 2", "nothing in column `true_z`"]),
            (ROW.replace("vo", "v/o"), ["line 2", "`system` = `v/o`"]),
            (twice, ["line 3", "`vo` frames 0 and 1 again"]),
            (other_truth, ["line 3", "another true pose"]),
            (ROW.replace("lab", "one/two"), ["line 2", "`sequence` = `one/two`"]),
            (String::new(), ["pairs.csv", "no row"]),
        ] {
            let message = read(&format!("{HEADER}\n{text}\n")).unwrap_err().to_string();
            assert!(words.iter().all(|word| message.contains(word)), "{message}\nexpected: {words:?}");
        }
        for (header, words) in [
            (HEADER.replace("fx", "focal"), "an unknown column `focal`; expected the columns of docs/own_data.md"),
            (HEADER.replace("fx", "fy"), "a second column `fy`"),
            (HEADER.replace("fx,", ""), "no column `fx`"),
            (HEADER.replace(',', ";"), "columns separated by semicolons"),
            (HEADER.replace(',', "\t"), "columns separated by tabs"),
            (format!(",{HEADER}"), "no name of column 1 of 26"),
        ] {
            let message = read(&format!("{header}\n{ROW}\n")).unwrap_err().to_string();
            assert!(message.contains("line 1: found ") && message.contains(words), "{message}");
        }
    }
}
