//! Systems that measure the car's motion with errors of known covariance.
//!
//! Each covariance follows from what the system sees in that frame; the error is drawn from it, so it
//! is the true one: `e = L g` with `Σ = L Lᵀ` and `g` standard normal, `T̂ = exp(e) T` (paper Eq. 2).

use nalgebra::{Matrix6, RowVector6, Vector3, Vector6};

use super::random::{Purpose, Random};
use super::rig::{Rig, baseline_m};
use super::scene::Ray;
use super::sensors::View;
use super::settings::SyntheticSettings;
use super::street::is_moving;
use super::surface::shade;
use super::world::Moment;
use crate::geometry::{Covariance6, Pinhole, Pose, hat};
use crate::systems::RelativePose;

/// Names of the simulated systems; `measurements/NAME/DRIVE.csv` holds their measurements.
pub const SYSTEMS: [&str; 4] = ["vo", "wheel", "icp", "coarse_gnss"];

/// What a smooth motion would be taken for without any landmark or point, m and rad.
const MOTION_PRIOR: [f64; 6] = [0.25, 0.25, 0.25, 0.02, 0.02, 0.02];

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

/// Directions of the points that ICP aligns, of a turn and from top to bottom, and their noise.
const ICP_AZIMUTHS: usize = 72;
const ICP_ELEVATIONS: [f64; 8] = [0.03, 0.0, -0.03, -0.06, -0.1, -0.15, -0.22, -0.3];
const ICP_RANGE_M: f64 = 80.0;
/// Noise of a point's distance to its plane: more than the beam's, because neighbours are not independent, m.
const ICP_NOISE_M: f64 = 0.12;

/// What all systems measured between two neighbouring frames, in the order of [`SYSTEMS`].
pub(super) fn measure(
    settings: &SyntheticSettings,
    rig: &Rig,
    seed: u64,
    source: &Moment,
    target: &Moment,
) -> [RelativePose; 4] {
    let motion = source.world_from_vehicle.inverse() * target.world_from_vehicle;
    let camera_motion = motion.conjugated_by(&rig.calibration.camera2_from_vehicle);
    let measured = [
        (camera_motion, stereo_odometry_covariance(settings, rig, seed, source, target)),
        (motion, wheel_covariance(&motion)),
        (motion, icp_covariance(rig, source, target)),
        (motion, coarse_gnss_covariance()),
    ];
    let mut system = 0;
    measured.map(|(truth, covariance)| {
        let mut random = Random::new(seed, Purpose::Errors(system), source.frame as u64);
        system += 1;
        let error = draw_error(&covariance, &mut random);
        RelativePose {
            source: source.frame,
            target: target.frame,
            source_from_target: Pose::exp(&error) * truth,
            covariance: Some(covariance),
        }
    })
}

/// An error with this covariance.
pub(super) fn draw_error(covariance: &Covariance6, random: &mut Random) -> Vector6<f64> {
    let factor = covariance.matrix().cholesky().expect("a simulated covariance is positive definite").unpack();
    factor * Vector6::from_fn(|_, _| random.normal())
}

/// Sparse stereo visual odometry, axes of the left colour camera: landmarks by texture, seen by both
/// cameras in both frames; `Σ = (Σ JᵀJ/σ² + Λ)⁻¹` with the Jacobian J of the reprojection into the
/// source frame, pixel noise `σ² = σ₀² (1 + (30/contrast)²)` (the fainter a corner, the less surely it
/// is found: Förstner 1987) and a weak motion prior Λ. Landmarks on a moving car that pass the outlier gate shift
/// the estimate by `w`; how much of it remains is drawn anew for each car: Σ grows by `w wᵀ`.
fn stereo_odometry_covariance(
    settings: &SyntheticSettings,
    rig: &Rig,
    seed: u64,
    source: &Moment,
    target: &Moment,
) -> Covariance6 {
    let vehicle_from_camera = rig.vehicle_from_camera2();
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
        let contrast = contrast(&view, target.gain, u, v);
        if landmarks == settings.vo_landmarks || contrast < LEAST_CONTRAST {
            continue;
        }
        let noise = settings.vo_pixel_noise * (1.0 + (HALF_CONTRAST / contrast).powi(2)).sqrt();
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
        let Pinhole { fx, fy, .. } = view.camera;
        let z = point.z;
        let by_point = [
            Vector3::new(fx / z, 0.0, -fx * point.x / (z * z)),
            Vector3::new(0.0, fy / z, -fy * point.y / (z * z)),
            Vector3::new(fx / z, 0.0, -fx * (point.x - baseline_m()) / (z * z)),
        ];
        // exp(e) X ≈ X + ρ + φ × X
        let by_rotation = -hat(&point);
        let jacobian = by_point.map(|row| {
            let rotation = by_rotation.transpose() * row;
            RowVector6::new(row.x, row.y, row.z, rotation.x, rotation.y, rotation.z)
        });
        Some(Landmark { jacobian, shift_px: actual - predicted, moving: key })
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

/// `u`, `v` in the left and `u` in the right image, if inside both.
fn stereo_pixels(camera: &Pinhole, point: &Vector3<f64>) -> Option<Vector3<f64>> {
    let left = camera.project(point)?;
    let right = camera.project(&Vector3::new(point.x - baseline_m(), point.y, point.z))?;
    let inside = |u: f64, v: f64| {
        (0.0..=(camera.width - 1) as f64).contains(&u) && (0.0..=(camera.height - 1) as f64).contains(&v)
    };
    (inside(left.x, left.y) && inside(right.x, right.y)).then(|| Vector3::new(left.x, left.y, right.x))
}

/// Wheel odometry, vehicle axes: scale and slip grow with the way, heading errors with the turn.
fn wheel_covariance(motion: &Pose) -> Covariance6 {
    let way_m = motion.translation.norm();
    let turn_rad = motion.rotation.matrix()[(1, 0)].abs();
    Covariance6::from_std_devs(&Vector6::new(
        0.004 + 0.02 * way_m + 0.3 * turn_rad,
        0.003 + 0.006 * way_m + 0.6 * turn_rad,
        0.006 + 0.004 * way_m,
        0.003,
        0.003,
        0.0008 + 0.0004 * way_m + 0.05 * turn_rad,
    ))
}

/// Point-to-plane ICP, vehicle axes: `Σ = (Σ JᵀJ/σ² + Λ)⁻¹` with `J = [nᵀ, (p × n)ᵀ]`; weak along
/// streets whose walls and ground all run along.
fn icp_covariance(rig: &Rig, source: &Moment, target: &Moment) -> Covariance6 {
    let world_from_velodyne = target.world_from_vehicle * rig.vehicle_from_velodyne();
    let vehicle_from_world = source.world_from_vehicle.inverse();
    let mut normal_matrix = prior_information();
    for (elevation, step) in ICP_ELEVATIONS.iter().flat_map(|z| (0..ICP_AZIMUTHS).map(move |step| (z, step))) {
        let (sine, cosine) = libm::sincos(std::f64::consts::TAU * step as f64 / ICP_AZIMUTHS as f64);
        let direction = world_from_velodyne.rotation * Vector3::new(cosine, sine, *elevation);
        let ray = Ray { origin: world_from_velodyne.translation, direction };
        let Some(hit) = target.scene.cast(&ray).filter(|hit| hit.distance < ICP_RANGE_M) else { continue };
        let moving = hit.thing.is_some_and(|thing| is_moving(target.scene.things[thing].key));
        if moving {
            continue;
        }
        let point = vehicle_from_world.transform_point(&ray.at(hit.distance));
        let normal = vehicle_from_world.rotation * hit.normal;
        let lever = point.cross(&normal);
        let row = RowVector6::new(normal.x, normal.y, normal.z, lever.x, lever.y, lever.z);
        normal_matrix += row.transpose() * row / (ICP_NOISE_M * ICP_NOISE_M);
    }
    Covariance6::from_matrix(inverse(&normal_matrix)).expect("the inverse of a sum of squares")
}

/// A cheap receiver and compass, vehicle axes: white noise that knows nothing of the scene.
fn coarse_gnss_covariance() -> Covariance6 {
    Covariance6::from_std_devs(&Vector6::new(0.08, 0.08, 0.12, 0.004, 0.004, 0.006))
}

fn prior_information() -> Matrix6<f64> {
    Matrix6::from_diagonal(&Vector6::from(MOTION_PRIOR).map(|std_dev| 1.0 / (std_dev * std_dev)))
}

/// The inverse of a symmetric positive definite matrix, symmetric to the last bit.
fn inverse(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    let inverse = matrix.cholesky().expect("a prior keeps it positive definite").inverse();
    0.5 * (inverse + inverse.transpose())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// χ² with many degrees of freedom is nearly normal with mean k and variance 2k.
    fn assert_chi_squared(sum: f64, degrees: f64) {
        // 99.9 %, both sides.
        let limit = 3.291 * (2.0 * degrees).sqrt();
        assert!((sum - degrees).abs() < limit, "{sum} against {degrees} ± {limit}");
    }

    #[test]
    fn drawn_errors_have_the_stated_covariance() {
        let settings = SyntheticSettings { size: [192, 64], ..SyntheticSettings::default() };
        let folder = tempfile::tempdir().unwrap();
        let rig = Rig::install(folder.path(), settings.size).unwrap();
        let mut world = super::super::world::World::new(&settings, 1);
        let moments = [world.next_moment(), world.next_moment()];
        let covariance = stereo_odometry_covariance(&settings, &rig, world.seed(), &moments[0], &moments[1]);
        let information = covariance.matrix().cholesky().unwrap();
        let mut random = Random::new(9, Purpose::Errors(0), 0);
        let draws: Vec<Vector6<f64>> = (0..10_000).map(|_| draw_error(&covariance, &mut random)).collect();
        // As a whole, and along each axis.
        assert_chi_squared(draws.iter().map(|e| e.dot(&information.solve(e))).sum(), 60_000.0);
        for axis in 0..6 {
            let variance = covariance.variance()[axis];
            assert_chi_squared(draws.iter().map(|e| e[axis] * e[axis] / variance).sum(), 10_000.0);
        }
        // Whitened errors are uncorrelated: each of the 15 sums has variance 10,000.
        let factor = covariance.matrix().cholesky().unwrap().unpack();
        let white: Vec<Vector6<f64>> = draws.iter().map(|e| factor.solve_lower_triangular(e).unwrap()).collect();
        for (a, b) in (0..6).flat_map(|a| (0..a).map(move |b| (a, b))) {
            let sum: f64 = white.iter().map(|w| w[a] * w[b]).sum();
            assert!(sum.abs() < 3.291 * 100.0 * 1.3, "{a} {b} {sum}");
        }
    }
}
