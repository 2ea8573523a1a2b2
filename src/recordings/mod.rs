//! What lies on disk: one file a layout, all giving one [`Recording`]: frames with their times, images, camera and right
//! camera, scans and depth maps, the poses that a recording brings with it, and where its sensors are to each other.
//!
//! Leaves to others: who measured (`systems`), depth that is made (`depth`), which frames make pairs (`pairs`).

mod association;
mod calibration;
mod euroc;
mod frames;
mod image;
mod keyed_lines;
mod kitti_odometry;
mod kitti_raw;
mod layout;
mod locate;
mod manifest;
mod manifest_row;
mod open;
mod oxts;
mod recording;
mod sensor_yaml;
mod settings;
mod time_list;
mod times;
mod trajectory;
mod tum_rgbd;
mod undistortion;

pub(crate) use self::image::decode;
pub use self::image::{RgbImage, decode_image, read_image};
pub(crate) use association::LARGEST_DISTANCE_S;
pub use calibration::{Calibration, MeasurementFrame, camera_axes_from_vehicle};
pub use euroc::load_euroc;
pub use kitti_odometry::load_kitti_odometry;
pub use kitti_raw::{load_kitti_calibration, load_kitti_raw};
pub use layout::Layout;
pub(crate) use locate::locate_recording;
pub use manifest::Manifest;
pub(crate) use manifest_row::{ManifestCamera, ManifestRow, format_manifest_row, manifest_header};
pub use open::{Opening, open_recording};
pub(crate) use oxts::EARTH_RADIUS_M;
pub use oxts::{OxtsPacket, world_from_vehicle};
pub(crate) use recording::KITTI_STEPS_PER_METRE;
pub use recording::{FrameFiles, Listed, Motions, Recording};
pub use settings::CameraConfig;
pub(crate) use trajectory::{KittiPoses, LARGEST_MOTION_M, parse_kitti_poses, pose_from_quaternion, stated_axes};
pub use trajectory::{Trajectory, parse_kitti_trajectory, parse_tum_trajectory};
pub(crate) use tum_rgbd::is_known_camera;
pub use tum_rgbd::load_tum_rgbd;
pub use undistortion::Undistortion;

/// Environment variable that overrides `data.root`.
pub const DATA_ROOT_VARIABLE: &str = "RELCOV_DATA_ROOT";
