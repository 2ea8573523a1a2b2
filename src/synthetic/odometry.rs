//! The simulated visual odometry: sparse stereo, as accurate as the scene's texture lets it be.

use nalgebra::{RowVector6, Vector3, Vector6};

use super::least_squares::{inverse, prior_information};
use super::random::{Purpose, Random};
use super::rig::{Rig, baseline_m};
use super::sensors::View;
use super::settings::SyntheticSettings;
use super::shading::shade;
use super::street::is_moving;
use super::world::Moment;
use crate::geometry::{Covariance6, Pinhole, Pose, hat};

/// Candidates for landmarks: the image is divided into so many columns and rows.
const BUCKETS: [usize; 2] = [24, 8];
/// Contrast (grey levels over three pixels) of the faintest landmark.
const LEAST_CONTRAST: f64 = 4.0;
/// Contrast at which a landmark is found with √2 of the noise it has at the strongest.
const HALF_CONTRAST: f64 = 30.0;
/// Nearest and farthest landmark, m.
const LANDMARK_DEPTH_M: [f64; 2] = [1.5, 80.0];
/// A landmark that moves farther than this by itself is found out, standard deviations of a pixel.
const OUTLIER_GATE: f64 = 4.0;

/// Sparse stereo visual odometry, axes of the left colour camera: landmarks by texture, seen by both
/// cameras in both frames; `Σ = (Σ JᵀJ/σ² + Λ)⁻¹` with the Jacobian J of the reprojection into the
/// source frame, pixel noise `σ² = σ₀² (1 + (30/contrast)²)` (the fainter a corner, the less surely it
/// is found: Förstner 1987) and a weak motion prior Λ. Landmarks on a moving car that pass the outlier gate shift
/// the estimate by `w`; how much of it remains is drawn anew for each car: Σ grows by `w wᵀ`.
pub(super) fn stereo_odometry_covariance(
    settings: &SyntheticSettings,
    rig: &Rig,
    seed: u64,
    source: &Moment,
    target: &Moment,
) -> Covariance6 {
    let vehicle_from_camera = rig.vehicle_from_camera();
    let view = View {
        scene: &target.scene,
        light: &target.light,
        camera: rig.camera(),
        world_from_camera: target.world_from_vehicle * vehicle_from_camera,
    };
    let stereo = Stereo { rig, source, target, vehicle_from_camera };
    let mut random = Random::new(seed, Purpose::Landmarks, source.frame as u64);
    let mut normal_matrix = prior_information();
    let mut shifts: Vec<(u64, Vector6<f64>)> = Vec::new();
    let mut landmarks = 0;
    // In random order, so that a limit on their number leaves no part of the image out.
    let mut buckets: Vec<(u64, usize)> = (0..BUCKETS[0] * BUCKETS[1]).map(|bucket| (random.bits(), bucket)).collect();
    buckets.sort_unstable();
    for (_, bucket) in buckets {
        let (column, row) = (bucket % BUCKETS[0], bucket / BUCKETS[0]);
        let u = (column as f64 + random.uniform()) * view.camera.width as f64 / BUCKETS[0] as f64;
        let v = (row as f64 + random.uniform()) * view.camera.height as f64 / BUCKETS[1] as f64;
        if landmarks == settings.vo_landmarks {
            break;
        }
        let contrast = contrast(&view, target.gain, u, v);
        if contrast < LEAST_CONTRAST {
            continue;
        }
        let faintness = HALF_CONTRAST / contrast;
        let noise = settings.vo_pixel_noise * (1.0 + faintness * faintness).sqrt();
        let Some(landmark) = stereo.landmark(&view, u, v) else { continue };
        if landmark.shift_px.norm() > OUTLIER_GATE * noise {
            continue;
        }
        let information = 1.0 / (noise * noise);
        landmarks += 1;
        for (row, shift) in landmark.jacobian.iter().zip(landmark.shift_px.iter()) {
            normal_matrix += row.transpose() * row * information;
            if let Some(key) = landmark.moving {
                let entry = match shifts.iter().position(|(other, _)| *other == key) {
                    Some(entry) => entry,
                    None => {
                        shifts.push((key, Vector6::zeros()));
                        shifts.len() - 1
                    }
                };
                shifts[entry].1 += row.transpose() * (shift * information);
            }
        }
    }
    let mut covariance = inverse(&normal_matrix);
    let estimate = covariance;
    for (_, gradient) in shifts {
        let shift = estimate * gradient;
        covariance += shift * shift.transpose();
    }
    Covariance6::from_matrix(covariance).expect("a sum of squares")
}

/// Contrast around a pixel, grey levels.
fn contrast(view: &View<'_>, gain: f64, u: f64, v: f64) -> f64 {
    let cone = view.cone(1.0);
    let level = |u: f64, v: f64| {
        let ray = view.ray(u, v);
        let colour = shade(view.scene, view.light, &ray, &cone, view.scene.cast(&ray).as_ref());
        255.0 * (gain * (colour.x + colour.y + colour.z) / 3.0).clamp(0.0, 1.0).sqrt()
    };
    let across = level(u + 1.5, v) - level(u - 1.5, v);
    let down = level(u, v + 1.5) - level(u, v - 1.5);
    // A corner shows in both directions, an edge in one.
    across.abs().min(down.abs()) + 0.3 * across.abs().max(down.abs())
}

struct Stereo<'a> {
    rig: &'a Rig,
    source: &'a Moment,
    target: &'a Moment,
    vehicle_from_camera: Pose,
}

struct Landmark {
    /// Of `u` and `v` in the left and `u` in the right image by the error e.
    jacobian: [RowVector6<f64>; 3],
    /// How far its own motion moves it in those, px.
    shift_px: Vector3<f64>,
    /// Key of the moving car it sits on.
    moving: Option<u64>,
}

impl Stereo<'_> {
    /// The landmark behind a pixel of the target's left image, if both cameras see it in both frames.
    fn landmark(&self, view: &View<'_>, u: f64, v: f64) -> Option<Landmark> {
        let ray = view.ray(u, v);
        let hit = self.target.scene.cast(&ray)?;
        if !(LANDMARK_DEPTH_M[0]..LANDMARK_DEPTH_M[1]).contains(&hit.distance) {
            return None;
        }
        let in_target = ray.at(hit.distance);
        let key = hit.thing.map(|thing| self.target.scene.things[thing].key).filter(|&key| is_moving(key));
        let in_source = match key {
            None => in_target,
            Some(key) => {
                let car = |moment: &Moment| moment.moving.iter().find(|car| car.key == key).copied();
                car(self.target)?.carry(&in_target, &car(self.source)?)
            }
        };
        self.is_seen(self.target, &in_target)?;
        let actual = self.is_seen(self.source, &in_source)?;
        // Where it would be seen if it stood still: what the estimator takes for granted.
        let camera_from_world = (self.source.world_from_vehicle * self.vehicle_from_camera).inverse();
        let point = camera_from_world.transform_point(&in_target);
        let predicted = stereo_pixels(&view.camera, &point)?;
        Some(Landmark { jacobian: jacobian(&view.camera, &point), shift_px: actual - predicted, moving: key })
    }

    /// Pixels of a world point in both cameras of a frame, if neither view is blocked.
    fn is_seen(&self, moment: &Moment, point: &Vector3<f64>) -> Option<Vector3<f64>> {
        let world_from_camera = moment.world_from_vehicle * self.vehicle_from_camera;
        let pixels = stereo_pixels(&self.rig.camera(), &world_from_camera.inverse().transform_point(point))?;
        let right = (world_from_camera * self.rig.camera2_from_camera3()).translation;
        let visible = moment.scene.sees(&world_from_camera.translation, point) && moment.scene.sees(&right, point);
        visible.then_some(pixels)
    }
}

/// How the stereo pixels of `exp(e) X` change with e at zero, px/m and px/rad; X in axes of the left camera.
fn jacobian(camera: &Pinhole, point: &Vector3<f64>) -> [RowVector6<f64>; 3] {
    let Pinhole { fx, fy, .. } = camera;
    let z = point.z;
    let by_point = [
        Vector3::new(fx / z, 0.0, -fx * point.x / (z * z)),
        Vector3::new(0.0, fy / z, -fy * point.y / (z * z)),
        Vector3::new(fx / z, 0.0, -fx * (point.x - baseline_m()) / (z * z)),
    ];
    // exp(e) X ≈ X + ρ + φ × X
    let by_rotation = -hat(point);
    by_point.map(|row| {
        let rotation = by_rotation.transpose() * row;
        RowVector6::new(row.x, row.y, row.z, rotation.x, rotation.y, rotation.z)
    })
}

/// `u`, `v` in the left and `u` in the right image, if inside both.
fn stereo_pixels(camera: &Pinhole, point: &Vector3<f64>) -> Option<Vector3<f64>> {
    let left = camera.project(point)?;
    let right = camera.project(&Vector3::new(point.x - baseline_m(), point.y, point.z))?;
    let inside = |u: f64, v: f64| {
        (0.0..=(camera.width - 1) as f64).contains(&u) && (0.0..=(camera.height - 1) as f64).contains(&v)
    };
    (inside(left.x, left.y) && inside(right.x, right.y)).then(|| Vector3::new(left.x, left.y, right.x))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { fx: 111.0, fy: 111.0, cx: 94.0, cy: 32.0, width: 192, height: 64 };

    #[test]
    fn the_jacobian_is_that_of_the_left_perturbed_reprojection() {
        let point = Vector3::new(1.4, -0.6, 7.0);
        let rows = jacobian(&CAMERA, &point);
        for axis in 0..6 {
            let step = 1e-6;
            let at = |size: f64| {
                let mut error = Vector6::zeros();
                error[axis] = size;
                stereo_pixels(&CAMERA, &Pose::exp(&error).transform_point(&point)).unwrap()
            };
            let slope = (at(step) - at(-step)) / (2.0 * step);
            for (row, slope) in rows.iter().zip(slope.iter()) {
                assert!((row[axis] - slope).abs() < 1e-4, "axis {axis}: {} against {slope}", row[axis]);
            }
        }
    }

    #[test]
    fn the_covariance_is_that_of_a_least_squares_estimate_from_noisy_pixels() {
        // One Gauss-Newton step from the truth, many times, against (JᵀJ/σ²)⁻¹.
        let mut random = Random::new(5, Purpose::Landmarks, 0);
        let mut point =
            || Vector3::new(random.between(-4.0, 4.0), random.between(-1.5, 1.5), random.between(6.0, 20.0));
        let points: Vec<Vector3<f64>> =
            (0..40).map(|_| point()).filter(|point| stereo_pixels(&CAMERA, point).is_some()).collect();
        assert!(points.len() > 20);
        let noise = 0.01;
        let rows: Vec<RowVector6<f64>> = points.iter().flat_map(|point| jacobian(&CAMERA, point)).collect();
        let normal_matrix =
            rows.iter().map(|row| row.transpose() * row).sum::<nalgebra::Matrix6<f64>>() / (noise * noise);
        let expected = inverse(&normal_matrix);
        let draws = 4000;
        let mut scatter = nalgebra::Matrix6::zeros();
        for _ in 0..draws {
            let gradient: Vector6<f64> = rows.iter().map(|row| row.transpose() * (noise * random.normal())).sum();
            let estimate = expected * gradient / (noise * noise);
            scatter += estimate * estimate.transpose() / f64::from(draws);
        }
        for axis in 0..6 {
            let ratio = scatter[(axis, axis)] / expected[(axis, axis)];
            assert!((ratio - 1.0).abs() < 4.0 * (2.0 / f64::from(draws)).sqrt(), "axis {axis}: {ratio}");
        }
    }
}
