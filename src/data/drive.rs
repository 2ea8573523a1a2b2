//! One drive in the KITTI raw layout: which frames have what.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::calibration::Calibration;
use super::image::{RgbImage, read_image};
use super::manifest::Listed;
use super::oxts::{OxtsPacket, world_from_vehicle};
use crate::error::{Error, Place, Result};
use crate::files::read_text;
use crate::geometry::Pose;

/// Frame indices above this are taken for mistakes.
pub(super) const LARGEST_FRAME: usize = 1_000_000_000;

/// Files by frame index.
pub type FrameFiles = BTreeMap<usize, PathBuf>;

/// A drive folder and what was found in it.
#[derive(Clone, Debug)]
pub struct Drive {
    /// Folder name, such as `2011_09_30_drive_0034_sync`.
    pub name: String,
    /// The sensors of its date.
    pub calibration: Calibration,
    /// Left colour images (`image_02`), PNG or JPEG.
    pub images: FrameFiles,
    /// Right colour images (`image_03`).
    pub right_images: FrameFiles,
    /// LiDAR scans (`velodyne_points`).
    pub scans: FrameFiles,
    /// Pose of the vehicle by GNSS/INS (`oxts`), world of east, north, up.
    pub oxts_poses: BTreeMap<usize, Pose>,
    /// Time of each frame, seconds since 1970 (UTC as written); empty without a timestamps file.
    pub timestamps_s: BTreeMap<usize, f64>,
    /// Packets that could not be read; their frames have no pose.
    pub problems: Vec<String>,
    /// What a pairs manifest says of it; `None` for drives in the KITTI layout.
    pub listed: Option<Listed>,
}

impl Drive {
    /// Looks through `root/DATE/DRIVE`.
    ///
    /// # Errors
    /// The folder or its calibration is missing or unreadable. A broken packet is a problem noted,
    /// not an error.
    pub fn load(root: &Path, name: &str) -> Result<Self> {
        let date = name.get(..10).filter(|date| date.bytes().all(|byte| byte.is_ascii_digit() || byte == b'_'));
        let Some(date) = date else {
            return Err(Error::config(
                "data",
                format!(
                    "drive `{name}` does not begin with a date; KITTI's names look like 2011_09_30_drive_0034_sync"
                ),
            ));
        };
        let date_folder = root.join(date);
        let folder = date_folder.join(name);
        if !folder.is_dir() {
            return Err(Error::Data(format!(
                "{}: no such drive; expected ROOT/DATE/DRIVE below data.root = {} (set data.root or {})",
                folder.display(),
                root.display(),
                crate::config::DATA_ROOT_VARIABLE
            )));
        }
        let mut problems = Vec::new();
        let packets = list_frames(&folder.join("oxts/data"), &["txt"])?;
        let oxts_poses = load_poses(&packets, &mut problems);
        Ok(Self {
            name: name.to_owned(),
            calibration: Calibration::load(&date_folder)?,
            images: list_frames(&folder.join("image_02/data"), &["png", "jpg", "jpeg"])?,
            right_images: list_frames(&folder.join("image_03/data"), &["png", "jpg", "jpeg"])?,
            scans: list_frames(&folder.join("velodyne_points/data"), &["bin"])?,
            oxts_poses,
            timestamps_s: load_timestamps(&folder, &mut problems),
            problems,
            listed: None,
        })
    }

    /// Reads the left colour image of a frame.
    ///
    /// # Errors
    /// The frame has none, or it cannot be decoded or has another size than the calibration says.
    pub fn read_image(&self, frame: usize) -> Result<RgbImage> {
        let missing = || Error::Data(format!("{}, frame {frame}: no image in image_02/data", self.name));
        self.read_sized(self.images.get(&frame).ok_or_else(missing)?)
    }

    /// The same of the right camera.
    ///
    /// # Errors
    /// As [`Drive::read_image`].
    pub fn read_right_image(&self, frame: usize) -> Result<RgbImage> {
        let missing = || Error::Data(format!("{}, frame {frame}: no image in image_03/data", self.name));
        self.read_sized(self.right_images.get(&frame).ok_or_else(missing)?)
    }

    fn read_sized(&self, path: &Path) -> Result<RgbImage> {
        let image = read_image(path)?;
        let expected = &self.calibration.camera2;
        if (image.width, image.height) != (expected.width, expected.height) {
            return Err(Error::malformed(
                path,
                Place::Whole,
                format!("{}x{} pixels", image.width, image.height),
                match self.listed {
                    None => format!("{}x{} as in calib_cam_to_cam.txt (S_rect)", expected.width, expected.height),
                    Some(_) => format!("{}x{} as the first of the sequence", expected.width, expected.height),
                },
            ));
        }
        Ok(image)
    }

    /// The recording date, `2011_09_30`; of a manifest's sequence, its name.
    pub fn date(&self) -> &str {
        if self.listed.is_some() { &self.name } else { &self.name[..10] }
    }

    /// The name without `_sync`, as measurement files use it.
    pub fn short_name(&self) -> &str {
        self.name.strip_suffix("_sync").unwrap_or(&self.name)
    }
}

/// Files named by their frame index; a folder that is absent holds none.
fn list_frames(folder: &Path, extensions: &[&str]) -> Result<FrameFiles> {
    if !folder.is_dir() {
        return Ok(FrameFiles::new());
    }
    let mut frames = FrameFiles::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let path = entry.map_err(Error::io("list", folder))?.path();
        let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or("").to_ascii_lowercase();
        let index = path.file_stem().and_then(|stem| stem.to_str()).and_then(|stem| stem.parse().ok());
        let Some(index) = index.filter(|_| extensions.contains(&extension.as_str())) else { continue };
        if index > LARGEST_FRAME {
            return Err(Error::malformed(
                path,
                Place::Whole,
                format!("frame index {index}"),
                format!("at most {LARGEST_FRAME}"),
            ));
        }
        if let Some(twin) = frames.insert(index, path.clone()) {
            let found = format!("a second file of frame {index} beside {}", twin.display());
            return Err(Error::malformed(
                path,
                Place::Whole,
                found,
                "one file for each frame; remove or move the other",
            ));
        }
    }
    Ok(frames)
}

fn load_poses(packets: &FrameFiles, problems: &mut Vec<String>) -> BTreeMap<usize, Pose> {
    let mut mercator_scale = None;
    let mut poses = BTreeMap::new();
    for (&frame, path) in packets {
        match OxtsPacket::load(path) {
            Ok(packet) => {
                let scale = *mercator_scale.get_or_insert_with(|| packet.mercator_scale());
                poses.insert(frame, world_from_vehicle(&packet, scale));
            }
            Err(error) => problems.push(error.to_string()),
        }
    }
    poses
}

/// Frame times of the camera, else of the packets.
fn load_timestamps(folder: &Path, problems: &mut Vec<String>) -> BTreeMap<usize, f64> {
    let candidates = ["image_02/timestamps.txt", "oxts/timestamps.txt"].map(|name| folder.join(name));
    let Some(path) = candidates.into_iter().find(|path| path.is_file()) else { return BTreeMap::new() };
    let text = match read_text(&path) {
        Ok(text) => text,
        Err(error) => {
            problems.push(error.to_string());
            return BTreeMap::new();
        }
    };
    let mut times = BTreeMap::new();
    for (frame, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        match parse_timestamp_s(line) {
            Some(time) => {
                times.insert(frame, time);
            }
            None => {
                let place = Place::Line(frame + 1);
                problems.push(
                    Error::malformed(&path, place, format!("`{line}`"), "a time like 2011-09-30 12:40:59.409")
                        .to_string(),
                );
            }
        }
    }
    times
}

/// Seconds since 1970 of `2011-09-30 12:40:59.409428480`.
fn parse_timestamp_s(text: &str) -> Option<f64> {
    let (date, time) = text.trim().split_once(' ')?;
    let mut date = date.splitn(3, '-').map(|part| part.parse::<i64>().ok());
    let (year, month, day) = (date.next()??, date.next()??, date.next()??);
    let mut time = time.splitn(3, ':').map(|part| part.parse::<f64>().ok());
    let (hours, minutes, seconds) = (time.next()??, time.next()??, time.next()??);
    if !(1..=12).contains(&month) || !(1..=31).contains(&day) {
        return None;
    }
    // Days from the civil calendar, years counted from March.
    let year = if month <= 2 { year - 1 } else { year };
    let era = year.div_euclid(400);
    let year_of_era = year - era * 400;
    let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let days = era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year - 719_468;
    Some(days as f64 * 86_400.0 + hours * 3_600.0 + minutes * 60.0 + seconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timestamps_count_seconds_since_1970() {
        assert_eq!(parse_timestamp_s("1970-01-01 00:00:00.000000000"), Some(0.0));
        // date -u -d '2011-09-30 12:40:59' +%s
        assert_eq!(parse_timestamp_s("2011-09-30 12:40:59.5"), Some(1_317_386_459.5));
        assert_eq!(parse_timestamp_s("2012-02-29 00:00:00"), Some(1_330_473_600.0));
        assert_eq!(parse_timestamp_s("2011-13-30 12:40:59.5"), None);
        assert_eq!(parse_timestamp_s("yesterday"), None);
    }
}
