//! ROS messages: `geometry_msgs/PoseWithCovarianceStamped` of the target in the source frame, as JSON, which is YAML.
//!
//! ROS writes a pose as position and orientation, each with an error of its own in the parent's axes: `t̂ = t + δt`,
//! `R̂ = exp(φ) R`. Of a left perturbation `T̂ = exp(ρ, φ) T`, `δt = ρ − [t]ₓ φ`.

use nalgebra::Matrix6;
use serde_json::json;

use super::motion::{MeasuredMotion, MeasuredMotions};
use super::numbers::{pose_numbers, rows};
use crate::geometry::{Pose, hat};

pub(super) fn render(measured: &MeasuredMotions, floor: Option<[f64; 2]>) -> String {
    let message = |motion: &MeasuredMotion| {
        let [x, y, z, qx, qy, qz, qw] = pose_numbers(&motion.source_from_target);
        let (sec, nanosec) = motion.times.map_or((0, 0), |[_, target]| target.stamp());
        let covariance = motion.covariance.mapped(&position_jacobian(&motion.source_from_target));
        let covariance = floor.map_or(covariance, |floor| covariance.with_floor(floor));
        let message = json!({
            "header": {
                "stamp": { "sec": sec, "nanosec": nanosec },
                "frame_id": measured.frame.name(),
            },
            "pose": {
                "pose": {
                    "position": { "x": x, "y": y, "z": z },
                    "orientation": { "x": qx, "y": qy, "z": qz, "w": qw },
                },
                "covariance": rows(covariance.matrix()).collect::<Vec<f64>>(),
            },
        });
        format!("{message}\n")
    };
    measured.motions.iter().map(message).collect()
}

/// How position and fixed-axis rotation err with the left perturbation.
fn position_jacobian(pose: &Pose) -> Matrix6<f64> {
    let mut jacobian = Matrix6::identity();
    jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&-hat(&pose.translation));
    jacobian
}

#[cfg(test)]
mod tests {
    use super::super::tests::measured;
    use super::*;
    use crate::geometry::{Covariance6, Tangent};

    #[test]
    fn position_and_rotation_err_as_the_perturbation_moves_them() {
        let pose = measured().motions[0].source_from_target;
        let jacobian = position_jacobian(&pose);
        for component in 0..6 {
            let mut e = Tangent::zeros();
            e[component] = 1e-5;
            let moved = Pose::exp(&e) * pose;
            let position = moved.translation - pose.translation;
            let rotation = (moved.rotation * pose.rotation.inverse()).scaled_axis();
            let expected = jacobian * e;
            assert!((position - expected.fixed_rows::<3>(0)).norm() < 1e-9);
            assert!((rotation - expected.fixed_rows::<3>(3)).norm() < 1e-9);
        }
    }

    #[test]
    fn messages_have_36_values_and_no_zeros() {
        let mut measured = measured();
        measured.motions[0].covariance = Covariance6::zero();
        let text = render(&measured, Some([1e-6, 1e-8]));
        let message: serde_json::Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
        let values = message["pose"]["covariance"].as_array().unwrap();
        assert_eq!((values.len(), values[0].as_f64(), values[35].as_f64()), (36, Some(1e-6), Some(1e-8)));
        assert_eq!(message["header"]["stamp"]["sec"], 1_403_636_580);
        assert_eq!(message["header"]["stamp"]["nanosec"], 13_555_584);
    }
}
