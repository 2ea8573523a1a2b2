//! Depth of the target image, in metres along the optical axis, at the network's size; 0 = unknown.
//!
//! Three sources: PNG files, LiDAR scans, a flat road. A depth network is to become the fourth.

mod files;
mod ground_plane;
mod lidar;

use std::ops::Range;
use std::path::Path;

pub(crate) use files::encode_depth_png;
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
    /// The map at another size, each pixel taking the known depth nearest to its centre within its
    /// footprint: depths of different surfaces are never averaged, sparse ones never lost.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let columns: Vec<Footprint> = (0..width).map(|u| Footprint::new(u, self.width, width)).collect();
        let rows: Vec<Footprint> = (0..height).map(|v| Footprint::new(v, self.height, height)).collect();
        let pixels = rows.iter().flat_map(|row| columns.iter().map(move |column| (row, column)));
        let depth_m = pixels.map(|(row, column)| self.nearest_known(row, column)).collect();
        Self { width, height, depth_m }
    }

    fn nearest_known(&self, row: &Footprint, column: &Footprint) -> f32 {
        let at = |v: usize, u: usize| self.depth_m[v * self.width + u];
        let central = at(row.centre as usize, column.centre as usize);
        if central > 0.0 {
            return central;
        }
        let pixels = row.pixels.clone().flat_map(|v| column.pixels.clone().map(move |u| (v, u)));
        let distance =
            |&(v, u): &(usize, usize)| (v as f64 + 0.5 - row.centre).powi(2) + (u as f64 + 0.5 - column.centre).powi(2);
        let known = pixels.filter(|&(v, u)| at(v, u) > 0.0);
        known.min_by(|a, b| distance(a).total_cmp(&distance(b))).map_or(0.0, |(v, u)| at(v, u))
    }
}

/// The source pixels that one target pixel covers along one axis.
struct Footprint {
    pixels: Range<usize>,
    /// Centre of the target pixel, in source pixels from the edge.
    centre: f64,
}

impl Footprint {
    fn new(pixel: usize, from: usize, to: usize) -> Self {
        let scale = from as f64 / to as f64;
        let (first, end) = (pixel as f64 * scale, (pixel + 1) as f64 * scale);
        Self { pixels: first as usize..(end.ceil() as usize).min(from), centre: 0.5 * (first + end) }
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

    #[test]
    fn resizing_keeps_the_returns_of_a_sparse_map() {
        let mut depth_m = vec![0.0; 64];
        depth_m[9] = 7.0;
        let map = DepthMap { width: 8, height: 8, depth_m };
        assert_eq!(map.resized(2, 2).depth_m, [7.0, 0.0, 0.0, 0.0]);
    }
}
