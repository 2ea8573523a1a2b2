//! Motions between the poses of a trajectory.

use std::path::Path;

use crate::geometry::Pose;
use crate::recordings::{Motions, Trajectory};

/// Longer steps of a trajectory, in units of its median, are gaps.
const MOST_STEPS: usize = 10;

/// Which poses of a trajectory make motions.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Steps {
    /// Those of neighbouring frames: where one is missing, nothing is known.
    Consecutive,
    /// Each and the next, however many frames lie between: what a system measured between its keyframes.
    Keyframes,
}

/// Motions between poses.
pub(super) fn motions_of(trajectory: &Trajectory, steps: Steps) -> Motions {
    let pairs = trajectory.iter().zip(trajectory.iter().skip(1));
    let wanted = pairs.filter(|((source, _), (target, _))| steps == Steps::Keyframes || **source + 1 == **target);
    let motion = |((&source, world_from_source), (&target, world_from_target)): ((&usize, &Pose), (&usize, &Pose))| {
        ((source, target), world_from_source.inverse() * *world_from_target)
    };
    wanted.map(motion).collect()
}

/// Says that a trajectory has a gap that is no keyframe's: many times as long as its usual step.
pub(super) fn warn_of_long_steps(motions: &Motions, path: &Path) {
    let mut steps: Vec<usize> = motions.keys().map(|(source, target)| target - source).collect();
    steps.sort_unstable();
    let longest = motions.keys().max_by_key(|(source, target)| target - source);
    let (Some(&usual), Some(&(source, target))) = (steps.get(steps.len() / 2), longest) else { return };
    if target - source > MOST_STEPS * usual {
        let path = path.display();
        tracing::warn!("{path}: no pose between frames {source} and {target}, which is taken for one motion");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn motions_of_keyframes_are_those_between_them() {
        let forward = |frame: usize| Pose::exp(&Tangent::new(frame as f64, 0.0, 0.0, 0.0, 0.0, 0.0));
        let trajectory = [0, 1, 3, 6, 9].map(|frame| (frame, forward(frame))).into();
        let motions = motions_of(&trajectory, Steps::Keyframes);
        let expected: Motions = [(0, 1), (1, 3), (3, 6), (6, 9)]
            .map(|(source, target)| ((source, target), forward(target - source)))
            .into();
        assert_eq!(motions, expected);
        assert_eq!(motions_of(&trajectory, Steps::Consecutive).into_keys().collect::<Vec<_>>(), [(0, 1)]);
    }
}
