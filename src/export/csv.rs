//! Relative poses as `relcov` itself reads them: `source,target,x,y,z,qx,qy,qz,qw` and 36 values, row by row.

use super::motion::MeasuredMotions;
use super::numbers::{join, pose_numbers, rows};
use super::options::ExportOptions;
use super::perturbation::Perturbation;
use crate::systems::{Side, Statement, relative_pose_header};

pub(super) fn render(measured: &MeasuredMotions, options: &ExportOptions) -> String {
    let side = options.side();
    let stated = match side {
        Perturbation::Left => Side::Left,
        Perturbation::Right => Side::Right,
    };
    let statement = Statement { frame: Some(measured.frame), side: stated };
    let mut text = statement.line(options.remark());
    text += &relative_pose_header();
    for motion in &measured.motions {
        let covariance = motion.covariance_on(side, options.floor);
        let numbers = pose_numbers(&motion.source_from_target).into_iter().chain(rows(covariance.matrix()));
        text += &format!("{},{},{}\n", motion.source, motion.target, join(numbers, ","));
    }
    text
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::tests::measured;
    use super::*;
    use crate::systems::parse_relative_poses;

    #[test]
    fn both_sides_come_back_as_left() {
        let measured = measured();
        for side in [None, Some(Perturbation::Left), Some(Perturbation::Right)] {
            let options = ExportOptions { perturbation: side, ..ExportOptions::default() };
            let poses = parse_relative_poses(&render(&measured, &options), Path::new("p.csv")).unwrap();
            for (pose, motion) in poses.iter().zip(&measured.motions) {
                assert_eq!((pose.source, pose.target), (motion.source, motion.target));
                let difference = pose.covariance.unwrap().matrix() - motion.covariance.matrix();
                assert!(difference.norm() < 1e-13, "{side:?}: {}", difference.norm());
            }
        }
    }
}
