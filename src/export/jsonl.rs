//! JSON lines that say everything about themselves.

use serde::Serialize;

use super::{MeasuredMotion, MeasuredMotions, Perturbation, pose_numbers};
use crate::geometry::{Conventions, Covariance6};

/// A pose in JSON.
#[derive(Serialize)]
pub(crate) struct JsonPose {
    translation: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

impl JsonPose {
    pub(crate) fn new(pose: &crate::geometry::Pose) -> Self {
        let [x, y, z, quaternion @ ..] = pose_numbers(pose);
        Self { translation: [x, y, z], quaternion_xyzw: quaternion }
    }
}

/// A covariance in JSON, with its conventions.
#[derive(Serialize)]
pub(crate) struct JsonCovariance<'a> {
    frame: &'a str,
    perturbation: &'static str,
    order: [&'static str; 6],
    covariance: [[f64; 6]; 6],
    std_devs: [f64; 6],
}

impl<'a> JsonCovariance<'a> {
    pub(crate) fn new(frame: &'a str, side: Perturbation, covariance: &Covariance6) -> Self {
        let matrix = covariance.matrix();
        Self {
            frame,
            perturbation: side.name(),
            order: Conventions::COMPONENTS,
            covariance: std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)])),
            std_devs: covariance.std_devs().into(),
        }
    }
}

#[derive(Serialize)]
struct Line<'a> {
    system: &'a str,
    drive: &'a str,
    source: usize,
    target: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    times: Option<[f64; 2]>,
    pose: JsonPose,
    #[serde(flatten)]
    covariance: JsonCovariance<'a>,
}

pub(super) fn render(measured: &MeasuredMotions, side: Option<Perturbation>, floor: Option<[f64; 2]>) -> String {
    let side = side.unwrap_or(Perturbation::Left);
    let line = |motion: &MeasuredMotion| {
        let line = Line {
            system: &measured.system,
            drive: &measured.drive,
            source: motion.source,
            target: motion.target,
            times: motion.times_s,
            pose: JsonPose::new(&motion.source_from_target),
            covariance: JsonCovariance::new(measured.frame.name(), side, &motion.covariance_on(side, floor)),
        };
        serde_json::to_string(&line).expect("numbers and names are JSON") + "\n"
    };
    measured.motions.iter().map(line).collect()
}
