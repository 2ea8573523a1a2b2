//! KITTI's calibration files: lines of `KEY: values`.

use std::collections::HashMap;
use std::path::PathBuf;

use nalgebra::{Matrix3, Vector3};

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

    /// A rectified camera and where camera 0 is to it.
    pub(super) fn camera(&self, number: usize) -> Result<(Pinhole, Pose)> {
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
    pub(super) fn offset(&self) -> Result<Vector3<f64>> {
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

    pub(super) fn rotation(&self, key: &str, translation: Vector3<f64>) -> Result<Pose> {
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
