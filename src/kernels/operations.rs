//! Operations on tensors of any device: by the kernels where they can take the tensors, by Burn elsewhere.

use burn::nn::conv::Conv2d;
use burn::nn::{Dropout, Linear};
use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use burn::tensor::ops::MaxPoolOptions;

#[cfg(feature = "flex")]
use super::flex;
use super::warp::Validity;

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
