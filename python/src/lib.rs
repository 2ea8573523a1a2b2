//! The native half of the Python package `relcov`: bytes and numbers in, numbers out. `relcov/__init__.py` gives it its
//! face, in numpy arrays.

use std::path::PathBuf;

use nalgebra::{Matrix3, Vector3};
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use relcov::data::RgbImage;
use relcov::depth::{DepthMap, LiveDepth};
use relcov::geometry::{Pinhole, Pose};
use relcov::{Error, Measurement, RightView};

/// Largest `|RᵀR − I|` of a rotation.
const ROTATION_TOLERANCE: f64 = 1e-3;

fn to_python(error: Error) -> PyErr {
    let text = error.to_string();
    match error {
        Error::Io { .. } => PyOSError::new_err(text),
        Error::Device { .. } | Error::Training(_) => PyRuntimeError::new_err(text),
        _ => PyValueError::new_err(text),
    }
}

/// A trained model and what makes depth where none is given.
#[pyclass(frozen, module = "relcov._relcov")]
struct NativeModel {
    model: relcov::Model,
    depth: LiveDepth,
}

/// Height, width and `3 * height * width` bytes.
type Image<'a> = (usize, usize, &'a [u8]);
/// Height, width and little-endian f32.
type Depth<'a> = (usize, usize, &'a [u8]);

fn image((height, width, bytes): Image) -> RgbImage {
    RgbImage { width, height, bytes: bytes.to_vec() }
}

/// A pose of 16 numbers, row by row.
fn pose(name: &str, rows: [f64; 16]) -> PyResult<Pose> {
    let rotation = Matrix3::from_fn(|row, column| rows[4 * row + column]);
    let translation = Vector3::new(rows[3], rows[7], rows[11]);
    Pose::from_rounded_parts(rotation, translation, ROTATION_TOLERANCE).map_err(|deviation| {
        PyValueError::new_err(format!(
            "{name}: its upper left 3x3 block is no rotation matrix: |RᵀR − I| = {deviation:.1e}"
        ))
    })
}

#[pymethods]
impl NativeModel {
    #[new]
    fn new(py: Python<'_>, path: PathBuf, device: &str) -> PyResult<Self> {
        py.detach(|| {
            let device = relcov::device::open_device(device)?;
            let model = relcov::Model::load(path, &device)?;
            let depth = model.live_depth();
            Ok(Self { model, depth })
        })
        .map_err(to_python)
    }

    /// Axes of the covariances: vehicle, camera or world.
    #[getter]
    fn frame(&self) -> &'static str {
        self.model.error_frame().name()
    }

    /// Height and width of the network's input, px.
    #[getter]
    fn size(&self) -> (usize, usize) {
        let architecture = self.model.architecture();
        (architecture.height, architecture.width)
    }

    /// Whether it looks at the right camera too.
    #[getter]
    fn stereo(&self) -> bool {
        self.model.architecture().stereo
    }

    /// Rows of the covariance.
    #[allow(clippy::too_many_arguments, reason = "what the Python side hands over")]
    fn predict(
        &self,
        py: Python<'_>,
        source_image: Image,
        target_image: Image,
        intrinsics: [f64; 4],
        source_from_target: [f64; 16],
        depth: Option<Depth>,
        right_images: Option<(Image, Image)>,
        right_from_left: Option<[f64; 16]>,
    ) -> PyResult<Vec<Vec<f64>>> {
        let (height, width) = (target_image.0, target_image.1);
        let [fx, fy, cx, cy] = intrinsics;
        let camera = Pinhole { fx, fy, cx, cy, width, height };
        let source_from_target = pose("T", source_from_target)?;
        let (source_image, target_image) = (image(source_image), image(target_image));
        let right = match (right_images, right_from_left) {
            (Some((source, target)), Some(rows)) => Some(RightView {
                source_image: image(source),
                target_image: image(target),
                right_from_left: pose("right[2]", rows)?,
            }),
            _ => None,
        };
        let given = depth.map(|(height, width, bytes)| {
            let depth_m = bytes.chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().expect("four bytes")));
            DepthMap { width, height, depth_m: depth_m.collect() }
        });
        let predict = || {
            let target_depth = match given {
                Some(depth) => depth,
                None => self.depth.estimate(&target_image, &camera)?,
            };
            let measurement =
                Measurement { source_image, target_image, target_depth, camera, source_from_target, right };
            self.model.predict(&measurement)
        };
        let covariance = py.detach(predict).map_err(to_python)?;
        Ok(covariance.matrix().row_iter().map(|row| row.iter().copied().collect()).collect())
    }
}

#[pymodule]
fn _relcov(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<NativeModel>()
}
