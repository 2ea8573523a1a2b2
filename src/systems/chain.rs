//! Poses from motions: frames that hang together get one set of axes.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use crate::geometry::Pose;
use crate::recordings::Trajectory;

/// Poses of all frames, part by part: `first_from_frame`, where motions join a part's frames to its first one. Of several
/// ways to a frame the one of fewest motions counts.
pub fn chain_poses(motions: &[(usize, usize, Pose)]) -> Vec<Trajectory> {
    let mut neighbours: BTreeMap<usize, Vec<(usize, Pose)>> = BTreeMap::new();
    for &(source, target, source_from_target) in motions {
        neighbours.entry(source).or_default().push((target, source_from_target));
        neighbours.entry(target).or_default().push((source, source_from_target.inverse()));
    }
    let mut left: BTreeSet<usize> = neighbours.keys().copied().collect();
    let mut parts = Vec::new();
    while let Some(first) = left.pop_first() {
        let mut poses = Trajectory::from([(first, Pose::identity())]);
        let mut reached = VecDeque::from([first]);
        while let Some(frame) = reached.pop_front() {
            let here = poses[&frame];
            for (next, motion) in &neighbours[&frame] {
                if left.remove(next) {
                    poses.insert(*next, here * *motion);
                    reached.push_back(*next);
                }
            }
        }
        parts.push(poses);
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn every_frame_has_one_pose_in_its_part() {
        let step = Pose::exp(&Tangent::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.1));
        let motions = [(0, 1, step), (0, 2, step * step), (1, 3, step * step), (2, 3, step), (7, 8, step)];
        let parts = chain_poses(&motions);
        let frames: Vec<Vec<usize>> = parts.iter().map(|part| part.keys().copied().collect()).collect();
        assert_eq!(frames, [vec![0, 1, 2, 3], vec![7, 8]]);
        assert!((parts[0][&3].matrix() - (step * step * step).matrix()).norm() < 1e-12);
    }
}
