//! How far odometry reaches: the frames that its motions join.

use std::collections::BTreeSet;

use crate::fusion::Odometry;
use crate::recordings::Trajectory;

/// The frames that some motion reaches.
pub(super) fn reached_frames(odometry: &[Odometry]) -> BTreeSet<usize> {
    let motions = odometry.iter().flat_map(|system| &system.motions);
    motions.flat_map(|motion| [motion.source, motion.target]).collect()
}

/// The true poses of frames that some motion reaches.
pub(super) fn reached(truth: &Trajectory, odometry: &[Odometry]) -> Trajectory {
    let frames = reached_frames(odometry);
    truth.iter().filter(|(frame, _)| frames.contains(frame)).map(|(&frame, &pose)| (frame, pose)).collect()
}
