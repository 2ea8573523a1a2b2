//! The one TOML file that describes an experiment, with its defaults.
//!
//! Order of precedence: defaults < the file that `extends` names < file < `RELCOV_DATA_ROOT` (for recorded data, not for
//! `data.synthetic`) < `--set key=value`. Relative paths
//! resolve against the file that holds them (those of `--set` and the environment against the
//! current folder). Unknown keys are errors.

mod depth_training;
mod load;
mod overrides;
mod training;
mod validate;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::depth::{ScaleRule, ScaleScope};
use crate::geometry::ErrorFrame;
use crate::model::{EvidenceInput, ImagePair, InputBasis, PoseInput};
use crate::network::{Head, ImageNetwork};
use crate::synthetic::SyntheticSettings;

pub use depth_training::DepthTrainingConfig;
pub use training::{Schedule, StopConfig, TrainingConfig, WatchedSplit};

/// Environment variable that overrides `data.root`.
pub const DATA_ROOT_VARIABLE: &str = "RELCOV_DATA_ROOT";

/// An experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of the run folder.
    pub name: String,
    /// Folder that holds run folders. Default: `checkpoints` in the current folder.
    #[serde(default = "default_checkpoints")]
    pub checkpoints: PathBuf,
    /// Seed of weights, batches and dropout. Default: 0.
    #[serde(default)]
    pub seed: u64,
    /// `auto | flex | ndarray | wgpu | vulkan | cuda[:i]`. Default: auto. `--device` overrides it.
    #[serde(default = "default_device")]
    pub device: String,
    /// Where the images and true poses are.
    pub data: DataConfig,
    /// What counts as the true pose.
    #[serde(default)]
    pub truth: TruthConfig,
    /// The systems whose measurements are learned; the first is the paper's System 1.
    pub systems: Vec<SystemConfig>,
    /// Where the depth of the target image comes from.
    #[serde(default)]
    pub depth: DepthConfig,
    /// The covariance network.
    #[serde(default)]
    pub model: ModelConfig,
    /// How it is trained.
    #[serde(default)]
    pub training: TrainingConfig,
    /// How `relcov train-depth` trains a depth network. Default: its defaults.
    #[serde(default, skip_serializing_if = "DepthTrainingConfig::is_default")]
    pub depth_training: DepthTrainingConfig,
}

/// Images and true poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Folder in the KITTI raw layout: `DATE/DRIVE/{image_02,oxts,…}` and `DATE/calib_*.txt`. Default: none, the data
    /// are a `manifest`'s.
    #[serde(default)]
    pub root: PathBuf,
    /// A pairs manifest in place of drives in the KITTI raw layout: its sequences are the drives, its columns the
    /// measured and true poses ([`crate::data::Manifest`]). Default: none.
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

/// The true poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "source", rename_all = "snake_case", deny_unknown_fields)]
pub enum TruthConfig {
    /// The drive's GNSS/INS packets (the paper's choice; default).
    Oxts {},
    /// A trajectory file for each drive.
    Trajectory(TrajectoryConfig),
    /// The columns `true_x` … `true_qw` of the pairs manifest.
    Manifest {
        /// Whose motion they describe. Default: camera2, the camera of the manifest.
        #[serde(default = "camera_of_the_manifest")]
        frame: MeasurementFrame,
    },
}

impl Default for TruthConfig {
    fn default() -> Self {
        Self::Oxts {}
    }
}

/// A system of relative-pose measurements.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SystemConfig {
    /// Its name in tables.
    pub name: String,
    /// Its exact share of each mini-batch (the paper: 0.75 and 0.25). 0: evaluated, never learned from.
    pub share: f64,
    /// Where its measurements come from.
    #[serde(flatten)]
    pub source: SystemSource,
}

/// Where a system's measurements come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "source", rename_all = "snake_case", deny_unknown_fields)]
pub enum SystemSource {
    // With braces, so that serde refuses unknown keys beside the tag.
    /// The truth itself: zero error (the paper's System 2).
    Truth {},
    /// The drive's GNSS/INS packets; errors of their own when the truth is another.
    Oxts {},
    /// Absolute poses in a file for each drive.
    Trajectory(TrajectoryConfig),
    /// Relative poses in a CSV file for each drive.
    Relative(RelativeConfig),
    /// Generated: the truth, wrong by errors of every size, drawn anew in every pass of a training
    /// ([`crate::systems::Perturbation`]). Needs true poses and no measurement.
    Perturbation(PerturbationConfig),
    /// The rows of the pairs manifest that bear the system's name.
    Manifest {
        /// Whose motion they describe. Default: camera2, the camera of the manifest.
        #[serde(default = "camera_of_the_manifest")]
        frame: MeasurementFrame,
    },
}

/// A file of absolute poses for each drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrajectoryConfig {
    /// Path below `data.root`, with `{drive}` (folder name without `_sync`), `{date}` or
    /// `{sequence}` (KITTI odometry number).
    pub path: PathBuf,
    /// `kitti` (3x4 rows, with or without a leading frame index) or `tum`. Default: kitti.
    #[serde(default)]
    pub format: TrajectoryFormat,
    /// Whose poses they are. Default: camera0.
    #[serde(default)]
    pub frame: MeasurementFrame,
}

/// A CSV file of relative poses for each drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RelativeConfig {
    /// As for trajectories.
    pub path: PathBuf,
    /// Whose poses they are. Default: camera0.
    #[serde(default)]
    pub frame: MeasurementFrame,
}

/// Errors of generated measurements.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PerturbationConfig {
    /// Errors of the middle size, x … yaw in axes of the errors, m and rad; they are drawn from a tenth to ten times of
    /// it. Default: the RMS errors of the other systems that are learned from, over their training pairs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base: Option<[f64; 6]>,
}

/// Format of a trajectory file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrajectoryFormat {
    /// Rows of 12 numbers (3x4, row-major), or 13 with a leading frame index.
    #[default]
    Kitti,
    /// Rows of `t x y z qx qy qz qw`, t in seconds (UNIX time of the frame).
    Tum,
}

/// The body whose motion a measurement describes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MeasurementFrame {
    /// Rectified left grey camera: KITTI odometry, most visual odometries on KITTI.
    #[default]
    Camera0,
    /// Left colour camera, the one whose images are used.
    Camera2,
    /// The vehicle: KITTI's IMU, x forward, y left, z up.
    Vehicle,
}

/// Depth of the target image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "source", rename_all = "snake_case", deny_unknown_fields)]
pub enum DepthConfig {
    /// A flat road below the camera and a far wall behind: needs nothing.
    GroundPlane {
        /// Height of the camera above the road, m. Default: KITTI's 1.65.
        #[serde(default = "default_camera_height_m")]
        camera_height_m: f64,
        /// Image row of the horizon at full size, px. Default: the principal point (level camera).
        #[serde(default, skip_serializing_if = "Option::is_none")]
        horizon_px: Option<f64>,
        /// Depth of everything farther, and of all above the horizon, m. Default: 80.
        #[serde(default = "default_max_depth_m")]
        max_depth_m: f64,
    },
    /// LiDAR scans projected into the image, gaps filled from the nearest return.
    Lidar {
        /// Farthest return that may fill a pixel, px of the network's input. Default: 12.
        #[serde(default = "default_fill_radius_px")]
        fill_radius_px: usize,
    },
    /// 16-bit PNG files, metres x 256, 0 = unknown.
    Files {
        /// Path below `data.root`, with `{date}`, `{drive}` and `{frame}` (ten digits).
        path: String,
    },
    /// The column `depth` of the pairs manifest: 16-bit PNG files, metres x 256, 0 = unknown.
    Manifest {},
    /// A depth network; `relcov depth` keeps its maps.
    Monodepth2(NetworkDepthConfig),
}

/// A depth network, what makes its depths metres, and where its maps are kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkDepthConfig {
    /// Folder of its weights: `encoder.pth` and `depth.pth` as published, or what `relcov train-depth` made.
    pub weights: PathBuf,
    /// What makes its depths metres. Default: what the weights call for: 1 for those made by `relcov train-depth`,
    /// 5.4 for published ones trained on stereo pairs, else the mean of the LiDAR (the paper).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<ScaleRule>,
    /// Which LiDAR returns a frame's scale is taken from. Default: those of the frame (the paper).
    #[serde(default)]
    pub scope: ScaleScope,
    /// Folder of its maps. Default: `depth/WEIGHTS` in `checkpoints`, WEIGHTS being the name of their folder.
    #[serde(default)]
    pub cache: PathBuf,
}

impl Default for DepthConfig {
    fn default() -> Self {
        Self::GroundPlane {
            camera_height_m: default_camera_height_m(),
            horizon_px: None,
            max_depth_m: default_max_depth_m(),
        }
    }
}

/// The covariance network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Input width, px. Default: 512.
    pub width: usize,
    /// Input height, px. Default: 160.
    pub height: usize,
    /// `warped` (the paper) or `raw` (the source image as it is, as in the paper's references 5 and 7: the
    /// network does not see the measured pose). Default: warped.
    pub pair: ImagePair,
    /// `pair` (the paper) or `residual` (learns faster). Default: residual.
    pub input: InputBasis,
    /// Whether each warped image comes with a channel that says where it is valid. Default: false (the paper).
    pub validity_mask: bool,
    /// Whether the right camera's images are seen too (the paper's footnote 1). Default: false (the paper).
    pub stereo: bool,
    /// `none` (the paper) or `mlp`: the measured pose as a 6-vector beside the images. Default: none.
    pub pose: PoseInput,
    /// `off` (the paper) or `alignment`: what direct alignment of the two images says of the measured pose's error,
    /// beside the images ([`crate::alignment`]). Default: off.
    pub evidence: EvidenceInput,
    /// `table_one` (the paper) or `none`: evidence alone. Default: table_one.
    pub network: ImageNetwork,
    /// `diagonal` (the paper), `full` (`L D Lᵀ`, 21 values) or `posterior` (needs evidence; a full covariance, and an
    /// estimate of the error itself). Default: diagonal.
    pub head: Head,
    /// Dropout after each convolution. Default: 0.5 (paper Section V-A).
    pub dropout: f64,
    /// Floor under predicted log-variances. Default: 12 nats below the mean.
    pub min_log_variance: MinLogVariance,
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            width: 512,
            height: 160,
            pair: ImagePair::default(),
            input: InputBasis::default(),
            validity_mask: false,
            stereo: false,
            pose: PoseInput::default(),
            evidence: EvidenceInput::default(),
            network: ImageNetwork::default(),
            head: Head::default(),
            dropout: 0.5,
            min_log_variance: MinLogVariance::BelowMean(12.0),
        }
    }
}

/// Floor under predicted log-variances. With error-free measurements in training the loss has no
/// lower bound without one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MinLogVariance {
    /// No floor (the paper).
    Off,
    /// This many nats below the training set's ln(mean e²), for each component.
    BelowMean(f64),
    /// These values, ln m² and ln rad².
    Absolute([f64; 6]),
}

fn camera_of_the_manifest() -> MeasurementFrame {
    MeasurementFrame::Camera2
}

fn default_checkpoints() -> PathBuf {
    "checkpoints".into()
}

fn default_device() -> String {
    "auto".to_owned()
}

fn default_validation_fraction() -> f64 {
    0.1
}

fn default_max_bad_fraction() -> f64 {
    0.01
}

fn default_cache_mb() -> usize {
    256
}

fn default_camera_height_m() -> f64 {
    1.65
}

fn default_max_depth_m() -> f64 {
    80.0
}

fn default_fill_radius_px() -> usize {
    12
}
