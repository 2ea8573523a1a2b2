//! Depth from LiDAR: scans projected into the image.

use std::path::Path;

use nalgebra::Vector3;

use super::DepthMap;
use crate::error::{Error, Place, Result};
use crate::files::read_bytes;
use crate::geometry::{Pinhole, Pose};

/// Bytes of a point: x, y, z, reflectance as little-endian f32.
const POINT_BYTES: usize = 16;

/// Reads a KITTI velodyne file: points in metres, x forward, y left, z up.
///
/// # Errors
/// The file cannot be read, its size is no multiple of a point's, or a coordinate is not finite.
pub fn read_scan(path: &Path) -> Result<Vec<Vector3<f32>>> {
    let bytes = read_bytes(path)?;
    if bytes.len() % POINT_BYTES != 0 || bytes.is_empty() {
        return Err(Error::malformed(
            path,
            Place::Whole,
            format!("{} bytes", bytes.len()),
            format!("a multiple of {POINT_BYTES} (x, y, z, reflectance as f32); the file may be cut off"),
        ));
    }
    let coordinate =
        |point: &[u8], axis: usize| f32::from_le_bytes(point[4 * axis..4 * axis + 4].try_into().expect("4 bytes"));
    bytes
        .chunks_exact(POINT_BYTES)
        .enumerate()
        .map(|(index, point)| {
            let point = Vector3::new(coordinate(point, 0), coordinate(point, 1), coordinate(point, 2));
            if point.iter().all(|value| value.is_finite()) {
                Ok(point)
            } else {
                let place = Place::Field(format!("point {index}"));
                Err(Error::malformed(path, place, format!("{:?}", point.as_slice()), "finite coordinates"))
            }
        })
        .collect()
}

/// Sparse depth of a scan: `P_rect_02 R_rect_00 T_velo_cam`, points before the scanner only
/// (x ≥ 0), the nearest return wins a pixel.
pub fn project_scan(points: &[Vector3<f32>], camera_from_velodyne: &Pose, camera: &Pinhole) -> DepthMap {
    let mut depth_m = vec![0.0_f32; camera.width * camera.height];
    for point in points.iter().filter(|point| point.x >= 0.0) {
        let point = camera_from_velodyne.transform_point(&point.cast());
        let Some(pixel) = camera.project(&point) else { continue };
        let (u, v) = (pixel.x.round(), pixel.y.round());
        if u < 0.0 || v < 0.0 || u >= camera.width as f64 || v >= camera.height as f64 {
            continue;
        }
        let nearest = &mut depth_m[v as usize * camera.width + u as usize];
        let depth = point.z as f32;
        if *nearest == 0.0 || depth < *nearest {
            *nearest = depth;
        }
    }
    DepthMap { width: camera.width, height: camera.height, depth_m }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_of_two_returns_wins_a_pixel() {
        let camera = Pinhole { fx: 10.0, fy: 10.0, cx: 4.0, cy: 4.0, width: 9, height: 9 };
        // Velodyne x forward is camera z.
        let axes = nalgebra::Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(
            0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0,
        ));
        let camera_from_velodyne = Pose::new(axes, Vector3::zeros());
        let points = [Vector3::new(20.0, 0.0, 0.0), Vector3::new(8.0, 0.0, 0.0), Vector3::new(-5.0, 0.0, 0.0)];
        let map = project_scan(&points, &camera_from_velodyne, &camera);
        assert_eq!(map.depth_m[4 * 9 + 4], 8.0);
        assert_eq!(map.depth_m.iter().filter(|&&depth| depth > 0.0).count(), 1);
    }
}
