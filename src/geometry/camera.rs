//! The pinhole camera of rectified images.

use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// Least focal length in widths and heights of the image: it sees 169 degrees.
const LEAST_FOCAL_LENGTH: f64 = 0.05;

/// What intrinsics should be, for messages.
pub(crate) const OWN_INTRINSICS: &str = "intrinsics fx, fy, cx, cy at the image's own size, px";

/// Pinhole intrinsics of an image of known size; pixels, centres at integer coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pinhole {
    /// Focal length along x, px.
    pub fx: f64,
    /// Focal length along y, px.
    pub fy: f64,
    /// Principal point, column, px.
    pub cx: f64,
    /// Principal point, row, px.
    pub cy: f64,
    /// Image width, px.
    pub width: usize,
    /// Image height, px.
    pub height: usize,
}

impl Pinhole {
    /// That its principal point lies in the image, as it does unless the intrinsics are those of another size, and that it
    /// does not see all before it, as one does whose focal lengths are no pixels.
    ///
    /// # Errors
    /// It does not; both are named.
    pub fn require_centre(&self) -> Result<(), String> {
        let Self { fx, fy, cx, cy, width, height } = *self;
        if !((0.0..=width as f64).contains(&cx) && (0.0..=height as f64).contains(&cy)) {
            return Err(format!("a principal point ({cx}, {cy}) outside the image of {width}x{height}"));
        }
        let is_short = |focal_length: f64, size: usize| focal_length < LEAST_FOCAL_LENGTH * size as f64;
        // Those that are not positive are told of where they are read.
        match fx > 0.0 && fy > 0.0 && (is_short(fx, width) || is_short(fy, height)) {
            false => Ok(()),
            true => Err(format!("focal lengths ({fx}, {fy}), which see a half space in an image of {width}x{height}")),
        }
    }

    /// That its principal point lies in the middle half of the image: of half or twice the size it does not.
    ///
    /// # Errors
    /// It does not; both are named.
    pub fn require_middle(&self) -> Result<(), String> {
        let Self { cx, cy, width, height, .. } = *self;
        let in_middle = |centre: f64, size: usize| (0.25..=0.75).contains(&(centre / size as f64));
        match in_middle(cx, width) && in_middle(cy, height) {
            true => Ok(()),
            false => {
                Err(format!("a principal point ({cx}, {cy}) far from the middle of the image of {width}x{height}"))
            }
        }
    }

    /// The camera of the same view sampled at another size.
    ///
    /// A pixel covers the half-open square of half a pixel around its centre, so edges, not centres,
    /// scale: `u' = (u + ½) s − ½`.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let scale_x = width as f64 / self.width as f64;
        let scale_y = height as f64 / self.height as f64;
        Self {
            fx: self.fx * scale_x,
            fy: self.fy * scale_y,
            cx: (self.cx + 0.5) * scale_x - 0.5,
            cy: (self.cy + 0.5) * scale_y - 0.5,
            width,
            height,
        }
    }

    /// The row of a view of `height` rows that a row of this one becomes.
    pub fn resized_row(&self, row: f64, height: usize) -> f64 {
        (row + 0.5) * height as f64 / self.height as f64 - 0.5
    }

    /// Pixel of a point in front of the camera; metres in, pixels out.
    pub fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        (point.z > 0.0)
            .then(|| Vector2::new(self.fx * point.x / point.z + self.cx, self.fy * point.y / point.z + self.cy))
    }

    /// The point at `depth` (m, along the optical axis) seen by a pixel.
    pub fn backproject(&self, pixel: &Vector2<f64>, depth: f64) -> Vector3<f64> {
        depth * Vector3::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    const CAMERA: Pinhole =
        Pinhole { fx: 707.0912, fy: 707.0912, cx: 601.8873, cy: 183.1104, width: 1226, height: 370 };

    #[test]
    fn backprojection_inverts_projection() {
        let point = Vector3::new(-3.0, 1.2, 17.0);
        let pixel = CAMERA.project(&point).unwrap();
        assert_relative_eq!(CAMERA.backproject(&pixel, point.z), point, epsilon = 1e-12);
        assert!(CAMERA.project(&-point).is_none());
    }

    #[test]
    fn resizing_keeps_the_edges_of_the_view() {
        let small = CAMERA.resized(320, 96);
        // The left and right image edges see the same directions at both sizes.
        for (full_px, small_px) in [(-0.5, -0.5), (1225.5, 319.5)] {
            let full = CAMERA.backproject(&Vector2::new(full_px, 0.0), 1.0);
            let resized = small.backproject(&Vector2::new(small_px, 0.0), 1.0);
            assert_relative_eq!(full.x, resized.x, epsilon = 1e-12);
        }
        let there_and_back = small.resized(1226, 370);
        assert_relative_eq!(there_and_back.cx, CAMERA.cx, epsilon = 1e-9);
    }
}
