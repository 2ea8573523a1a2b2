//! Configuration of the depth of target images.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::scale::{ScaleRule, ScaleScope};

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
    /// 16-bit PNG files, metres x 256, 0 = unknown; of the undistorted image, whose camera `relcov inspect` prints, where
    /// the recording's images are distorted.
    Files {
        /// Path below `data.root`, with `{date}`, `{drive}` and `{frame}` (ten digits).
        path: String,
    },
    /// The recording's own maps: TUM RGB-D's `depth.txt`, the column `depth` of a manifest (there `manifest` is another
    /// name of it).
    #[serde(alias = "manifest")]
    Recording {},
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

fn default_camera_height_m() -> f64 {
    1.65
}

fn default_max_depth_m() -> f64 {
    80.0
}

fn default_fill_radius_px() -> usize {
    12
}
