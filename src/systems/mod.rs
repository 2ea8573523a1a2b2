//! Where measured poses come from, and how systems are mixed into mini-batches.
//!
//! In: trajectory files (KITTI, TUM), CSV files of relative poses, a pairs manifest, or the truth itself. Out: for each
//! drive and system the measured `source_from_target` of frame pairs, with the body they describe.
//! Leaves pairing with images and truth to `data`.

mod chain;
mod frames;
mod measurements;
mod mixing;
mod perturbation;
mod relative;
mod sequences;
mod trajectory;
mod truth;

pub use chain::chain_poses;
pub(crate) use frames::{Joined, frames_of_rows};
pub(crate) use measurements::measurement_file;
pub use measurements::{Measurements, load_measurements};
pub use mixing::{BatchPlan, Mixer, PlannedPair};
pub use perturbation::Perturbation;
pub(crate) use perturbation::standard_normal;
pub(crate) use relative::{LARGEST_MOTION_M, Side, Statement, parse_bare_relative_poses};
pub use relative::{RelativePose, format_relative_pose, parse_relative_poses, relative_pose_header};
pub use sequences::{OdometrySequence, odometry_sequence};
pub(crate) use trajectory::{KittiPoses, parse_kitti_poses, pose_from_quaternion};
pub use trajectory::{Trajectory, parse_kitti_trajectory, parse_tum_trajectory};
pub use truth::Truth;
