//! Configuration of the data, and all that pairs are made and read by.

use std::path::PathBuf;

use serde::{Deserialize, Deserializer, Serialize};

use crate::alignment::EvidenceInput;
use crate::depth::DepthConfig;
use crate::geometry::ErrorFrame;
use crate::recordings::{CameraConfig, Layout};
use crate::synthetic::SyntheticSettings;
use crate::systems::{SystemConfig, TruthConfig};

/// Images and true poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Folder that holds recordings: of the KITTI raw layout `DATE/DRIVE`, of KITTI odometry `sequences/NN`, of TUM RGB-D
    /// and EuRoC the recordings' folders. Default: none, the data are a `manifest`'s.
    #[serde(default)]
    pub root: PathBuf,
    /// How recordings lie there: `kitti_raw`, `kitti_odometry`, `tum_rgbd` or `euroc`. Default: the one that fits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub layout: Option<Layout>,
    /// How many frames apart the two of a pair are; several make pairs of each: `gap = [1, 5, 10]`. Default: neighbouring
    /// frames, keyframes and the next, and what files of relative poses and manifests list.
    #[serde(default, skip_serializing_if = "Vec::is_empty", deserialize_with = "one_or_several")]
    pub gap: Vec<usize>,
    /// The camera, for recordings that do not say it (`tum_rgbd`). Default: the known one of fr1, fr2 and fr3, by the name
    /// of the recording.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraConfig>,
    /// A pairs manifest in place of recordings: its sequences are the drives, its columns the
    /// measured and true poses ([`crate::recordings::Manifest`]). Default: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub manifest: Option<PathBuf>,
    /// With a manifest or in the layout `tum_rgbd`: vehicle axes into those of the camera, `x y z qx qy qz qw`, m. Default: the vehicle is where the
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
    /// Name of its folder, such as `2011_09_30_drive_0034_sync`, `03` or `MH_01_easy`.
    pub drive: String,
    /// Only pairs whose source frame lies in `[first, end)`. Default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frames: Option<[usize; 2]>,
    /// Its camera, where it is another than `data.camera`. Default: that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraConfig>,
}

/// A number, or a list of such.
fn one_or_several<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<usize>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "a number of frames, or a list of such")]
    enum Gap {
        One(usize),
        Several(Vec<usize>),
    }
    Ok(match Gap::deserialize(deserializer)? {
        Gap::One(gap) => vec![gap],
        Gap::Several(gaps) => gaps,
    })
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
