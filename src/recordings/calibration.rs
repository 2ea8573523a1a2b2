//! Where the sensors of a recording are to each other, and its camera.

use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::{ErrorFrame, Pinhole, Pose};

/// The body whose motion a measurement describes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MeasurementFrame {
    /// Rectified left grey camera: KITTI odometry, most visual odometries on KITTI.
    #[default]
    Camera0,
    /// The camera whose images are used: in KITTI the left colour camera.
    #[serde(rename = "camera2", alias = "camera")]
    Camera,
    /// The vehicle: KITTI's IMU, x forward, y left, z up.
    Vehicle,
}

/// The camera whose images are used, and where everything is relative to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// That camera (rectified, full size): in KITTI the left colour camera.
    pub camera: Pinhole,
    /// Offset of that camera in the rectified rig.
    pub camera_from_camera0: Pose,
    /// LiDAR points into it.
    pub camera_from_velodyne: Pose,
    /// Vehicle (IMU) axes into it.
    pub camera_from_vehicle: Pose,
    /// Its points into the right camera; `None` without one of the same intrinsics.
    pub right_from_left: Option<Pose>,
}

impl Calibration {
    /// A camera without other sensors; the vehicle is where it is, x forward, y left, z up, unless its axes are told.
    pub(super) fn of_camera(camera: Pinhole, camera_from_vehicle: Option<&Pose>) -> Self {
        let camera_from_vehicle = camera_from_vehicle.copied().unwrap_or_else(camera_axes_from_vehicle);
        Self {
            camera,
            camera_from_camera0: Pose::identity(),
            camera_from_velodyne: camera_from_vehicle,
            camera_from_vehicle,
            right_from_left: None,
        }
    }

    /// Vehicle axes into those of `frame`; the world's need the vehicle's pose in it.
    pub fn axes_from_vehicle(&self, frame: ErrorFrame, world_from_vehicle: Option<&Pose>) -> Option<Pose> {
        match frame {
            ErrorFrame::Vehicle => Some(Pose::identity()),
            ErrorFrame::Camera => Some(self.camera_from_vehicle),
            ErrorFrame::World => Some(Pose { translation: Vector3::zeros(), ..*world_from_vehicle? }),
        }
    }

    /// Axes of a measurement into those of the camera.
    pub fn camera_from(&self, frame: MeasurementFrame) -> Pose {
        match frame {
            MeasurementFrame::Camera0 => self.camera_from_camera0,
            MeasurementFrame::Camera => Pose::identity(),
            MeasurementFrame::Vehicle => self.camera_from_vehicle,
        }
    }
}

/// Axes of a vehicle (x forward, y left, z up) at the camera's own place into those of the camera.
pub fn camera_axes_from_vehicle() -> Pose {
    let rotation = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    Pose::new(Rotation3::from_matrix_unchecked(rotation), Vector3::zeros())
}
