//! Absolute fixes: positions, or whole poses, that some receiver knows now and then.

use std::collections::BTreeSet;
use std::path::Path;

use nalgebra::{Rotation3, Vector3};

use crate::error::{Error, Place, Result};
use crate::files::{Form, Table};
use crate::geometry::Pose;
use crate::recordings::{Trajectory, pose_from_quaternion};
use crate::synthetic::{Purpose, Random};

/// Standard deviation of the attitude that simulated fixes give once, for the first frame, rad.
const FIRST_ATTITUDE_RAD: f64 = 0.02;

/// Standard deviations that a fix can have, m and rad: their squares keep their digits beside one another.
pub const DEVIATIONS: std::ops::RangeInclusive<f64> = 1e-9..=1e9;

/// What is known of one frame's absolute pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Fix {
    /// The frame.
    pub frame: usize,
    /// Measured position of the body in the world, m.
    pub position: Vector3<f64>,
    /// Standard deviations of its errors along the world's axes, m.
    pub position_std_m: Vector3<f64>,
    /// Measured attitude, where there is one, and standard deviations of its errors about the body's axes, rad.
    pub attitude: Option<(Rotation3<f64>, Vector3<f64>)>,
}

/// Fixes drawn around the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimulatedFixes {
    /// A position every so many frames, from the first on; the first comes with an attitude (σ .02 rad).
    pub every: usize,
    /// Standard deviation along each axis, m.
    pub std_m: f64,
    /// Seed of their errors.
    pub seed: u64,
}

impl SimulatedFixes {
    /// Draws fixes for a drive; `number` tells it from others, which get other errors.
    pub fn draw(&self, truth: &Trajectory, number: usize) -> Vec<Fix> {
        let mut random = Random::new(self.seed, Purpose::Fixes, number as u64);
        let mut noise = |std: f64| Vector3::from_fn(|_, _| std * random.normal());
        let mut fixes = Vec::new();
        for (&frame, pose) in truth.iter().step_by(self.every) {
            let position = pose.translation + noise(self.std_m);
            let attitude = fixes.is_empty().then(|| {
                let error = Rotation3::new(noise(FIRST_ATTITUDE_RAD));
                (pose.rotation * error, Vector3::repeat(FIRST_ATTITUDE_RAD))
            });
            fixes.push(Fix { frame, position, position_std_m: Vector3::repeat(self.std_m), attitude });
        }
        fixes
    }
}

/// Columns of a position, and those that a whole pose has besides.
const POSITION: [&str; 7] = ["frame", "x", "y", "z", "std_x", "std_y", "std_z"];
const ATTITUDE: [&str; 7] = ["qx", "qy", "qz", "qw", "std_roll", "std_pitch", "std_yaw"];

/// Parses a CSV of fixes: `frame,x,y,z,std_x,std_y,std_z`, and for whole poses also
/// `qx,qy,qz,qw,std_roll,std_pitch,std_yaw`; by the names of a header, in any order, or without one in this. Lines that
/// begin with `#` are remarks.
///
/// # Errors
/// A column is unknown or missing, a cell empty or not a finite number, a standard deviation not positive, a quaternion far
/// from unit length, or a frame stands there twice; the message names the line.
pub fn parse_fixes(text: &str, path: &Path) -> Result<Vec<Fix>> {
    let columns = [POSITION, ATTITUDE].concat();
    let form = Form {
        columns: &columns,
        widths: &[POSITION.len(), columns.len()],
        described: "frame,x,y,z,std_x,std_y,std_z, and for poses qx,qy,qz,qw,std_roll,std_pitch,std_yaw",
    };
    let mut table = Table::open(text, path, &form)?;
    let position_columns = table.header.require(&POSITION)?;
    let attitude_columns = table.header.group(&ATTITUDE)?;
    let mut fixes: Vec<Fix> = Vec::new();
    let mut frames = BTreeSet::new();
    while let Some(row) = table.next()? {
        let frame = row.frame(position_columns[0])?;
        let position = row.numbers::<6>(&position_columns[1..])?;
        let attitude = attitude_columns.as_ref().map(|columns| row.all_or_none::<7>(columns)).transpose()?.flatten();
        let attitude = match attitude {
            None => None,
            Some([qx, qy, qz, qw, roll, pitch, yaw]) => {
                let pose = pose_from_quaternion(Vector3::zeros(), [qx, qy, qz, qw], path, &row.place())?;
                Some((pose.rotation, Vector3::new(roll, pitch, yaw)))
            }
        };
        let position_std_m = Vector3::from_column_slice(&position[3..]);
        let deviations = position_std_m.iter().chain(attitude.iter().flat_map(|(_, std)| std.iter()));
        if let Some(std) = deviations.into_iter().find(|std| !DEVIATIONS.contains(*std)) {
            return Err(row.broken(format!("a standard deviation of {std}"), "one from 1e-9 to 1e9"));
        }
        if !frames.insert(frame) {
            return Err(row.broken(format!("frame {frame} again"), "each frame once"));
        }
        fixes.push(Fix { frame, position: Vector3::from_column_slice(&position[..3]), position_std_m, attitude });
    }
    if fixes.is_empty() {
        return Err(Error::malformed(path, Place::Whole, "no fix", "a row for each: frame,x,y,z,std_x,std_y,std_z"));
    }
    Ok(fixes)
}

/// A fix that holds a frame where it is, to the micrometre: what a trajectory without any fix begins with.
pub(super) fn anchor(frame: usize, world_from_body: &Pose) -> Fix {
    Fix {
        frame,
        position: world_from_body.translation,
        position_std_m: Vector3::repeat(1e-6),
        attitude: Some((world_from_body.rotation, Vector3::repeat(1e-6))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn fixes_are_read_and_what_is_wrong_is_named() {
        let text =
            "# world: east north up\nframe,x,y,z,std_x,std_y,std_z\n3,1,2,3,.5,.5,1\n7,1,2,3,1,1,1,0,0,0,1,.1,.1,.2\n";
        let fixes = parse_fixes(text, Path::new("fixes.csv")).unwrap();
        assert_eq!((fixes[0].frame, fixes[0].position_std_m.z, fixes[0].attitude.is_some()), (3, 1.0, false));
        assert_eq!(fixes[1].attitude.unwrap().1.z, 0.2);
        for (text, word) in [
            ("1,2,3\n", "3 cells"),
            ("frame,lat,lon,alt,std_x,std_y,std_z\n", "line 1: found an unknown column `lat`"),
            ("1,0,0,0,1,0,1\n", "standard deviation of 0"),
            ("1,0,0,0,1,1,1\n1,0,0,0,1,1,1\n", "line 2"),
            ("1,0,0,0,1,1,1,0,0,0,2,1,1,1\n", "length 2"),
            ("1,0,x,0,1,1,1\n", "`x`"),
        ] {
            let message = parse_fixes(text, Path::new("fixes.csv")).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    }

    #[test]
    fn simulated_fixes_scatter_as_they_say() {
        let truth: Trajectory =
            (0..4000).map(|frame| (frame, Pose::exp(&Tangent::new(frame as f64, 0.0, 0.0, 0.0, 0.0, 0.0)))).collect();
        let fixes = SimulatedFixes { every: 2, std_m: 0.5, seed: 3 }.draw(&truth, 0);
        assert_eq!((fixes.len(), fixes[1].frame), (2000, 2));
        assert!(fixes[0].attitude.is_some() && fixes[1].attitude.is_none());
        let square: f64 =
            fixes.iter().map(|fix| (fix.position - truth[&fix.frame].translation).norm_squared()).sum::<f64>() / 6000.0;
        assert!((square / 0.25 - 1.0).abs() < 0.08, "{square}");
    }
}
