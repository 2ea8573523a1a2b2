//! A recording: which frames have what, and when.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::calibration::Calibration;
use super::image::{RgbImage, read_image};
use super::layout::Layout;
use super::undistortion::Undistortion;
use crate::error::{Error, Place, Result};
use crate::geometry::Pose;
use crate::time::Time;

/// Steps of a metre in depth maps: KITTI's.
pub(crate) const KITTI_STEPS_PER_METRE: f32 = 256.0;

/// Files by frame index.
pub type FrameFiles = BTreeMap<usize, PathBuf>;

/// Motions by source and target frame, `source_from_target`.
pub type Motions = BTreeMap<(usize, usize), Pose>;

/// A recording and what was found of it.
#[derive(Clone, Debug)]
pub struct Recording {
    /// Its name below the root, such as `2011_09_30_drive_0034_sync`; of a manifest's sequence, that.
    pub name: String,
    /// How it lies on disk.
    pub layout: Layout,
    /// Its camera, and where its other sensors are.
    pub calibration: Calibration,
    /// Images of the camera, PNG or JPEG.
    pub images: FrameFiles,
    /// Images of the right camera.
    pub right_images: FrameFiles,
    /// LiDAR scans.
    pub scans: FrameFiles,
    /// Depth maps of its own, 16-bit PNG, 0 = unknown.
    pub depth: FrameFiles,
    /// Steps of a metre in those.
    pub depth_steps_per_metre: f32,
    /// What takes the distortion out of its images and depth maps, where they have one.
    pub lens: Option<Arc<Undistortion>>,
    /// The same of its right images.
    pub right_lens: Option<Arc<Undistortion>>,
    /// Poses that it brings with it, `world_from_vehicle`: in the KITTI raw layout by GNSS/INS (`oxts`), world of east,
    /// north, up; in KITTI odometry the world is the vehicle of the first pose; in TUM RGB-D and EuRoC that of the motion
    /// capture or scanner.
    pub poses: BTreeMap<usize, Pose>,
    /// Time of each frame (UTC as written); empty where nothing tells.
    pub times: BTreeMap<usize, Time>,
    /// Poses that could not be read; their frames have none.
    pub problems: Vec<String>,
    /// Times that could not be read or are missing; their frames have none.
    pub time_problems: Vec<String>,
    /// What else is missing or not used, counted.
    pub remarks: Vec<String>,
    /// Motions that are listed with it; `None` where its layout lists none.
    pub listed: Option<Listed>,
    /// What it was read from beside the files of frames.
    pub sources: Vec<PathBuf>,
}

/// What a manifest says of motions.
#[derive(Clone, Debug, Default)]
pub struct Listed {
    /// Measured ones by system.
    pub measurements: BTreeMap<String, Motions>,
    /// True ones.
    pub true_motions: Motions,
}

impl Recording {
    /// A recording of which nothing is known yet but its sensors.
    pub(super) fn new(layout: Layout, name: &str, calibration: Calibration) -> Self {
        Self {
            name: name.to_owned(),
            layout,
            calibration,
            images: FrameFiles::new(),
            right_images: FrameFiles::new(),
            scans: FrameFiles::new(),
            depth: FrameFiles::new(),
            depth_steps_per_metre: KITTI_STEPS_PER_METRE,
            lens: None,
            right_lens: None,
            poses: BTreeMap::new(),
            times: BTreeMap::new(),
            problems: Vec::new(),
            time_problems: Vec::new(),
            remarks: Vec::new(),
            listed: None,
            sources: Vec::new(),
        }
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
                self.layout.times()
            ))),
        }
    }

    /// Reads the image of a frame, undistorted.
    ///
    /// # Errors
    /// The frame has none, or it cannot be decoded or has another size than the calibration says.
    pub fn read_image(&self, frame: usize) -> Result<RgbImage> {
        self.read(&self.images, frame, "image", self.lens.as_deref())
    }

    /// The same of the right camera.
    ///
    /// # Errors
    /// As [`Recording::read_image`].
    pub fn read_right_image(&self, frame: usize) -> Result<RgbImage> {
        self.read(&self.right_images, frame, "right image", self.right_lens.as_deref())
    }

    fn read(&self, images: &FrameFiles, frame: usize, what: &str, lens: Option<&Undistortion>) -> Result<RgbImage> {
        let Some(path) = images.get(&frame) else {
            return Err(Error::Data(format!("{}, frame {frame}: no {what} in {}", self.name, self.layout.images())));
        };
        let image = read_image(path)?;
        let [width, height] = self.image_size();
        if [image.width, image.height] != [width, height] {
            return Err(Error::malformed(
                path,
                Place::Whole,
                format!("{}x{} pixels", image.width, image.height),
                format!("{width}x{height} as {}", self.layout.size()),
            ));
        }
        Ok(match lens {
            Some(lens) => lens.image(&image),
            None => image,
        })
    }

    /// Width and height of its images, px.
    pub fn image_size(&self) -> [usize; 2] {
        [self.calibration.camera.width, self.calibration.camera.height]
    }

    /// The files it was read from, and is to be read from.
    pub(crate) fn files(&self) -> impl Iterator<Item = &Path> {
        let frames = [&self.images, &self.right_images, &self.scans, &self.depth];
        frames.into_iter().flat_map(BTreeMap::values).chain(&self.sources).map(PathBuf::as_path)
    }

    /// The recording date, `2011_09_30`, where its name begins with one; else its name.
    pub fn date(&self) -> &str {
        if self.layout == Layout::KittiRaw { &self.name[..10] } else { &self.name }
    }

    /// The name without `_sync`, as measurement files use it.
    pub fn short_name(&self) -> &str {
        self.name.strip_suffix("_sync").unwrap_or(&self.name)
    }
}
