//! How well a warped image explains the one it should equal (Godard et al. 2019, Eqs. 1-3).

use burn::tensor::Tensor;
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::{AvgPoolOptions, PadMode};

/// Share of structural similarity; the rest is L1.
const STRUCTURE: f64 = 0.85;
/// Constants of structural similarity for values in 0…1 (Wang et al. 2004).
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// An image that others are compared with, and the statistics of its 3x3 windows.
#[derive(Clone)]
pub(super) struct Target {
    /// `[batch, 3, height, width]`, 0…1.
    image: Tensor<4>,
    mean: Tensor<4>,
    variance: Tensor<4>,
}

impl Target {
    /// # Shapes
    /// - `image`: `[batch, 3, height, width]`, 0…1
    pub fn new(image: Tensor<4>) -> Self {
        let mean = window_mean(image.clone());
        let variance = window_mean(image.clone().square()) - mean.clone().square();
        Self { image, mean, variance }
    }

    /// The same images several times, one batch behind the other.
    pub fn repeated(self, times: usize) -> Self {
        let Self { image, mean, variance } = self;
        let [image, mean, variance] = [image, mean, variance].map(|tensor| tensor.repeat_dim(0, times));
        Self { image, mean, variance }
    }

    /// `0.85 (1 − SSIM)/2 + 0.15 L1` at every pixel, a mean over channels.
    ///
    /// # Shapes
    /// - `image`: as the target
    /// - returns: `[batch, 1, height, width]`, 0…1
    pub fn photometric_error(&self, image: Tensor<4>) -> Tensor<4> {
        let difference = (image.clone() - self.image.clone()).abs().mean_dim(1);
        self.structural_distance(image).mean_dim(1) * STRUCTURE + difference * (1.0 - STRUCTURE)
    }

    /// `(1 − SSIM)/2` over windows of 3x3 pixels, clamped to 0…1.
    fn structural_distance(&self, x: Tensor<4>) -> Tensor<4> {
        let (mean_x, mean_y) = (window_mean(x.clone()), self.mean.clone());
        let variance_x = window_mean(x.clone().square()) - mean_x.clone().square();
        let products = mean_x.clone() * mean_y.clone();
        let covariance = window_mean(x * self.image.clone()) - products.clone();
        let numerator = (products * 2.0 + C1) * (covariance * 2.0 + C2);
        let denominator = (mean_x.square() + mean_y.square() + C1) * (variance_x + self.variance.clone() + C2);
        ((numerator / denominator) * -0.5 + 0.5).clamp(0.0, 1.0)
    }
}

/// Mean of each 3x3 neighbourhood, the image continued by its mirror image.
fn window_mean(image: Tensor<4>) -> Tensor<4> {
    let padded = image.pad([(1, 1), (1, 1)], PadMode::Reflect);
    avg_pool2d(padded, AvgPoolOptions::new([3, 3]).with_stride([1, 1]))
}

/// Mean of `|∂d/d̄| e^−|∂I|` along rows and columns, d̄ the mean of the disparity d: changes of depth where the
/// image does not change.
///
/// # Shapes
/// - `disparity`: `[batch, 1, height, width]`
/// - `image`: `[batch, 3, height, width]`, 0…1
/// - returns: `[1]`
pub(super) fn smoothness(disparity: Tensor<4>, image: Tensor<4>) -> Tensor<1> {
    let mean = disparity.clone().mean_dim(2).mean_dim(3);
    let normalised = disparity / (mean + 1e-7);
    let change = |tensor: &Tensor<4>, axis: usize| {
        let size = tensor.dims()[axis];
        let later = tensor.clone().narrow(axis, 1, size - 1);
        (later - tensor.clone().narrow(axis, 0, size - 1)).abs()
    };
    let along = |axis: usize| {
        let weight = (change(&image, axis).mean_dim(1) * -1.0).exp();
        (change(&normalised, axis) * weight).mean()
    };
    along(2) + along(3)
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Distribution, TensorData};

    use super::*;

    #[test]
    fn equal_images_have_no_error_and_opposite_ones_much() {
        let device = Device::flex();
        let image = Tensor::<4>::random([2, 3, 8, 9], Distribution::Uniform(0.0, 1.0), &device);
        let target = Target::new(image.clone());
        let error = target.photometric_error(image.clone());
        assert_eq!(error.dims(), [2, 1, 8, 9]);
        assert!(error.max().into_scalar::<f32>() < 1e-6);
        let opposite = target.photometric_error(image * -1.0 + 1.0).mean().into_scalar::<f32>();
        assert!(opposite > 0.5, "{opposite}");
    }

    /// Numbers of PyTorch 2.15 in f64, by Monodepth2's definitions: reflection padding, average pooling of 3x3, differences.
    #[test]
    fn errors_and_smoothness_are_those_of_pytorch() {
        let device = Device::flex();
        let wave = |shape: [usize; 4], mean: f64, size: f64, step: f64, phase: f64| {
            let values =
                (0..shape.iter().product()).map(|k: usize| (mean + size * (step * k as f64 + phase).sin()) as f32);
            Tensor::<4>::from_data(TensorData::new(values.collect::<Vec<f32>>(), shape), &device)
        };
        let image = wave([1, 3, 6, 8], 0.5, 0.4, 0.37, 0.0);
        let target = wave([1, 3, 6, 8], 0.5, 0.4, 0.41, 0.2);
        let error = Target::new(target.clone()).photometric_error(image);
        let at = |v: usize, u: usize| error.clone().slice([0..1, 0..1, v..v + 1, u..u + 1]).into_scalar::<f32>();
        let close =
            |found: f32, expected: f64| assert!((f64::from(found) - expected).abs() < 1e-5, "{found}, {expected}");
        close(error.clone().mean().into_scalar(), 0.497_089_730);
        close(at(0, 0), 0.654_910_116);
        close(at(3, 4), 0.285_656_903);
        let disparity = wave([1, 1, 6, 8], 0.5, 0.3, 0.2, 0.0);
        close(smoothness(disparity, target).into_scalar(), 0.331_508_746);
    }

    /// An edge of depth costs less on an edge of the image.
    #[test]
    fn smoothness_forgives_edges_of_the_image() {
        let device = Device::flex();
        let step = |from: usize| {
            let row: Vec<f32> = (0..8).map(|u| if u < from { 0.1 } else { 0.9 }).collect();
            Tensor::<1>::from_floats(row.as_slice(), &device).reshape([1, 1, 1, 8]).repeat_dim(2, 4)
        };
        let image = step(4).repeat_dim(1, 3);
        let [on_edge, elsewhere] = [4, 6].map(|from| smoothness(step(from), image.clone()).into_scalar::<f32>());
        assert!(on_edge < 0.7 * elsewhere, "{on_edge} and {elsewhere}");
        assert_eq!(smoothness(step(8), image).into_scalar::<f32>(), 0.0);
    }
}
