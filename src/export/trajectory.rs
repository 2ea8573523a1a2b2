//! Trajectories: the rows of TUM and KITTI, followed by 36 covariance values.

use nalgebra::Matrix4;

use super::chain::Chain;
use super::motion::MeasuredMotions;
use super::numbers::{join, pose_numbers, rows};
use super::options::{ExportOptions, TrajectoryCovariance};
use super::perturbation::{Perturbation, on_side};
use crate::error::{Error, Result};
use crate::fusion::FusedTrajectory;
use crate::geometry::{Covariance6, Pose};
use crate::time::Time;

/// `t x y z qx qy qz qw`, t in seconds, or the frame where times are not known.
pub(super) fn render_tum(measured: &MeasuredMotions, options: &ExportOptions) -> Result<String> {
    let chain = Chain::of(measured)?;
    let begin = measured.motions[0].times.map(|[source, _]| source);
    let ends = measured.motions.iter().map(|motion| motion.times.map(|[_, target]| target));
    let times: Vec<Option<Time>> = std::iter::once(begin).chain(ends).collect();
    if let Some(row) = times.iter().position(Option::is_none).filter(|_| times.iter().any(Option::is_some)) {
        let (drive, frame) = (&measured.drive, chain.frames[row]);
        let problem = "has no time, and others have; a TUM trajectory has times for all poses, or frames for all";
        return Err(Error::Data(format!("{drive}: frame {frame} {problem}")));
    }
    let rows = times.iter().zip(&chain.frames);
    let times: Vec<String> =
        rows.map(|(time, frame)| time.map_or(frame.to_string(), |time| time.to_string())).collect();
    let side = options.side();
    let what = match options.trajectory {
        TrajectoryCovariance::None => String::new(),
        TrajectoryCovariance::Relative => format!("; covariance of the motion from the row before, {}", remark(side)),
        TrajectoryCovariance::Accumulated => format!("; covariance of the pose in the first frame, {}", remark(side)),
    };
    let (frame, how) = (measured.frame.name(), options.remark());
    let mut text = format!("# t x y z qx qy qz qw; first_from_frame{how}, axes: {frame}{what}\n");
    for (row, time) in times.iter().enumerate() {
        let numbers = pose_numbers(&chain.poses[row]).into_iter().chain(covariance(measured, &chain, row, options));
        text += &format!("{time} {}\n", join(numbers, " "));
    }
    Ok(text)
}

/// Twelve numbers, the first three rows of `first_from_frame`; no remark, for the format knows none.
pub(super) fn render_kitti(measured: &MeasuredMotions, options: &ExportOptions) -> Result<String> {
    let chain = Chain::of(measured)?;
    let mut text = String::new();
    for row in 0..chain.poses.len() {
        let matrix: Matrix4<f64> = chain.poses[row].matrix();
        let pose = (0..12).map(|entry| matrix[(entry / 4, entry % 4)]);
        text += &join(pose.chain(covariance(measured, &chain, row, options)), " ");
        text.push('\n');
    }
    Ok(text)
}

/// A fused trajectory as TUM rows with 36 covariance values; t is the frame.
pub fn fused_trajectory(fused: &FusedTrajectory) -> String {
    let mut text =
        "# frame x y z qx qy qz qw; world_from_body; marginal covariance, order x y z roll pitch yaw, right perturbation, axes of the body\n"
            .to_owned();
    for (frame, pose) in &fused.poses {
        let numbers = pose_numbers(pose).into_iter().chain(rows(fused.covariances[frame].matrix()));
        text += &format!("{frame} {}\n", join(numbers, " "));
    }
    text
}

fn remark(side: Perturbation) -> String {
    format!("order x y z roll pitch yaw, {} perturbation", side.name())
}

fn covariance(measured: &MeasuredMotions, chain: &Chain, row: usize, options: &ExportOptions) -> Vec<f64> {
    let (side, floor) = (options.side(), options.floor);
    let covariance = match (options.trajectory, row) {
        (TrajectoryCovariance::None, _) => return Vec::new(),
        (_, 0) => on_side(&Covariance6::zero(), &Pose::identity(), side, floor),
        (TrajectoryCovariance::Relative, _) => measured.motions[row - 1].covariance_on(side, floor),
        (TrajectoryCovariance::Accumulated, _) => on_side(&chain.covariances[row], &chain.poses[row], side, floor),
    };
    rows(covariance.matrix()).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::Path;

    use super::super::Format;
    use super::super::tests::measured;
    use super::*;
    use crate::recordings::{parse_kitti_trajectory, parse_tum_trajectory};

    #[test]
    fn plain_trajectories_are_read_back() {
        let measured = measured();
        let plain = ExportOptions { trajectory: TrajectoryCovariance::None, ..ExportOptions::default() };
        let chain = Chain::of(&measured).unwrap();
        let kitti = Format::Kitti.render(&measured, &plain).unwrap();
        let poses = parse_kitti_trajectory(&kitti, Path::new("p"), 4).unwrap();
        let times = chain
            .frames
            .iter()
            .map(|&frame| (frame, Time::from_nanoseconds(1_403_636_579_763_555_584 + 50_000_000 * frame as i64)));
        let times: BTreeMap<usize, Time> = times.collect();
        let tum =
            parse_tum_trajectory(&Format::Tum.render(&measured, &plain).unwrap(), Path::new("p"), &times, 0.0).unwrap();
        for (frame, expected) in chain.frames.iter().zip(&chain.poses) {
            assert!((poses[frame].matrix() - expected.matrix()).norm() < 1e-14);
            assert!((tum[frame].matrix() - expected.matrix()).norm() < 1e-14);
        }
    }

    #[test]
    fn rows_carry_the_covariance_that_was_asked_for() {
        let measured = measured();
        let numbers = |trajectory| {
            let options = ExportOptions { trajectory, ..ExportOptions::default() };
            let text = Format::Tum.render(&measured, &options).unwrap();
            let row = text.lines().nth(3).unwrap();
            row.split(' ').skip(8).map(|word| word.parse().unwrap()).collect::<Vec<f64>>()
        };
        let chain = Chain::of(&measured).unwrap();
        assert_eq!(numbers(TrajectoryCovariance::Relative)[7], measured.motions[1].covariance.matrix()[(1, 1)]);
        assert_eq!(numbers(TrajectoryCovariance::Accumulated)[7], chain.covariances[2].matrix()[(1, 1)]);
    }
}
