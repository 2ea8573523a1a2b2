//! Lenses that bend straight lines: where a ray falls on the distorted image, which ray a pixel of it saw, and the pinhole
//! camera whose image holds nothing but what the lens saw. Leaves the images themselves to
//! [`Undistortion`](crate::recordings::Undistortion).

use nalgebra::{Matrix2, Vector2};
use serde::{Deserialize, Serialize};

use super::Pinhole;

/// Length of Newton's last step in [`Lens::undistort`], normalised coordinates: the error left is its square.
const CONVERGED: f64 = 1e-12;
/// Newton's steps, and halvings of one, before there is no answer; real lenses take fewer than ten, and no halving.
const MOST_STEPS: usize = 40;
const MOST_HALVINGS: usize = 10;
/// Places between the optical axis and a ray at which it is asked whether the model folds over.
const PLACES: usize = 16;

/// A pinhole camera behind a lens with radial-tangential distortion (Brown and Conrady; "radtan", "plumb bob"), as OpenCV
/// has it with five coefficients.
///
/// With a ray's normalised coordinates `p = (x, y)`, `r² = x² + y²` and `t = (p2, p1)`, it falls on
/// `p' = (1 + k1 r² + k2 r⁴ + k3 r⁶ + 2 t·p) p + r² t` (Brown 1966; OpenCV's "Camera Calibration and 3D
/// Reconstruction", its terms gathered), and so on the pixel `(fx x' + cx, fy y' + cy)`.
///
/// The polynomial describes a lens only as far as it was fitted: further out it may fold over, so that several rays reach
/// one pixel. Its Jacobian is symmetric; as long as it is positive definite all the way from the optical axis to a ray,
/// the ray is taken for one that the lens sees.
///
/// # Frames
/// Normalised coordinates are those of the plane z = 1 in camera axes (x right, y down, z forward).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Intrinsics and size of the distorted image.
    pub camera: Pinhole,
    /// `k1, k2, p1, p2, k3`, in OpenCV's order; without unit, for normalised coordinates.
    pub distortion: [f64; 5],
}

impl Lens {
    /// The pixel of the distorted image on which a ray falls; beyond a fold of the model, a pixel that others reach too.
    ///
    /// # Shapes
    /// - `ray`: normalised coordinates x/z, y/z
    /// - returns: px; it may lie outside the image
    pub fn distort(&self, ray: &Vector2<f64>) -> Vector2<f64> {
        let Pinhole { fx, fy, cx, cy, .. } = self.camera;
        let bent = self.bent(ray);
        Vector2::new(fx * bent.x + cx, fy * bent.y + cy)
    }

    /// The ray that a pixel of the distorted image saw, by Newton's method from the optical axis outwards; `None` where
    /// no ray reaches the pixel without crossing a fold of the model.
    ///
    /// # Shapes
    /// - `pixel`: px; it may lie outside the image
    /// - returns: normalised coordinates x/z, y/z
    pub fn undistort(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let seen = self.camera.backproject(pixel, 1.0).xy();
        let mut ray = Vector2::zeros();
        for _ in 0..MOST_STEPS {
            let missing = seen - self.bent(&ray);
            let mut step = self.jacobian(&ray).try_inverse()? * missing;
            if step.norm() <= CONVERGED {
                ray += step;
                return (!self.folds_before(&ray)).then_some(ray);
            }
            let is_nearer =
                |ray: Vector2<f64>| self.is_unfolded(&ray) && (seen - self.bent(&ray)).norm() < missing.norm();
            let mut halvings = 0;
            while !is_nearer(ray + step) {
                step /= 2.0;
                halvings += 1;
                if halvings > MOST_HALVINGS {
                    return None;
                }
            }
            ray += step;
        }
        None
    }

    /// The pinhole camera of the undistorted image: of the same size, and no pixel of it lies outside the distorted one.
    ///
    /// It sees the largest rectangle between the innermost places of the four undistorted borders, whose corners are the
    /// centres of its corner pixels. OpenCV's `getOptimalNewCameraMatrix` with `alpha = 0`, with a departure: all
    /// pixels of the border are asked, not nine on each side. Without distortion it is the camera itself. `None` if the
    /// model folds over within the image, or leaves no such rectangle.
    pub fn rectified(&self) -> Option<Pinhole> {
        if self.distortion == [0.0; 5] {
            return Some(self.camera);
        }
        let Pinhole { width, height, .. } = self.camera;
        let (last_column, last_row) = (width as f64 - 1.0, height as f64 - 1.0);
        let ray = |column: f64, row: f64| self.undistort(&Vector2::new(column, row));
        let (mut left, mut right) = (f64::NEG_INFINITY, f64::INFINITY);
        for row in 0..height {
            left = left.max(ray(0.0, row as f64)?.x);
            right = right.min(ray(last_column, row as f64)?.x);
        }
        let (mut top, mut bottom) = (f64::NEG_INFINITY, f64::INFINITY);
        for column in 0..width {
            top = top.max(ray(column as f64, 0.0)?.y);
            bottom = bottom.min(ray(column as f64, last_row)?.y);
        }
        let (fx, fy) = (last_column / (right - left), last_row / (bottom - top));
        (left < right && top < bottom).then_some(Pinhole { fx, fy, cx: -fx * left, cy: -fy * top, width, height })
    }

    /// Whether the model folds over between the optical axis and a ray, or at it.
    pub(crate) fn folds_before(&self, ray: &Vector2<f64>) -> bool {
        (1..=PLACES).any(|place| !self.is_unfolded(&(ray * (place as f64 / PLACES as f64))))
    }

    /// Whether the model keeps its orientation around a ray: Sylvester's criterion of a positive definite Jacobian.
    fn is_unfolded(&self, ray: &Vector2<f64>) -> bool {
        let jacobian = self.jacobian(ray);
        jacobian.m11 > 0.0 && jacobian.determinant() > 0.0
    }

    /// p' of the type's equation, normalised.
    fn bent(&self, ray: &Vector2<f64>) -> Vector2<f64> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let tangential = Vector2::new(p2, p1);
        let r2 = ray.norm_squared();
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        (radial + 2.0 * tangential.dot(ray)) * ray + r2 * tangential
    }

    /// Its derivative by the ray.
    fn jacobian(&self, ray: &Vector2<f64>) -> Matrix2<f64> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let tangential = Vector2::new(p2, p1);
        let r2 = ray.norm_squared();
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let radial_by_r2 = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
        let mixed = ray * tangential.transpose();
        Matrix2::from_diagonal_element(radial + 2.0 * tangential.dot(ray))
            + 2.0 * (radial_by_r2 * ray * ray.transpose() + mixed + mixed.transpose())
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    /// TUM fr1, as calibrated by its authors.
    const TUM: Lens = Lens {
        camera: Pinhole { fx: 517.3, fy: 516.5, cx: 318.6, cy: 255.3, width: 640, height: 480 },
        distortion: [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
    };
    /// EuRoC cam0.
    const EUROC: Lens = Lens {
        camera: Pinhole { fx: 458.654, fy: 457.296, cx: 367.215, cy: 248.375, width: 752, height: 480 },
        distortion: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0],
    };

    fn pixels(camera: &Pinhole) -> impl Iterator<Item = Vector2<f64>> {
        let width = camera.width;
        (0..width * camera.height).map(move |index| Vector2::new((index % width) as f64, (index / width) as f64))
    }

    #[test]
    fn undistorting_inverts_distorting_over_the_whole_image() {
        for lens in [TUM, EUROC] {
            for pixel in pixels(&lens.camera) {
                let ray = lens.undistort(&pixel).unwrap();
                let again = lens.distort(&ray);
                assert_relative_eq!(again, pixel, epsilon = 1e-10 * lens.camera.fx);
                assert_relative_eq!(lens.undistort(&again).unwrap(), ray, epsilon = 1e-10);
            }
        }
    }

    #[test]
    fn the_jacobian_is_that_of_finite_differences() {
        const STEP: f64 = 1e-5;
        for lens in [TUM, EUROC] {
            for ray in [Vector2::zeros(), Vector2::new(0.3, -0.4), Vector2::new(-0.6, 0.1)] {
                let columns = [Vector2::x(), Vector2::y()]
                    .map(|axis| (lens.bent(&(ray + STEP * axis)) - lens.bent(&(ray - STEP * axis))) / (2.0 * STEP));
                assert_relative_eq!(lens.jacobian(&ray), Matrix2::from_columns(&columns), epsilon = 1e-8);
            }
        }
    }

    #[test]
    fn a_lens_without_distortion_is_its_camera() {
        let lens = Lens { distortion: [0.0; 5], ..TUM };
        assert_eq!(lens.rectified(), Some(lens.camera));
        for pixel in pixels(&lens.camera).step_by(997) {
            let ray = lens.undistort(&pixel).unwrap();
            assert_relative_eq!(ray, lens.camera.backproject(&pixel, 1.0).xy(), epsilon = 1e-14);
            assert_relative_eq!(lens.distort(&ray), pixel, epsilon = 1e-10);
        }
    }

    #[test]
    fn every_pixel_of_the_rectified_camera_lies_in_the_distorted_image() {
        for lens in [TUM, EUROC] {
            let camera = lens.rectified().unwrap();
            assert_eq!((camera.width, camera.height), (lens.camera.width, lens.camera.height));
            // Beyond the left, upper, right and lower border. Between two pixels of a border its undistorted curve may
            // reach a little further; its innermost place may lie where another border cuts the curve off.
            let mut beyond_px = [f64::NEG_INFINITY; 4];
            let last = Vector2::new(camera.width as f64 - 1.0, camera.height as f64 - 1.0);
            for pixel in pixels(&camera) {
                let seen = lens.distort(&camera.backproject(&pixel, 1.0).xy());
                let beyond = [-seen.x, -seen.y, seen.x - last.x, seen.y - last.y];
                beyond_px = std::array::from_fn(|side| beyond_px[side].max(beyond[side]));
            }
            assert!(beyond_px.iter().all(|px| (-1.0..1e-3).contains(px)), "{beyond_px:?} px beyond the borders");
        }
    }

    #[test]
    fn a_lens_that_folds_over_has_no_ray_rather_than_a_wrong_one() {
        // r (1 - r²) never exceeds 0.385; with k2 a second branch beyond the fold reaches every pixel.
        for k2 in [0.0, 0.3] {
            let lens = Lens { distortion: [-1.0, k2, 0.0, 0.0, 0.0], ..TUM };
            assert_eq!(lens.undistort(&Vector2::new(0.0, 0.0)), None);
            assert_eq!(lens.rectified(), None);
            let ray = Vector2::new(0.2, 0.1);
            assert_relative_eq!(lens.undistort(&lens.distort(&ray)).unwrap(), ray, epsilon = 1e-12);
            assert!(lens.folds_before(&Vector2::new(1.63, 0.0)) && !lens.folds_before(&ray));
        }
        let nonsense = Lens { distortion: [f64::NAN; 5], ..TUM };
        assert_eq!(nonsense.undistort(&Vector2::new(10.0, 20.0)), None);
        assert_eq!(nonsense.rectified(), None);
    }

    #[test]
    fn points_and_cameras_are_those_of_opencv() {
        let reference: serde_json::Value =
            serde_json::from_str(include_str!("../../tests/data/lens.json")).expect("JSON");
        for (lens, found) in [TUM, EUROC].iter().zip(reference["lenses"].as_array().unwrap()) {
            let camera = lens.camera;
            assert_eq!(found["intrinsics"], serde_json::json!([camera.fx, camera.fy, camera.cx, camera.cy]));
            assert_eq!(found["distortion"], serde_json::json!(lens.distortion));
            let points: Vec<[f64; 4]> = serde_json::from_value(found["points"].clone()).unwrap();
            assert!(points.len() >= 24);
            for [u, v, x, y] in points {
                let ray = lens.undistort(&Vector2::new(u, v)).unwrap();
                assert_relative_eq!(ray, Vector2::new(x, y), epsilon = 1e-9);
            }
            // OpenCV's has nine points on each side of the border.
            let optimal: [f64; 4] = serde_json::from_value(found["optimal"].clone()).unwrap();
            let ours = lens.rectified().unwrap();
            for (ours, theirs) in [ours.fx, ours.fy, ours.cx, ours.cy].into_iter().zip(optimal) {
                assert_relative_eq!(ours, theirs, epsilon = 0.5);
            }
        }
    }
}
