//! Systems that measure the car's motion with errors of known covariance.
//!
//! Each covariance follows from what the system sees in that frame; the error is drawn from it, so it
//! is the true one: `e = L g` with `Σ = L Lᵀ` and `g` standard normal, `T̂ = exp(e) T` (paper Eq. 2).

use nalgebra::{RowVector6, Vector3, Vector6};

use super::least_squares::{inverse, prior_information};
use super::odometry::stereo_odometry_covariance;
use super::random::{Purpose, Random};
use super::rig::Rig;
use super::scene::Ray;
use super::settings::SyntheticSettings;
use super::street::is_moving;
use super::world::Moment;
use crate::geometry::{Covariance6, Pose};
use crate::systems::RelativePose;

/// Names of the simulated systems; `measurements/NAME/DRIVE.csv` holds their measurements.
pub const SYSTEMS: [&str; 4] = ["vo", "wheel", "icp", "coarse_gnss"];

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
    let camera_motion = motion.conjugated_by(&rig.calibration.camera_from_vehicle);
    let measured = [
        (0, camera_motion, stereo_odometry_covariance(settings, rig, seed, source, target)),
        (1, motion, wheel_covariance(&motion)),
        (2, motion, icp_covariance(rig, source, target)),
        (3, motion, coarse_gnss_covariance()),
    ];
    measured.map(|(system, truth, covariance)| {
        let mut random = Random::new(seed, Purpose::Errors(system), source.frame as u64);
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
        let row = distance_to_plane(&point, &(vehicle_from_world.rotation * hit.normal));
        normal_matrix += row.transpose() * row / (ICP_NOISE_M * ICP_NOISE_M);
    }
    Covariance6::from_matrix(inverse(&normal_matrix)).expect("the inverse of a sum of squares")
}

/// How the distance of `exp(e) p` to its plane changes with e at zero.
fn distance_to_plane(point: &Vector3<f64>, normal: &Vector3<f64>) -> RowVector6<f64> {
    let lever = point.cross(normal);
    RowVector6::new(normal.x, normal.y, normal.z, lever.x, lever.y, lever.z)
}

/// A cheap receiver and compass, vehicle axes: white noise that knows nothing of the scene.
fn coarse_gnss_covariance() -> Covariance6 {
    Covariance6::from_std_devs(&Vector6::new(0.08, 0.08, 0.12, 0.004, 0.004, 0.006))
}

#[cfg(test)]
mod tests {
    use super::super::world::World;
    use super::*;

    /// Half the width, in standard deviations, of a normal interval of 99.9 %; and of those that 21
    /// statements together keep with 99.9 %: one in 21,000 lies outside.
    const OF_ONE_STATEMENT: f64 = 3.291;
    const OF_21_STATEMENTS: f64 = 4.07;

    /// χ² with many degrees of freedom is nearly normal with mean k and variance 2k.
    fn assert_chi_squared(sum: f64, degrees: f64, width: f64) {
        let limit = width * (2.0 * degrees).sqrt();
        assert!((sum - degrees).abs() < limit, "{sum} against {degrees} ± {limit}");
    }

    fn small() -> SyntheticSettings {
        SyntheticSettings { size: [192, 64], ..SyntheticSettings::default() }
    }

    /// The first moments of a drive.
    fn drive(frames: usize) -> (Rig, Vec<Moment>) {
        let folder = tempfile::tempdir().unwrap();
        let rig = Rig::install(folder.path(), small().size).unwrap();
        let mut world = World::new(&small(), 1);
        (rig, (0..frames).map(|_| world.next_moment()).collect())
    }

    #[test]
    fn the_icp_row_is_the_slope_of_the_distance_to_the_plane() {
        let (point, normal) = (Vector3::new(9.0, 4.0, -0.5), Vector3::new(0.6, 0.0, 0.8));
        let row = distance_to_plane(&point, &normal);
        for axis in 0..6 {
            let step = 1e-6;
            let at = |size: f64| {
                let mut error = Vector6::zeros();
                error[axis] = size;
                normal.dot(&(Pose::exp(&error).transform_point(&point) - point))
            };
            assert!((row[axis] - (at(step) - at(-step)) / (2.0 * step)).abs() < 1e-6, "axis {axis}");
        }
    }

    #[test]
    fn wheels_err_more_the_faster_and_the_more_the_car_turns() {
        let std_devs = |way_m: f64, turn_rad: f64| {
            wheel_covariance(&Pose::exp(&Vector6::new(way_m, 0.0, 0.0, 0.0, 0.0, turn_rad))).std_devs()
        };
        let (still, fast, turning) = (std_devs(0.0, 0.0), std_devs(1.5, 0.0), std_devs(1.5, 0.08));
        assert!(fast[0] > 3.0 * still[0] && turning[5] > 2.0 * fast[5] && turning[1] > 2.0 * fast[1]);
        assert_eq!(turning, std_devs(1.5, -0.08));
    }

    #[test]
    fn icp_is_weakest_along_the_street() {
        let (rig, moments) = drive(30);
        let std_devs = icp_covariance(&rig, &moments[28], &moments[29]).std_devs();
        assert!(std_devs[0] > 1.3 * std_devs[1] && std_devs[0] > 1.3 * std_devs[2], "{std_devs}");
    }

    #[test]
    fn drawn_errors_have_the_stated_covariance() {
        let (rig, moments) = drive(2);
        let covariance = stereo_odometry_covariance(&small(), &rig, 3, &moments[0], &moments[1]);
        let information = covariance.matrix().cholesky().unwrap();
        let mut random = Random::new(9, Purpose::Errors(0), 0);
        let draws: Vec<Vector6<f64>> = (0..10_000).map(|_| draw_error(&covariance, &mut random)).collect();
        // As a whole; then, should one part hide another, along each axis and between them.
        assert_chi_squared(draws.iter().map(|e| e.dot(&information.solve(e))).sum(), 60_000.0, OF_ONE_STATEMENT);
        for axis in 0..6 {
            let variance = covariance.variance()[axis];
            assert_chi_squared(draws.iter().map(|e| e[axis] * e[axis] / variance).sum(), 10_000.0, OF_21_STATEMENTS);
        }
        // Whitened errors are uncorrelated: each of the 15 sums has variance 10,000.
        let factor = covariance.matrix().cholesky().unwrap().unpack();
        let white: Vec<Vector6<f64>> = draws.iter().map(|e| factor.solve_lower_triangular(e).unwrap()).collect();
        for (a, b) in (0..6).flat_map(|a| (0..a).map(move |b| (a, b))) {
            let sum: f64 = white.iter().map(|w| w[a] * w[b]).sum();
            assert!(sum.abs() < OF_21_STATEMENTS * 100.0, "{a} {b} {sum}");
        }
    }
}
