//! The native half of the Python package `relcov`: bytes and numbers in, numbers out. `relcov/__init__.py` gives it its
//! face, in numpy arrays.

use std::ffi::OsString;
use std::path::PathBuf;

use nalgebra::{Matrix3, SMatrix, Vector3};
use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use relcov::depth::{DepthMap, LiveDepth};
use relcov::geometry::{Pinhole, Pose};
use relcov::recordings::RgbImage;
use relcov::{Error, Judgement, Measurement, RightView};

/// As the program's: training frees and takes the same large buffers in every step.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

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

/// What a model says of a measurement; matrices as rows.
#[pyclass(frozen, get_all, module = "relcov._relcov")]
struct NativeJudgement {
    covariance: Vec<Vec<f64>>,
    correction: Option<Vec<f64>>,
    corrected_pose: Option<Vec<Vec<f64>>>,
    corrected_covariance: Option<Vec<Vec<f64>>>,
    verdict: Option<&'static str>,
    reason: Option<&'static str>,
    evidence: Option<Py<NativeEvidence>>,
}

/// What direct alignment found at the finest level of its pyramid.
#[pyclass(frozen, get_all, module = "relcov._relcov")]
struct NativeEvidence {
    estimate: Vec<f64>,
    information: Vec<Vec<f64>>,
    residual_before: f64,
    residual_after: f64,
    valid_share: f64,
    gain: f64,
    bias: f64,
}

impl NativeJudgement {
    fn new(py: Python<'_>, judgement: &Judgement) -> PyResult<Self> {
        let evidence = judgement.evidence.as_ref().map(|evidence| {
            let finest = evidence.finest();
            let evidence = NativeEvidence {
                estimate: finest.error.iter().copied().collect(),
                information: rows(&finest.information),
                residual_before: finest.residual_before,
                residual_after: finest.residual_after,
                valid_share: finest.valid_share,
                gain: evidence.gain,
                bias: evidence.bias,
            };
            Py::new(py, evidence)
        });
        let verdict = judgement.verdict();
        Ok(Self {
            covariance: rows(judgement.covariance.matrix()),
            correction: judgement.posterior.map(|posterior| posterior.mean.iter().copied().collect()),
            corrected_pose: judgement.corrected_source_from_target.map(|pose| rows(&pose.matrix())),
            corrected_covariance: judgement.posterior.map(|posterior| rows(posterior.covariance.matrix())),
            verdict: verdict.map(|verdict| verdict.name()),
            reason: verdict.and_then(|verdict| verdict.reason()),
            evidence: evidence.transpose()?,
        })
    }
}

fn rows<const N: usize>(matrix: &SMatrix<f64, N, N>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
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

    /// All that the model says of a measurement.
    #[allow(clippy::too_many_arguments, reason = "what the Python side hands over")]
    fn judge(
        &self,
        py: Python<'_>,
        source_image: Image,
        target_image: Image,
        intrinsics: [f64; 4],
        source_from_target: [f64; 16],
        depth: Option<Depth>,
        right_images: Option<(Image, Image)>,
        right_from_left: Option<[f64; 16]>,
        camera_from_vehicle: Option<[f64; 16]>,
    ) -> PyResult<NativeJudgement> {
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
        let camera_from_vehicle = camera_from_vehicle.map(|rows| pose("camera_from_vehicle", rows)).transpose()?;
        let given = depth.map(|(height, width, bytes)| {
            let depth_m = bytes.chunks_exact(4).map(|four| f32::from_le_bytes(four.try_into().expect("four bytes")));
            DepthMap { width, height, depth_m: depth_m.collect() }
        });
        let judge = || {
            let target_depth = match given {
                Some(depth) => depth,
                None => self.depth.estimate(&target_image, &camera)?,
            };
            self.model.judge(&Measurement {
                source_image,
                target_image,
                target_depth,
                camera,
                source_from_target,
                right,
                camera_from_vehicle,
            })
        };
        let judgement = py.detach(judge).map_err(to_python)?;
        NativeJudgement::new(py, &judgement)
    }
}

/// The command line: its arguments, the first being its name; returns its exit code.
#[pyfunction]
fn run_command(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
    py.detach(|| relcov::cli::run_with(arguments))
}

#[pymodule]
fn _relcov(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<NativeModel>()?;
    module.add_class::<NativeJudgement>()?;
    module.add_class::<NativeEvidence>()?;
    module.add_function(wrap_pyfunction!(run_command, module)?)
}
