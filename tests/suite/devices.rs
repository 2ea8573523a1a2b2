//! The same numbers on every backend, and gradients against finite differences.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::{Vector2, Vector3};
use relcov::alignment::{EvidenceInput, FEATURES};
use relcov::device::open_device;
use relcov::geometry::{Pinhole, Pose, Tangent};
use relcov::loss::gaussian_loss;
use relcov::model::{Architecture, ImagePair, InputBasis, MicroBatch, PoseInput};
use relcov::network::{Head, ImageNetwork};
use relcov::pairs::{EvidenceBatch, ImageBatch, PairBatch, RightBatch};
use relcov::warp::Warp;

use crate::support::device;

const HEIGHT: usize = 16;
const WIDTH: usize = 24;
const CAMERA: Pinhole = Pinhole { fx: 20.0, fy: 22.0, cx: 11.3, cy: 7.6, width: WIDTH, height: HEIGHT };

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().iter::<f64>().collect()
}

fn floats<const D: usize>(shape: [usize; D], value: impl Fn(usize) -> f32, device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new((0..shape.iter().product()).map(value).collect::<Vec<f32>>(), shape), device)
}

fn pose_tensor(poses: &[Pose], device: &Device) -> Tensor<3> {
    let rows: Vec<f32> =
        poses.iter().flat_map(|pose| pose.matrix().transpose().as_slice().to_vec()).map(|x| x as f32).collect();
    Tensor::from_data(TensorData::new(rows, [poses.len(), 4, 4]), device)
}

/// The right camera looks from half a metre to the right.
fn right_from_left() -> Pose {
    Pose { translation: Vector3::new(-0.5, 0.0, 0.0), ..Pose::identity() }
}

/// Two pairs of smooth images with modest motions.
fn pairs(device: &Device) -> PairBatch {
    let wave = |scale: f32| move |k: usize| 0.5 + 0.4 * ((k % WIDTH) as f32 * scale + (k / WIDTH) as f32 * 0.31).sin();
    let intrinsics = [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy].map(|x| x as f32);
    let poses = [
        Pose::exp(&Tangent::new(0.1, -0.05, 0.4, 0.01, 0.02, -0.01)),
        Pose::exp(&Tangent::new(-0.2, 0.02, -0.3, -0.02, 0.01, 0.03)),
    ];
    let right = RightBatch {
        source_image: floats([2, 3, HEIGHT, WIDTH], wave(0.19), device),
        target_image: floats([2, 3, HEIGHT, WIDTH], wave(0.2), device),
        source_from_target: pose_tensor(&poses.map(|pose| right_from_left() * pose), device),
        target_from_target: pose_tensor(&[right_from_left(); 2], device),
    };
    let motion: Vec<f32> = poses.iter().flat_map(|pose| pose.log().as_slice().to_vec()).map(|x| x as f32).collect();
    let images = ImageBatch {
        source_image: floats([2, 3, HEIGHT, WIDTH], wave(0.21), device),
        target_image: floats([2, 3, HEIGHT, WIDTH], wave(0.23), device),
        target_depth: floats([2, 1, HEIGHT, WIDTH], |k| 4.0 + 2.0 * (k as f32 * 0.05).sin(), device),
        intrinsics: floats([2, 4], |k| intrinsics[k % 4], device),
        source_from_target: pose_tensor(&poses, device),
        right: Some(right),
    };
    // Symmetric and dominated by its diagonal.
    let information = |k: usize| {
        let (row, column) = (k / 6 % 6, k % 6);
        if row == column { 4e3 * (1 + row) as f32 } else { 300.0 * ((row + column) as f32).cos() }
    };
    PairBatch {
        images: Some(images),
        motion: floats([2, 6], |k| motion[k], device),
        error: floats([2, 6], |k| 0.02 * (k as f32 - 5.5), device),
        evidence: Some(EvidenceBatch {
            features: floats([2, FEATURES], |k| (k as f32 * 0.7).sin(), device),
            estimate: floats([2, 6], |k| 0.018 * (k as f32 - 5.0), device),
            information: floats([2, 6, 6], information, device),
        }),
    }
}

fn images(device: &Device) -> ImageBatch {
    pairs(device).images.expect("included")
}

fn architecture(input: InputBasis) -> Architecture {
    Architecture { input, dropout: 0.0, log_variance_floor: Some([-14.0; 6]), ..Architecture::paper(WIDTH, HEIGHT) }
}

/// With everything that the paper's model does without.
fn extended() -> Architecture {
    Architecture {
        validity_mask: true,
        stereo: true,
        pose: PoseInput::Mlp,
        head: Head::Full,
        ..architecture(InputBasis::Residual)
    }
}

/// Without the warp.
fn raw() -> Architecture {
    Architecture { pair: ImagePair::Raw, head: Head::Full, ..architecture(InputBasis::Pair) }
}

/// With evidence beside the images, and a posterior.
fn with_evidence() -> Architecture {
    let evidence = EvidenceInput::Alignment;
    Architecture { evidence, head: Head::Posterior, ..architecture(InputBasis::Residual) }
}

/// Evidence alone.
fn evidence_alone() -> Architecture {
    Architecture { network: ImageNetwork::None, ..with_evidence() }
}

/// Loss and the gradients of every weight for the fixed pairs, with the oracle's weights.
fn training_step(architecture: &Architecture, device: &Device) -> (Vec<f64>, Vec<Vec<f64>>) {
    let autodiff = device.clone().autodiff();
    let model = architecture.init([-4.0; 6], &autodiff);
    let model = crate::support::with_formula_weights(model);
    let (loss, gradients) = model.step(&MicroBatch { pairs: pairs(device), weight: 0.5, corrected_share: 0.5 });
    let mut reader = GradientReader { gradients: &gradients, found: Vec::new() };
    model.visit(&mut reader);
    (values(loss), reader.found)
}

struct GradientReader<'a> {
    gradients: &'a burn::optim::GradientsParams,
    found: Vec<Vec<f64>>,
}

impl burn::module::ModuleVisitor for GradientReader<'_> {
    fn visit_float<const D: usize>(&mut self, param: &burn::module::Param<Tensor<D>>) {
        self.found.push(values(self.gradients.get::<D>(param.id).expect("every weight has a gradient")));
    }
}

fn compare_with_flex(device: &Device) {
    for (architecture, tensors) in [
        (architecture(InputBasis::Residual), 14),
        (extended(), 18),
        (raw(), 14),
        (with_evidence(), 21),
        (evidence_alone(), 9),
    ] {
        let (loss, gradients) = training_step(&architecture, &open_device("flex").unwrap());
        let (other_loss, other_gradients) = training_step(&architecture, device);
        for (a, b) in loss.iter().zip(&other_loss) {
            assert!((a - b).abs() <= 1e-4 * a.abs(), "{architecture:?}: loss {a} against {b}");
        }
        assert_eq!(gradients.len(), tensors, "weights and biases of every layer");
        for (layer, (a, b)) in gradients.iter().zip(&other_gradients).enumerate() {
            let scale = a.iter().map(|x| x.abs()).fold(0.0, f64::max);
            let off = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(scale > 0.0 && off <= 1e-3 * scale, "{architecture:?}, {layer}: off by {off:e} of {scale:e}");
        }
    }
}

#[test]
fn a_training_step_on_every_backend_agrees_with_flex() {
    ["ndarray", "wgpu"].into_iter().filter_map(device).for_each(|device| compare_with_flex(&device));
}

#[test]
fn devices_that_are_not_there_are_explained() {
    let message = open_device("tpu").unwrap_err().to_string();
    assert!(message.contains("`tpu`") && message.contains("auto | flex"), "{message}");
    if !cfg!(feature = "cuda") {
        let message = open_device("cuda:1").unwrap_err().to_string();
        assert!(message.contains("--features cuda"), "{message}");
    }
    assert!(open_device("flex:3").is_err());
}

#[test]
fn warp_by_identity_returns_the_source_image() {
    for (name, device) in [("flex", open_device("flex").ok()), ("ndarray", device("ndarray"))] {
        let Some(device) = device else {
            assert_ne!(name, "flex");
            continue;
        };
        let pairs = images(&device);
        let identity = pose_tensor(&[Pose::identity(); 2], &device);
        let warped = Warp.forward(pairs.source_image.clone(), pairs.target_depth, pairs.intrinsics, identity);
        assert_eq!(warped.valid_mask.min().into_scalar::<f32>(), 1.0, "{name}");
        let off = (warped.image - pairs.source_image).abs().max().into_scalar::<f32>();
        assert!(off < 1e-4, "{name}: {off}");
    }
}

#[test]
fn the_warp_projects_where_the_camera_does() {
    let device = open_device("flex").unwrap();
    let pairs = images(&device);
    let pose = Pose::exp(&Tangent::new(0.1, -0.05, 0.4, 0.01, 0.02, -0.01));
    let coordinates = Warp.project(pairs.target_depth.clone(), pairs.intrinsics, pairs.source_from_target);
    let (u, v, depth) = (values(coordinates.u), values(coordinates.v), values(pairs.target_depth));
    for (row, column) in [(0, 0), (3, 20), (9, 11), (15, 23)] {
        let pixel = row * WIDTH + column;
        let point = CAMERA.backproject(&Vector2::new(column as f64, row as f64), depth[pixel]);
        let expected = CAMERA.project(&pose.transform_point(&point)).unwrap();
        assert!((Vector2::new(u[pixel], v[pixel]) - expected).norm() < 1e-3, "pixel {row},{column}");
    }
}

#[test]
fn pixels_behind_the_camera_or_without_depth_are_invalid_and_finite() {
    let device = open_device("flex").unwrap();
    let pairs = images(&device);
    let backwards = Pose { translation: Vector3::new(0.0, 0.0, -20.0), ..Pose::identity() };
    for (depth, pose) in [(pairs.target_depth.clone(), backwards), (pairs.target_depth.zeros_like(), Pose::identity())]
    {
        let warped =
            Warp.forward(pairs.source_image.clone(), depth, pairs.intrinsics.clone(), pose_tensor(&[pose; 2], &device));
        assert_eq!(warped.valid_mask.sum().into_scalar::<f32>(), 0.0);
        assert_eq!(warped.image.abs().sum().into_scalar::<f32>(), 0.0);
    }
}

/// Two roads to one number (unless RELCOV_INSTRUCTIONS=burn makes them one): on flex `forward` is one pass over the pixels, `project` and `sample` are
/// Burn's operations.
#[test]
fn the_warp_in_one_pass_agrees_with_the_warp_in_steps() {
    let device = open_device("flex").unwrap();
    let mut pairs = images(&device);
    let noise = |scale: f32| move |k: usize| ((k as f32 * 12.9898 + scale).sin() * 43758.547).fract().abs();
    for round in 0..20 {
        let size = 0.05 * round as f32;
        let poses: Vec<Pose> = (0..2)
            .map(|pair| {
                let at = |k: usize| f64::from((noise(size)(k + 6 * pair) - 0.5) * size);
                Pose::exp(&Tangent::new(at(0), at(1), 6.0 * at(2), at(3), at(4), at(5)))
            })
            .collect();
        // Some depths unknown, some behind the source camera after the motion.
        let depth = |k: usize| (8.0 * noise(size + 1.0)(k) - 1.0).max(0.0);
        pairs.target_depth = floats([2, 1, HEIGHT, WIDTH], depth, &device);
        pairs.source_image = floats([2, 3, HEIGHT, WIDTH], noise(size + 2.0), &device);
        let pose = pose_tensor(&poses, &device);
        let ImageBatch { source_image, target_depth, intrinsics, .. } = pairs.clone();
        let coordinates = Warp.project(target_depth.clone(), intrinsics.clone(), pose.clone());
        let [u, v] = [coordinates.u.clone(), coordinates.v.clone()].map(values);
        let in_steps = Warp.sample(source_image.clone(), coordinates);
        let in_one = Warp.forward(source_image, target_depth, intrinsics, pose);
        let [steps_mask, one_mask] = [in_steps.valid_mask, in_one.valid_mask].map(values);
        let [steps, one] = [in_steps.image, in_one.image].map(values);
        assert!(steps_mask.iter().sum::<f64>() > 20.0, "round {round}: the test must see valid pixels");
        for (index, (a, b)) in one.iter().zip(&steps).enumerate() {
            let pixel = index / (3 * HEIGHT * WIDTH) * HEIGHT * WIDTH + index % (HEIGHT * WIDTH);
            // Rounding decides on which side of the border a coordinate within 1e-4 px of it lies.
            let off = |x: f64, last: usize| (x + 1e-3).abs().min((x - last as f64 - 1e-3).abs()) < 1e-4;
            if off(u[pixel], WIDTH - 1) || off(v[pixel], HEIGHT - 1) {
                continue;
            }
            assert_eq!(one_mask[pixel], steps_mask[pixel], "round {round}, pixel {pixel}");
            assert!((a - b).abs() < 2e-4, "round {round}, value {index}: {a} for {b} at ({}, {})", u[pixel], v[pixel]);
        }
    }
}

#[test]
fn gradients_of_the_warp_agree_with_finite_differences() {
    let device = open_device("flex").unwrap();
    let autodiff = device.clone().autodiff();
    let fixed = images(&device);
    // Pixels near the border may step out of the image; there the warp jumps.
    let at = Warp.project(fixed.target_depth.clone(), fixed.intrinsics.clone(), fixed.source_from_target.clone());
    let inner = |x: Tensor<4>, size: usize| (x - (size - 1) as f32 / 2.0).abs().lower_elem(size as f32 / 2.0 - 2.0);
    let inside = inner(at.u, WIDTH).bool_and(inner(at.v, HEIGHT)).float();
    assert!(inside.clone().mean().into_scalar::<f32>() > 0.3);
    let weights = floats([2, 3, HEIGHT, WIDTH], |k| (k as f32 * 0.7).sin(), &device) * inside;
    let objective = |image: Tensor<4>, depth: Tensor<4>, pose: Tensor<3>| {
        let warped = Warp.forward(image, depth, fixed.intrinsics.clone(), pose);
        (warped.image * weights.clone()).sum()
    };
    let image = fixed.source_image.clone().autodiff().require_grad();
    let depth = fixed.target_depth.clone().autodiff().require_grad();
    let pose = fixed.source_from_target.clone().autodiff().require_grad();
    assert!(autodiff.is_autodiff());
    let gradients = objective(image.clone(), depth.clone(), pose.clone()).backward();

    // Central differences along one direction of each input. A few pixels cross a kink of the bilinear
    // surface within the step, which a missing or wrong term would exceed by far.
    fn check<const D: usize>(
        name: &str,
        at: Tensor<D>,
        gradient: Tensor<D>,
        step: f32,
        f: impl Fn(Tensor<D>) -> Tensor<1>,
    ) {
        let direction = floats(at.dims(), |k| (1.3 * k as f32 + 0.4 * (k as f32).sqrt()).sin(), &at.device());
        let ahead = f(at.clone() + direction.clone() * step).into_scalar::<f32>();
        let behind = f(at - direction.clone() * step).into_scalar::<f32>();
        let numeric = f64::from(ahead - behind) / (2.0 * f64::from(step));
        let analytic = f64::from((gradient * direction).sum().into_scalar::<f32>());
        assert!((numeric - analytic).abs() <= 0.04 * analytic.abs().max(0.2), "{name}: {numeric} against {analytic}");
    }
    let (i, d, p) = (fixed.source_image.clone(), fixed.target_depth.clone(), fixed.source_from_target.clone());
    check("image", i.clone(), image.grad(&gradients).unwrap(), 1e-2, |image| objective(image, d.clone(), p.clone()));
    check("depth", d.clone(), depth.grad(&gradients).unwrap(), 2e-3, |depth| objective(i.clone(), depth, p.clone()));
    check("pose", p.clone(), pose.grad(&gradients).unwrap(), 2e-4, |pose| objective(i.clone(), d.clone(), pose));
}

#[test]
fn the_loss_and_its_gradient_are_finite_for_every_input() {
    let device = open_device("flex").unwrap();
    let extremes = [0.0_f32, 1e-38, 1e-8, 1.0, 1e4, 3e38];
    for d in extremes.into_iter().chain(extremes.map(|d| -d)) {
        for e in extremes {
            let log_variance = floats([1, 6], |_| d, &device).autodiff().require_grad();
            let loss = gaussian_loss(log_variance.clone(), floats([1, 6], |_| e, &device).autodiff());
            let gradient = log_variance.grad(&loss.clone().sum().backward()).unwrap();
            assert!(values(loss).iter().all(|x| x.is_finite()), "loss at d {d:e}, e {e:e}");
            assert!(values(gradient).iter().all(|x| x.is_finite()), "gradient at d {d:e}, e {e:e}");
        }
    }
}

#[test]
fn the_loss_is_lowest_where_the_variance_is_the_squared_error() {
    let device = open_device("flex").unwrap();
    let error = floats([1, 6], |k| 0.01 * (k + 1) as f32, &device);
    let best = floats([1, 6], |k| (0.01 * (k + 1) as f32).powi(2).ln(), &device);
    let log_variance = best.clone().autodiff().require_grad();
    let loss = gaussian_loss(log_variance.clone(), error.clone().autodiff());
    let gradient = log_variance.grad(&loss.clone().sum().backward()).unwrap();
    assert!(values(gradient).iter().all(|slope| slope.abs() < 1e-4));
    for step in [-0.1, 0.1] {
        let nearby = gaussian_loss(best.clone() + step, error.clone());
        assert!(values(nearby)[0] > values(loss.clone())[0]);
    }
}
