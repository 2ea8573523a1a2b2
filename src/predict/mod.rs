//! A trained model as a library: one measurement in, its covariance out, or all that is said of it ([`Model`],
//! [`Judgement`]); a JSON object in, a JSON object out ([`Stream`]); all measurements of a data set
//! ([`Model::predict_measurements`]).

mod dataset;
mod identity;
mod request;
mod stream;

use std::path::Path;
use std::sync::Arc;

use burn::tensor::Device;
use rayon::prelude::*;

use crate::alignment::{Evidence, EvidenceInput};
use crate::config::Config;
use crate::depth::{DepthConfig, DepthMap, EXPECTED_ASPECT, LiveDepth};
use crate::error::{Error, Result};
use crate::evaluation::{Recalibration, read_values};
use crate::export::Verdict;
use crate::geometry::{Covariance6, ErrorFrame, OWN_INTRINSICS, Pinhole, Pose, Posterior, Tangent};
use crate::model::{Architecture, CovarianceModel, Estimate};
use crate::network::Head;
use crate::pairs::{PairNumbers, PairSample, RightImages, SHOWS_NOTHING};
use crate::recordings::{RgbImage, camera_axes_from_vehicle};
use crate::training::RunFolder;

pub use stream::{Stream, StreamSettings};

/// Larger focal lengths, px, and motions between two images, m, are mistakes.
const LARGEST: f64 = 1e6;

/// A model ready to predict.
///
/// ```no_run
/// use relcov::recordings::read_image;
/// use relcov::{Measurement, Model, depth, device, geometry};
///
/// # fn main() -> relcov::Result<()> {
/// let model = Model::load("checkpoints/kitti_sample", &device::open_device("auto")?)?;
/// let camera = geometry::Pinhole { fx: 707.1, fy: 707.1, cx: 601.9, cy: 183.1, width: 1226, height: 370 };
/// let covariance = model.predict(&Measurement {
///     source_image: read_image("frame0.png".as_ref())?,
///     target_image: read_image("frame1.png".as_ref())?,
///     target_depth: depth::ground_plane_depth(&camera, 1.65, None, 80.0),
///     camera,
///     source_from_target: geometry::Pose::exp(&geometry::Tangent::new(0.0, 0.0, 0.9, 0.0, 0.0, 0.0)),
///     right: None,
///     camera_from_vehicle: None,
/// })?;
/// let sigma = covariance.std_devs(); // x, y, z (m), roll, pitch, yaw (rad), axes of model.error_frame()
/// # let _ = sigma;
/// # Ok(())
/// # }
/// ```
pub struct Model {
    architecture: Architecture,
    error_frame: ErrorFrame,
    network: CovarianceModel,
    recalibration: Option<Recalibration>,
    /// Vehicle axes into the camera's, on the drives it was trained on.
    camera_from_vehicle: Option<Pose>,
    /// Where the run's depth came from; of a folder without a readable configuration, why that is not known.
    depth: Result<DepthConfig, String>,
    device: Device,
}

/// A relative-pose measurement with what is needed to judge it.
#[derive(Clone, Debug)]
pub struct Measurement {
    /// `I_i`, any size (that of `camera`).
    pub source_image: RgbImage,
    /// `I_{i+1}`, the same size.
    pub target_image: RgbImage,
    /// Depth of the target image, m along the optical axis, 0 = unknown; of the network's size, or any of the image's aspect. [`DepthEstimator`](crate::depth::DepthEstimator)
    /// makes it from the image by a network.
    pub target_depth: DepthMap,
    /// Intrinsics of both images at their size.
    pub camera: Pinhole,
    /// Measured `ⁱT̂ᵢ₊₁` in axes of this camera (x right, y down, z forward), m.
    pub source_from_target: Pose,
    /// What the right camera saw, for a model that looks at it ([`Architecture::stereo`]).
    pub right: Option<RightView>,
    /// Vehicle axes into those of this camera, m, for a model with evidence whose covariances are in axes of the
    /// vehicle; `None`: as on the drives that the model was trained on.
    pub camera_from_vehicle: Option<Pose>,
}

/// What a model says of a measurement; axes of [`Model::error_frame`], order ρ then φ, m and rad.
#[derive(Clone, Debug, PartialEq)]
pub struct Judgement {
    /// R: covariance of `e = log(T̂ T⁻¹)`, of the measurement as it is.
    pub covariance: Covariance6,
    /// Of a model with a posterior head: μ, the error that the images show, and C, the covariance of what is left without
    /// it; `R = C + μ μᵀ`.
    pub posterior: Option<Posterior>,
    /// Of the same: the corrected measurement `exp(−μ) T̂`, in axes of the camera as the measurement itself, m; its
    /// covariance is C.
    pub corrected_source_from_target: Option<Pose>,
    /// What direct alignment found, of a model with evidence. Where it came to no verdict
    /// ([`Evidence::no_verdict`]) the covariance is the prior's and the correction is none.
    pub evidence: Option<Evidence>,
}

impl Judgement {
    /// Whether the images say something of the error, of a model with evidence.
    pub fn verdict(&self) -> Option<Verdict> {
        self.evidence.as_ref().map(|evidence| Verdict::of(evidence.no_verdict))
    }
}

/// The right camera's part of a [`Measurement`].
#[derive(Clone, Debug)]
pub struct RightView {
    /// Right image of time i, the size of the left one.
    pub source_image: RgbImage,
    /// Right image of time i + 1, the same size.
    pub target_image: RgbImage,
    /// Points of the left camera into the right one, m; both have the same intrinsics.
    pub right_from_left: Pose,
}

impl Model {
    /// Loads the best model of a run folder.
    ///
    /// # Errors
    /// The folder holds no usable run, or its conventions are not this program's.
    pub fn load(run: impl AsRef<Path>, device: &Device) -> Result<Self> {
        let run = RunFolder::open(run.as_ref())?;
        let manifest = run.manifest()?;
        let network = run.load_model(&manifest, device)?;
        let camera_from_vehicle = manifest.camera_from_vehicle();
        Ok(Self {
            camera_from_vehicle,
            architecture: manifest.architecture,
            error_frame: manifest.conventions.error_frame,
            network,
            recalibration: run.recalibration()?,
            depth: Config::load(&run.config_path(), &[]).map(|config| config.depth).map_err(|error| error.to_string()),
            device: device.clone(),
        })
    }

    /// A model that was never trained: predicts `log_variance` (ln m², ln rad²) for every pair.
    ///
    /// ```
    /// use relcov::recordings::RgbImage;
    /// use relcov::geometry::{ErrorFrame, Pinhole, Pose};
    /// use relcov::model::Architecture;
    /// use relcov::{Measurement, Model, depth, device};
    ///
    /// # fn main() -> relcov::Result<()> {
    /// let model = Model::untrained(Architecture::paper(32, 16), ErrorFrame::Vehicle, [-4.0; 6], &device::open_device("flex")?);
    ///
    /// let camera = Pinhole { fx: 40.0, fy: 40.0, cx: 31.5, cy: 15.5, width: 64, height: 32 };
    /// let grey = RgbImage { width: 64, height: 32, bytes: vec![128; 3 * 64 * 32] };
    /// let covariance = model.predict(&Measurement {
    ///     source_image: grey.clone(),
    ///     target_image: grey,
    ///     target_depth: depth::ground_plane_depth(&camera, 1.65, None, 80.0),
    ///     camera,
    ///     source_from_target: Pose::identity(),
    ///     right: None,
    ///     camera_from_vehicle: None,
    /// })?;
    /// assert!((covariance.variance()[0].ln() + 4.0).abs() < 1e-5);
    /// # Ok(())
    /// # }
    /// ```
    pub fn untrained(
        architecture: Architecture,
        error_frame: ErrorFrame,
        log_variance: [f64; 6],
        device: &Device,
    ) -> Self {
        let network = architecture.init(log_variance, device);
        let depth = Ok(DepthConfig::default());
        Self {
            architecture,
            error_frame,
            network,
            recalibration: None,
            camera_from_vehicle: None,
            depth,
            device: device.clone(),
        }
    }

    /// Axes in which predicted covariances are expressed.
    pub fn error_frame(&self) -> ErrorFrame {
        self.error_frame
    }

    /// Shape of the model.
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    /// Depth for images that come without, from the source the model was trained with: a flat road, or a depth network
    /// whose scale is known. Other sources have none for a single image, which [`LiveDepth::estimate`] says.
    pub fn live_depth(&self) -> LiveDepth {
        match &self.depth {
            Ok(depth) => self.live_depth_of(depth),
            Err(problem) => LiveDepth::missing(format!(
                "no depth was given, and the run does not say where to take it from: {problem}"
            )),
        }
    }

    /// The same from another source.
    pub fn live_depth_of(&self, config: &DepthConfig) -> LiveDepth {
        LiveDepth::new(config, [self.architecture.width, self.architecture.height], &self.device)
    }

    /// Predicts the covariance of a measurement: of `e = log(T̂ T⁻¹)`, order ρ then φ, m² and rad²,
    /// in axes of [`Model::error_frame`]; recalibrated if the run was.
    ///
    /// # Errors
    /// Images do not have the camera's size, buffers not the size they state, no depth is known, the pose or intrinsics
    /// are not finite, the source image shows nothing of the target, or the model's output is not finite. A model with
    /// evidence says *no verdict* instead where images or depth show nothing ([`Model::judge`]).
    pub fn predict(&self, measurement: &Measurement) -> Result<Covariance6> {
        Ok(self.judge(measurement)?.covariance)
    }

    /// The same for several measurements at once, which is faster; none for none.
    ///
    /// # Errors
    /// As [`Model::predict`], for any of them.
    pub fn predict_batch(&self, measurements: &[Measurement]) -> Result<Vec<Covariance6>> {
        Ok(self.judge_batch(measurements)?.into_iter().map(|judgement| judgement.covariance).collect())
    }

    /// All that the model says of a measurement: its covariance, the error that the images show and what remains
    /// without it, and the evidence behind both.
    ///
    /// # Errors
    /// As [`Model::predict`].
    pub fn judge(&self, measurement: &Measurement) -> Result<Judgement> {
        Ok(self.judge_batch(std::slice::from_ref(measurement))?.swap_remove(0))
    }

    /// The same for several measurements at once, which is faster; none for none.
    ///
    /// # Errors
    /// As [`Model::predict`], for any of them.
    pub fn judge_batch(&self, measurements: &[Measurement]) -> Result<Vec<Judgement>> {
        let samples =
            measurements.par_iter().map(|measurement| self.prepare(measurement)).collect::<Result<Vec<_>>>()?;
        if samples.is_empty() {
            return Ok(Vec::new());
        }
        let numbers = PairNumbers::new(&samples, self.architecture.images());
        let outputs = read_values(self.network.forward(&numbers.upload(&self.device)))?;
        let evidence: Vec<_> = samples.into_iter().map(|sample| sample.evidence).collect();
        let estimates = self.network.estimates(&outputs, &evidence)?;
        let judged = measurements.iter().zip(estimates).zip(evidence);
        judged
            .map(|((measurement, estimate), evidence)| {
                let Estimate { covariance, posterior, .. } = self.recalibrated(estimate);
                let correct = |posterior: Posterior| self.corrected(measurement, &posterior);
                let corrected_source_from_target = posterior.map(correct).transpose()?;
                Ok(Judgement { covariance, posterior, corrected_source_from_target, evidence })
            })
            .collect()
    }

    /// The measured pose without the error that the images show, axes of the measurement's camera.
    fn corrected(&self, measurement: &Measurement, posterior: &Posterior) -> Result<Pose> {
        let camera_from_errors = self.errors_from_camera(measurement)?.inverse();
        Ok(posterior.transported(&camera_from_errors).correct(&measurement.source_from_target))
    }

    fn recalibrated(&self, mut estimate: Estimate) -> Estimate {
        if let Some(recalibration) = &self.recalibration {
            recalibration.apply_to(&mut estimate.covariance, &mut estimate.posterior);
        }
        estimate
    }

    /// Whether it predicts the error itself, so that measurements can be corrected.
    pub fn corrects(&self) -> bool {
        self.architecture.head == Head::Posterior
    }

    fn has_evidence(&self) -> bool {
        self.architecture.evidence == EvidenceInput::Alignment
    }

    /// Vehicle axes into those of a camera: as given; else, where errors must be brought to them, as on the drives that it
    /// was trained on; else the vehicle is where the camera is.
    fn camera_from_vehicle(&self, given: Option<Pose>) -> Pose {
        given.or(self.camera_from_vehicle.filter(|_| self.has_evidence())).unwrap_or_else(camera_axes_from_vehicle)
    }

    /// Axes of the errors from those of a measurement's camera.
    fn errors_from_camera(&self, measurement: &Measurement) -> Result<Pose> {
        match self.error_frame {
            ErrorFrame::Camera => Ok(Pose::identity()),
            ErrorFrame::Vehicle => Ok(self.camera_from_vehicle(measurement.camera_from_vehicle).inverse()),
            ErrorFrame::World => Err(Error::Data(
                "this model's covariances are in axes of the world, which a single measurement does not know; its evidence needs them: predict for a data set, or train with data.error_frame = \"vehicle\" or \"camera\"".to_owned(),
            )),
        }
    }

    fn prepare(&self, measurement: &Measurement) -> Result<PairSample> {
        let Measurement { source_image, target_image, target_depth, camera, source_from_target, right, .. } =
            measurement;
        let with_evidence = self.has_evidence();
        let must_show = self.architecture.pair.needs_overlap(self.architecture.evidence);
        let right = right.as_ref().filter(|_| self.architecture.stereo);
        if self.architecture.stereo && right.is_none() {
            return Err(Error::Data(
                "this model looks at the right camera too; give the measurement's `right`".to_owned(),
            ));
        }
        let mut images = vec![("source image", source_image), ("target image", target_image)];
        if let Some(right) = right {
            images.extend([("right source image", &right.source_image), ("right target image", &right.target_image)]);
        }
        for (name, image) in images {
            let (width, height) = (image.width, image.height);
            if (width, height) != (camera.width, camera.height) {
                return Err(Error::Data(format!(
                    "the {name} has {width}x{height} pixels and the camera {}x{}; give intrinsics of the image's size",
                    camera.width, camera.height
                )));
            }
            if image.bytes.len() != 3 * image.width * image.height {
                let found = image.bytes.len();
                return Err(Error::Data(format!("the {name} has {found} bytes; expected 3 for each of its pixels")));
            }
        }
        if target_depth.depth_m.len() != target_depth.width * target_depth.height || target_depth.depth_m.is_empty() {
            return Err(Error::Data("the depth map does not hold one depth for each of its pixels".to_owned()));
        }
        camera.require_centre().map_err(|found| Error::Data(format!("found {found}; expected {OWN_INTRINSICS}")))?;
        let (width, height) = (self.architecture.width, self.architecture.height);
        // One of the network's own size shows what the network sees.
        if [target_depth.width, target_depth.height] != [width, height] {
            let fits = target_depth.require_aspect([camera.width, camera.height]);
            fits.map_err(|found| Error::Data(format!("found {found}; expected {EXPECTED_ASPECT}")))?;
        }
        if must_show && target_depth.known().next().is_none() {
            return Err(Error::Data(
                "the depth of not one pixel is known (0 = unknown, else metres): there is nothing to warp".to_owned(),
            ));
        }
        let intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy];
        let seen = intrinsics.iter().all(|value| value.abs() <= LARGEST) && camera.fx > 0.0 && camera.fy > 0.0;
        let moved = source_from_target.is_finite() && source_from_target.translation.norm() <= LARGEST;
        if !(seen && moved) {
            return Err(Error::Data(
                "the measurement's intrinsics (px) and pose (m) must be finite, none above a million, and its focal lengths positive".to_owned(),
            ));
        }
        let resized = |image: &RgbImage| Arc::new(image.clone().resized(width, height));
        let (target_depth, camera) = (target_depth.resized(width, height), camera.resized(width, height));
        let (source_image, target_image) = rayon::join(|| resized(source_image), || resized(target_image));
        let mut sample = PairSample {
            source_image,
            target_image,
            target_depth: Arc::new(target_depth),
            camera,
            source_from_target: *source_from_target,
            error: Tangent::zeros(),
            right: right.map(|right| RightImages {
                source_image: resized(&right.source_image),
                target_image: resized(&right.target_image),
                right_from_left: right.right_from_left,
            }),
            evidence: None,
        };
        if must_show && !sample.shows_target() {
            return Err(Error::Data(SHOWS_NOTHING.to_owned()));
        }
        if with_evidence {
            sample.evidence = Some(sample.align(&self.errors_from_camera(measurement)?));
        }
        Ok(sample)
    }
}

#[cfg(test)]
mod tests;
