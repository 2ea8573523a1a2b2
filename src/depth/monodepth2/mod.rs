//! The depth network Monodepth2 (Godard, Mac Aodha, Firman, Brostow, "Digging into self-supervised monocular depth
//! estimation", ICCV 2019) with a ResNet-18 encoder: one image in, disparities at four scales out.
//!
//! Batch norms are folded into the convolutions before them: in evaluation mode that is the same function, and the
//! network is then plain convolutions, whether its weights come from the published files ([`PublishedWeights`]) or
//! from training here.

mod decoder;
mod encoder;
mod state_dict;

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::{Initializer, PaddingConfig2d};
use burn::tensor::{Device, Tensor};

pub use state_dict::PublishedWeights;

use decoder::DepthDecoder;
use encoder::ResNet18;

/// Input sizes are multiples of this: the encoder halves the image five times, and the decoder doubles it again.
pub const SIZE_STEP: usize = 32;

/// The largest input side, px.
pub const MOST_SIZE: usize = 8192;

/// Whether an input may be so wide or high, px.
pub fn is_input_size(size: usize) -> bool {
    size.is_multiple_of(SIZE_STEP) && (2 * SIZE_STEP..=MOST_SIZE).contains(&size)
}

/// Encoder and decoder.
///
/// Departures: none in evaluation. Trained here, it has no batch norms (the second convolution of each residual
/// block starts at zero instead), so that small batches train as large ones do.
#[derive(Module, Debug)]
pub struct Monodepth2 {
    encoder: ResNet18,
    decoder: DepthDecoder,
}

impl Monodepth2 {
    /// A network with random weights, whose finest disparity is about `disparity` everywhere.
    pub fn init(disparity: f64, device: &Device) -> Self {
        Self { encoder: ResNet18::init(device), decoder: DepthDecoder::init(disparity, device) }
    }

    /// Disparities in 0…1 at full, half, quarter and eighth size.
    ///
    /// # Shapes
    /// - `images`: `[batch, 3, height, width]`, 0…1; both sizes multiples of [`SIZE_STEP`], at least twice that
    /// - returns: four of `[batch, 1, height / 2^s, width / 2^s]`
    pub fn forward(&self, images: Tensor<4>) -> [Tensor<4>; 4] {
        self.decoder.forward(self.encoder.forward(images))
    }

    /// The disparity at full size alone. Shapes as in [`Monodepth2::forward`].
    pub fn disparity(&self, images: Tensor<4>) -> Tensor<4> {
        self.decoder.finest(self.encoder.forward(images))
    }
}

/// `1 / (1/max + (1/min − 1/max) · disparity)`, as Monodepth2 bounds depth; its published networks use 0.1 and 100,
/// in units of their own.
pub fn disparity_to_depth(disparity: Tensor<4>, min_depth: f64, max_depth: f64) -> Tensor<4> {
    let (nearest, farthest) = (1.0 / min_depth, 1.0 / max_depth);
    (disparity * (nearest - farthest) + farthest).recip()
}

/// The inverse of [`disparity_to_depth`] for one depth.
pub fn depth_to_disparity(depth: f64, min_depth: f64, max_depth: f64) -> f64 {
    (1.0 / depth - 1.0 / max_depth) / (1.0 / min_depth - 1.0 / max_depth)
}

/// A convolution with bias and zero padding that keeps the size at stride 1.
fn convolution(inputs: usize, outputs: usize, kernel: usize, stride: usize, device: &Device) -> Conv2d {
    let pad = kernel / 2;
    convolution_config(inputs, outputs, kernel, stride)
        .with_padding(PaddingConfig2d::Explicit(pad, pad, pad, pad))
        .init(device)
}

/// He's initialisation (He et al. 2015), for ReLU and nearly so for ELU.
fn convolution_config(inputs: usize, outputs: usize, kernel: usize, stride: usize) -> Conv2dConfig {
    Conv2dConfig::new([inputs, outputs], [kernel, kernel])
        .with_stride([stride, stride])
        .with_initializer(Initializer::KaimingUniform { gain: std::f64::consts::SQRT_2, fan_out_only: false })
}
