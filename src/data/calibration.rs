//! KITTI raw calibration: `calib_cam_to_cam.txt`, `calib_velo_to_cam.txt`, `calib_imu_to_velo.txt`.
//!
//! Only the rectified keys are needed; dates and the keys of unrectified images are passed over.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use crate::config::MeasurementFrame;
use crate::error::{Error, Place, Result};
use crate::files::{parse_numbers, read_text};
use crate::geometry::{ErrorFrame, Pinhole, Pose};

/// Largest `|RᵀR − I|` of a rotation printed with KITTI's seven digits.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// Sensors of a vehicle are not farther apart, m.
const LARGEST_OFFSET_M: f64 = 50.0;

/// Sensors of one recording day: the colour camera and where everything is relative to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// The left colour camera (rectified, full size).
    pub camera2: Pinhole,
    /// Offset of camera 2 in the rectified rig.
    pub camera2_from_camera0: Pose,
    /// LiDAR points into camera 2.
    pub camera2_from_velodyne: Pose,
    /// Vehicle (IMU) axes into camera 2.
    pub camera2_from_vehicle: Pose,
    /// The left colour camera's points into the right one's; `None` without a camera 3 of the same intrinsics.
    pub camera3_from_camera2: Option<Pose>,
}

impl Calibration {
    /// The files of a date folder.
    pub(super) const FILES: [&str; 3] = ["calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"];

    /// Reads the three files of a date folder.
    ///
    /// # Errors
    /// A file or key is missing, a line is short or not numeric, or a matrix is not a rotation.
    pub fn load(date_folder: &Path) -> Result<Self> {
        let [cameras, velodyne, imu] = Self::FILES.map(|name| KeyedLines::load(date_folder.join(name)));
        let (cameras, velodyne, imu) = (cameras?, velodyne?, imu?);

        let (camera2, camera2_from_camera0) = cameras.camera(2)?;
        let right = cameras.lines.contains_key("P_rect_03").then(|| cameras.camera(3)).transpose()?;
        let camera3_from_camera2 = right
            .filter(|(camera3, _)| *camera3 == camera2)
            .map(|(_, camera3_from_camera0)| camera3_from_camera0 * camera2_from_camera0.inverse());
        let rectification = cameras.rotation("R_rect_00", Vector3::zeros())?;
        let camera_from_velodyne = velodyne.rotation("R", velodyne.offset()?)?;
        let velodyne_from_imu = imu.rotation("R", imu.offset()?)?;
        let camera2_from_velodyne = camera2_from_camera0 * rectification * camera_from_velodyne;
        Ok(Self {
            camera2,
            camera2_from_camera0,
            camera2_from_velodyne,
            camera2_from_vehicle: camera2_from_velodyne * velodyne_from_imu,
            camera3_from_camera2,
        })
    }

    /// Vehicle axes into those of `frame`; the world's need the vehicle's pose in it.
    pub fn axes_from_vehicle(&self, frame: ErrorFrame, world_from_vehicle: Option<&Pose>) -> Option<Pose> {
        match frame {
            ErrorFrame::Vehicle => Some(Pose::identity()),
            ErrorFrame::Camera => Some(self.camera2_from_vehicle),
            ErrorFrame::World => Some(Pose { translation: Vector3::zeros(), ..*world_from_vehicle? }),
        }
    }

    /// Axes of a measurement into camera 2.
    pub fn camera2_from(&self, frame: MeasurementFrame) -> Pose {
        match frame {
            MeasurementFrame::Camera0 => self.camera2_from_camera0,
            MeasurementFrame::Camera2 => Pose::identity(),
            MeasurementFrame::Vehicle => self.camera2_from_vehicle,
        }
    }
}

/// A file of `KEY: values` lines.
struct KeyedLines {
    path: PathBuf,
    lines: HashMap<String, (usize, String)>,
}

impl KeyedLines {
    fn load(path: PathBuf) -> Result<Self> {
        let text = read_text(&path)?;
        let mut lines: HashMap<String, (usize, String)> = HashMap::new();
        for (index, line) in text.lines().enumerate() {
            let Some((key, values)) = line.split_once(':') else { continue };
            let twin = lines.insert(key.trim().to_owned(), (index + 1, values.to_owned()));
            if let Some((first, _)) = twin {
                let found = format!("`{}` again, first on line {first}", key.trim());
                return Err(Error::malformed(path, Place::Line(index + 1), found, "each key once"));
            }
        }
        Ok(Self { path, lines })
    }

    fn numbers<const N: usize>(&self, key: &str) -> Result<[f64; N]> {
        let Some((line, values)) = self.lines.get(key) else {
            return Err(Error::malformed(
                &self.path,
                Place::Field(key.to_owned()),
                "no such line",
                format!("`{key}:` with {N} numbers"),
            ));
        };
        let place = Place::Line(*line);
        let numbers = parse_numbers(values, &self.path, &place)?;
        let count = numbers.len();
        numbers.try_into().map_err(|_| {
            Error::malformed(&self.path, place, format!("`{key}` with {count} numbers"), format!("{N} numbers"))
        })
    }

    /// A rectified camera and where camera 0 is to it.
    fn camera(&self, number: usize) -> Result<(Pinhole, Pose)> {
        let size: [f64; 2] = self.numbers(&format!("S_rect_0{number}"))?;
        let key = format!("P_rect_0{number}");
        let [fx, skew, cx, px, _, fy, cy, py, _, _, _, pz] = self.numbers::<12>(&key)?;
        let usable = fx > 0.0 && fy > 0.0 && skew == 0.0 && size.iter().all(|&pixels| pixels >= 2.0);
        if !usable {
            return Err(Error::malformed(
                &self.path,
                Place::Field(key),
                format!("fx {fx}, fy {fy}, skew {skew}, size {size:?}"),
                "a pinhole camera without skew",
            ));
        }
        // P = K [I | t]
        let offset = Vector3::new((px - cx * pz) / fx, (py - cy * pz) / fy, pz);
        let camera = Pinhole { fx, fy, cx, cy, width: size[0] as usize, height: size[1] as usize };
        Ok((camera, Pose { translation: offset, ..Pose::identity() }))
    }

    /// Where a sensor is beside another, m.
    fn offset(&self) -> Result<Vector3<f64>> {
        let offset = Vector3::from(self.numbers::<3>("T")?);
        match offset.norm() <= LARGEST_OFFSET_M {
            true => Ok(offset),
            false => {
                let found = format!("an offset of {:.1e} m", offset.norm());
                Err(Error::malformed(
                    &self.path,
                    Place::Field("T".to_owned()),
                    found,
                    "metres between sensors of a vehicle",
                ))
            }
        }
    }

    fn rotation(&self, key: &str, translation: Vector3<f64>) -> Result<Pose> {
        let matrix = Matrix3::from_row_slice(&self.numbers::<9>(key)?);
        Pose::from_rounded_parts(matrix, translation, ROTATION_TOLERANCE).map_err(|deviation| {
            let place = Place::Line(self.lines[key].0);
            Error::malformed(
                &self.path,
                place,
                format!("`{key}` with |RᵀR − I| = {deviation:.1e}"),
                "a rotation matrix",
            )
        })
    }
}
