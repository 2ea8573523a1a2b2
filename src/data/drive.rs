//! One drive in the KITTI raw layout: which frames have what.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::calibration::Calibration;
use super::image::{RgbImage, read_image};
use super::manifest::Listed;
use super::oxts::{OxtsPacket, world_from_vehicle};
use super::times::load_times;
use crate::error::{Error, Place, Result};
use crate::files::{LARGEST_FRAME, extension};
use crate::geometry::Pose;
use crate::time::Time;

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
    /// Time of each frame (UTC as written); empty without a timestamps file.
    pub times: BTreeMap<usize, Time>,
    /// Packets that could not be read; their frames have no pose.
    pub problems: Vec<String>,
    /// Times that could not be read or are missing; their frames have none.
    pub time_problems: Vec<String>,
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
        let (mut problems, mut time_problems) = (Vec::new(), Vec::new());
        let packets = list_frames(&folder.join("oxts/data"), &["txt"])?;
        let oxts_poses = load_poses(&packets, &mut problems);
        let images = list_frames(&folder.join("image_02/data"), &["png", "jpg", "jpeg"])?;
        let times = load_times(&folder, [&images, &packets], &mut time_problems);
        Ok(Self {
            name: name.to_owned(),
            calibration: Calibration::load(&date_folder)?,
            images,
            right_images: list_frames(&folder.join("image_03/data"), &["png", "jpg", "jpeg"])?,
            scans: list_frames(&folder.join("velodyne_points/data"), &["bin"])?,
            oxts_poses,
            times,
            problems,
            time_problems,
            listed: None,
        })
    }

    /// The frames' times, for what cannot do without them.
    ///
    /// # Errors
    /// None are known.
    pub fn require_times(&self, what: &str) -> Result<&BTreeMap<usize, Time>> {
        match self.times.is_empty() {
            false => Ok(&self.times),
            true => Err(Error::Data(format!(
                "{}: the times of its frames are not known; {what} needs {}",
                self.name,
                self.missing_times()
            ))),
        }
    }

    /// Where times that are not known would stand.
    pub(crate) fn missing_times(&self) -> &'static str {
        match self.listed {
            None => "image_02/timestamps.txt or oxts/timestamps.txt with a time a line",
            Some(_) => "the columns source_time and target_time in its manifest",
        }
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

    /// Width and height of its images, px.
    pub fn image_size(&self) -> [usize; 2] {
        [self.calibration.camera2.width, self.calibration.camera2.height]
    }

    /// The files it was read from, and is to be read from.
    pub(crate) fn files(&self, root: &Path) -> Vec<PathBuf> {
        let listed = self.listed.iter().flat_map(|listed| listed.depth.values());
        let frames = [&self.images, &self.right_images, &self.scans].into_iter().flat_map(BTreeMap::values);
        let date = root.join(self.date());
        let folder = date.join(&self.name);
        let calibration = Calibration::FILES.map(|name| date.join(name));
        let times = ["image_02/timestamps.txt", "oxts/timestamps.txt"].map(|name| folder.join(name));
        let packets = self.oxts_poses.keys().map(|frame| folder.join(format!("oxts/data/{frame:010}.txt")));
        frames.chain(listed).cloned().chain(calibration).chain(times).chain(packets).collect()
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
        let extension = extension(&path);
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
    let mut first: Option<OxtsPacket> = None;
    let mut poses = BTreeMap::new();
    for (&frame, path) in packets {
        match OxtsPacket::load(path) {
            Ok(packet) => {
                let first = *first.get_or_insert(packet);
                poses.insert(frame, world_from_vehicle(&packet.beside(&first), first.mercator_scale()));
            }
            Err(error) => problems.push(error.to_string()),
        }
    }
    poses
}
