//! Depth of a flat road: needs nothing but the height of the camera.

use super::DepthMap;
use crate::geometry::Pinhole;

/// Depth of a plane `camera_height_m` below the camera, and `max_depth_m` wherever it is farther than
/// that or not seen.
///
/// `z = h / (n · K⁻¹p)` with the road's normal n in camera axes (y down). The horizon, an image row of
/// this camera, gives its pitch; without one the camera looks level. Things that stand on the road
/// get the depth of the road behind them.
pub fn ground_plane_depth(
    camera: &Pinhole,
    camera_height_m: f64,
    horizon_px: Option<f64>,
    max_depth_m: f64,
) -> DepthMap {
    // On the horizon n · K⁻¹p = 0, so tan(pitch) = (cy − horizon)/fy.
    let pitch = horizon_px.map_or(0.0, |row| ((camera.cy - row) / camera.fy).atan());
    let (normal_z, normal_y) = pitch.sin_cos();
    let row_depth = |v: usize| {
        let along_normal = normal_y * (v as f64 - camera.cy) / camera.fy + normal_z;
        let depth = camera_height_m / along_normal;
        if along_normal > 0.0 { depth.min(max_depth_m) } else { max_depth_m }
    };
    let depth_m = (0..camera.height).flat_map(|v| std::iter::repeat_n(row_depth(v) as f32, camera.width)).collect();
    DepthMap { width: camera.width, height: camera.height, depth_m }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::*;

    const CAMERA: Pinhole = Pinhole { fx: 200.0, fy: 200.0, cx: 160.0, cy: 50.0, width: 320, height: 96 };

    #[test]
    fn points_of_the_map_lie_on_the_road() {
        let map = ground_plane_depth(&CAMERA, 1.65, None, 80.0);
        for v in 60..96 {
            let depth = f64::from(map.depth_m[v * 320]);
            let point = CAMERA.backproject(&Vector2::new(0.0, v as f64), depth);
            assert_relative_eq!(point.y, 1.65, epsilon = 1e-6);
        }
        assert!(map.depth_m[..50 * 320].iter().all(|&depth| depth == 80.0));
    }

    #[test]
    fn a_higher_horizon_tilts_the_camera_down() {
        let map = ground_plane_depth(&CAMERA, 1.65, Some(40.0), 1e6);
        let row = |v: usize| map.depth_m[v * 320];
        assert!(row(39) == 1e6 && row(41) < 1e6, "the road ends at the horizon");
        assert!(row(90) < ground_plane_depth(&CAMERA, 1.65, None, 1e6).depth_m[90 * 320]);
    }
}
