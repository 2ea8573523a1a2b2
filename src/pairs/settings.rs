//! Configuration of the data, and all that pairs are made and read by.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::alignment::EvidenceInput;
use crate::depth::DepthConfig;
use crate::geometry::ErrorFrame;
use crate::synthetic::SyntheticSettings;
use crate::systems::{SystemConfig, TruthConfig};

/// Images and true poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Folder in the KITTI raw layout: `DATE/DRIVE/{image_02,oxts,…}` and `DATE/calib_*.txt`. Default: none, the data
    /// are a `manifest`'s.
    #[serde(default)]
    pub root: PathBuf,
    /// A pairs manifest in place of drives in the KITTI raw layout: its sequences are the drives, its columns the
    /// measured and true poses ([`crate::recordings::Manifest`]). Default: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub manifest: Option<PathBuf>,
    /// With a manifest: vehicle axes into those of the camera, `x y z qx qy qz qw`, m. Default: the vehicle is where the
    /// camera is, x forward, y left, z up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_from_vehicle: Option<[f64; 7]>,
    /// A synthetic data set to render at `root` when it is not there. Default: none, the data are there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub synthetic: Option<SyntheticSettings>,
    /// Axes of errors and covariances. Default: vehicle.
    #[serde(default)]
    pub error_frame: ErrorFrame,
    /// Drives to train on.
    pub train: Vec<DriveConfig>,
    /// Drives to watch during training (stop rule, best checkpoint). Default: held out of `train`.
    #[serde(default)]
    pub validation: Vec<DriveConfig>,
    /// Without `validation`: the share of each training drive, at its end, that is held out.
    /// Default: 0.1.
    #[serde(default = "default_validation_fraction")]
    pub validation_fraction: f64,
    /// Drives of the MDE table.
    pub test: Vec<DriveConfig>,
    /// Share of frames that may turn out unreadable before a run gives up. Default: 0.01.
    #[serde(default = "default_max_bad_fraction")]
    pub max_bad_fraction: f64,
    /// Memory for decoded frames of each split that is read, MB; the cache never grows beyond it.
    /// Default: 256.
    #[serde(default = "default_cache_mb")]
    pub cache_mb: usize,
}

/// A drive, or a part of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveConfig {
    /// Folder name, such as `2011_09_30_drive_0034_sync`.
    pub drive: String,
    /// Only pairs whose source frame lies in `[first, end)`. Default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames: Option<[usize; 2]>,
}

fn default_validation_fraction() -> f64 {
    0.1
}

pub(crate) fn default_max_bad_fraction() -> f64 {
    0.01
}

pub(crate) fn default_cache_mb() -> usize {
    256
}

/// The sections of a configuration that say which pairs there are, and how they are read.
#[derive(Clone, Copy, Debug)]
pub struct PairSettings<'a> {
    /// Where the recordings are, and which drives are for what.
    pub data: &'a DataConfig,
    /// What counts as the true pose.
    pub truth: &'a TruthConfig,
    /// Who measured.
    pub systems: &'a [SystemConfig],
    /// Where the depth of the target image comes from.
    pub depth: &'a DepthConfig,
    /// What is read of a pair.
    pub input: PairInput,
    /// Seed of generated measurements.
    pub seed: u64,
    /// Whether pairs to watch are held out of those to learn from, where the data name none.
    pub held_out: bool,
}

/// What is read of a pair: what the model looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PairInput {
    /// Width of its images, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// Whether the right camera's images are read too.
    pub stereo: bool,
    /// Whether the two images are aligned.
    pub evidence: EvidenceInput,
    /// Whether a pair of which the source shows nothing of the target is left out.
    pub needs_overlap: bool,
}
