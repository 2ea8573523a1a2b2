//! A procedural street world in the KITTI raw layout, with systems whose error covariance is known.
//!
//! In: [`SyntheticSettings`], a seed among them. Out: a data set that the readers of `data` take for a
//! recorded one: colour stereo, LiDAR, GNSS/INS packets, calibration, depth, and for each system a CSV
//! of relative poses with their true covariances. Rendered by ray casting on the CPU; the same
//! settings give the same bytes on any machine and any number of threads, which is why everything that
//! reaches a file is computed with `libm` and not with the platform's functions.
//! Knows nothing of networks and training.

mod folder;
mod least_squares;
mod motion;
mod odometry;
mod packets;
mod random;
mod recording;
mod rig;
mod road;
mod scene;
mod sensors;
mod settings;
mod shading;
mod street;
mod surface;
mod systems;
mod texture;
mod world;

pub use folder::{Replace, drive_name, is_rendered, is_synthetic};
pub(crate) use random::{Purpose, Random};
pub use recording::{RecordingProgress, record};
pub use settings::SyntheticSettings;
pub use systems::SYSTEMS;
