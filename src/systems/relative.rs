//! CSV files of relative poses: `source,target,x,y,z,qx,qy,qz,qw[,36 covariance values]`.

use std::path::Path;

use nalgebra::{Matrix6, UnitQuaternion, Vector3};

use super::trajectory::{parse_frame_index, pose_from_quaternion};
use crate::error::{Error, Place, Result};
use crate::files::parse_numbers;
use crate::geometry::{Covariance6, Pose};

/// Columns of pose and frames.
const POSE_COLUMNS: usize = 9;
/// Columns of a row that carries its covariance.
const COVARIANCE_COLUMNS: usize = POSE_COLUMNS + 36;

/// A measured relative pose, with its covariance when the file states one.
#[derive(Clone, Debug, PartialEq)]
pub struct RelativePose {
    /// Source frame i.
    pub source: usize,
    /// Target frame, i + 1 in an unbroken sequence.
    pub target: usize,
    /// `ⁱT̂ᵢ₊₁`, axes of the body the file describes.
    pub source_from_target: Pose,
    /// Covariance of the left perturbation, row-major in the file, order ρ then φ, same axes.
    pub covariance: Option<Covariance6>,
}

/// What some editors put before the first character of a file.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// What a remark says where covariances are those of the right perturbation.
pub(crate) const RIGHT: &str = "perturbation right";

/// The axes that a remark of a CSV of relative poses states: `# frame vehicle, …`.
pub(crate) fn stated_frame(text: &str) -> Option<&str> {
    let remarks = text.trim_start_matches(BYTE_ORDER_MARK).lines().take_while(|line| line.starts_with('#'));
    remarks.filter_map(|line| line.split_once("frame ")?.1.split([',', ' ']).next()).next()
}

/// Parses a CSV of relative poses. Lines that begin with `#` are remarks, and the first other line may be a header that
/// begins with `source`. Covariances are those of the left perturbation, unless a remark says `perturbation right`.
///
/// # Errors
/// Wrong count, numbers that are not finite, a quaternion far from unit length, a covariance that
/// is none, or a pair that does not come after the one before; the message names the line.
pub fn parse_relative_poses(text: &str, path: &Path) -> Result<Vec<RelativePose>> {
    let mut poses: Vec<RelativePose> = Vec::new();
    let (mut right, mut header_may_come) = (false, true);
    for (index, line) in text.trim_start_matches(BYTE_ORDER_MARK).lines().enumerate() {
        if line.trim_start().starts_with('#') {
            right |= line.contains(RIGHT);
            continue;
        }
        let header = std::mem::take(&mut header_may_come) && line.trim_start().starts_with("source");
        if line.trim().is_empty() || header {
            continue;
        }
        let place = Place::Line(index + 1);
        let malformed = |found: String, expected: &str| Error::malformed(path, place.clone(), found, expected);
        let values = parse_numbers(&line.replace(',', " "), path, &place)?;
        if values.len() != POSE_COLUMNS && values.len() != COVARIANCE_COLUMNS {
            return Err(malformed(
                format!("{} values", values.len()),
                "9 (source,target,x,y,z,qx,qy,qz,qw), or 45 with a row-major covariance",
            ));
        }
        let source = parse_frame_index(values[0], path, &place)?;
        let target = parse_frame_index(values[1], path, &place)?;
        if target <= source {
            return Err(malformed(format!("source {source}, target {target}"), "a target after its source"));
        }
        if let Some(last) = poses.last()
            && (last.source, last.target) >= (source, target)
        {
            let found = format!("pair {source},{target} after {},{}", last.source, last.target);
            return Err(malformed(found, "increasing pairs, each once"));
        }
        let translation = Vector3::new(values[2], values[3], values[4]);
        let source_from_target =
            pose_from_quaternion(translation, [values[5], values[6], values[7], values[8]], path, &place)?;
        let covariance = match &values[POSE_COLUMNS..] {
            [] => None,
            entries => Some(
                Covariance6::from_matrix(Matrix6::from_row_slice(entries))
                    .map_err(|error| malformed(error.to_string(), "a symmetric, non-negative 6x6 covariance"))?,
            ),
        };
        let covariance = match (right, covariance) {
            (true, Some(covariance)) => Some(covariance.left_of(&source_from_target)),
            (_, covariance) => covariance,
        };
        poses.push(RelativePose { source, target, source_from_target, covariance });
    }
    Ok(poses)
}

/// Columns of a file that states covariances, as [`parse_relative_poses`] reads them.
pub fn relative_pose_header() -> String {
    let entries = (0..36).map(|k| format!(",c{}{}", k / 6, k % 6)).collect::<String>();
    format!("source,target,x,y,z,qx,qy,qz,qw{entries}\n")
}

/// A row of the CSV that [`parse_relative_poses`] reads, with its line end.
pub fn format_relative_pose(pose: &RelativePose) -> String {
    let quaternion = UnitQuaternion::from_rotation_matrix(&pose.source_from_target.rotation);
    let numbers = pose.source_from_target.translation.iter().chain(quaternion.coords.iter());
    let mut row = format!("{},{}", pose.source, pose.target);
    numbers.for_each(|value| row += &format!(",{value:.12}"));
    if let Some(covariance) = &pose.covariance {
        covariance.matrix().transpose().iter().for_each(|value| row += &format!(",{value:.9e}"));
    }
    row + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Tangent;

    fn parse(text: &str) -> Result<Vec<RelativePose>> {
        parse_relative_poses(text, Path::new("relative.csv"))
    }

    #[test]
    fn a_row_may_carry_its_covariance() {
        let identity: Vec<&str> = (0..36).map(|k| if k % 7 == 0 { "0.5" } else { "0" }).collect();
        let text =
            format!("source,target,x,y,z,qx,qy,qz,qw\n4,5,1,0,0,0,0,0,1\n5,6,1,2,3,0,0,0,1,{}\n", identity.join(","));
        let poses = parse(&text).unwrap();
        assert_eq!((poses[0].source, poses[0].covariance.is_some()), (4, false));
        assert_eq!(poses[1].covariance.unwrap().variance()[5], 0.5);
        assert_eq!(poses[1].source_from_target.translation.y, 2.0);
    }

    #[test]
    fn written_rows_come_back() {
        let pose = RelativePose {
            source: 3,
            target: 4,
            source_from_target: Pose::exp(&Tangent::new(1.2, -0.1, 0.02, 0.01, -0.02, 0.3)),
            covariance: Some(Covariance6::from_std_devs(&Tangent::new(0.1, 0.2, 0.3, 1e-3, 2e-3, 3e-3))),
        };
        let text = relative_pose_header() + &format_relative_pose(&pose);
        let back = parse(&text).unwrap().remove(0);
        assert!((back.source_from_target.matrix() - pose.source_from_target.matrix()).norm() < 1e-11);
        let difference = back.covariance.unwrap().matrix() - pose.covariance.unwrap().matrix();
        assert!(difference.norm() < 1e-10);
        let bare = RelativePose { covariance: None, ..pose };
        assert_eq!(format_relative_pose(&bare).matches(',').count(), 8);
    }

    #[test]
    fn errors_name_the_line() {
        for (text, words) in [
            ("1,2,0,0,0,0,0,0\n", ["line 1", "8 values"]),
            ("1,2,0,0,0,0,0,0,1\n1,2,0,0,0,0,0,0,1\n", ["line 2", "1,2 after 1,2"]),
            ("2,1,0,0,0,0,0,0,1\n", ["line 1", "target 1"]),
            ("1,2,0,0,0,0,0,0,2\n", ["line 1", "length 2"]),
            ("1,2,0,x,0,0,0,0,1\n", ["line 1", "`x`"]),
            ("1.5,2,0,0,0,0,0,0,1\n", ["line 1", "1.5"]),
        ] {
            let message = parse(text).unwrap_err().to_string();
            assert!(words.iter().all(|word| message.contains(word)), "{message}");
        }
    }
}
