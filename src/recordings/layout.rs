//! The ways in which recordings lie on disk.

use serde::{Deserialize, Serialize};

/// How a recording lies on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// KITTI raw: `DATE/DRIVE/{image_02,image_03,velodyne_points,oxts}` and `DATE/calib_*.txt`.
    KittiRaw,
    /// A pairs manifest.
    Manifest,
}

impl Layout {
    /// Where its images are, for messages.
    pub(super) fn images(self) -> &'static str {
        match self {
            Self::KittiRaw => "image_02/data and image_03/data",
            Self::Manifest => "its manifest",
        }
    }

    /// Where the size of its images is told, for messages.
    pub(super) fn size(self) -> &'static str {
        match self {
            Self::KittiRaw => "in calib_cam_to_cam.txt (S_rect)",
            Self::Manifest => "the first of the sequence",
        }
    }

    /// Where the times of its frames are told, for messages.
    pub(crate) fn times(self) -> &'static str {
        match self {
            Self::KittiRaw => "image_02/timestamps.txt or oxts/timestamps.txt with a time a line",
            Self::Manifest => "the columns source_time and target_time in its manifest",
        }
    }
}
