//! The car's sensors, placed as KITTI's are: two colour cameras, a LiDAR, a GNSS/INS unit; and the
//! calibration files that describe them.

use std::path::Path;

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use crate::error::Result;
use crate::files::write_atomically;
use crate::geometry::{Pinhole, Pose};
use crate::recordings::{Calibration, load_kitti_calibration};

/// Focal length in image widths, and principal point in image widths and heights: near KITTI's.
const FOCAL: f64 = 0.577;
const PRINCIPAL_POINT: [f64; 2] = [0.491, 0.495];
/// Where the colour cameras look from, m to the right of the rectified rig's origin.
const CAMERA_2_M: f64 = -0.0663;
const CAMERA_3_M: f64 = 0.4716;

/// All sensors.
#[derive(Clone, Debug)]
pub(super) struct Rig {
    /// As a reader of the files sees it.
    pub calibration: Calibration,
}

impl Rig {
    /// Writes the calibration files of a date and reads them back: what is rendered is what they say.
    ///
    /// # Errors
    /// They cannot be written.
    pub(super) fn install(date_folder: &Path, size: [usize; 2]) -> Result<Self> {
        for (name, text) in calibration_files(size) {
            write_atomically(&date_folder.join(name), text.as_bytes())?;
        }
        Ok(Self { calibration: load_kitti_calibration(date_folder)? })
    }

    pub(super) fn camera(&self) -> Pinhole {
        self.calibration.camera
    }

    pub(super) fn vehicle_from_camera(&self) -> Pose {
        self.calibration.camera_from_vehicle.inverse()
    }

    /// The right camera, which looks in the same direction.
    pub(super) fn camera2_from_camera3(&self) -> Pose {
        Pose { translation: Vector3::new(CAMERA_3_M - CAMERA_2_M, 0.0, 0.0), ..Pose::identity() }
    }

    pub(super) fn vehicle_from_velodyne(&self) -> Pose {
        self.vehicle_from_camera() * self.calibration.camera_from_velodyne
    }
}

/// Distance between the colour cameras, m.
pub(super) fn baseline_m() -> f64 {
    CAMERA_3_M - CAMERA_2_M
}

fn calibration_files([width, height]: [usize; 2]) -> [(&'static str, String); 3] {
    let focal = FOCAL * width as f64;
    let [cx, cy] = [PRINCIPAL_POINT[0] * width as f64, PRINCIPAL_POINT[1] * height as f64];
    let mut cameras = "calib_time: 01-Jan-2026 00:00:00\ncorner_dist: 0.0\n".to_owned();
    for (camera, right_m) in [(0, 0.0), (1, 0.5372), (2, CAMERA_2_M), (3, CAMERA_3_M)] {
        // Of the cameras only the first one's rectifying rotation is used.
        let rectification = if camera == 0 { near_identity([1.1e-3, -2.3e-3, 0.9e-3]) } else { Matrix3::identity() };
        let projection = [focal, 0.0, cx, -focal * right_m, 0.0, focal, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
        cameras += &format!("S_rect_0{camera}: {width} {height}\n");
        cameras += &format!("R_rect_0{camera}: {}\n", numbers(rectification.transpose().iter()));
        cameras += &format!("P_rect_0{camera}: {}\n", numbers(projection.iter()));
    }
    // Camera x right, y down, z forward; velodyne and IMU x forward, y left, z up.
    let axes = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let camera_from_velodyne = axes * near_identity([2.1e-3, -1.3e-3, 3.7e-3]);
    let velodyne_from_imu = near_identity([0.4e-3, 1.0e-3, -3.9e-3]);
    let rigid = |rotation: Matrix3<f64>, translation: [f64; 3]| {
        let (rotation, translation) = (numbers(rotation.transpose().iter()), numbers(translation.iter()));
        format!("calib_time: 01-Jan-2026 00:00:00\nR: {rotation}\nT: {translation}\n")
    };
    [
        ("calib_cam_to_cam.txt", cameras),
        ("calib_velo_to_cam.txt", rigid(camera_from_velodyne, [-0.0042, -0.0721, -0.3015])),
        ("calib_imu_to_velo.txt", rigid(velodyne_from_imu, [-0.8093, 0.3186, -0.7987])),
    ]
}

/// A small rotation by the vector part of its quaternion: sums, products and roots only.
fn near_identity([x, y, z]: [f64; 3]) -> Matrix3<f64> {
    let rotation: Rotation3<f64> = UnitQuaternion::from_quaternion(Quaternion::new(1.0, x, y, z)).to_rotation_matrix();
    rotation.into_inner()
}

fn numbers<'a>(values: impl Iterator<Item = &'a f64>) -> String {
    values.map(|value| format!("{value:.12e}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readers_see_a_rig_like_kittis() {
        let folder = tempfile::tempdir().unwrap();
        let rig = Rig::install(folder.path(), [512, 160]).unwrap();
        assert_eq!((rig.camera().width, rig.camera().height), (512, 160));
        let vehicle_from_camera = rig.vehicle_from_camera();
        // The camera looks forward from in front of the IMU, left of it, and about .72 m above.
        let forward = vehicle_from_camera.rotation * Vector3::z();
        assert!((forward - Vector3::x()).norm() < 0.02);
        let place = vehicle_from_camera.translation;
        assert!((place - Vector3::new(1.08, -0.26, 0.72)).norm() < 0.1, "{place}");
        let right = rig.camera2_from_camera3().translation;
        assert!((right.x - baseline_m()).abs() < 1e-12);
    }
}
