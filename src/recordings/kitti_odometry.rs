//! KITTI odometry: `sequences/NN/{image_0..3,velodyne,calib.txt,times.txt}` and `poses/NN.txt`.
//!
//! Colour images are used where there are any, else grey ones. The layout has no IMU: the vehicle is where camera 0 is,
//! x forward, y left, z up.

use std::collections::BTreeMap;
use std::path::Path;

use super::calibration::{Calibration, camera_axes_from_vehicle};
use super::frames::{IMAGES, list_frames};
use super::image::size_of_first;
use super::keyed_lines::KeyedLines;
use super::layout::Layout;
use super::recording::{FrameFiles, Recording};
use super::times::load_times;
use super::trajectory::{KittiPoses, Trajectory, parse_kitti_poses};
use crate::error::{Error, Place, Result};
use crate::files::read_text;
use crate::geometry::{OWN_INTRINSICS, Pose};
use crate::time::Time;

/// Left and right camera in the order of preference: colour, then grey.
const CAMERAS: [[usize; 2]; 2] = [[2, 3], [0, 1]];

/// Looks through `root/sequences/NAME`, and `root/poses/NAME.txt` for its true poses. `camera_from_vehicle`: vehicle axes
/// into those of the camera; `None`: the vehicle is where camera 0 is, x forward, y left, z up.
///
/// # Errors
/// It is not there or has no images, its calibration is missing or malformed, or its poses are malformed or fewer or
/// more than its times.
pub fn load_kitti_odometry(root: &Path, name: &str, camera_from_vehicle: Option<&Pose>) -> Result<Recording> {
    let folder = root.join("sequences").join(name);
    if !folder.is_dir() {
        let folder = folder.display();
        return Err(Error::Data(format!("{folder}: no such folder; expected ROOT/sequences/NN below data.root")));
    }
    let images_of = |camera: usize| list_frames(&folder.join(format!("image_{camera}")), &IMAGES);
    let mut found = None;
    for [left, right] in CAMERAS {
        let images = images_of(left)?;
        if !images.is_empty() {
            found = Some((images, images_of(right)?, [left, right]));
            break;
        }
    }
    let Some((images, right_images, [left, right])) = found else {
        let folder = folder.display();
        return Err(Error::Data(format!("{folder}: no images in image_2 or image_0, which are named by their frame")));
    };
    let scans = list_frames(&folder.join("velodyne"), &["bin"])?;
    let mut remarks = Vec::new();
    let grey = if left == CAMERAS[0][0] { images_of(CAMERAS[1][0])?.len() } else { 0 };
    if grey > images.len() {
        let (folder, colour) = (folder.display(), images.len());
        remarks.push(format!("{folder}: {colour} colour images are used, and there are {grey} grey ones in image_0"));
    }
    let size = size_of_first(images.values())?;
    let calibration =
        load_calibration(&folder.join("calib.txt"), [left, right], size, !scans.is_empty(), camera_from_vehicle)?;
    let mut time_problems = Vec::new();
    let (times_file, poses_file) = (folder.join("times.txt"), root.join("poses").join(format!("{name}.txt")));
    let times = load_times([(times_file.as_path(), &images)], &mut time_problems);
    if !times.is_empty() && times.len() != images.len() {
        let (path, times, images) = (times_file.display(), times.len(), images.len());
        remarks.push(format!("{path}: {times} times beside {images} images; that of line k is taken for image k - 1"));
    }
    if times.is_empty() && time_problems.is_empty() {
        remarks.push(format!("{}: not there; the times of its frames are not known", times_file.display()));
    }
    let poses = match poses_file.is_file() {
        true => load_poses(&poses_file, &calibration, &images, &times, &mut remarks)?,
        false => {
            remarks.push(format!("{}: not there; it brings no true poses", poses_file.display()));
            BTreeMap::new()
        }
    };
    Ok(Recording {
        images,
        right_images,
        scans,
        poses,
        times,
        time_problems,
        remarks,
        sources: vec![folder.join("calib.txt"), times_file, poses_file],
        ..Recording::new(Layout::KittiOdometry, name, calibration)
    })
}

fn load_calibration(
    path: &Path,
    [left, right]: [usize; 2],
    size: [usize; 2],
    scans: bool,
    camera_from_vehicle: Option<&Pose>,
) -> Result<Calibration> {
    let lines = KeyedLines::load(path.to_owned())?;
    let left_key = format!("P{left}");
    let left = lines.projection(&left_key, size)?;
    let right_key = format!("P{right}");
    let right = lines.has(&right_key).then(|| lines.projection(&right_key, size)).transpose()?;
    let right_from_left = KeyedLines::right_from_left(&left, right);
    let (camera, camera_from_camera0) = left;
    // The file says no size: of images that were resized without it the point would lie elsewhere.
    camera.require_middle().map_err(|found| Error::malformed(path, Place::Field(left_key), found, OWN_INTRINSICS))?;
    // Without scans nobody asks for it.
    let camera0_from_velodyne = if scans || lines.has("Tr") { lines.pose("Tr")? } else { Pose::identity() };
    Ok(Calibration {
        camera,
        camera_from_camera0,
        camera_from_velodyne: camera_from_camera0 * camera0_from_velodyne,
        camera_from_vehicle: camera_from_vehicle.map_or(camera_from_camera0 * camera_axes_from_vehicle(), |told| *told),
        right_from_left,
    })
}

/// True poses `world_from_vehicle`; the file has those of camera 0 in axes of its first pose, a row for each frame. The world
/// is turned with the vehicle's axes: x forward, y left, z up at the first frame.
fn load_poses(
    path: &Path,
    calibration: &Calibration,
    images: &FrameFiles,
    times: &BTreeMap<usize, Time>,
    remarks: &mut Vec<String>,
) -> Result<BTreeMap<usize, Pose>> {
    let poses: Trajectory = match parse_kitti_poses(&read_text(path)?, path)? {
        KittiPoses::Framed(poses) => poses,
        KittiPoses::Rows(rows) => {
            if times.is_empty() && rows.len() != images.len() {
                let (path, rows, images) = (path.display(), rows.len(), images.len());
                remarks.push(format!("{path}: {rows} rows beside {images} images, taken for frames 0 … {}", rows - 1));
            }
            frames_of(rows.len(), path, images, times)?.into_iter().zip(rows).collect()
        }
    };
    let lacking = images.keys().filter(|frame| !poses.contains_key(frame)).count();
    if lacking > 0 {
        remarks.push(format!("{}: no pose of {lacking} of its {} frames", path.display(), images.len()));
    }
    let camera0_from_vehicle = calibration.camera_from_camera0.inverse() * calibration.camera_from_vehicle;
    let world_from_first = camera_axes_from_vehicle().inverse();
    let of_vehicle = |(frame, first_from_camera0): (usize, Pose)| {
        (frame, world_from_first * first_from_camera0 * camera0_from_vehicle)
    };
    Ok(poses.into_iter().map(of_vehicle).collect())
}

/// The frames of so many rows: those that have times, else frames from 0 on.
///
/// # Errors
/// There are fewer or more times, or without times fewer rows than images.
fn frames_of(rows: usize, path: &Path, images: &FrameFiles, times: &BTreeMap<usize, Time>) -> Result<Vec<usize>> {
    let last = images.last_key_value().map_or(0, |(&last, _)| last);
    let (fits, expected) = match times.is_empty() {
        false => (rows == times.len(), format!("{} as times.txt has times: a row for each frame", times.len())),
        true => (rows > last, format!("a row for each frame from 0 to {last}")),
    };
    match fits {
        true if times.is_empty() => Ok((0..rows).collect()),
        true => Ok(times.keys().copied().collect()),
        false => Err(Error::malformed(path, Place::Whole, format!("poses of {rows} frames"), expected)),
    }
}
