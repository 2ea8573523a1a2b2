//! KITTI raw: `DATE/DRIVE/{image_02,image_03,velodyne_points,oxts}` and `DATE/calib_*.txt`.
//!
//! Only the rectified keys of the calibration are needed; dates and the keys of unrectified images are passed over.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Vector3;

use super::calibration::Calibration;
use super::frames::{IMAGES, list_frames};
use super::keyed_lines::KeyedLines;
use super::layout::Layout;
use super::oxts::{OxtsPacket, world_from_vehicle};
use super::recording::{FrameFiles, Recording};
use super::times::load_times;
use crate::error::{Error, Result};
use crate::geometry::Pose;

/// The calibration of a date folder.
const CALIBRATION: [&str; 3] = ["calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"];
/// Times of images, else of packets.
const TIMES: [&str; 2] = ["image_02/timestamps.txt", "oxts/timestamps.txt"];

/// The date with which a drive's name begins.
pub(super) fn date_of(name: &str) -> Option<&str> {
    name.get(..10).filter(|date| date.bytes().all(|byte| byte.is_ascii_digit() || byte == b'_'))
}

/// Looks through `root/DATE/DRIVE`.
///
/// # Errors
/// The folder or its calibration is missing or unreadable. A broken packet is a problem noted, not an error.
pub fn load_kitti_raw(root: &Path, name: &str) -> Result<Recording> {
    let Some(date) = date_of(name) else {
        return Err(Error::config(
            "data",
            format!("drive `{name}` does not begin with a date; KITTI's names look like 2011_09_30_drive_0034_sync"),
        ));
    };
    let date_folder = root.join(date);
    let folder = date_folder.join(name);
    if !folder.is_dir() {
        return Err(Error::Data(format!(
            "{}: no such drive; expected ROOT/DATE/DRIVE below data.root = {} (set data.root or {})",
            folder.display(),
            root.display(),
            super::DATA_ROOT_VARIABLE
        )));
    }
    let (mut problems, mut time_problems) = (Vec::new(), Vec::new());
    let packets = list_frames(&folder.join("oxts/data"), &["txt"])?;
    let images = list_frames(&folder.join("image_02/data"), &IMAGES)?;
    let of_times = TIMES.map(|name| folder.join(name));
    let times = load_times(of_times.iter().map(|path| path.as_path()).zip([&images, &packets]), &mut time_problems);
    Ok(Recording {
        right_images: list_frames(&folder.join("image_03/data"), &IMAGES)?,
        scans: list_frames(&folder.join("velodyne_points/data"), &["bin"])?,
        poses: load_poses(&packets, &mut problems),
        images,
        times,
        problems,
        time_problems,
        sources: packets.into_values().chain(CALIBRATION.map(|name| date_folder.join(name))).chain(of_times).collect(),
        ..Recording::new(Layout::KittiRaw, name, load_kitti_calibration(&date_folder)?)
    })
}

/// Reads the three calibration files of a date folder.
///
/// # Errors
/// A file or key is missing, a line is short or not numeric, or a matrix is not a rotation.
pub fn load_kitti_calibration(date_folder: &Path) -> Result<Calibration> {
    let [cameras, velodyne, imu] = CALIBRATION.map(|name| KeyedLines::load(date_folder.join(name)));
    let (cameras, velodyne, imu) = (cameras?, velodyne?, imu?);
    let left = cameras.camera(2)?;
    let right = cameras.has("P_rect_03").then(|| cameras.camera(3)).transpose()?;
    let right_from_left = KeyedLines::right_from_left(&left, right);
    let (camera, camera_from_camera0) = left;
    let rectification = cameras.rotation("R_rect_00", Vector3::zeros())?;
    let camera0_from_velodyne = velodyne.rotation("R", velodyne.offset()?)?;
    let velodyne_from_imu = imu.rotation("R", imu.offset()?)?;
    let camera_from_velodyne = camera_from_camera0 * rectification * camera0_from_velodyne;
    Ok(Calibration {
        camera,
        camera_from_camera0,
        camera_from_velodyne,
        camera_from_vehicle: camera_from_velodyne * velodyne_from_imu,
        right_from_left,
    })
}

fn load_poses(packets: &FrameFiles, problems: &mut Vec<String>) -> BTreeMap<usize, Pose> {
    let mut first: Option<OxtsPacket> = None;
    let mut poses = BTreeMap::new();
    for (&frame, path) in packets {
        match OxtsPacket::load(path) {
            Ok(packet) => {
                let first = *first.get_or_insert(packet);
                poses.insert(frame, world_from_vehicle(&packet.beside(&first), first.mercator_scale()));
            }
            Err(error) => problems.push(error.to_string()),
        }
    }
    poses
}
