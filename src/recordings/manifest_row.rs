//! Rows of a pairs manifest, read and written.

use std::fmt;

use nalgebra::{UnitQuaternion, Vector3};

use super::recording::KITTI_STEPS_PER_METRE;
use super::trajectory::{LARGEST_MOTION_M, pose_from_quaternion};
use crate::error::Result;
use crate::files::{Header, Row};
use crate::geometry::Pose;
use crate::time::{EXPECTED_SECONDS, Time};

/// Its columns: those that must be there, the true pose, and what else may be.
const REQUIRED: [&str; 16] = [
    "system",
    "source",
    "target",
    "source_image",
    "target_image",
    "fx",
    "fy",
    "cx",
    "cy",
    "x",
    "y",
    "z",
    "qx",
    "qy",
    "qz",
    "qw",
];
const TRUE_POSE: [&str; 7] = ["true_x", "true_y", "true_z", "true_qx", "true_qy", "true_qz", "true_qw"];
const DISTORTION: [&str; 5] = ["k1", "k2", "p1", "p2", "k3"];
const OPTIONAL: [&str; 5] = ["sequence", "depth", "source_time", "target_time", "depth_factor"];

/// A row, its numbers read.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ManifestRow<'a> {
    pub(crate) system: &'a str,
    pub(crate) sequence: &'a str,
    /// Source and target.
    pub(crate) frames: [usize; 2],
    pub(crate) images: [&'a str; 2],
    pub(crate) camera: ManifestCamera,
    pub(crate) source_from_target: Pose,
    pub(crate) true_source_from_target: Option<Pose>,
    pub(crate) depth: Option<&'a str>,
    pub(crate) times: [Option<Time>; 2],
}

/// What a row says of the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ManifestCamera {
    /// fx, fy, cx, cy of the images as stored, px.
    pub(crate) intrinsics: [f64; 4],
    /// k1, k2, p1, p2, k3.
    pub(crate) distortion: [f64; 5],
    /// Steps of a metre in depth maps.
    pub(crate) depth_factor: f64,
}

impl fmt::Display for ManifestCamera {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { intrinsics, distortion, depth_factor } = self;
        write!(formatter, "intrinsics {intrinsics:?}")?;
        if *distortion != [0.0; 5] {
            write!(formatter, ", distortion {distortion:?}")?;
        }
        if *depth_factor != f64::from(KITTI_STEPS_PER_METRE) {
            write!(formatter, ", depth_factor {depth_factor}")?;
        }
        Ok(())
    }
}

/// Where its columns are.
pub(super) struct Columns {
    required: Vec<usize>,
    true_pose: Option<Vec<usize>>,
    distortion: Option<Vec<usize>>,
    optional: [Option<usize>; 5],
}

impl Columns {
    /// All that there can be.
    pub(super) fn names() -> Vec<&'static str> {
        [REQUIRED.as_slice(), &TRUE_POSE, &OPTIONAL, &DISTORTION].concat()
    }

    pub(super) fn find(header: &Header) -> Result<Self> {
        Ok(Self {
            required: header.require(&REQUIRED)?,
            true_pose: header.group(&TRUE_POSE)?,
            distortion: header.group(&DISTORTION)?,
            optional: OPTIONAL.map(|name| header.position(name)),
        })
    }

    pub(super) fn read<'t>(&self, row: &Row<'t>) -> Result<ManifestRow<'t>> {
        let &[system, source, target, source_image, target_image, ref numbers @ ..] = self.required.as_slice() else {
            unreachable!("all of them are there")
        };
        let [sequence, depth, source_time, target_time, depth_factor] =
            self.optional.map(|column| column.filter(|&column| !row.is_empty(column)));
        let distortion = self.distortion.as_ref().map(|columns| row.all_or_none(columns)).transpose()?.flatten();
        let depth_factor = depth_factor.map(|column| row.number(column)).transpose()?;
        let camera = ManifestCamera {
            intrinsics: row.numbers(&numbers[..4])?,
            distortion: distortion.unwrap_or_default(),
            depth_factor: depth_factor.unwrap_or(f64::from(KITTI_STEPS_PER_METRE)),
        };
        if camera.intrinsics[0] <= 0.0 || camera.intrinsics[1] <= 0.0 {
            return Err(row.broken(camera.to_string(), "fx and fy above zero"));
        }
        if !(1.0..=1e6).contains(&camera.depth_factor) {
            return Err(row.broken(format!("depth_factor {}", camera.depth_factor), "steps of a metre, 1 to 1e6"));
        }
        let true_pose = self.true_pose.as_ref().map(|columns| row.all_or_none(columns)).transpose()?.flatten();
        let time = |column: Option<usize>| {
            let read =
                |column| Time::parse_seconds(row.cell(column)).ok_or_else(|| row.broken_cell(column, EXPECTED_SECONDS));
            column.map(read).transpose()
        };
        Ok(ManifestRow {
            system: row.text(system)?,
            sequence: sequence.map_or("sequence", |column| row.cell(column)),
            frames: [row.frame(source)?, row.frame(target)?],
            images: [row.text(source_image)?, row.text(target_image)?],
            camera,
            source_from_target: pose_of(row, row.numbers(&numbers[4..])?)?,
            true_source_from_target: true_pose.map(|numbers| pose_of(row, numbers)).transpose()?,
            depth: depth.map(|column| row.cell(column)),
            times: [time(source_time)?, time(target_time)?],
        })
    }
}

fn pose_of(row: &Row, [x, y, z, quaternion @ ..]: [f64; 7]) -> Result<Pose> {
    let pose = pose_from_quaternion(Vector3::new(x, y, z), quaternion, row.path(), &row.place())?;
    match pose.translation.norm() <= LARGEST_MOTION_M {
        true => Ok(pose),
        false => {
            Err(row
                .broken(format!("a motion of {:.1e} m", pose.translation.norm()), "at most 10 km between two frames"))
        }
    }
}

/// The columns of [`format_manifest_row`].
pub(crate) fn manifest_header() -> String {
    let [sequence, rest @ ..] = OPTIONAL;
    let columns = [&REQUIRED[..1], &[sequence], &REQUIRED[1..], &TRUE_POSE, &rest, &DISTORTION].concat();
    columns.join(",") + "\n"
}

/// A row under [`manifest_header`], with its line end; what is not known stays empty.
pub(crate) fn format_manifest_row(row: &ManifestRow) -> String {
    let numbers = |numbers: &[f64]| numbers.iter().map(f64::to_string).collect::<Vec<_>>();
    let pose = |pose: &Pose| {
        let quaternion = UnitQuaternion::from_rotation_matrix(&pose.rotation);
        pose.translation.iter().chain(quaternion.coords.iter()).map(f64::to_string).collect::<Vec<_>>()
    };
    let empty = |count: usize| vec![String::new(); count];
    let ManifestCamera { intrinsics, distortion, depth_factor } = &row.camera;
    let time = |time: Option<Time>| time.map_or(String::new(), |time| time.to_string());
    let mut cells = vec![quoted(row.system), quoted(row.sequence)];
    cells.extend(row.frames.map(|frame| frame.to_string()));
    cells.extend(row.images.map(quoted));
    cells.extend(numbers(intrinsics));
    cells.extend(pose(&row.source_from_target));
    cells.extend(row.true_source_from_target.as_ref().map_or_else(|| empty(TRUE_POSE.len()), pose));
    cells.push(row.depth.map_or(String::new(), quoted));
    cells.extend(row.times.map(time));
    cells.push(if row.depth.is_some() { depth_factor.to_string() } else { String::new() });
    cells.extend(if *distortion == [0.0; 5] { empty(DISTORTION.len()) } else { numbers(distortion) });
    cells.join(",") + "\n"
}

/// A cell as CSV has it (RFC 4180).
fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::{Form, Table};
    use crate::geometry::Tangent;

    #[test]
    fn a_row_comes_back_as_it_was_written() {
        let full = ManifestRow {
            system: "vo",
            sequence: "lab",
            frames: [3, 8],
            images: ["rgb/3, left.png", "rgb/8.png"],
            camera: ManifestCamera {
                intrinsics: [517.3, 516.5, 318.6, 255.3],
                distortion: [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
                depth_factor: 5000.0,
            },
            source_from_target: Pose::exp(&Tangent::new(0.1, -0.2, 0.3, 0.01, 0.02, -0.03)),
            true_source_from_target: Some(Pose::exp(&Tangent::new(0.11, -0.2, 0.3, 0.01, 0.02, -0.03))),
            depth: Some("depth/8.png"),
            times: [Some(Time::from_nanoseconds(1_403_636_579_763_555_584)), Some(Time::from_nanoseconds(5))],
        };
        let plain = ManifestCamera { distortion: [0.0; 5], depth_factor: 256.0, ..full.camera };
        let bare =
            ManifestRow { camera: plain, true_source_from_target: None, depth: None, times: [None; 2], ..full.clone() };
        let text = manifest_header() + &format_manifest_row(&full) + &format_manifest_row(&bare);
        let (columns, path) = (Columns::names(), std::path::Path::new("pairs.csv"));
        let mut table = Table::open(&text, path, &Form { columns: &columns, widths: &[], described: "" }).unwrap();
        let places = Columns::find(&table.header).unwrap();
        for row in [full, bare] {
            let back = places.read(&table.next().unwrap().unwrap()).unwrap();
            let far = |a: &Pose, b: &Pose| (a.matrix() - b.matrix()).norm();
            assert!(far(&back.source_from_target, &row.source_from_target) < 1e-14);
            assert_eq!(back.true_source_from_target.is_some(), row.true_source_from_target.is_some());
            assert_eq!(without_poses(&back), without_poses(&row));
        }
    }

    fn without_poses<'a>(row: &ManifestRow<'a>) -> ManifestRow<'a> {
        ManifestRow { source_from_target: Pose::identity(), true_source_from_target: None, ..row.clone() }
    }
}
