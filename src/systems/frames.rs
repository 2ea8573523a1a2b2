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
    /// Sets of frames that a program may have gone through, the likelier first; each in order.
    pub(crate) sets: &'a [Vec<usize>],
}

/// The frame of each of so many rows: those of the drive's odometry sequence where there are as many; else one by one
/// those of a set of as many frames, which is said where they do not begin at 0 or have gaps; else frames from 0 on, and
/// where these are not as many as there are, that is said.
///
/// # Errors
/// There are not as many, and the frames begin after 0: a part of something.
pub(crate) fn frames_of_rows(rows: usize, path: &Path, joined: &Joined) -> Result<Vec<usize>> {
    let Joined { whose, sequence, sets } = joined;
    if let Some(cut) = sequence.filter(|cut| cut.frames == rows) {
        return Ok((cut.first_frame..).take(rows).collect());
    }
    let from_zero = || (0..rows).collect();
    let known = || sets.iter().flatten().copied();
    let (Some(first), Some(last)) = (known().min(), known().max()) else { return Ok(from_zero()) };
    if rows == last + 1 {
        return Ok(from_zero());
    }
    let doubt = "a frame before each row (13 columns) leaves no doubt";
    if let Some(frames) = sets.iter().find(|frames| frames.len() == rows) {
        let (path, from, to) = (path.display(), frames[0], frames[rows - 1]);
        tracing::warn!(
            "{path}: {rows} rows without frames, taken one by one for those of {whose}, {from} … {to}; {doubt}"
        );
        return Ok(frames.clone());
    }
    if first > 0 {
        let found = format!("{rows} rows without frames, which would be 0 … {}", rows - 1);
        let expected = format!("frames of {whose}, {first} … {last}: write the frame before each row (13 columns)");
        return Err(Error::malformed(path, Place::Whole, found, expected));
    }
    let (path, end) = (path.display(), rows - 1);
    tracing::warn!(
        "{path}: {rows} rows without frames, taken for 0 … {end}, and {whose} has frames {first} … {last}; {doubt}"
    );
    Ok(from_zero())
}

#[cfg(test)]
mod tests {
    use super::super::odometry_sequence;
    use super::*;

    fn frames(rows: usize, drive: &str, sets: &[Vec<usize>]) -> Result<Vec<usize>> {
        let joined = Joined { whose: drive, sequence: odometry_sequence(drive), sets };
        frames_of_rows(rows, Path::new("vo.txt"), &joined)
    }

    #[test]
    fn rows_are_the_frames_that_they_fit() {
        let (eight, packets) = ("2011_09_30_drive_0028", (0..5177).collect::<Vec<_>>());
        let ten: Vec<usize> = (1100..1110).collect();
        let first_and_last = |frames: Vec<usize>| [frames[0], *frames.last().unwrap()];
        let of = |rows| first_and_last(frames(rows, eight, &[ten.clone(), packets.clone()]).unwrap());
        assert_eq!(of(4071), [1100, 5170]);
        assert_eq!(of(5177), [0, 5176]);
        assert_eq!(of(10), [1100, 1109]);
        assert_eq!(of(4000), [0, 3999]);
        // Frames that were dropped from a recording were not measured either.
        assert_eq!(frames(3, "lab", &[vec![2, 5, 9]]).unwrap(), [2, 5, 9]);
        // Frame 0 has a row, though nothing else.
        assert_eq!(frames(4, "lab", &[vec![1, 2, 3]]).unwrap(), [0, 1, 2, 3]);
        let message = frames(4, "lab", &[vec![10, 11, 12]]).unwrap_err().to_string();
        let expected = "found 4 rows without frames, which would be 0 … 3; expected frames of lab, 10 … 12";
        assert!(message.contains(expected), "{message}");
    }
}
