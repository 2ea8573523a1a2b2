//! What belongs together by time: of a sensor that runs on its own, what is nearest to each frame.

use std::collections::BTreeMap;

use crate::time::Time;

/// Largest distance in time between a frame and what belongs to it, s: the TUM benchmark's, a fifth of KITTI's period.
pub(crate) const LARGEST_DISTANCE_S: f64 = 0.02;

/// Frames and what was found nearest to each, within a limit; nothing belongs to two frames.
pub(super) struct Association {
    /// Frames in order of time.
    frames: Vec<(Time, usize)>,
    limit_s: f64,
    /// By frame: how far away in time, s, and which.
    nearest: BTreeMap<usize, (f64, usize)>,
}

impl Association {
    pub(super) fn new(times: &BTreeMap<usize, Time>, limit_s: f64) -> Self {
        let mut frames: Vec<(Time, usize)> = times.iter().map(|(&frame, &time)| (time, frame)).collect();
        frames.sort();
        Self { frames, limit_s, nearest: BTreeMap::new() }
    }

    /// Offers what was seen at a time to the frame that is nearest.
    pub(super) fn offer(&mut self, time: Time, index: usize) {
        let after = self.frames.partition_point(|&(frame_time, _)| frame_time < time);
        let around = &self.frames[after.saturating_sub(1)..self.frames.len().min(after + 1)];
        let distances = around.iter().map(|&(frame_time, frame)| (frame_time.since(time).abs(), frame));
        let Some((distance, frame)) = distances.min_by(|a, b| a.0.total_cmp(&b.0)) else { return };
        let known = self.nearest.get(&frame).map_or(self.limit_s, |&(distance, _)| distance);
        if distance <= known {
            self.nearest.insert(frame, (distance, index));
        }
    }

    /// Largest distance, s.
    pub(super) fn limit_s(&self) -> f64 {
        self.limit_s
    }

    /// First and last time of the frames.
    pub(super) fn span(&self) -> Option<[Time; 2]> {
        Some([self.frames.first()?.0, self.frames.last()?.0])
    }

    /// How many frames there are.
    pub(super) fn frames(&self) -> usize {
        self.frames.len()
    }

    /// By frame: the index of what is nearest.
    pub(super) fn into_nearest(self) -> BTreeMap<usize, usize> {
        self.nearest.into_iter().map(|(frame, (_, index))| (frame, index)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_belongs_to_two_frames_and_none_to_what_is_far() {
        let time = |milliseconds: i64| Time::from_nanoseconds(milliseconds * 1_000_000);
        let frames: BTreeMap<usize, Time> = [(4, time(100)), (5, time(133)), (6, time(166)), (7, time(200))].into();
        let mut association = Association::new(&frames, 0.02);
        // The first is nearer to frame 5; the last but one is nearer to frame 7 than the last; frame 6 has none.
        for (index, milliseconds) in [120, 205, 210].into_iter().enumerate() {
            association.offer(time(milliseconds), index);
        }
        assert_eq!(association.into_nearest(), [(5, 0), (7, 1)].into());
    }
}
