//! Configuration of the true poses and of the systems that measured.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::recordings::MeasurementFrame;

/// The true poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "source", rename_all = "snake_case", deny_unknown_fields)]
pub enum TruthConfig {
    /// What the recording brings with it (default): in KITTI raw its GNSS/INS packets (the paper's choice), in KITTI
    /// odometry `poses/NN.txt`, in TUM RGB-D `groundtruth.txt`, in EuRoC `state_groundtruth_estimate0`, of a manifest its
    /// columns `true_x` … `true_qw`, as the camera's.
    Recording {},
    /// The drive's GNSS/INS packets: KITTI raw's.
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
        Self::Recording {}
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

fn camera_of_the_manifest() -> MeasurementFrame {
    MeasurementFrame::Camera
}
