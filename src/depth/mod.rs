//! Depth of the target image, in metres along the optical axis, at the network's size; 0 = unknown.
//!
//! Three sources: PNG files, LiDAR scans, a flat road. A depth network is to become the fourth.

mod files;
mod ground_plane;
mod lidar;

use std::path::Path;

pub use files::{read_depth_png, write_depth_png};
pub use ground_plane::ground_plane_depth;
pub use lidar::{fill_gaps, project_scan, read_scan};

use crate::config::DepthConfig;
use crate::data::Drive;
use crate::error::{Error, Result};
use crate::geometry::Pinhole;

/// A depth image.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `width * height` depths, m, row-major; 0 = unknown.
    pub depth_m: Vec<f32>,
}

impl DepthMap {
    /// The map at another size, each pixel taking the depth nearest to its centre: depths of
    /// different surfaces are never averaged.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let nearest = |pixel: usize, from: usize, to: usize| {
            let position = (pixel as f64 + 0.5) * from as f64 / to as f64;
            (position as usize).min(from - 1)
        };
        let depth_m = (0..height)
            .flat_map(|v| (0..width).map(move |u| (u, v)))
            .map(|(u, v)| self.depth_m[nearest(v, self.height, height) * self.width + nearest(u, self.width, width)])
            .collect();
        Self { width, height, depth_m }
    }
}

/// Whether the configured source has depth for a frame.
pub fn has_depth(config: &DepthConfig, drive: &Drive, frame: usize, root: &Path) -> bool {
    match config {
        DepthConfig::GroundPlane { .. } => true,
        DepthConfig::Lidar { .. } => drive.scans.contains_key(&frame),
        DepthConfig::Files { path } => files::depth_path(path, drive, frame, root).is_file(),
    }
}

/// Depth of a frame as seen by `camera`, the colour camera at the network's size.
///
/// # Errors
/// The frame's scan or depth file is missing or malformed.
pub fn load_depth(
    config: &DepthConfig,
    drive: &Drive,
    frame: usize,
    root: &Path,
    camera: &Pinhole,
) -> Result<DepthMap> {
    match config {
        DepthConfig::GroundPlane { camera_height_m, horizon_px, max_depth_m } => {
            let full = &drive.calibration.camera2;
            let horizon_px = horizon_px.map(|row| (row + 0.5) * camera.height as f64 / full.height as f64 - 0.5);
            Ok(ground_plane_depth(camera, *camera_height_m, horizon_px, *max_depth_m))
        }
        DepthConfig::Lidar { fill_radius_px } => {
            let path = drive.scans.get(&frame).ok_or_else(|| {
                Error::Data(format!(
                    "{}, frame {frame}: no LiDAR scan in velodyne_points/data; choose another depth.source",
                    drive.name
                ))
            })?;
            let sparse = project_scan(&read_scan(path)?, &drive.calibration.camera2_from_velodyne, camera);
            Ok(fill_gaps(&sparse, *fill_radius_px))
        }
        DepthConfig::Files { path } => {
            let path = files::depth_path(path, drive, frame, root);
            Ok(read_depth_png(&path)?.resized(camera.width, camera.height))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resizing_never_mixes_depths() {
        let map = DepthMap { width: 4, height: 2, depth_m: vec![1.0, 1.0, 9.0, 9.0, 0.0, 1.0, 9.0, 0.0] };
        let small = map.resized(2, 1);
        assert!(small.depth_m.iter().all(|depth| map.depth_m.contains(depth)));
        assert_eq!(map.resized(4, 2), map);
    }
}
