//! The ways in which recordings lie on disk.

use serde::{Deserialize, Serialize};

/// How a recording lies on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// KITTI raw: `DATE/DRIVE/{image_02,image_03,velodyne_points,oxts}` and `DATE/calib_*.txt`.
    KittiRaw,
    /// KITTI odometry: `sequences/NN/{image_0..3,velodyne,calib.txt,times.txt}` and `poses/NN.txt`.
    KittiOdometry,
    /// TUM RGB-D: `rgb.txt`, `depth.txt` and `groundtruth.txt`.
    TumRgbd,
    /// EuRoC, or ASL: `mav0/{cam0,cam1,state_groundtruth_estimate0}`, each with `data.csv` and `sensor.yaml`.
    Euroc,
    /// A pairs manifest.
    Manifest,
}

impl Layout {
    /// Name as in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::KittiRaw => "kitti_raw",
            Self::KittiOdometry => "kitti_odometry",
            Self::TumRgbd => "tum_rgbd",
            Self::Euroc => "euroc",
            Self::Manifest => "manifest",
        }
    }

    /// Whether it says nothing of the camera, which must be known otherwise.
    pub(crate) fn takes_camera(self) -> bool {
        self == Self::TumRgbd
    }

    /// Whether it knows no vehicle, which is where the camera is unless it is told.
    pub(crate) fn takes_vehicle(self) -> bool {
        matches!(self, Self::TumRgbd | Self::KittiOdometry | Self::Manifest)
    }

    /// Whether trajectories of such recordings are in TUM's form, where nothing else is said.
    pub(crate) fn has_tum_trajectories(self) -> bool {
        matches!(self, Self::TumRgbd | Self::Euroc)
    }

    /// Where its images are, for messages.
    pub(super) fn images(self) -> &'static str {
        match self {
            Self::KittiRaw => "image_02/data and image_03/data",
            Self::KittiOdometry => "image_2 and image_3, or image_0 and image_1",
            Self::TumRgbd => "rgb.txt",
            Self::Euroc => "mav0/cam0 and mav0/cam1",
            Self::Manifest => "its manifest",
        }
    }

    /// Where the size of its images is told, for messages.
    pub(super) fn size(self) -> &'static str {
        match self {
            Self::KittiRaw => "in calib_cam_to_cam.txt (S_rect)",
            Self::Euroc => "in sensor.yaml (resolution)",
            Self::KittiOdometry | Self::TumRgbd | Self::Manifest => "the first of the sequence",
        }
    }

    /// What a right camera takes, for messages.
    pub(crate) fn right_camera(self) -> &'static str {
        match self {
            Self::KittiRaw => "its calib_cam_to_cam.txt needs S_rect_03 and P_rect_03 with the intrinsics of P_rect_02",
            Self::KittiOdometry => "its calib.txt needs P3 with the intrinsics of P2, or P1 with those of P0",
            Self::Euroc => "it needs mav0/cam1 with data.csv and sensor.yaml",
            Self::TumRgbd | Self::Manifest => "its layout knows none",
        }
    }

    /// Where the times of its frames are told, for messages.
    pub(crate) fn times(self) -> &'static str {
        match self {
            Self::KittiRaw => "image_02/timestamps.txt or oxts/timestamps.txt with a time a line",
            Self::KittiOdometry => "times.txt with a time a line",
            Self::TumRgbd => "rgb.txt",
            Self::Euroc => "mav0/cam0/data.csv",
            Self::Manifest => "the columns source_time and target_time in its manifest",
        }
    }
}
