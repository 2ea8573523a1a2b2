//! Which frames the rows of a trajectory are, where the rows do not say it.

use std::path::Path;

use super::sequences::OdometrySequence;
use crate::error::{Error, Place, Result};

/// What rows can be the poses of.
pub(crate) struct Joined<'a> {
    /// Whose frames they are, for messages.
    pub(crate) whose: &'a str,
    /// The odometry sequence that was cut from the drive.
    pub(crate) sequence: Option<OdometrySequence>,
    /// Whether the file is that sequence's by its name.
    pub(crate) is_sequence: bool,
    /// Sets of frames that a program may have gone through, the likelier first; each in order.
    pub(crate) sets: [Vec<usize>; 2],
}

/// The frame of each of so many rows: those of the drive's odometry sequence where there are as many; else one by one
/// those of a set of as many frames; else frames from 0 on, and where these are not as many as the drive has, that is
/// said.
///
/// # Errors
/// There are not as many, and the frames begin after 0: a part of something.
pub(crate) fn frames_of_rows(rows: usize, path: &Path, joined: &Joined) -> Result<Vec<usize>> {
    let Joined { whose, sequence, is_sequence, sets } = joined;
    if let Some(cut) = sequence.filter(|cut| *is_sequence || cut.frames == rows) {
        return Ok((cut.first_frame..).take(rows).collect());
    }
    if let Some(frames) = sets.iter().find(|frames| frames.len() == rows) {
        return Ok(frames.clone());
    }
    let known = || sets.iter().flatten().copied();
    let (Some(first), Some(last)) = (known().min(), known().max()) else { return Ok((0..rows).collect()) };
    if first > 0 {
        return Err(Error::malformed(
            path,
            Place::Whole,
            format!("{rows} rows without frames, which would be 0 … {}", rows - 1),
            format!("frames of {whose}, {first} … {last}: write the frame before each row (13 columns)"),
        ));
    }
    if rows != last + 1 {
        tracing::warn!(
            "{}: {rows} rows without frames, taken for 0 … {}, and {whose} has frames {first} … {last}; a frame before each row (13 columns) leaves no doubt",
            path.display(),
            rows - 1
        );
    }
    Ok((0..rows).collect())
}

#[cfg(test)]
mod tests {
    use super::super::odometry_sequence;
    use super::*;

    fn frames(rows: usize, drive: &str, is_sequence: bool, sets: [Vec<usize>; 2]) -> Result<Vec<usize>> {
        let joined = Joined { whose: drive, sequence: odometry_sequence(drive), is_sequence, sets };
        frames_of_rows(rows, Path::new("vo.txt"), &joined)
    }

    #[test]
    fn rows_are_the_frames_that_they_fit() {
        let (eight, packets) = ("2011_09_30_drive_0028", (0..5177).collect::<Vec<_>>());
        let ten: Vec<usize> = (1100..1110).collect();
        let first_and_last = |frames: Vec<usize>| [frames[0], *frames.last().unwrap()];
        let of = |rows, is_sequence| {
            first_and_last(frames(rows, eight, is_sequence, [ten.clone(), packets.clone()]).unwrap())
        };
        assert_eq!(of(4071, false), [1100, 5170]);
        assert_eq!(of(5177, false), [0, 5176]);
        assert_eq!(of(10, false), [1100, 1109]);
        assert_eq!(of(400, true), [1100, 1499]);
        assert_eq!(of(4000, false), [0, 3999]);
        // Frames that were dropped from a recording were not measured either.
        assert_eq!(frames(3, "lab", false, [vec![2, 5, 9], vec![]]).unwrap(), [2, 5, 9]);
        let message = frames(4, "lab", false, [vec![10, 11, 12], vec![]]).unwrap_err().to_string();
        assert!(
            message.contains("found 4 rows without frames, which would be 0 … 3; expected frames of lab, 10 … 12"),
            "{message}"
        );
    }
}
