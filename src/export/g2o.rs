//! Pose graphs for g2o: `VERTEX_SE3:QUAT` by chaining, `EDGE_SE3:QUAT` with the upper triangle of the information.
//!
//! g2o's error is `(t, q_xyz)` of `T̂⁻¹T`: a right perturbation, rotations as the vector part of a quaternion, half the
//! angle. So an information matrix of angles has its rotation block times 4 and its cross blocks times 2.

use nalgebra::{Matrix6, Vector6};

use super::motion::MeasuredMotions;
use super::numbers::{join, pose_numbers};
use super::options::G2oRotation;
use super::perturbation::Perturbation;
use crate::error::{Error, Result};
use crate::geometry::Pose;
use crate::recordings::Trajectory;
use crate::systems::chain_poses;

pub(super) fn render(measured: &MeasuredMotions, rotation: G2oRotation, floor: Option<[f64; 2]>) -> Result<String> {
    let MeasuredMotions { system, drive, motions, .. } = measured;
    let steps: Vec<(usize, usize, Pose)> =
        motions.iter().map(|motion| (motion.source, motion.target, motion.source_from_target)).collect();
    let poses: Trajectory = chain_poses(&steps).into_iter().flatten().collect();
    let vertex =
        |(frame, pose): (&usize, &Pose)| format!("VERTEX_SE3:QUAT {frame} {}\n", join(pose_numbers(pose), " "));
    let vertices: String = poses.iter().map(vertex).collect();
    let mut edges = String::new();
    for motion in motions {
        let covariance = motion.covariance_on(Perturbation::Right, floor);
        let information = covariance.information().ok_or_else(|| {
            Error::Data(format!(
                "{drive}, {system}, frames {} and {}: the covariance has no inverse, which g2o needs; --floor lifts variances of zero",
                motion.source, motion.target
            ))
        })?;
        let information = match rotation {
            G2oRotation::Angle => information,
            G2oRotation::HalfAngle => of_half_angles(&information),
        };
        let upper = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
        let numbers = pose_numbers(&motion.source_from_target).into_iter().chain(upper.map(|at| information[at]));
        edges += &format!("EDGE_SE3:QUAT {} {} {}\n", motion.source, motion.target, join(numbers, " "));
    }
    Ok(vertices + &edges)
}

fn of_half_angles(information: &Matrix6<f64>) -> Matrix6<f64> {
    let scale = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, 2.0, 2.0, 2.0));
    scale * information * scale
}

#[cfg(test)]
mod tests {
    use super::super::tests::measured;
    use super::*;

    fn numbers(text: &str, kind: &str) -> Vec<Vec<f64>> {
        let lines = text.lines().filter(|line| line.starts_with(kind));
        lines.map(|line| line.split(' ').skip(1).map(|word| word.parse().unwrap()).collect()).collect()
    }

    #[test]
    fn half_angles_weigh_four_times() {
        let whole = render(&measured(), G2oRotation::Angle, None).unwrap();
        let half = render(&measured(), G2oRotation::HalfAngle, None).unwrap();
        let (whole, half) = (&numbers(&whole, "EDGE")[0], &numbers(&half, "EDGE")[0]);
        // After two keys and seven numbers of the pose: x x, x roll and yaw yaw.
        for (entry, factor) in [(0, 1.0), (3, 2.0), (20, 4.0)] {
            assert!((half[9 + entry] / whole[9 + entry] - factor).abs() < 1e-12);
        }
    }

    #[test]
    fn a_gap_begins_another_chain() {
        let mut measured = measured();
        (measured.motions[1].source, measured.motions[1].target) = (9, 10);
        let text = render(&measured, G2oRotation::Angle, None).unwrap();
        let keys: Vec<f64> = numbers(&text, "VERTEX").iter().map(|vertex| vertex[0]).collect();
        assert_eq!(keys, [4.0, 5.0, 9.0, 10.0]);
        measured.motions[0].covariance = crate::geometry::Covariance6::zero();
        assert!(render(&measured, G2oRotation::Angle, None).unwrap_err().to_string().contains("--floor"));
    }
}
