//! KITTI's calibration files: lines of `KEY: values`.

use std::collections::HashMap;
use std::path::PathBuf;

use nalgebra::{Matrix3, Matrix3x4, Vector3};

use crate::error::{Error, Place, Result};
use crate::files::{parse_numbers, read_text};
use crate::geometry::{Pinhole, Pose};

/// Largest `|RᵀR − I|` of a rotation printed with KITTI's seven digits.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// Sensors of a vehicle are not farther apart, m.
const LARGEST_OFFSET_M: f64 = 50.0;

/// A file of `KEY: values` lines.
pub(super) struct KeyedLines {
    path: PathBuf,
    lines: HashMap<String, (usize, String)>,
}

impl KeyedLines {
    pub(super) fn load(path: PathBuf) -> Result<Self> {
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

    /// Whether it has a key.
    pub(super) fn has(&self, key: &str) -> bool {
        self.lines.contains_key(key)
    }

    pub(super) fn numbers<const N: usize>(&self, key: &str) -> Result<[f64; N]> {
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

    /// A rectified camera of KITTI raw and where camera 0 is to it.
    pub(super) fn camera(&self, number: usize) -> Result<(Pinhole, Pose)> {
        let size: [f64; 2] = self.numbers(&format!("S_rect_0{number}"))?;
        self.projection(&format!("P_rect_0{number}"), size.map(|pixels| pixels as usize))
    }

    /// A camera of this size (width and height, px) by its 3x4 matrix `P = K [I | t]`, and where camera 0 is to it.
    pub(super) fn projection(&self, key: &str, size: [usize; 2]) -> Result<(Pinhole, Pose)> {
        let [fx, skew, cx, px, lower, fy, cy, py, zero, other, one, pz] = self.numbers::<12>(key)?;
        let is_projection = [skew, lower, zero, other] == [0.0; 4] && one == 1.0;
        let usable = fx > 0.0 && fy > 0.0 && is_projection && size.iter().all(|&pixels| pixels >= 2);
        if !usable {
            return Err(Error::malformed(
                &self.path,
                Place::Field(key.to_owned()),
                format!("rows ({fx} {skew} {cx}), ({lower} {fy} {cy}), ({zero} {other} {one}), size {size:?}"),
                "a pinhole camera without skew: rows (fx 0 cx), (0 fy cy), (0 0 1)",
            ));
        }
        let offset = self.near(key, Vector3::new((px - cx * pz) / fx, (py - cy * pz) / fy, pz))?;
        let [width, height] = size;
        let camera = Pinhole { fx, fy, cx, cy, width, height };
        Ok((camera, Pose { translation: offset, ..Pose::identity() }))
    }

    /// The right camera beside the left one, where it is there and has the same intrinsics; both as they are beside camera 0.
    pub(super) fn right_from_left(left: &(Pinhole, Pose), right: Option<(Pinhole, Pose)>) -> Option<Pose> {
        let (camera, left_from_camera0) = left;
        let (_, right_from_camera0) = right.filter(|(right, _)| right == camera)?;
        Some(right_from_camera0 * left_from_camera0.inverse())
    }

    /// Where a sensor is beside another, by its 3x4 matrix.
    pub(super) fn pose(&self, key: &str) -> Result<Pose> {
        let matrix = Matrix3x4::from_row_slice(&self.numbers::<12>(key)?);
        let offset = self.near(key, matrix.column(3).into())?;
        self.pose_of_parts(key, matrix.fixed_columns::<3>(0).into(), offset)
    }

    /// The same by its rotation alone.
    pub(super) fn rotation(&self, key: &str, translation: Vector3<f64>) -> Result<Pose> {
        self.pose_of_parts(key, Matrix3::from_row_slice(&self.numbers::<9>(key)?), translation)
    }

    /// The same by its offset alone, m.
    pub(super) fn offset(&self) -> Result<Vector3<f64>> {
        self.near("T", Vector3::from(self.numbers::<3>("T")?))
    }

    fn near(&self, key: &str, offset: Vector3<f64>) -> Result<Vector3<f64>> {
        let found = format!("`{key}` with an offset of {:.1e} m", offset.norm());
        match offset.norm() <= LARGEST_OFFSET_M {
            true => Ok(offset),
            false => Err(self.malformed(key, found, "metres between sensors of a vehicle")),
        }
    }

    fn pose_of_parts(&self, key: &str, rotation: Matrix3<f64>, offset: Vector3<f64>) -> Result<Pose> {
        Pose::from_rounded_parts(rotation, offset, ROTATION_TOLERANCE).map_err(|deviation| {
            self.malformed(key, format!("`{key}` with |RᵀR − I| = {deviation:.1e}"), "a rotation matrix")
        })
    }

    fn malformed(&self, key: &str, found: String, expected: &str) -> Error {
        Error::malformed(&self.path, Place::Line(self.lines[key].0), found, expected)
    }
}
