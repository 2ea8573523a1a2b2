//! Measured motions with their covariances in the forms that other programs read.
//!
//! In: [`MeasuredMotions`], one system's relative poses on one drive with covariances of the left perturbation, order ρ
//! then φ, all in one set of axes. Out: text, each format with its own order, side and units:
//!
//! | [`Format`] | a line is | covariance |
//! |---|---|---|
//! | `csv` | a relative pose: `source,target,x,y,z,qx,qy,qz,qw` and 36 values | ρ, φ; left or right |
//! | `jsonl` | the same with its names, as a JSON object | ρ, φ; left or right |
//! | `tum`, `kitti` | an absolute pose of the chained trajectory, and 36 values | ρ, φ; left or right |
//! | `g2o` | `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT` | 21 information values, t then q, right |
//! | `gtsam` | a `BetweenFactorPose3`: keys, pose and 36 values | **φ, ρ**, right |
//! | `ros` | a `geometry_msgs/PoseWithCovarianceStamped` as JSON (which is YAML) | position, then fixed axes |
//!
//! Each of them writes the measurements as they are, or corrected by what the images show of their errors ([`Poses`]).
//! Leaves the choice of axes to its caller and writing files to `cli`.

mod chain;
mod csv;
mod format;
mod g2o;
mod gtsam;
mod jsonl;
mod motion;
mod numbers;
mod options;
mod perturbation;
mod ros;
#[cfg(test)]
mod tests;
mod trajectory;

pub use chain::Chain;
pub use format::Format;
pub(crate) use jsonl::{JsonJudgement, JsonPose};
pub use motion::{MeasuredMotion, MeasuredMotions, Verdict};
pub use options::{ExportOptions, G2oRotation, Poses, ROS_FLOOR, TrajectoryCovariance};
pub use perturbation::Perturbation;
pub use trajectory::fused_trajectory;
