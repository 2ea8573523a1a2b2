//! Depth of a frame from the source that a configuration names.

use std::path::{Path, PathBuf};

use super::{DepthCache, DepthMap, files, fill_gaps, ground_plane_depth, project_scan, read_scan};
use crate::depth::DepthConfig;
use crate::error::{Error, Place, Result};
use crate::geometry::Pinhole;
use crate::recordings::{KITTI_STEPS_PER_METRE, Recording, RgbImage};

/// Whether the configured source has depth for a frame.
pub fn has_depth(config: &DepthConfig, drive: &Recording, frame: usize, root: &Path) -> bool {
    match config {
        DepthConfig::GroundPlane { .. } => true,
        DepthConfig::Lidar { .. } => drive.scans.contains_key(&frame),
        DepthConfig::Files { path } => files::depth_path(path, drive, frame, root).is_file(),
        // What a recording has was looked for when it was opened; what a manifest lists was not.
        DepthConfig::Recording {} => {
            drive.depth.get(&frame).is_some_and(|path| drive.listed.is_none() || path.is_file())
        }
        DepthConfig::Monodepth2(config) => DepthCache::of(config).map_path(drive, frame).is_file(),
    }
}

/// The file in which the configured source looks for a frame's depth, where it is one of the user's.
pub(crate) fn depth_file(config: &DepthConfig, drive: &Recording, frame: usize, root: &Path) -> Option<PathBuf> {
    match config {
        DepthConfig::Files { path } => Some(files::depth_path(path, drive, frame, root)),
        DepthConfig::Recording {} => drive.depth.get(&frame).cloned(),
        DepthConfig::GroundPlane { .. } | DepthConfig::Lidar { .. } | DepthConfig::Monodepth2(_) => None,
    }
}

/// The file that holds a frame's depth, whoever made it.
pub(crate) fn map_file(config: &DepthConfig, drive: &Recording, frame: usize, root: &Path) -> Option<PathBuf> {
    match config {
        DepthConfig::Monodepth2(config) => Some(DepthCache::of(config).map_path(drive, frame)),
        other => depth_file(other, drive, frame, root),
    }
}

/// Depth of a frame as seen by `camera`, the colour camera at the network's size; `image` is the frame at that size.
///
/// # Errors
/// The frame's scan or depth file is missing or malformed, or knows the depth of no pixel.
pub fn load_depth(
    config: &DepthConfig,
    drive: &Recording,
    frame: usize,
    root: &Path,
    camera: &Pinhole,
    image: &RgbImage,
) -> Result<DepthMap> {
    let depth = native_depth(config, drive, frame, root, camera, image)?.resized(camera.width, camera.height);
    if depth.known().next().is_none() {
        return Err(Error::Data(format!(
            "{}, frame {frame}: the depth of not one pixel is known: an empty depth map, or no LiDAR return before the camera",
            drive.name
        )));
    }
    Ok(depth)
}

/// The same at the size that the source has: that of its files, else the camera's.
///
/// # Errors
/// As [`load_depth`].
pub fn native_depth(
    config: &DepthConfig,
    drive: &Recording,
    frame: usize,
    root: &Path,
    camera: &Pinhole,
    image: &RgbImage,
) -> Result<DepthMap> {
    match config {
        DepthConfig::GroundPlane { camera_height_m, horizon_px, max_depth_m } => {
            let horizon_px = horizon_px.map(|row| drive.calibration.camera.resized_row(row, camera.height));
            Ok(ground_plane_depth(camera, *camera_height_m, horizon_px, *max_depth_m))
        }
        DepthConfig::Lidar { fill_radius_px } => {
            let path = drive.scans.get(&frame).ok_or_else(|| {
                Error::Data(format!("{}, frame {frame}: no LiDAR scan; choose another depth.source", drive.name))
            })?;
            let sparse = project_scan(&read_scan(path)?, &drive.calibration.camera_from_velodyne, camera);
            Ok(fill_gaps(&sparse, image, *fill_radius_px))
        }
        DepthConfig::Files { path } => files::read_depth_of(
            &files::depth_path(path, drive, frame, root),
            drive.image_size(),
            KITTI_STEPS_PER_METRE,
        ),
        DepthConfig::Recording {} => {
            let path = drive.depth.get(&frame).ok_or_else(|| {
                Error::Data(format!(
                    "{}, frame {frame}: the recording has no depth map of it; choose another depth.source",
                    drive.name
                ))
            })?;
            let map = files::read_depth_of(path, drive.image_size(), drive.depth_steps_per_metre)?;
            undistorted(map, drive, path)
        }
        DepthConfig::Monodepth2(config) => DepthCache::of(config).load(drive, frame),
    }
}

/// A recording's own map as its undistorted camera sees it.
fn undistorted(map: DepthMap, drive: &Recording, path: &Path) -> Result<DepthMap> {
    let Some(lens) = &drive.lens else { return Ok(map) };
    let [width, height] = drive.image_size();
    if [map.width, map.height] != [width, height] {
        let found = format!("{}x{} pixels", map.width, map.height);
        let expected = format!("{width}x{height} as its image, whose distortion it shares");
        return Err(Error::malformed(path, Place::Whole, found, expected));
    }
    Ok(DepthMap { depth_m: lens.depth(&map.depth_m), ..map })
}
