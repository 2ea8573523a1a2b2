//! Laws of the alignment, on pictures of a made scene.

use approx::assert_relative_eq;
use nalgebra::{Matrix6, Vector2, Vector3};
use rand::{RngExt, SeedableRng};

use super::*;
use crate::geometry::{Pinhole, Pose, Tangent};

const CAMERA: Pinhole = Pinhole { fx: 105.0, fy: 105.0, cx: 95.0, cy: 31.0, width: 192, height: 64 };

/// Planes by the axis across them and their place on it, m: a road between façades with a wall behind; a wall alone.
const STREET: &[(usize, f64)] = &[(1, 1.6), (0, -5.0), (0, 6.0), (2, 30.0)];
const WALL: &[(usize, f64)] = &[(2, 8.0)];

/// Two views of a scene.
struct Pair {
    source: GreyImage,
    target: GreyImage,
    depth_m: Vec<f32>,
    /// The true motion.
    source_from_target: Pose,
}

/// What a ray from a place in a direction hits first: distance along the optical axis's unit, and the point.
fn hit(planes: &[(usize, f64)], origin: &Vector3<f64>, direction: &Vector3<f64>) -> (f64, Vector3<f64>) {
    let distance = |&(axis, place): &(usize, f64)| match (place - origin[axis]) / direction[axis] {
        distance if distance > 0.0 => distance,
        _ => f64::INFINITY,
    };
    let nearest = planes.iter().map(distance).fold(100.0, f64::min);
    (nearest, origin + nearest * direction)
}

/// Smooth everywhere, with structure at several scales.
fn texture(point: &Vector3<f64>) -> f64 {
    let wave = |scale: f64, [a, b, c]: [f64; 3]| ((a * point.x + b * point.y + c * point.z) / scale).sin();
    let coarse = wave(1.3, [1.0, 0.3, 0.8]) + wave(1.9, [-0.4, 1.0, 0.6]);
    let fine = wave(0.6, [0.7, -0.6, 1.0]) * wave(0.8, [1.0, 0.8, -0.3]);
    0.5 + 0.12 * coarse + 0.1 * fine
}

/// What a camera sees, each pixel the mean of 4x4 rays, and the depth at its centre.
fn render(planes: &[(usize, f64)], world_from_camera: &Pose) -> (GreyImage, Vec<f32>) {
    let ray = |u: f64, v: f64| {
        let direction = CAMERA.backproject(&Vector2::new(u, v), 1.0);
        hit(planes, &world_from_camera.translation, &(world_from_camera.rotation * direction))
    };
    let offsets = [-0.375, -0.125, 0.125, 0.375];
    let (mut pixels, mut depth_m) = (Vec::new(), Vec::new());
    for row in 0..CAMERA.height {
        for column in 0..CAMERA.width {
            let (u, v) = (column as f64, row as f64);
            let rays = offsets.iter().flat_map(|dv| offsets.iter().map(move |du| (u + du, v + dv)));
            pixels.push((rays.map(|(u, v)| texture(&ray(u, v).1)).sum::<f64>() / 16.0) as f32);
            depth_m.push(ray(u, v).0 as f32);
        }
    }
    (GreyImage { width: CAMERA.width, height: CAMERA.height, pixels }, depth_m)
}

fn pair() -> Pair {
    pair_of(STREET)
}

fn pair_of(planes: &[(usize, f64)]) -> Pair {
    let source_from_target = Pose::exp(&Tangent::new(0.02, -0.01, 0.5, 0.002, 0.01, -0.001));
    let (source, _) = render(planes, &Pose::identity());
    let (target, depth_m) = render(planes, &source_from_target);
    Pair { source, target, depth_m, source_from_target }
}

impl Pair {
    fn align(&self, source_from_target: Pose) -> Evidence {
        align(&AlignmentInput {
            source_image: &self.source,
            target_image: &self.target,
            target_depth_m: &self.depth_m,
            camera: CAMERA,
            source_from_target,
        })
    }

    /// The evidence of a measurement that is wrong by e.
    fn measured_with(&self, error: &Tangent) -> Evidence {
        self.align(Pose::exp(error) * self.source_from_target)
    }
}

/// Errors of a size: metres and radians that move pixels alike.
fn error(size: f64) -> Tangent {
    size * Tangent::new(1.0, -0.7, 1.5, 0.1, -0.15, 0.2)
}

#[test]
fn the_estimate_is_the_error_at_every_size() {
    let pair = pair();
    let rest = pair.measured_with(&Tangent::zeros()).finest().error;
    assert!(rest.fixed_rows::<3>(0).norm() < 3e-3 && rest.fixed_rows::<3>(3).norm() < 3e-4, "{rest}");
    for size in [1e-3, 1e-2, 1e-1] {
        let evidence = pair.measured_with(&error(size));
        assert_eq!(evidence.no_verdict, None);
        // What the alignment sees of a measurement without error is the same for all.
        let left = (evidence.finest().error - rest - error(size)).component_div(&error(1.0)).abs().max();
        assert!(left < 2e-4 + 0.02 * size, "size {size}: off by {left} of {size}");
    }
}

#[test]
fn identical_images_and_no_motion_are_evidence_of_no_error() {
    let pair = pair();
    let still = Pair { source: pair.target.clone(), source_from_target: Pose::identity(), ..pair };
    let evidence = still.measured_with(&Tangent::zeros());
    assert!(evidence.finest().error.abs().max() < 1e-6, "{}", evidence.finest().error);
    assert_eq!(evidence.no_verdict, None);
}

#[test]
fn the_estimate_moves_with_the_axes() {
    let pair = pair();
    let evidence = pair.measured_with(&error(0.03));
    let vehicle_from_camera = Pose::exp(&Tangent::new(1.0, 0.2, 1.5, 1.2, -1.2, 1.2));
    let moved = evidence.transported(&vehicle_from_camera);
    let expected = vehicle_from_camera.adjoint() * error(0.03);
    assert!((moved.finest().error - expected).norm() < 0.05 * expected.norm());
    let length = |evidence: &Evidence| {
        let level = evidence.finest();
        (level.error.transpose() * level.information * level.error)[(0, 0)]
    };
    assert_relative_eq!(length(&moved), length(&evidence), max_relative = 1e-9);
}

#[test]
fn light_is_no_error() {
    let pair = pair();
    let dark = pair.measured_with(&error(0.03));
    let pixels = pair.target.pixels.iter().map(|grey| 1.2 * grey + 0.05).collect();
    let bright = Pair { target: GreyImage { pixels, ..pair.target.clone() }, ..pair };
    let bright = bright.measured_with(&error(0.03));
    let sigma = dark.finest().information.try_inverse().unwrap().diagonal().map(f64::sqrt);
    let moved = (bright.finest().error - dark.finest().error).component_div(&sigma).abs().max();
    assert!(moved < 0.3, "{moved} σ");
    assert_relative_eq!(bright.gain, 0.2, epsilon = 0.02);
    assert_relative_eq!(bright.bias, 0.05, epsilon = 0.01);
}

/// A car that came by: what it covers, a twentieth of the picture, has moved by some pixels. Images have the noise of a
/// sensor.
#[test]
fn a_moving_thing_shifts_the_estimate_by_less_than_it_says() {
    let mut pair = pair_of(WALL);
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let pixels = pair.source.pixels.iter_mut().chain(&mut pair.target.pixels);
    pixels.for_each(|grey| *grey += random.random_range(-0.02..0.02));
    let still = pair.measured_with(&error(0.03));
    let mut target = pair.target.clone();
    for row in 26..44 {
        for column in 60..92 {
            target.pixels[row * CAMERA.width + column] = pair.target.pixels[(row + 2) * CAMERA.width + column + 8];
        }
    }
    let moving = Pair { target, ..pair }.measured_with(&error(0.03));
    let sigma = moving.finest().information.try_inverse().unwrap().diagonal().map(f64::sqrt);
    let shift = (moving.finest().error - still.finest().error).component_div(&sigma);
    assert!(shift.abs().max() < 1.0, "{shift} σ");
}

/// `Λ` is the curvature of the cost, by differences of the sum of squares around the estimate.
#[test]
fn information_is_the_curvature_of_the_cost() {
    let pair = pair_of(WALL);
    let level = *pair.measured_with(&Tangent::zeros()).finest();
    let textured = image::Textured::new(&pair.source);
    let intrinsics = [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy].map(|value| value as f32);
    let points = normal_equations::Points::new(&image::Textured::new(&pair.target), &pair.depth_m, intrinsics);
    let at_rest = Pose::exp(&-level.error) * pair.source_from_target;
    let residuals_at = |shift: &Tangent| {
        let state = normal_equations::State { source_from_target: Pose::exp(&-shift) * at_rest, gain: 0.0, bias: 0.0 };
        let mut residuals = Vec::new();
        normal_equations::residuals(&textured, intrinsics, &points, &state, &mut residuals);
        residuals
    };
    let steps = Tangent::new(0.02, 0.02, 0.04, 2e-3, 2e-3, 2e-3);
    let scale = level.residual_after as f32;
    let columns: Vec<Vec<f32>> = (0..6)
        .map(|c| {
            let step = Tangent::from_fn(|row, _| if row == c { steps[c] } else { 0.0 });
            let (ahead, behind) = (residuals_at(&step), residuals_at(&-step));
            ahead.iter().zip(behind).map(|(a, b)| (a - b) / (2.0 * steps[c] as f32)).collect()
        })
        .collect();
    let weights: Vec<f32> = residuals_at(&Tangent::zeros())
        .iter()
        .map(|r| {
            (normal_equations::DEGREES_OF_FREEDOM + 1.0) / (normal_equations::DEGREES_OF_FREEDOM + (r / scale).powi(2))
        })
        .collect();
    let sum = |a: &dyn Fn(usize) -> f32, b: &dyn Fn(usize) -> f32| -> f64 {
        let terms = (0..points.known).map(|k| f64::from(weights[k] * a(k) * b(k)));
        terms.filter(|term| term.is_finite()).sum()
    };
    let greys = |k: usize| points.grey[k];
    let ones = |_: usize| 1.0;
    let pose = Matrix6::from_fn(|row, column| sum(&|k| columns[row][k], &|k| columns[column][k]));
    let cross = nalgebra::Matrix6x2::from_fn(|row, column| match column {
        0 => sum(&|k| columns[row][k], &greys),
        _ => sum(&|k| columns[row][k], &ones),
    });
    let light = nalgebra::Matrix2::new(sum(&greys, &greys), sum(&greys, &ones), sum(&ones, &greys), sum(&ones, &ones));
    let expected = (pose - cross * light.try_inverse().unwrap() * cross.transpose()) / f64::from(scale * scale);
    let unit = Matrix6::from_diagonal(&expected.diagonal().map(|value| value.sqrt().recip()));
    let difference = (unit * (level.information - expected) * unit).abs().max();
    assert!(difference < 0.05, "{difference}");
}

#[test]
fn what_shows_nothing_gets_no_verdict() {
    let flat = |grey: f32| GreyImage { pixels: vec![grey; 192 * 64], width: 192, height: 64 };
    let no_verdict = |pair: &Pair, error: &Tangent| pair.measured_with(error).no_verdict;
    let black = Pair { source: flat(0.0), target: flat(0.0), ..pair() };
    assert_eq!(no_verdict(&black, &Tangent::zeros()), Some(NoVerdict::NoTexture));
    let one_black = Pair { source: flat(0.5), ..pair() };
    assert_eq!(no_verdict(&one_black, &Tangent::zeros()), Some(NoVerdict::NoTexture));
    let unknown = Pair { depth_m: vec![0.0; 192 * 64], ..pair() };
    assert_eq!(no_verdict(&unknown, &Tangent::zeros()), Some(NoVerdict::NoDepth));
    for (axis, side) in [(0, 1.0), (1, 1.0), (2, 1.0), (2, -1.0)] {
        let kilometre = Tangent::from_fn(|row, _| if row == axis { 1000.0 * side } else { 0.0 });
        assert_eq!(no_verdict(&pair(), &kilometre), Some(NoVerdict::NoOverlap), "{kilometre}");
    }
    let turned = Tangent::new(0.0, 0.0, 0.0, 0.0, std::f64::consts::PI, 0.0);
    assert_eq!(no_verdict(&pair(), &turned), Some(NoVerdict::NoOverlap));
    let mut depth_m = vec![0.0; 192 * 64];
    pair().depth_m.iter().enumerate().step_by(100).for_each(|(index, &depth)| depth_m[index] = depth);
    assert_eq!(no_verdict(&Pair { depth_m, ..pair() }, &Tangent::zeros()), Some(NoVerdict::NoDepth));
}

#[test]
fn sparse_depth_is_enough() {
    let mut pair = pair();
    pair.depth_m.iter_mut().enumerate().filter(|(index, _)| index % 7 != 0).for_each(|(_, depth)| *depth = 0.0);
    let evidence = pair.measured_with(&error(0.03));
    assert_eq!(evidence.no_verdict, None);
    let left = (evidence.finest().error - error(0.03)).component_div(&error(0.03)).abs().max();
    assert!(left < 0.2, "{left}");
}
