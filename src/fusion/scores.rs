//! How good a trajectory and its covariances are.

use super::FusedTrajectory;
use crate::evaluation::CHI_SQUARED_6_95;
use crate::geometry::{ROTATION, TRANSLATION, Tangent};
use crate::recordings::Trajectory;

/// Scores of a trajectory against the truth; no alignment, for both are in one world.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrajectoryScores {
    /// Frames that were compared.
    pub frames: usize,
    /// Absolute trajectory error: root of the mean squared distance, m.
    pub ate_m: f64,
    /// The same of the rotation, rad.
    pub ate_rad: f64,
    /// Relative pose error from frame to frame: root of the mean squared translation, m.
    pub rpe_m: f64,
    /// The same of the rotation, rad.
    pub rpe_rad: f64,
    /// Mean of `eᵀΣ⁻¹e / 6` over the frames, e the right perturbation; 1 where covariances are right.
    pub anees: f64,
    /// Share of frames whose `eᵀΣ⁻¹e` lies below the 95 % quantile of χ² with six degrees of freedom.
    pub nees_below_95: f64,
}

impl TrajectoryScores {
    /// Scores over the frames that both know. A trajectory that was not placed is laid onto the truth by its first frame,
    /// which is then judged as the begin of the first step alone. `None` where nothing is left to judge, or the truth
    /// does not know that first frame.
    pub fn of(fused: &FusedTrajectory, truth: &Trajectory) -> Option<Self> {
        let placed = fused.in_world_of(truth)?;
        let common: Vec<usize> = placed.poses.keys().copied().filter(|frame| truth.contains_key(frame)).collect();
        let judged = if fused.placed { common.as_slice() } else { common.get(1..)? };
        let error = |frame: &usize| (placed.poses[frame].inverse() * truth[frame]).log();
        let errors: Vec<Tangent> = judged.iter().map(error).collect();
        let normalised: Vec<f64> = judged
            .iter()
            .zip(&errors)
            .filter_map(|(frame, error)| Some(fused.covariances[frame].mahalanobis(error)?.0))
            .collect();
        let steps: Vec<Tangent> = common
            .windows(2)
            .map(|pair| {
                let step = |poses: &Trajectory| poses[&pair[0]].inverse() * poses[&pair[1]];
                (step(&fused.poses).inverse() * step(truth)).log()
            })
            .collect();
        let distance = |frame: &usize| (placed.poses[frame].translation - truth[frame].translation).norm();
        let [_, ate_rad] = root_mean_squares(&errors);
        let [rpe_m, rpe_rad] = root_mean_squares(&steps);
        let count = judged.len();
        (count > 0).then(|| Self {
            frames: count,
            ate_m: (judged.iter().map(|frame| distance(frame).powi(2)).sum::<f64>() / count as f64).sqrt(),
            ate_rad,
            rpe_m,
            rpe_rad,
            anees: normalised.iter().sum::<f64>() / (6 * normalised.len()) as f64,
            nees_below_95: normalised.iter().filter(|nees| **nees < CHI_SQUARED_6_95).count() as f64
                / normalised.len() as f64,
        })
    }

    /// The scores of several drives or draws as one: over all their frames.
    pub fn mean(all: &[Self]) -> Option<Self> {
        let frames: usize = all.iter().map(|scores| scores.frames).sum();
        let mean = |of: fn(&Self) -> f64| {
            all.iter().map(|scores| scores.frames as f64 * of(scores)).sum::<f64>() / frames as f64
        };
        (frames > 0).then(|| Self {
            frames,
            ate_m: mean(|scores| scores.ate_m.powi(2)).sqrt(),
            ate_rad: mean(|scores| scores.ate_rad.powi(2)).sqrt(),
            rpe_m: mean(|scores| scores.rpe_m.powi(2)).sqrt(),
            rpe_rad: mean(|scores| scores.rpe_rad.powi(2)).sqrt(),
            anees: mean(|scores| scores.anees),
            nees_below_95: mean(|scores| scores.nees_below_95),
        })
    }
}

/// Of the translations and of the rotations; NaN without any.
fn root_mean_squares(tangents: &[Tangent]) -> [f64; 2] {
    [TRANSLATION, ROTATION].map(|range| {
        let sum: f64 = tangents.iter().map(|e| e.fixed_rows::<3>(range.start).norm_squared()).sum();
        (sum / tangents.len() as f64).sqrt()
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::geometry::{Covariance6, Pose};

    #[test]
    fn scores_are_those_of_a_known_error() {
        let truth: Trajectory =
            (0..5).map(|frame| (frame, Pose::exp(&Tangent::new(frame as f64, 0.0, 0.0, 0.0, 0.0, 0.0)))).collect();
        // A constant shift of 3 and 4 cm, with σ = 5 cm and rad.
        let shifted =
            |(&frame, pose): (&usize, &Pose)| (frame, Pose::exp(&Tangent::new(0.03, 0.04, 0.0, 0.0, 0.0, 0.0)) * *pose);
        let poses: BTreeMap<usize, Pose> = truth.iter().map(shifted).collect();
        let covariance = Covariance6::from_std_devs(&Tangent::repeat(0.05));
        let covariances = truth.keys().map(|&frame| (frame, covariance)).collect();
        let mut fused = FusedTrajectory { poses, covariances, placed: true };
        let scores = TrajectoryScores::of(&fused, &truth).unwrap();
        assert!((scores.ate_m - 0.05).abs() < 1e-12 && scores.rpe_m < 1e-12 && scores.frames == 5);
        assert!((scores.anees - 1.0 / 6.0).abs() < 1e-12 && scores.nees_below_95 == 1.0);
        // Laid onto the truth by its first frame nothing is left.
        fused.placed = false;
        let scores = TrajectoryScores::of(&fused, &truth).unwrap();
        assert!(scores.ate_m < 1e-12 && scores.frames == 4);
        assert_eq!(TrajectoryScores::of(&fused, &Trajectory::new()), None);
    }
}
