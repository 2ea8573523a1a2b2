//! Motions between the poses of a trajectory.

use std::collections::BTreeMap;
use std::path::Path;

use crate::recordings::{Motions, Trajectory};

/// Longer steps of a trajectory, in units of its median, are gaps.
const MOST_STEPS: usize = 10;

/// Which poses of a trajectory make motions.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Steps<'a> {
    /// Those so many frames apart, for each number: where one is missing, nothing is known.
    Apart(&'a [usize]),
    /// Each and the next, however many frames lie between: what a system measured between its keyframes.
    Keyframes,
}

/// Motions between poses.
pub(super) fn motions_of(trajectory: &Trajectory, steps: Steps) -> Motions {
    let motion =
        |(source, target): (usize, usize)| ((source, target), trajectory[&source].inverse() * trajectory[&target]);
    let frames = trajectory.keys().copied();
    match steps {
        Steps::Keyframes => frames.clone().zip(frames.skip(1)).map(motion).collect(),
        Steps::Apart(gaps) => {
            let pairs = frames.flat_map(|source| gaps.iter().map(move |gap| (source, source + gap)));
            pairs.filter(|(_, target)| trajectory.contains_key(target)).map(motion).collect()
        }
    }
}

/// Of listed motions those so many frames apart; all, where nothing is asked for.
pub(super) fn apart<T: Clone>(listed: &BTreeMap<(usize, usize), T>, gaps: &[usize]) -> BTreeMap<(usize, usize), T> {
    let wanted = |(source, target): (usize, usize)| gaps.is_empty() || gaps.contains(&(target - source));
    listed.iter().filter(|(pair, _)| wanted(**pair)).map(|(pair, motion)| (*pair, motion.clone())).collect()
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
    use crate::geometry::{Pose, Tangent};

    #[test]
    fn motions_of_keyframes_are_those_between_them() {
        let forward = |frame: usize| Pose::exp(&Tangent::new(frame as f64, 0.0, 0.0, 0.0, 0.0, 0.0));
        let trajectory = [0, 1, 3, 6, 9].map(|frame| (frame, forward(frame))).into();
        let motions = motions_of(&trajectory, Steps::Keyframes);
        let expected: Motions = [(0, 1), (1, 3), (3, 6), (6, 9)]
            .map(|(source, target)| ((source, target), forward(target - source)))
            .into();
        assert_eq!(motions, expected);
        let apart = |gaps: &[usize]| motions_of(&trajectory, Steps::Apart(gaps)).into_keys().collect::<Vec<_>>();
        assert_eq!(apart(&[1]), [(0, 1)]);
        assert_eq!(apart(&[3, 5]), [(0, 3), (1, 6), (3, 6), (6, 9)]);
    }
}
