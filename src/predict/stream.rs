//! Predictions by JSON lines: one object in, one object out, so that any language can ask.

use serde::Serialize;

use super::identity::{Id, identity, replace_no_numbers};
use super::request::{PoseFrame, Request};
use super::{Measurement, Model, RightView};
use crate::depth::{DepthConfig, LiveDepth, decode_depth_png, read_depth_png};
use crate::error::{Error, Result, excerpt, shortened};
use crate::export::{JsonJudgement, JsonPose, MeasuredMotion, Perturbation, Poses};
use crate::files::without_mark;
use crate::geometry::{ErrorFrame, Pinhole, Pose};
use crate::recordings::{decode_image, read_image};

/// How a stream answers.
#[derive(Clone, Debug, Default)]
pub struct StreamSettings {
    /// Where depth comes from that a request does not give; `None`: the run's own source.
    pub depth: Option<DepthConfig>,
    /// Axes of covariances and corrections; `None`: the model's.
    pub frame: Option<ErrorFrame>,
    /// Side of the covariances; `None`: left.
    pub perturbation: Option<Perturbation>,
    /// Least variances, m² and rad².
    pub floor: Option<[f64; 2]>,
    /// Whether an answer's covariance is that of the measured pose, or that of the corrected one, which it then has too.
    pub poses: Poses,
}

/// Answers requests one by one; keeps nothing of them.
///
/// A request:
///
/// ```json
/// {"id": 7, "source_image": "0.png", "target_image": {"base64": "…"}, "intrinsics": [707.1, 707.1, 601.9, 183.1],
///  "pose": [0.0, 0.0, 0.9, 0.0, 0.0, 0.0, 1.0], "depth": "1_depth.png"}
/// ```
///
/// | field | meaning |
/// |---|---|
/// | `source_image`, `target_image` | PNG or JPEG: a path, a data URL, or an object with its `base64`; rectified, of one size, pixels as stored |
/// | `intrinsics` | fx, fy, cx, cy at that size, px, pixel centres at integer coordinates |
/// | `pose` | measured `ⁱT̂ᵢ₊₁`: 7 numbers `x y z qx qy qz qw`, or 12 or 16 of a matrix, row by row, nested or not; m |
/// | `pose_frame` | `camera` (default) or `vehicle`: whose motion that is |
/// | `camera_from_vehicle` | a pose in the same form; default: as on the drives that a model with evidence was trained on; of others the vehicle is where the camera is, x forward, z up |
/// | `depth` | of the target and of its aspect, 16-bit PNG, metres x 256: a path or `base64`; default: what the run's own source makes |
/// | `right_source_image`, `right_target_image`, `right_from_left` | for stereo models |
/// | `id` | text or a number; comes back with the answer, as it was sent |
///
/// The answer has `id`, and `covariance` (6 x 6), `std_devs`, `order`, `frame` and `perturbation`, or `error`. A model
/// with evidence adds its `verdict`, `ok` or the name of the `reason` why the images say nothing of the error; one with a
/// posterior head `correction` (μ), `corrected_pose` and `corrected_covariance`, in the same axes and on the same side;
/// or, where [`StreamSettings::poses`] are corrected, `corrected: true`, the corrected `pose`, and its covariance in place
/// of the measurement's.
pub struct Stream<'a> {
    model: &'a Model,
    depth: LiveDepth,
    frame: ErrorFrame,
    perturbation: Perturbation,
    floor: Option<[f64; 2]>,
    poses: Poses,
}

#[derive(Serialize)]
struct Answer<'a> {
    id: Id,
    #[serde(flatten)]
    corrected: Option<Corrected>,
    #[serde(flatten)]
    judgement: JsonJudgement<'a>,
}

/// The pose whose covariance an answer has, where it is not the one that was sent.
#[derive(Serialize)]
struct Corrected {
    corrected: bool,
    pose: JsonPose,
}

#[derive(Serialize)]
struct Refusal {
    id: Id,
    error: String,
}

impl<'a> Stream<'a> {
    /// A stream of a model's predictions.
    ///
    /// # Errors
    /// Axes of the world are asked for, or left, which single measurements do not know; or corrected poses, of a model
    /// that does not predict the error itself.
    pub fn new(model: &'a Model, settings: &StreamSettings) -> Result<Self> {
        let frame = settings.frame.unwrap_or(model.error_frame());
        if frame != model.error_frame() && (frame == ErrorFrame::World || model.error_frame() == ErrorFrame::World) {
            return Err(Error::Data(format!(
                "--frame {}: this model's covariances are in axes `{}`, and single measurements do not know the world's",
                frame.name(),
                model.error_frame().name()
            )));
        }
        if settings.perturbation == Some(Perturbation::Right) && frame == ErrorFrame::World {
            return Err(Error::Data(
                "--perturbation right needs the measured motion in axes of the world, which single measurements do not know".to_owned(),
            ));
        }
        if settings.poses == Poses::Corrected && !model.corrects() {
            return Err(Error::Data(
                "corrected poses are asked for, and this model does not predict the error itself; train one with model.head = \"posterior\"".to_owned(),
            ));
        }
        let depth = settings.depth.as_ref().map_or_else(|| model.live_depth(), |depth| model.live_depth_of(depth));
        let perturbation = settings.perturbation.unwrap_or(Perturbation::Left);
        Ok(Self { model, depth, frame, perturbation, floor: settings.floor, poses: settings.poses })
    }

    /// The answer to a request, without a line end. What is wrong with the request is its answer.
    pub fn answer(&self, request: &str) -> String {
        let request = without_mark(request);
        let parsed = serde_json::from_str::<Request>(request);
        let id = match &parsed {
            Ok(parsed) => parsed.id.clone(),
            // What is wrong stands elsewhere: whose request it is may still be told.
            Err(_) => identity(request),
        };
        let answered =
            parsed.map_err(|error| Error::Data(no_request(request, &error))).and_then(|request| self.judge(request));
        match answered {
            Ok(motion) => serde_json::to_string(&self.said_of(&motion, id)).expect("numbers and names are JSON"),
            Err(error) => refusal(id, &error.to_string()),
        }
    }

    /// The answer to what cannot be taken for a request; its id comes back where it can be found.
    pub fn refuse(line: &str, problem: &str) -> String {
        refusal(identity(line), problem)
    }

    fn said_of(&self, motion: &MeasuredMotion, id: Id) -> Answer<'static> {
        let corrected = (self.poses == Poses::Corrected)
            .then(|| Corrected { corrected: true, pose: JsonPose::new(&motion.source_from_target) });
        let judgement = JsonJudgement::new(self.frame.name(), motion, self.perturbation, self.floor);
        Answer { id, corrected, judgement }
    }

    /// What a request measured, with what the model says of it, in axes of the answers; corrected if that was asked for.
    fn judge(&self, request: Request) -> Result<MeasuredMotion> {
        let given = request.camera_from_vehicle.as_ref().map(|numbers| numbers.pose("camera_from_vehicle"));
        let camera_from_vehicle = self.model.camera_from_vehicle(given.transpose()?);
        let stated = request.pose.pose("pose")?;
        let source_from_target = match request.pose_frame {
            PoseFrame::Camera => stated,
            PoseFrame::Vehicle => stated.conjugated_by(&camera_from_vehicle),
        };
        let images = rayon::join(
            || request.source_image.read("source_image", read_image, decode_image),
            || request.target_image.read("target_image", read_image, decode_image),
        );
        let (source_image, target_image) = (images.0?, images.1?);
        let [fx, fy, cx, cy] = request.intrinsics;
        let camera = Pinhole { fx, fy, cx, cy, width: target_image.width, height: target_image.height };
        let target_depth = match &request.depth {
            Some(depth) => depth.read("depth", read_depth_png, decode_depth_png)?,
            None => self.depth.estimate(&target_image, &camera)?,
        };
        let right = match (&request.right_source_image, &request.right_target_image, &request.right_from_left) {
            (Some(source), Some(target), Some(right_from_left)) => Some(RightView {
                source_image: source.read("right_source_image", read_image, decode_image)?,
                target_image: target.read("right_target_image", read_image, decode_image)?,
                right_from_left: right_from_left.pose("right_from_left")?,
            }),
            (None, None, None) => None,
            _ => {
                let problem = "right_source_image, right_target_image and right_from_left come together, or not at all";
                return Err(Error::Data(problem.to_owned()));
            }
        };
        let measurement = Measurement {
            source_image,
            target_image,
            target_depth,
            camera,
            source_from_target,
            right,
            camera_from_vehicle: Some(camera_from_vehicle),
        };
        let judgement = self.model.judge(&measurement)?;
        let axes_from_camera = |frame| match frame {
            ErrorFrame::Camera => Pose::identity(),
            // A stream whose answers are in axes of the world says nothing of poses.
            ErrorFrame::Vehicle | ErrorFrame::World => camera_from_vehicle.inverse(),
        };
        let output_from_camera = axes_from_camera(self.frame);
        let verdict = judgement.verdict();
        let (mut covariance, mut posterior) = (judgement.covariance, judgement.posterior);
        if self.frame != self.model.error_frame() {
            let output_from_errors = output_from_camera * axes_from_camera(self.model.error_frame()).inverse();
            covariance = covariance.transported(&output_from_errors);
            posterior = posterior.map(|posterior| posterior.transported(&output_from_errors));
        }
        let motion = MeasuredMotion {
            source: 0,
            target: 1,
            times: None,
            source_from_target: source_from_target.conjugated_by(&output_from_camera),
            covariance,
            posterior,
            verdict,
        };
        Ok(match self.poses {
            Poses::Measured => motion,
            Poses::Corrected => motion.corrected().expect("checked when the stream was made"),
        })
    }
}

/// Why a line is no request; not longer than a reader wants it, whatever stands in it.
fn no_request(line: &str, error: &serde_json::Error) -> String {
    match replace_no_numbers(line) {
        (_, Some(word)) => {
            format!("no request: {} is no JSON number; send finite ones, or leave the pair out", excerpt(word))
        }
        (_, None) => format!("no request: {} (docs/predict.md lists the fields)", shortened(&error.to_string())),
    }
}

fn refusal(id: Id, problem: &str) -> String {
    serde_json::to_string(&Refusal { id, error: problem.to_owned() }).expect("text is JSON")
}
