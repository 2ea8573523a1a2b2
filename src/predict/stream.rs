//! Predictions by JSON lines: one object in, one object out, so that any language can ask.

use std::path::{Path, PathBuf};

use base64::Engine;
use nalgebra::{Matrix3, Vector3};
use serde::Serialize;
use serde_json::{Map, Value};

use super::{Measurement, Model, RightView};
use crate::config::DepthConfig;
use crate::data::{RgbImage, camera_axes_from_vehicle, decode_image, read_image};
use crate::depth::{DepthMap, LiveDepth, decode_depth_png, read_depth_png};
use crate::error::{Error, Place, Result};
use crate::export::{JsonCovariance, Perturbation};
use crate::geometry::{ErrorFrame, Pinhole, Pose};
use crate::systems::pose_from_quaternion;

/// Largest `|RᵀR − I|` of a rotation in a request.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Fields of a request.
const FIELDS: [&str; 11] = [
    "id",
    "source_image",
    "target_image",
    "intrinsics",
    "pose",
    "pose_frame",
    "camera_from_vehicle",
    "depth",
    "right_source_image",
    "right_target_image",
    "right_from_left",
];

/// How a stream answers.
#[derive(Clone, Debug, Default)]
pub struct StreamSettings {
    /// Where depth comes from that a request does not give; `None`: the run's own source.
    pub depth: Option<DepthConfig>,
    /// Axes of the covariances; `None`: the model's.
    pub frame: Option<ErrorFrame>,
    /// Side of the covariances; `None`: left.
    pub perturbation: Option<Perturbation>,
    /// Least variances, m² and rad².
    pub floor: Option<[f64; 2]>,
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
/// | `source_image`, `target_image` | PNG or JPEG: a path, or an object with its `base64`; rectified, of one size |
/// | `intrinsics` | fx, fy, cx, cy at that size, px, pixel centres at integer coordinates |
/// | `pose` | measured `ⁱT̂ᵢ₊₁`: 7 numbers `x y z qx qy qz qw`, or 12 or 16 of a matrix, row by row, nested or not; m |
/// | `pose_frame` | `camera` (default) or `vehicle`: whose motion that is |
/// | `camera_from_vehicle` | a pose in the same form; default: the vehicle is where the camera is, x forward, z up |
/// | `depth` | of the target, 16-bit PNG, metres x 256: a path or `base64`; default: what the run's own source makes |
/// | `right_source_image`, `right_target_image`, `right_from_left` | for stereo models |
/// | `id` | anything; comes back with the answer |
///
/// The answer has `id`, and `covariance` (6 x 6), `std_devs`, `order`, `frame` and `perturbation`, or `error`.
pub struct Stream<'a> {
    model: &'a Model,
    depth: LiveDepth,
    frame: ErrorFrame,
    perturbation: Perturbation,
    floor: Option<[f64; 2]>,
}

#[derive(Serialize)]
struct Answer<'a> {
    id: Value,
    #[serde(flatten)]
    covariance: JsonCovariance<'a>,
}

#[derive(Serialize)]
struct Refusal {
    id: Value,
    error: String,
}

impl<'a> Stream<'a> {
    /// A stream of a model's predictions.
    ///
    /// # Errors
    /// Axes of the world are asked for, or left, which single measurements do not know; or the weights of the depth
    /// network cannot be loaded.
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
        let depth = match &settings.depth {
            Some(depth) => model.live_depth_of(depth)?,
            None => model.live_depth()?,
        };
        let perturbation = settings.perturbation.unwrap_or(Perturbation::Left);
        Ok(Self { model, depth, frame, perturbation, floor: settings.floor })
    }

    /// The answer to a request, without a line end. What is wrong with the request is its answer.
    pub fn answer(&self, request: &str) -> String {
        let value = serde_json::from_str::<Value>(request);
        let id = value.as_ref().ok().and_then(|value| value.get("id")).cloned().unwrap_or(Value::Null);
        let answered = value
            .map_err(|error| Error::Data(format!("not a JSON object: {error}")))
            .and_then(|value| self.predict(&value));
        let line = match answered {
            Ok(covariance) => serde_json::to_string(&Answer { id, covariance }),
            Err(error) => Ok(Self::refuse(id, &error.to_string())),
        };
        line.expect("numbers and names are JSON")
    }

    /// The answer to what cannot be taken for a request.
    pub fn refuse(id: Value, problem: &str) -> String {
        serde_json::to_string(&Refusal { id, error: problem.to_owned() }).expect("text is JSON")
    }

    fn predict(&self, request: &Value) -> Result<JsonCovariance<'static>> {
        let fields = Fields::of(request)?;
        let camera_from_vehicle = fields.pose("camera_from_vehicle")?.unwrap_or_else(camera_axes_from_vehicle);
        let stated = fields.required_pose("pose")?;
        let source_from_target = match fields.text("pose_frame")? {
            None | Some("camera") => stated,
            Some("vehicle") => stated.conjugated_by(&camera_from_vehicle),
            Some(other) => return Err(wrong("pose_frame", format!("`{other}`"), "`camera` or `vehicle`")),
        };
        let images = rayon::join(|| fields.required_image("source_image"), || fields.required_image("target_image"));
        let (source_image, target_image) = (images.0?, images.1?);
        let camera = fields.camera(target_image.width, target_image.height)?;
        let target_depth = match fields.depth("depth")? {
            Some(depth) => depth,
            None => self.depth.estimate(&target_image, &camera)?,
        };
        let right = match fields.image("right_source_image")? {
            None => None,
            Some(source_image) => Some(RightView {
                source_image,
                target_image: fields.required_image("right_target_image")?,
                right_from_left: fields.required_pose("right_from_left")?,
            }),
        };
        let measurement = Measurement { source_image, target_image, target_depth, camera, source_from_target, right };
        let covariance = self.model.predict(&measurement)?;
        let axes_from_camera = |frame| match frame {
            ErrorFrame::Camera => Pose::identity(),
            ErrorFrame::Vehicle | ErrorFrame::World => camera_from_vehicle.inverse(),
        };
        let covariance = if self.frame == self.model.error_frame() {
            covariance
        } else {
            let output_from_errors =
                axes_from_camera(self.frame) * axes_from_camera(self.model.error_frame()).inverse();
            covariance.transported(&output_from_errors)
        };
        let covariance = match self.perturbation {
            Perturbation::Left => covariance,
            Perturbation::Right => {
                covariance.right_of(&source_from_target.conjugated_by(&axes_from_camera(self.frame)))
            }
        };
        let covariance = self.floor.map_or(covariance, |floor| covariance.with_floor(floor));
        Ok(JsonCovariance::new(self.frame.name(), self.perturbation, &covariance))
    }
}

fn wrong(field: &str, found: impl Into<String>, expected: &str) -> Error {
    Error::Data(format!("field `{field}`: found {}; expected {expected}", found.into()))
}

/// The fields of a request.
struct Fields<'a>(&'a Map<String, Value>);

impl<'a> Fields<'a> {
    fn of(request: &'a Value) -> Result<Self> {
        let Value::Object(fields) = request else {
            return Err(Error::Data(format!("not a JSON object but {}", kind(request))));
        };
        match fields.keys().find(|name| !FIELDS.contains(&name.as_str())) {
            Some(name) => Err(wrong(name, "an unknown field", &FIELDS.join(", "))),
            None => Ok(Self(fields)),
        }
    }

    /// A field that is there and not null.
    fn get(&self, name: &str) -> Option<&'a Value> {
        self.0.get(name).filter(|value| !value.is_null())
    }

    fn text(&self, name: &str) -> Result<Option<&'a str>> {
        let text = |value: &'a Value| value.as_str().ok_or_else(|| wrong(name, kind(value), "text"));
        self.get(name).map(text).transpose()
    }

    fn camera(&self, width: usize, height: usize) -> Result<Pinhole> {
        let expected = "fx, fy, cx, cy: a list of four numbers";
        let value = self.get("intrinsics").ok_or_else(|| wrong("intrinsics", "nothing", expected))?;
        let numbers = numbers("intrinsics", value)?;
        let &[fx, fy, cx, cy] = numbers.as_slice() else {
            return Err(wrong("intrinsics", format!("{} numbers", numbers.len()), expected));
        };
        Ok(Pinhole { fx, fy, cx, cy, width, height })
    }

    fn required_pose(&self, name: &str) -> Result<Pose> {
        self.pose(name)?.ok_or_else(|| wrong(name, "nothing", "x y z qx qy qz qw, or a 3x4 or 4x4 matrix"))
    }

    fn pose(&self, name: &str) -> Result<Option<Pose>> {
        let Some(value) = self.get(name) else { return Ok(None) };
        let numbers = numbers(name, value)?;
        let path = PathBuf::from(format!("request, field `{name}`"));
        match numbers.as_slice() {
            &[x, y, z, qx, qy, qz, qw] => {
                pose_from_quaternion(Vector3::new(x, y, z), [qx, qy, qz, qw], &path, &Place::Whole).map(Some)
            }
            rows
            @ ([_, _, _, _, _, _, _, _, _, _, _, _] | [_, _, _, _, _, _, _, _, _, _, _, _, 0.0, 0.0, 0.0, 1.0]) => {
                let rotation = Matrix3::from_fn(|row, column| rows[4 * row + column]);
                let translation = Vector3::new(rows[3], rows[7], rows[11]);
                let pose = Pose::from_rounded_parts(rotation, translation, ROTATION_TOLERANCE);
                pose.map(Some)
                    .map_err(|deviation| wrong(name, format!("|RᵀR − I| = {deviation:.1e}"), "a rotation matrix"))
            }
            other => {
                let found = format!("{} numbers, or a last row other than 0 0 0 1", other.len());
                Err(wrong(name, found, "7 (x y z qx qy qz qw), 12 (3x4) or 16 (4x4)"))
            }
        }
    }

    fn required_image(&self, name: &str) -> Result<RgbImage> {
        self.image(name)?.ok_or_else(|| wrong(name, "nothing", "a path, or an object with `base64`"))
    }

    fn image(&self, name: &str) -> Result<Option<RgbImage>> {
        self.content(name)?.map(|content| content.read(read_image, decode_image)).transpose()
    }

    fn depth(&self, name: &str) -> Result<Option<DepthMap>> {
        self.content(name)?.map(|content| content.read(read_depth_png, decode_depth_png)).transpose()
    }

    fn content(&self, name: &str) -> Result<Option<Content>> {
        let expected = "a path, or an object with `base64` alone";
        match self.get(name) {
            None => Ok(None),
            Some(Value::String(path)) => Ok(Some(Content::File(PathBuf::from(path)))),
            Some(Value::Object(object)) => match (object.get("base64"), object.len()) {
                (Some(Value::String(text)), 1) => {
                    let bytes = base64::engine::general_purpose::STANDARD.decode(text.trim());
                    let bytes = bytes.map_err(|error| wrong(name, error.to_string(), "base64 with padding"))?;
                    Ok(Some(Content::Bytes(PathBuf::from(format!("field `{name}`")), bytes)))
                }
                _ => Err(wrong(name, "another object", expected)),
            },
            Some(other) => Err(wrong(name, kind(other), expected)),
        }
    }
}

/// A file, or what would stand in it.
enum Content {
    File(PathBuf),
    Bytes(PathBuf, Vec<u8>),
}

impl Content {
    fn read<T>(
        self,
        from_file: impl FnOnce(&Path) -> Result<T>,
        from_bytes: impl FnOnce(&[u8], &Path) -> Result<T>,
    ) -> Result<T> {
        match self {
            Self::File(path) => from_file(&path),
            Self::Bytes(origin, bytes) => from_bytes(&bytes, &origin),
        }
    }
}

/// Numbers of a list, or of a list of lists.
fn numbers(name: &str, value: &Value) -> Result<Vec<f64>> {
    let finite = |value: &Value| match value.as_f64().filter(|number| number.is_finite()) {
        Some(number) => Ok(number),
        None => Err(wrong(name, kind(value), "finite numbers")),
    };
    let Value::Array(entries) = value else { return Err(wrong(name, kind(value), "a list of numbers")) };
    let rows = entries.iter().map(|entry| match entry {
        Value::Array(row) => row.iter().map(finite).collect::<Result<Vec<f64>>>(),
        other => Ok(vec![finite(other)?]),
    });
    Ok(rows.collect::<Result<Vec<_>>>()?.concat())
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "a number",
        Value::String(_) => "text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}
