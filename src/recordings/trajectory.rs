//! Files of absolute poses: KITTI rows of 12 or 13 numbers, TUM, and EuRoC.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix3x4, Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::association::Association;
use crate::error::{Error, Place, Result, excerpt};
use crate::files::{frame_index, parse_numbers, remarks, rows};
use crate::geometry::{ErrorFrame, Pose};
use crate::time::{EXPECTED_NANOSECONDS, EXPECTED_SECONDS, Time};

/// Largest `|RᵀR − I|` of a rotation in a trajectory file (files with six digits exist).
const ROTATION_TOLERANCE: f64 = 1e-3;
/// Largest deviation of a quaternion's norm from 1.
const QUATERNION_TOLERANCE: f64 = 1e-2;

/// Longer motions between two frames are mistakes, m.
pub(crate) const LARGEST_MOTION_M: f64 = 1e4;

/// Absolute poses `world_from_body` by frame index.
pub type Trajectory = BTreeMap<usize, Pose>;

/// The poses of a KITTI file.
pub(crate) enum KittiPoses {
    /// Rows of 13: each says its frame.
    Framed(Trajectory),
    /// Rows of 12: which frames they are must be known otherwise (`frames_of_rows`).
    Rows(Vec<Pose>),
}

/// Parses KITTI rows: 12 numbers (3x4, row-major), or 13 with a leading frame index.
///
/// Rows without an index are frames `first_frame`, `first_frame + 1`, …
///
/// # Errors
/// Wrong count, a number that is not finite, a matrix that is no rotation, an index that is not
/// larger than the one before; the message names the line. Or there is no row.
pub fn parse_kitti_trajectory(text: &str, path: &Path, first_frame: usize) -> Result<Trajectory> {
    Ok(match parse_kitti_poses(text, path)? {
        KittiPoses::Framed(trajectory) => trajectory,
        KittiPoses::Rows(poses) => (first_frame..).zip(poses).collect(),
    })
}

/// The same, with the frames left open where the file does not say them.
pub(crate) fn parse_kitti_poses(text: &str, path: &Path) -> Result<KittiPoses> {
    let (mut framed, mut poses) = (Trajectory::new(), Vec::new());
    let mut columns = None;
    for (place, line) in rows(text) {
        let malformed = |found: String, expected: &str| Error::malformed(path, place.clone(), found, expected);
        let values = parse_numbers(line, path, &place)?;
        let expected_columns = *columns.get_or_insert(values.len());
        if !matches!(values.len(), 12 | 13) || values.len() != expected_columns {
            return Err(malformed(
                format!("{} numbers", values.len()),
                match columns {
                    Some(12) => "12 as in the rows before (a 3x4 pose)",
                    Some(13) => "13 as in the rows before (a frame index and a 3x4 pose)",
                    _ if values.len() == 8 => {
                        "12 (a 3x4 pose), or 13 with a leading frame index; rows of 8 are TUM's, format = \"tum\""
                    }
                    _ => "12 (a 3x4 pose), or 13 with a leading frame index",
                },
            ));
        }
        let matrix = Matrix3x4::from_row_slice(&values[values.len() - 12..]);
        let pose =
            Pose::from_rounded_parts(matrix.fixed_columns::<3>(0).into(), matrix.column(3).into(), ROTATION_TOLERANCE)
                .map_err(|deviation| {
                    malformed(format!("|RᵀR − I| = {deviation:.1e}"), "a rotation matrix in the left 3x3 block")
                })?;
        if values.len() == 12 {
            poses.push(pose);
            continue;
        }
        let frame = frame_index(line.split_whitespace().next().unwrap_or_default(), path, &place)?;
        if let Some((&last, _)) = framed.last_key_value()
            && frame <= last
        {
            return Err(malformed(format!("frame {frame} after frame {last}"), "increasing frame indices, each once"));
        }
        framed.insert(frame, pose);
    }
    match (framed.is_empty(), poses.is_empty()) {
        (true, true) => {
            Err(Error::malformed(path, Place::Whole, "no row", "12 numbers a frame, or 13 with a leading frame index"))
        }
        (true, false) => Ok(KittiPoses::Rows(poses)),
        (false, _) => Ok(KittiPoses::Framed(framed)),
    }
}

/// Parses TUM rows `t x y z qx qy qz qw` and matches them to frames by time.
///
/// A frame takes the row nearest in time, within `tolerance_s`; other rows are left out.
///
/// # Errors
/// Wrong count, numbers that are not finite, a quaternion far from unit length, times that do not
/// increase; or not one row belongs to a frame.
pub fn parse_tum_trajectory(
    text: &str,
    path: &Path,
    frame_times: &BTreeMap<usize, Time>,
    tolerance_s: f64,
) -> Result<Trajectory> {
    match_tum_poses(text, path, frame_times, tolerance_s).map(FramePoses::said)
}

/// The same, with what there is to remark.
pub(super) fn match_tum_poses(
    text: &str,
    path: &Path,
    frame_times: &BTreeMap<usize, Time>,
    tolerance_s: f64,
) -> Result<FramePoses> {
    require_tum_order(text, path)?;
    let mut poses = TimedPoses::new(path, frame_times, tolerance_s);
    for (place, line) in rows(text) {
        let malformed = |found: String, expected: &str| Error::malformed(path, place.clone(), found, expected);
        let values = parse_numbers(line, path, &place)?;
        let &[_, x, y, z, qx, qy, qz, qw] = values.as_slice() else {
            return Err(malformed(format!("{} numbers", values.len()), "8: t x y z qx qy qz qw"));
        };
        let word = line.split_whitespace().next().unwrap_or_default();
        let time =
            Time::parse_seconds(word).ok_or_else(|| malformed(format!("time {}", excerpt(word)), EXPECTED_SECONDS))?;
        poses.push(time, Vector3::new(x, y, z), [qx, qy, qz, qw], &place)?;
    }
    poses.of_frames("rows of t x y z qx qy qz qw")
}

/// What a row of EuRoC's truth begins with, for messages.
const EUROC_COLUMNS: &str = "timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z, w the first of the quaternion";

/// Parses EuRoC rows `timestamp [ns], x, y, z, qw, qx, qy, qz, …`, the columns after those passed over, and matches them to
/// frames as [`parse_tum_trajectory`] does.
///
/// # Errors
/// As there; or the remark that names the columns has the quaternion's w after its x.
pub(super) fn parse_euroc_trajectory(
    text: &str,
    path: &Path,
    frame_times: &BTreeMap<usize, Time>,
    tolerance_s: f64,
) -> Result<FramePoses> {
    if let Some((place, remark)) =
        remarks(text).find(|(_, remark)| quaternion_columns(remark).is_some_and(|(x, w)| x < w))
    {
        return Err(Error::malformed(path, place, excerpt(remark), format!("columns {EUROC_COLUMNS}")));
    }
    let mut poses = TimedPoses::new(path, frame_times, tolerance_s);
    for (place, line) in rows(text) {
        let malformed = |found: String, expected: &str| Error::malformed(path, place.clone(), found, expected);
        let cells: Vec<&str> = line.splitn(9, ',').map(str::trim).collect();
        let &[word, x, y, z, qw, qx, qy, qz, ..] = cells.as_slice() else {
            return Err(malformed(format!("{} cells", cells.len()), &format!("at least 8: {EUROC_COLUMNS}")));
        };
        let time = Time::parse_nanoseconds(word)
            .ok_or_else(|| malformed(format!("time {}", excerpt(word)), EXPECTED_NANOSECONDS))?;
        let mut numbers = [0.0; 7];
        for (number, cell) in numbers.iter_mut().zip([x, y, z, qx, qy, qz, qw]) {
            let finite = cell.parse::<f64>().ok().filter(|value| value.is_finite());
            *number = finite.ok_or_else(|| malformed(excerpt(cell), "a finite number"))?;
        }
        let [x, y, z, quaternion @ ..] = numbers;
        poses.push(time, Vector3::new(x, y, z), quaternion, &place)?;
    }
    poses.of_frames(&format!("rows of {EUROC_COLUMNS}"))
}

/// Poses by increasing time, and which of them are nearest to frames.
struct TimedPoses<'a> {
    path: &'a Path,
    nearest: Association,
    poses: Vec<Pose>,
    span: Option<[Time; 2]>,
}

impl<'a> TimedPoses<'a> {
    fn new(path: &'a Path, frame_times: &BTreeMap<usize, Time>, tolerance_s: f64) -> Self {
        Self { path, nearest: Association::new(frame_times, tolerance_s), poses: Vec::new(), span: None }
    }

    /// Takes the next; its quaternion as `x y z w`.
    fn push(&mut self, time: Time, translation: Vector3<f64>, quaternion: [f64; 4], place: &Place) -> Result<()> {
        if let Some([_, last]) = self.span.filter(|[_, last]| time <= *last) {
            let found = format!("time {time} after {last}");
            return Err(Error::malformed(self.path, place.clone(), found, "increasing times"));
        }
        self.span = Some([self.span.map_or(time, |[first, _]| first), time]);
        self.nearest.offer(time, self.poses.len());
        self.poses.push(pose_from_quaternion(translation, quaternion, self.path, place)?);
        Ok(())
    }

    /// Those of frames; `expected` says what there should be where there is none.
    fn of_frames(self, expected: &str) -> Result<FramePoses> {
        let Some(span) = self.span else {
            return Err(Error::malformed(self.path, Place::Whole, "no row", expected));
        };
        poses_of_frames(self.nearest, &self.poses, span, self.path)
    }
}

/// Poses of frames, and how many frames have none, where there are such.
pub(super) struct FramePoses {
    pub(super) poses: Trajectory,
    pub(super) remark: Option<String>,
}

impl FramePoses {
    /// The poses; what there is to remark is said.
    fn said(self) -> Trajectory {
        if let Some(remark) = self.remark {
            tracing::warn!("{remark}");
        }
        self.poses
    }
}

/// The poses nearest to frames.
///
/// # Errors
/// Not one belongs to a frame: another clock, or other units.
fn poses_of_frames(nearest: Association, poses: &[Pose], span: [Time; 2], path: &Path) -> Result<FramePoses> {
    let (limit_s, all, frames) = (nearest.limit_s(), nearest.frames(), nearest.span());
    let nearest = nearest.into_nearest();
    if nearest.is_empty() {
        let expected = match frames {
            Some([begin, end]) => format!("times of frames, {begin} to {end}, to {limit_s} s"),
            None => "frames whose times are known".to_owned(),
        };
        let found = format!("{} poses, {} to {} s", poses.len(), span[0], span[1]);
        return Err(Error::malformed(path, Place::Whole, found, expected));
    }
    let remark = (nearest.len() < all).then(|| {
        let (path, lacking) = (path.display(), all - nearest.len());
        format!("{path}: no pose within {limit_s} s of {lacking} of the {all} frames")
    });
    Ok(FramePoses { poses: nearest.into_iter().map(|(frame, index)| (frame, poses[index])).collect(), remark })
}

/// The axes that the first line of a TUM trajectory states which relcov wrote: `…, axes: vehicle`.
pub(crate) fn stated_axes(text: &str) -> Option<ErrorFrame> {
    let (_, remark) = remarks(text).next()?;
    let (_, axes) = remark.split_once("axes: ")?;
    ErrorFrame::of(axes.split(|c: char| !c.is_alphabetic()).next()?)
}

/// That a remark which names columns names them as TUM files have them.
fn require_tum_order(text: &str, path: &Path) -> Result<()> {
    for (place, remark) in remarks(text) {
        if quaternion_columns(remark).is_some_and(|(x, w)| w < x) {
            return Err(Error::malformed(path, place, excerpt(remark), "columns t x y z qx qy qz qw, w the last"));
        }
    }
    Ok(())
}

/// Where a remark names the columns x and w of a quaternion: `qx`, `q_w`, `q_RS_x`.
fn quaternion_columns(remark: &str) -> Option<(usize, usize)> {
    let remark = remark.to_lowercase();
    let words: Vec<&str> = remark.split(|c: char| !(c.is_alphanumeric() || c == '_')).collect();
    let at = |axis: char| words.iter().position(|word| word.starts_with('q') && word.ends_with(axis) && word.len() > 1);
    at('x').zip(at('w'))
}

/// A pose from translation and quaternion `x y z w`, which is normalised.
pub(crate) fn pose_from_quaternion(
    translation: Vector3<f64>,
    [x, y, z, w]: [f64; 4],
    path: &Path,
    place: &Place,
) -> Result<Pose> {
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(Error::malformed(
            path,
            place.clone(),
            format!("a quaternion of length {norm:.4}"),
            "a quaternion of length 1",
        ));
    }
    let rotation: Rotation3<f64> = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix();
    Ok(Pose::new(rotation, translation))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Tangent;

    fn times(seconds: &[(usize, &str)]) -> BTreeMap<usize, Time> {
        seconds.iter().map(|&(frame, text)| (frame, Time::parse_seconds(text).unwrap())).collect()
    }

    const IDENTITY_ROW: &str = "1 0 0 0 0 1 0 0 0 0 1 0";

    fn parse(text: &str) -> Result<Trajectory> {
        parse_kitti_trajectory(text, Path::new("poses.txt"), 0)
    }

    proptest! {
        #[test]
        fn printed_poses_come_back(values in prop::array::uniform6(-2.0..2.0_f64), first in 0_usize..5000, indexed: bool) {
            let pose = Pose::exp(&Tangent::from(values));
            let m = pose.matrix();
            let row: Vec<String> = (0..12).map(|k| format!("{:.12e}", m[(k / 4, k % 4)])).collect();
            let prefix = if indexed { format!("{first} ") } else { String::new() };
            let parsed = parse_kitti_trajectory(&format!("{prefix}{}\n", row.join(" ")), Path::new("p"), first).unwrap();
            prop_assert!((parsed[&first].matrix() - m).norm() < 1e-9);
        }

        #[test]
        fn no_text_makes_the_parsers_panic(text in "[-0-9.eEnaif \n#]{0,200}") {
            let _ = parse(&text);
            let _ = parse_tum_trajectory(&text, Path::new("p"), &times(&[(0, "1")]), 0.1);
        }
    }

    #[test]
    fn errors_name_the_line() {
        for (text, line, word) in [
            (format!("{IDENTITY_ROW}\n1 2 3\n"), "line 2", "3 numbers"),
            (format!("{IDENTITY_ROW}\n\n{}\n", IDENTITY_ROW.replace("1 0 0 0 0", "nan 0 0 0 0")), "line 3", "`nan`"),
            (format!("2 {IDENTITY_ROW}\n2 {IDENTITY_ROW}\n"), "line 2", "frame 2 after frame 2"),
            (format!("7 {IDENTITY_ROW}\n3 {IDENTITY_ROW}\n"), "line 2", "frame 3 after frame 7"),
            (format!("{}\n", IDENTITY_ROW.replacen('1', "1.5", 1)), "line 1", "RᵀR"),
            (format!("{}\n", IDENTITY_ROW.replacen('1', "-1", 1)), "line 1", "RᵀR"),
            (format!("{IDENTITY_ROW}\n0 {IDENTITY_ROW}\n"), "line 2", "13 numbers"),
        ] {
            let message = parse(&text).unwrap_err().to_string();
            assert!(message.contains(line) && message.contains(word), "{message}");
        }
    }

    #[test]
    fn tum_rows_find_their_frames_by_time() {
        let frames = times(&[(10, "100.0"), (11, "100.1"), (12, "100.2")]);
        let text = "# t x y z qx qy qz qw\n99.0 0 0 0 0 0 0 1\n100.004 1 0 0 0 0 0 1\n100.014 7 0 0 0 0 0 1\n100.195 2 0 0 0 0 0.7071068 0.7071068\n";
        let trajectory = parse_tum_trajectory(text, Path::new("t"), &frames, 0.02).unwrap();
        assert_eq!(trajectory.keys().copied().collect::<Vec<_>>(), [10, 12]);
        assert_eq!(trajectory[&10].translation.x, 1.0);
        assert_relative_eq!(trajectory[&12].log()[5], std::f64::consts::FRAC_PI_2, epsilon = 1e-6);
        let far = times(&[(0, "0")]);
        let message = parse_tum_trajectory(text, Path::new("t"), &far, 0.02).unwrap_err().to_string();
        assert!(
            message.contains("found 4 poses, 99.000000000 to 100.195000000 s; expected times of frames"),
            "{message}"
        );
    }

    #[test]
    fn tum_times_are_read_to_the_nanosecond() {
        let frames = times(&[(0, "1403636579.763555584"), (1, "1403636579.763555600")]);
        let text = "1403636579.763555599 1 0 0 0 0 0 1\n";
        assert_eq!(parse_tum_trajectory(text, Path::new("t"), &frames, 1e-7).unwrap().keys().collect::<Vec<_>>(), [&1]);
        for (text, words) in [
            ("1.0,0,0,0,0,0,0,1\n", "expected numbers separated by blanks"),
            ("1403636579763555584 0 0 0 0 0 0 1\n", "nanoseconds are to be divided"),
            ("# t x y z qx qy qz qw\n", "found no row"),
            (
                "# t x y z qw qx qy qz\n1 0 0 0 1 0 0 0\n",
                "line 1: found `# t x y z qw qx qy qz`; expected columns t x y z",
            ),
        ] {
            let message = parse_tum_trajectory(text, Path::new("t"), &frames, 0.02).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }
}
