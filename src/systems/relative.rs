//! CSV files of relative poses: `source,target,x,y,z,qx,qy,qz,qw[,36 covariance values]`.

use std::path::Path;

use nalgebra::{Matrix6, UnitQuaternion, Vector3};

use crate::error::{Error, Place, Result, excerpt};
use crate::files::{Form, Table, remarks};
use crate::geometry::{Covariance6, ErrorFrame, Pose};
use crate::recordings::{LARGEST_MOTION_M, pose_from_quaternion};

/// Columns of frames and pose.
const POSE_COLUMNS: [&str; 9] = ["source", "target", "x", "y", "z", "qx", "qy", "qz", "qw"];
/// Entries of a covariance.
const ENTRIES: usize = 36;

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

/// What the first line of a file that relcov wrote says of all others: `# frame vehicle, perturbation left, …`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Statement {
    /// Axes of poses and covariances.
    pub(crate) frame: Option<ErrorFrame>,
    /// Side of covariances.
    pub(crate) side: Side,
}

/// The side on which errors stand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Side {
    #[default]
    Left,
    Right,
}

impl Statement {
    /// The line that says it, with a remark behind it.
    pub(crate) fn line(self, remark: &str) -> String {
        let frame = self.frame.map_or(String::new(), |frame| format!("frame {}, ", frame.name()));
        let side = if self.side == Side::Right { "right" } else { "left" };
        format!("# {frame}perturbation {side}, order x y z roll pitch yaw, m and rad{remark}\n")
    }

    /// What the remarks of a file say; one that does not have the form of relcov's own says nothing.
    ///
    /// # Errors
    /// One nearly has it: axes that are not known, or a side that stands elsewhere.
    pub(crate) fn of(text: &str, path: &Path) -> Result<Self> {
        for (place, remark) in remarks(text) {
            let unclear = || {
                let expected = "`# frame vehicle, perturbation right` with vehicle, camera or world, left or right";
                Error::malformed(path, place.clone(), excerpt(remark), expected)
            };
            match Self::parse(&remark.replace('"', "")) {
                Some(said) => return Ok(said),
                None if ["perturbation", "right"].iter().all(|word| remark.to_ascii_lowercase().contains(word)) => {
                    return Err(unclear());
                }
                None => {}
            }
        }
        Ok(Self::default())
    }

    /// A remark that begins with nothing but a statement; further ones may follow a comma.
    fn parse(remark: &str) -> Option<Self> {
        let mut said = Self::default();
        for (index, part) in remark.trim_start_matches('#').split(',').map(str::trim).enumerate() {
            match (part.split_once(' '), index) {
                (Some(("frame", axes)), _) if ErrorFrame::of(axes).is_some() => said.frame = ErrorFrame::of(axes),
                (Some(("perturbation", "left")), _) => said.side = Side::Left,
                (Some(("perturbation", "right")), _) => said.side = Side::Right,
                (_, 0) => return None,
                _ => {}
            }
        }
        Some(said)
    }
}

/// Parses a CSV of relative poses. A header gives columns their names (`source`, `target`, `x`, `y`, `z`, `qx`, `qy`, `qz`,
/// `qw`, and `c00` … `c55` for covariances) in any order; without one they have this order, and 36 cells after a header of
/// the nine are the covariance. Lines that begin with `#` are remarks. Covariances are those of the left perturbation,
/// unless the remark says otherwise that `relcov predict --format csv` writes.
///
/// # Errors
/// A column is unknown or missing, a cell empty or not a finite number, a quaternion far from unit length, a covariance
/// none, or a pair does not come after the one before; the message names the line.
pub fn parse_relative_poses(text: &str, path: &Path) -> Result<Vec<RelativePose>> {
    parse(text, path, Stated::Read)
}

/// The same without the covariances, whatever stands there: they are to be replaced.
///
/// # Errors
/// As [`parse_relative_poses`].
pub(crate) fn parse_bare_relative_poses(text: &str, path: &Path) -> Result<Vec<RelativePose>> {
    parse(text, path, Stated::PassedOver)
}

/// What becomes of the covariances that a file states.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stated {
    Read,
    PassedOver,
}

fn parse(text: &str, path: &Path, covariances: Stated) -> Result<Vec<RelativePose>> {
    let entries = entry_names();
    let columns: Vec<&str> = POSE_COLUMNS.into_iter().chain(entries.iter().map(String::as_str)).collect();
    let described = "source,target,x,y,z,qx,qy,qz,qw, and 36 values c00 … c55 for covariances";
    let widths = [POSE_COLUMNS.len(), POSE_COLUMNS.len() + ENTRIES];
    let mut table = Table::open(text, path, &Form { columns: &columns, widths: &widths, described })?;
    let places = table.header.require(&POSE_COLUMNS)?;
    let entries = table.header.group(&entries)?.unwrap_or_default();
    let Statement { side, .. } = Statement::of(text, path)?;
    let mut poses: Vec<RelativePose> = Vec::new();
    while let Some(row) = table.next()? {
        let (source, target) = (row.frame(places[0])?, row.frame(places[1])?);
        if target <= source {
            return Err(row.broken(
                format!("source {source}, target {target}"),
                "a target after its source; invert the pose of one before",
            ));
        }
        if let Some(last) = poses.last()
            && (last.source, last.target) >= (source, target)
        {
            let found = format!("pair {source},{target} after {},{}", last.source, last.target);
            return Err(row.broken(found, "increasing pairs, each once; sort the rows"));
        }
        let [x, y, z, quaternion @ ..] = row.numbers::<7>(&places[2..])?;
        let translation = Vector3::new(x, y, z);
        let source_from_target = pose_from_quaternion(translation, quaternion, path, &row.place())?;
        let stated = if covariances == Stated::Read && !entries.is_empty() {
            row.all_or_none::<ENTRIES>(&entries)?
        } else {
            None
        };
        let covariance = stated.map(|entries| {
            Covariance6::from_matrix(Matrix6::from_row_slice(&entries))
                .map_err(|error| row.broken(error.to_string(), error.remedy()))
        });
        let covariance = covariance.transpose()?.map(|covariance| match side {
            Side::Right => covariance.left_of(&source_from_target),
            Side::Left => covariance,
        });
        if translation.norm() > LARGEST_MOTION_M {
            return Err(
                row.broken(format!("a motion of {:.1e} m", translation.norm()), "at most 10 km between two frames")
            );
        }
        poses.push(RelativePose { source, target, source_from_target, covariance });
    }
    warn_of_turns(poses.iter().map(|pose| &pose.source_from_target), path);
    match poses.is_empty() {
        true => Err(Error::malformed(path, Place::Whole, "no row", format!("one for each pair: {described}"))),
        false => Ok(poses),
    }
}

/// Says that most motions turn by more than a right angle, as they do where w is read as x.
pub(super) fn warn_of_turns<'a>(motions: impl Iterator<Item = &'a Pose>, path: &Path) {
    let angles: Vec<f64> = motions.map(|motion| motion.rotation.angle()).collect();
    let turned = angles.iter().filter(|angle| **angle > std::f64::consts::FRAC_PI_2).count();
    if 2 * turned > angles.len() {
        let (path, count) = (path.display(), angles.len());
        tracing::warn!(
            "{path}: {turned} of {count} motions turn by more than 90 degrees; is qw the last of the quaternion?"
        );
    }
}

/// `c00` … `c55`.
fn entry_names() -> Vec<String> {
    (0..ENTRIES).map(|k| format!("c{}{}", k / 6, k % 6)).collect()
}

/// Columns of a file that states covariances, as [`parse_relative_poses`] reads them.
pub fn relative_pose_header() -> String {
    let columns = POSE_COLUMNS.map(str::to_owned).into_iter().chain(entry_names());
    columns.collect::<Vec<_>>().join(",") + "\n"
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
            ("1,2,0,0,0,0,0,0\n", ["line 1", "8 cells"]),
            ("1,2,0,0,0,0,0,0,1\n1,2,0,0,0,0,0,0,1\n", ["line 2", "1,2 after 1,2"]),
            ("2,1,0,0,0,0,0,0,1\n", ["line 1", "target 1"]),
            ("1,2,0,0,0,0,0,0,2\n", ["line 1", "length 2"]),
            ("1,2,0,x,0,0,0,0,1\n", ["line 1", "`x`"]),
            ("1.5,2,0,0,0,0,0,0,1\n", ["line 1", "1.5"]),
            ("source,target,x,y,z,qx,qy,qz,qw\n", ["no row", "one for each pair"]),
        ] {
            let message = parse(text).unwrap_err().to_string();
            assert!(words.iter().all(|word| message.contains(word)), "{message}");
        }
    }

    #[test]
    fn a_remark_is_a_remark() {
        let read = |text: &str| Statement::of(text, Path::new("relative.csv"));
        for (text, frame, side) in [
            ("# frame rate 10 Hz\n", None, Side::Left),
            ("# the frame camera, as told\n# frame vehicle\n", Some(ErrorFrame::Vehicle), Side::Left),
            ("\u{feff}\n# frame camera, perturbation right, m\n", Some(ErrorFrame::Camera), Side::Right),
            ("# perturbation right\n", None, Side::Right),
            ("source,target\n# frame camera\n", Some(ErrorFrame::Camera), Side::Left),
            ("\"# frame camera\",\"perturbation right\"\n", Some(ErrorFrame::Camera), Side::Right),
        ] {
            assert_eq!(read(text).unwrap(), Statement { frame, side }, "{text}");
        }
        for text in [
            "# frame camera0, perturbation right\n",
            "\n# covariances: Perturbation Right\n",
            "# of the right perturbation\n",
        ] {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains("expected `# frame vehicle, perturbation right`"), "{message}");
        }
        let statement = Statement { frame: Some(ErrorFrame::World), side: Side::Right };
        assert_eq!(read(&statement.line(", corrected")).unwrap(), statement);
    }
}
