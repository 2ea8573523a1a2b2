//! EuRoC's `sensor.yaml`: where a sensor is on the body, and of a camera its lens.

use std::path::Path;

use nalgebra::{Matrix4, RowVector4};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_saphyr::Spanned;

use super::image::MOST_PIXELS;
use crate::error::{Error, Place, Result, shortened};
use crate::files::read_text;
use crate::geometry::{Lens, OWN_INTRINSICS, Pinhole, Pose};

/// Largest `|RᵀR − I|` of a rotation printed with six digits or more.
const ROTATION_TOLERANCE: f64 = 1e-4;
/// Sensors of a body are not farther apart, m.
const LARGEST_OFFSET_M: f64 = 50.0;

/// What a camera's file holds, for messages.
const EXPECTED_CAMERA: &str = "the calibration of a camera: T_BS, camera_model, intrinsics, distortion_model, distortion_coefficients and resolution";
/// What to do with other cameras, for messages.
const OTHERWISE: &str = "undistort the images of other cameras, and list them in a manifest";

/// A camera on a body.
pub(super) struct BodyCamera {
    pub(super) body_from_camera: Pose,
    pub(super) lens: Lens,
    /// The camera of its undistorted images.
    pub(super) rectified: Pinhole,
}

#[derive(Deserialize)]
struct CameraYaml {
    #[serde(rename = "T_BS")]
    body_from_sensor: Matrix,
    camera_model: Spanned<String>,
    intrinsics: Spanned<Vec<f64>>,
    distortion_model: Option<Spanned<String>>,
    distortion_coefficients: Option<Spanned<Vec<f64>>>,
    resolution: Spanned<Vec<usize>>,
}

#[derive(Deserialize)]
struct SensorYaml {
    #[serde(rename = "T_BS")]
    body_from_sensor: Option<Matrix>,
}

#[derive(Deserialize)]
struct Matrix {
    data: Spanned<Vec<f64>>,
}

/// Reads a camera's file.
///
/// # Errors
/// It cannot be read, is no YAML, or lacks a key; or it names the line: another camera or distortion model than pinhole
/// and radial-tangential, numbers that no camera has, or a pose that is no rigid motion.
pub(super) fn load_body_camera(path: &Path) -> Result<BodyCamera> {
    let yaml: CameraYaml = parse(path, EXPECTED_CAMERA)?;
    let malformed = |line: usize, found: String, expected: &str| {
        Error::malformed(path, Place::Line(line), found, expected.to_owned())
    };
    if yaml.camera_model.value != "pinhole" {
        let found = format!("camera_model {}", yaml.camera_model.value);
        return Err(malformed(line(&yaml.camera_model), found, &format!("pinhole; {OTHERWISE}")));
    }
    let resolution = &yaml.resolution;
    let sides = 2..=MOST_PIXELS as usize;
    let &[width, height] = resolution.value.as_slice() else {
        let found = format!("resolution of {} numbers", resolution.value.len());
        return Err(malformed(line(resolution), found, "[width, height], px"));
    };
    if !(sides.contains(&width) && sides.contains(&height)) {
        let expected = format!("[width, height], {} to {} px", sides.start(), sides.end());
        return Err(malformed(line(resolution), format!("resolution [{width}, {height}]"), &expected));
    }
    let intrinsics = &yaml.intrinsics;
    let camera = match intrinsics.value.as_slice() {
        &[fx, fy, cx, cy] => Pinhole { fx, fy, cx, cy, width, height },
        numbers => {
            let found = format!("intrinsics of {} numbers", numbers.len());
            return Err(malformed(line(intrinsics), found, "[fu, fv, cu, cv], px"));
        }
    };
    if !(camera.fx > 0.0 && camera.fy > 0.0 && camera.fx.is_finite() && camera.fy.is_finite()) {
        let found = format!("focal lengths {} and {}", camera.fx, camera.fy);
        return Err(malformed(line(intrinsics), found, "positive ones, px"));
    }
    camera.require_centre().map_err(|found| malformed(line(intrinsics), found, OWN_INTRINSICS))?;
    let lens = Lens { camera, distortion: distortion_of(&yaml, path)? };
    let rectified = lens.rectified().ok_or_else(|| {
        let line = yaml.distortion_coefficients.as_ref().map_or(1, line);
        let found = format!("a distortion {:?} by which different rays meet in one pixel", lens.distortion);
        malformed(line, found, "k1, k2, p1, p2 or k1, k2, p1, p2, k3 of such a camera")
    })?;
    Ok(BodyCamera { body_from_camera: pose_of(&yaml.body_from_sensor, path)?, lens, rectified })
}

/// Reads where any sensor is; what says nothing of it is where the body is.
///
/// # Errors
/// The file cannot be read, is no YAML, or its pose is no rigid motion.
pub(super) fn load_body_from_sensor(path: &Path) -> Result<Pose> {
    let yaml: SensorYaml = parse(path, "keys of a sensor, of which T_BS is its pose")?;
    yaml.body_from_sensor.map_or(Ok(Pose::identity()), |matrix| pose_of(&matrix, path))
}

fn parse<T: DeserializeOwned>(path: &Path, expected: &str) -> Result<T> {
    serde_saphyr::from_str(&read_text(path)?).map_err(|error| {
        let place = error.location().map_or(Place::Whole, |location| Place::Line(location.line() as usize));
        Error::malformed(path, place, shortened(&error.without_snippet().to_string()), expected)
    })
}

fn line<T>(value: &Spanned<T>) -> usize {
    value.referenced.line() as usize
}

/// `k1, k2, p1, p2, k3`; all zero without a distortion.
fn distortion_of(yaml: &CameraYaml, path: &Path) -> Result<[f64; 5]> {
    let model = yaml.distortion_model.as_ref();
    let model_line = model.map_or(1, line);
    let (coefficients, coefficients_line) = match &yaml.distortion_coefficients {
        Some(coefficients) => (coefficients.value.as_slice(), line(coefficients)),
        None => (&[][..], model_line),
    };
    let malformed =
        |line: usize, found: String, expected: &str| Error::malformed(path, Place::Line(line), found, expected);
    if !coefficients.iter().all(|value| value.is_finite()) {
        return Err(malformed(coefficients_line, format!("{coefficients:?}"), "finite coefficients"));
    }
    match model.map_or("none", |model| model.value.as_str()) {
        "radial-tangential" | "radtan" => {
            let mut distortion = [0.0; 5];
            if !matches!(coefficients.len(), 4 | 5) {
                let found = format!("distortion_coefficients of {} numbers", coefficients.len());
                return Err(malformed(coefficients_line, found, "[k1, k2, p1, p2] or [k1, k2, p1, p2, k3]"));
            }
            distortion.iter_mut().zip(coefficients).for_each(|(place, value)| *place = *value);
            Ok(distortion)
        }
        "none" if coefficients.iter().all(|value| *value == 0.0) => Ok([0.0; 5]),
        "none" => {
            let found = format!("distortion_coefficients {coefficients:?} of no distortion_model");
            Err(malformed(coefficients_line, found, "distortion_model: radial-tangential, or zeros"))
        }
        other => {
            let expected = format!("radial-tangential, radtan or none; {OTHERWISE}");
            Err(malformed(model_line, format!("distortion_model {other}"), &expected))
        }
    }
}

/// The pose by its 4x4 matrix, row by row.
fn pose_of(matrix: &Matrix, path: &Path) -> Result<Pose> {
    let numbers = &matrix.data;
    let malformed = |found: String| {
        let expected = "T_BS, a rigid motion: 16 numbers of a 4x4 matrix, row by row, the last row 0 0 0 1, metres";
        Error::malformed(path, Place::Line(line(numbers)), found, expected)
    };
    if numbers.value.len() != 16 {
        return Err(malformed(format!("{} numbers", numbers.value.len())));
    }
    let matrix = Matrix4::from_row_slice(&numbers.value);
    if matrix.row(3) != RowVector4::new(0.0, 0.0, 0.0, 1.0) {
        return Err(malformed(format!("the last row {:?}", &numbers.value[12..])));
    }
    let offset = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    if offset.norm().is_nan() || offset.norm() > LARGEST_OFFSET_M {
        return Err(malformed(format!("an offset of {:.1e} m", offset.norm())));
    }
    Pose::from_rounded_parts(matrix.fixed_view::<3, 3>(0, 0).into_owned(), offset, ROTATION_TOLERANCE)
        .map_err(|deviation| malformed(format!("|RᵀR − I| = {deviation:.1e}")))
}
