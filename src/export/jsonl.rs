//! JSON lines that say everything about themselves.

use serde::Serialize;

use super::motion::{MeasuredMotion, MeasuredMotions, Verdict};
use super::numbers::pose_numbers;
use super::options::{ExportOptions, Poses};
use super::perturbation::{Perturbation, on_side};
use crate::geometry::{Conventions, Covariance6, Pose, Posterior};
use crate::time::Time;

/// A pose in JSON.
#[derive(Serialize)]
pub(crate) struct JsonPose {
    translation: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

impl JsonPose {
    pub(crate) fn new(pose: &Pose) -> Self {
        let [x, y, z, quaternion @ ..] = pose_numbers(pose);
        Self { translation: [x, y, z], quaternion_xyzw: quaternion }
    }
}

/// What is said of a measurement's error in JSON, with its conventions.
#[derive(Serialize)]
pub(crate) struct JsonJudgement<'a> {
    frame: &'a str,
    perturbation: &'static str,
    order: [&'static str; 6],
    covariance: [[f64; 6]; 6],
    std_devs: [f64; 6],
    #[serde(flatten)]
    correction: Option<JsonCorrection>,
    #[serde(skip_serializing_if = "Option::is_none")]
    verdict: Option<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<&'static str>,
}

/// The part of the error that the images show, and the measurement without it.
#[derive(Serialize)]
struct JsonCorrection {
    correction: [f64; 6],
    corrected_pose: JsonPose,
    corrected_covariance: [[f64; 6]; 6],
}

impl<'a> JsonJudgement<'a> {
    /// What is said of a motion in axes of `frame`, on the asked side, both covariances lifted to the floor.
    pub(crate) fn new(frame: &'a str, motion: &MeasuredMotion, side: Perturbation, floor: Option<[f64; 2]>) -> Self {
        let covariance = motion.covariance_on(side, floor);
        let measured = &motion.source_from_target;
        Self {
            frame,
            perturbation: side.name(),
            order: Conventions::COMPONENTS,
            covariance: entries(&covariance),
            std_devs: covariance.std_devs().into(),
            correction: motion.posterior.map(|posterior| JsonCorrection::new(&posterior, measured, side, floor)),
            verdict: motion.verdict.map(Verdict::name),
            reason: motion.verdict.and_then(Verdict::reason),
        }
    }
}

impl JsonCorrection {
    /// μ on the asked side: `exp(−μ) T̂ = T̂ exp(−Ad_{T̂⁻¹} μ)`. Each covariance moves with its own pose.
    fn new(posterior: &Posterior, measured: &Pose, side: Perturbation, floor: Option<[f64; 2]>) -> Self {
        let corrected = posterior.correct(measured);
        let mean = match side {
            Perturbation::Left => posterior.mean,
            Perturbation::Right => measured.inverse().adjoint() * posterior.mean,
        };
        Self {
            correction: mean.into(),
            corrected_pose: JsonPose::new(&corrected),
            corrected_covariance: entries(&on_side(&posterior.covariance, &corrected, side, floor)),
        }
    }
}

/// The matrix, row by row.
fn entries(covariance: &Covariance6) -> [[f64; 6]; 6] {
    std::array::from_fn(|row| std::array::from_fn(|column| covariance.matrix()[(row, column)]))
}

#[derive(Serialize)]
struct Line<'a> {
    system: &'a str,
    drive: &'a str,
    source: usize,
    target: usize,
    /// Seconds, as near as doubles come.
    #[serde(skip_serializing_if = "Option::is_none")]
    times: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    times_ns: Option<[i64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    corrected: Option<bool>,
    pose: JsonPose,
    #[serde(flatten)]
    judgement: JsonJudgement<'a>,
}

pub(super) fn render(measured: &MeasuredMotions, options: &ExportOptions) -> String {
    let line = |motion: &MeasuredMotion| {
        let line = Line {
            system: &measured.system,
            drive: &measured.drive,
            source: motion.source,
            target: motion.target,
            times: motion.times.map(|times| times.map(Time::seconds)),
            times_ns: motion.times.map(|times| times.map(Time::nanoseconds)),
            corrected: (options.poses == Poses::Corrected).then_some(true),
            pose: JsonPose::new(&motion.source_from_target),
            judgement: JsonJudgement::new(measured.frame.name(), motion, options.side(), options.floor),
        };
        serde_json::to_string(&line).expect("numbers and names are JSON") + "\n"
    };
    measured.motions.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix6;
    use serde_json::Value;

    use super::super::tests::{measured, seen};
    use super::*;
    use crate::geometry::Tangent;

    fn first_line(measured: &MeasuredMotions, options: &ExportOptions) -> Value {
        serde_json::from_str(render(measured, options).lines().next().unwrap()).unwrap()
    }

    fn matrix(line: &Value, field: &str) -> Matrix6<f64> {
        let rows: Vec<Vec<f64>> = serde_json::from_value(line[field].clone()).unwrap();
        Matrix6::from_row_slice(&rows.concat())
    }

    #[test]
    fn a_line_of_a_model_without_evidence_says_nothing_of_corrections() {
        let line = first_line(&measured(), &ExportOptions::default());
        let names: Vec<&str> = line.as_object().unwrap().keys().map(String::as_str).collect();
        assert_eq!(names.len(), 12, "{names:?}");
        assert!(
            render(&measured(), &ExportOptions::default())
                .contains("\"times_ns\":[1403636579963555584,1403636580013555584]")
        );
        for new in ["corrected", "correction", "corrected_pose", "corrected_covariance", "verdict", "reason"] {
            assert!(!names.contains(&new), "{names:?}");
        }
    }

    #[test]
    fn measurement_and_correction_stand_on_the_same_side() {
        let motion = &seen().motions[0];
        let corrected = motion.corrected().unwrap();
        for side in [Perturbation::Left, Perturbation::Right] {
            let floor = Some([0.0, 1e-3]);
            let options = ExportOptions { perturbation: Some(side), floor, ..ExportOptions::default() };
            let line = first_line(&seen(), &options);
            assert_eq!((line["verdict"].as_str(), line.get("reason")), (Some("ok"), None));
            let correction: [f64; 6] = serde_json::from_value(line["correction"].clone()).unwrap();
            let step = Pose::exp(&-Tangent::from(correction));
            let pose = match side {
                Perturbation::Left => step * motion.source_from_target,
                Perturbation::Right => motion.source_from_target * step,
            };
            assert!((pose.matrix() - corrected.source_from_target.matrix()).norm() < 1e-14);
            let stated: Vec<f64> = serde_json::from_value(line["corrected_pose"]["translation"].clone()).unwrap();
            assert!((pose.translation - nalgebra::Vector3::from_vec(stated)).norm() < 1e-14);
            assert_eq!(matrix(&line, "covariance"), *motion.covariance_on(side, floor).matrix());
            assert_eq!(matrix(&line, "corrected_covariance"), *corrected.covariance_on(side, floor).matrix());
            let asked = ExportOptions { poses: Poses::Corrected, ..options };
            let alone: Value = serde_json::from_str(
                crate::export::Format::Jsonl.render(&seen(), &asked).unwrap().lines().next().unwrap(),
            )
            .unwrap();
            assert_eq!(
                (&alone["pose"], &alone["covariance"]),
                (&line["corrected_pose"], &line["corrected_covariance"])
            );
            assert_eq!((alone["corrected"].as_bool(), alone.get("correction")), (Some(true), None));
        }
    }

    #[test]
    fn a_line_without_a_verdict_says_why() {
        let mut measured = seen();
        measured.motions[0].verdict = Some(Verdict::of(Some(crate::alignment::NoVerdict::NoDepth)));
        let line = first_line(&measured, &ExportOptions::default());
        assert_eq!(line["verdict"], "no_depth");
        assert_eq!(line["reason"], "the depth of too few pixels is known");
    }
}
