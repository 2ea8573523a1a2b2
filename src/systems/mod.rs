//! Where measured poses come from, and how systems are mixed into mini-batches.
//!
//! In: trajectory files (KITTI, TUM), CSV files of relative poses, or the truth itself. Out: for each
//! drive and system the measured `source_from_target` of frame pairs, with the body they describe.
//! Leaves pairing with images and truth to `data`.

mod measurements;
mod mixing;
mod relative;
mod sequences;
mod trajectory;

pub use measurements::{Measurements, load_measurements, load_true_poses};
pub use mixing::{BatchPlan, Mixer};
pub use relative::{RelativePose, format_relative_pose, parse_relative_poses, relative_pose_header};
pub use sequences::{OdometrySequence, odometry_sequence};
pub use trajectory::{Trajectory, parse_kitti_trajectory, parse_tum_trajectory};
