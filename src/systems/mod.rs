//! Where measured poses come from, and how systems are mixed into mini-batches.
//!
//! In: trajectory files (KITTI, TUM), CSV files of relative poses, a pairs manifest, or the truth itself. Out: for each
//! drive and system the measured `source_from_target` of frame pairs, with the body they describe.
//! Leaves what lies on disk to `recordings`, and pairing with images and truth to `pairs`.

mod chain;
mod files;
mod frames;
mod measurements;
mod mixing;
mod motions;
mod perturbation;
mod relative;
mod sequences;
mod settings;
mod truth;

pub use chain::chain_poses;
pub(crate) use files::{measurement_file, truth_file};
pub(crate) use frames::{Joined, frames_of_rows};

pub use measurements::{Measurements, load_measurements};
pub use mixing::{BatchPlan, Mixer, PlannedPair};
pub use perturbation::Perturbation;
pub(crate) use perturbation::standard_normal;
pub use relative::{RelativePose, format_relative_pose, parse_relative_poses, relative_pose_header};
pub(crate) use relative::{Side, Statement, parse_bare_relative_poses};
pub use sequences::{OdometrySequence, odometry_sequence};
pub use settings::{
    PerturbationConfig, RelativeConfig, SystemConfig, SystemSource, TrajectoryConfig, TrajectoryFormat, TruthConfig,
};
pub use truth::Truth;
