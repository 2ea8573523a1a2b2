//! Fast CPU operations: what training and prediction spend their time in, for Burn's flex backend.
//!
//! Tensors of any device come in; on flex with 32-bit floats they go to the kernels of this room, on
//! every other device to Burn's own operations, with the same result up to rounding. One departure: a
//! value that is not kept counts as 0 even if it is NaN (dropped by dropout, or a weight times an input
//! of 0 in a product with one row). The kernels themselves work on plain slices, know nothing of Burn,
//! and hold all `unsafe` of the crate: each block says why it is sound. They are written once, generic
//! over vector instructions (`RELCOV_INSTRUCTIONS` forces a set, see `instructions.rs`).

#![allow(unsafe_code, reason = "the one room where speed needs it")]
#![deny(clippy::undocumented_unsafe_blocks)]
#![cfg_attr(not(feature = "flex"), allow(unused, dead_code, reason = "only flex has kernels"))]

mod activation;
mod adam;
mod block;
mod buffer;
mod convolution;
mod dense;
#[cfg(feature = "flex")]
mod extension;
#[cfg(feature = "flex")]
mod flex;
mod fused;
mod instructions;
mod layouts;
mod optimiser;
mod pool;
mod product;
mod reference;
mod self_test;
mod warp;

use burn::nn::conv::Conv2d;
use burn::nn::{Dropout, Linear};
use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use burn::tensor::ops::MaxPoolOptions;

pub(crate) use block::{Block, double};
pub(crate) use fused::{Activation, Border};
pub(crate) use instructions::{Instructions, Kernel};
pub use optimiser::Adam;
pub(crate) use self_test::{deviation_by, deviation_on};
pub(crate) use warp::Validity;

/// [`Conv2d::forward`]; the kernels take any kernel size, stride and equal padding of opposite sides.
///
/// # Shapes
/// - `input`: `[batch, inputs, height, width]`
/// - returns: `[batch, outputs, output height, output width]`
pub(crate) fn conv2d(layer: &Conv2d, input: Tensor<4>) -> Tensor<4> {
    #[cfg(feature = "flex")]
    if let Some(shape) = flex::convolution_shape(layer, &input) {
        return flex::conv2d(layer, input, shape);
    }
    layer.forward(input)
}

/// ReLU, then dropout where the layer would drop: on a device with gradients, unless frozen.
///
/// Which values are dropped follows from the device's seed, and on flex does not depend on the number
/// of threads.
pub(crate) fn relu_dropout<const D: usize>(layer: &Dropout, input: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if flex::takes(&input) {
        return flex::relu_dropout(layer, input);
    }
    layer.forward(relu(input))
}

/// Maximum over 3x3 neighbourhoods at every second row and column, borders ignored.
///
/// # Shapes
/// - `input`: `[batch, channels, height, width]`
/// - returns: half of both sizes, rounded up
pub(crate) fn max_pool(input: Tensor<4>) -> Tensor<4> {
    #[cfg(feature = "flex")]
    if flex::takes_without_gradients(&input) {
        return flex::max_pool(input);
    }
    let options = MaxPoolOptions::new([3, 3]).with_stride([2, 2]).with_padding([1, 1]);
    burn::tensor::module::max_pool2d(input, options)
}

/// [`Linear::forward`]; fast for one row without gradients, where the weights' way from memory counts.
///
/// # Shapes
/// - `input`: `[batch, inputs]`; returns: `[batch, outputs]`
pub(crate) fn linear(layer: &Linear, input: Tensor<2>) -> Tensor<2> {
    #[cfg(feature = "flex")]
    if flex::takes_row(layer, &input) {
        return flex::linear_row(layer, input);
    }
    layer.forward(input)
}

/// The warp of one image into the other view, in one pass; `None` where only Burn's operations can do
/// it (with gradients, or not on flex). Shapes as in [`crate::warp::Warp::forward`].
pub(crate) fn warp(
    source_image: &Tensor<4>,
    target_depth: &Tensor<4>,
    intrinsics: &Tensor<2>,
    source_from_target: &Tensor<3>,
    validity: Validity,
) -> Option<(Tensor<4>, Tensor<4>)> {
    #[cfg(feature = "flex")]
    if flex::takes_without_gradients(source_image)
        && flex::takes_without_gradients(target_depth)
        && flex::takes_without_gradients(intrinsics)
        && flex::takes_without_gradients(source_from_target)
    {
        return Some(flex::warp(source_image, target_depth, intrinsics, source_from_target, validity));
    }
    None
}
