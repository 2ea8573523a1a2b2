//! Fast CPU operations: what training and prediction spend their time in, for Burn's flex backend.
//!
//! Functions on tensors come in, of any device; on flex with 32-bit floats they run the kernels of
//! this room, on every other device Burn's own operations, to the same result. The kernels themselves
//! work on plain slices, know nothing of Burn, and hold all `unsafe` of the crate: each block says why
//! it is sound. They are written once, generic over vector instructions ([`Instructions`]).

#![allow(unsafe_code, reason = "the one room where speed needs it")]

mod activation;
mod adam;
mod buffer;
mod convolution;
mod dense;
#[cfg(feature = "flex")]
mod extension;
mod instructions;
mod optimiser;
mod product;
#[cfg(test)]
mod reference;
mod warp;

use burn::nn::conv::Conv2d;
use burn::nn::{Dropout, Linear};
use burn::tensor::Tensor;
use burn::tensor::activation::relu;

pub use instructions::{INSTRUCTIONS_VARIABLE, Instructions};
pub use optimiser::Adam;
pub use warp::Validity;

/// [`Conv2d::forward`], any kernel size, stride and padding.
///
/// # Shapes
/// - `input`: `[batch, inputs, height, width]`
/// - returns: `[batch, outputs, output height, output width]`
pub fn conv2d(layer: &Conv2d, input: Tensor<4>) -> Tensor<4> {
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
pub fn relu_dropout<const D: usize>(layer: &Dropout, input: Tensor<D>) -> Tensor<D> {
    #[cfg(feature = "flex")]
    if flex::runs(&input) {
        return flex::relu_dropout(layer, input);
    }
    layer.forward(relu(input))
}

/// [`Linear::forward`]; fast for one row without gradients, where the weights' way from memory counts.
///
/// # Shapes
/// - `input`: `[batch, inputs]`; returns: `[batch, outputs]`
pub fn linear(layer: &Linear, input: Tensor<2>) -> Tensor<2> {
    #[cfg(feature = "flex")]
    if flex::is_plain_row(layer, &input) {
        return flex::linear_row(layer, input);
    }
    layer.forward(input)
}

/// The warp of one image into the other view, in one pass; `None` where only Burn's operations can do
/// it (with gradients, or not on flex). Shapes as in [`crate::warp::Warp::forward`].
pub fn warp(
    source_image: &Tensor<4>,
    target_depth: &Tensor<4>,
    intrinsics: &Tensor<2>,
    source_from_target: &Tensor<3>,
    validity: Validity,
) -> Option<(Tensor<4>, Tensor<4>)> {
    #[cfg(feature = "flex")]
    if flex::all_plain([source_image, target_depth]) && flex::plain(intrinsics) && flex::plain(source_from_target) {
        return Some(flex::warp(source_image, target_depth, intrinsics, source_from_target, validity));
    }
    let _ = (source_image, target_depth, intrinsics, source_from_target, validity);
    None
}

/// The way from tensors to the kernels.
#[cfg(feature = "flex")]
mod flex {
    use burn::backend::{Dispatch, DispatchDevice};
    use burn::nn::conv::Conv2d;
    use burn::nn::{Dropout, Linear, PaddingConfig2d};
    use burn::tensor::{DType, Distribution, Int, Tensor};

    use super::activation::DropoutRate;
    use super::adam::AdamFactors;
    use super::convolution::ConvolutionShape;
    use super::extension::{Layers, Operations};
    use super::instructions::Instructions;
    use super::warp::Validity;

    /// Whether the kernels can take this tensor.
    pub fn runs<const D: usize>(tensor: &Tensor<D>) -> bool {
        let device = tensor.device().inner();
        let on_flex = matches!(device.as_dispatch(), DispatchDevice::Flex(_));
        on_flex && tensor.dtype() == DType::F32 && Instructions::chosen().is_ok_and(|chosen| chosen.is_some())
    }

    /// Whether they can, and no gradient is asked for.
    pub fn plain<const D: usize>(tensor: &Tensor<D>) -> bool {
        runs(tensor) && !tensor.device().is_autodiff()
    }

    pub fn all_plain<const D: usize>(tensors: [&Tensor<D>; 2]) -> bool {
        tensors.into_iter().all(plain)
    }

    /// The shape of a layer that the kernels know.
    pub fn convolution_shape(layer: &Conv2d, input: &Tensor<4>) -> Option<ConvolutionShape> {
        let padding = match layer.padding {
            PaddingConfig2d::Valid => [0, 0],
            PaddingConfig2d::Explicit(top, left, bottom, right) if (top, left) == (bottom, right) => [top, left],
            PaddingConfig2d::Explicit(..) | PaddingConfig2d::Same => return None,
        };
        let known = runs(input) && layer.groups == 1 && layer.dilation == [1, 1];
        let [batch, inputs, height, width] = input.dims();
        let [outputs, ..] = layer.weight.dims();
        let (kernel, stride) = (layer.kernel_size, layer.stride);
        known.then_some(ConvolutionShape { batch, inputs, outputs, size: [height, width], kernel, stride, padding })
    }

    pub fn conv2d(layer: &Conv2d, input: Tensor<4>, shape: ConvolutionShape) -> Tensor<4> {
        let weight = layer.weight.val();
        let bias = match &layer.bias {
            Some(bias) => bias.val(),
            None => Tensor::zeros([shape.outputs], &weight.device().inner()),
        };
        let output = Dispatch::convolution(input.into_dispatch(), weight.into_dispatch(), bias.into_dispatch(), shape);
        Tensor::from_dispatch(output)
    }

    pub fn relu_dropout<const D: usize>(layer: &Dropout, input: Tensor<D>) -> Tensor<D> {
        let device = input.device();
        let active = layer.training.is_enabled() && device.is_autodiff() && layer.prob > 0.0;
        let (rate, seed) = if active {
            // Drawn from Burn's generator, so that `Device::seed` governs it; integers are 32 bits wide.
            let words = Tensor::<1, Int>::random([4], Distribution::Uniform(0.0, 65536.0), &device.inner());
            let seed = words.into_data().iter::<u64>().fold(0, |seed, word| seed << 16 | word);
            (DropoutRate::new(layer.prob), seed)
        } else {
            (DropoutRate::new(0.0), 0)
        };
        Tensor::from_dispatch(Dispatch::relu_dropout(input.into_dispatch(), rate, seed))
    }

    pub fn is_plain_row(layer: &Linear, input: &Tensor<2>) -> bool {
        input.dims()[0] == 1 && plain(input) && plain(&layer.weight.val())
    }

    pub fn linear_row(layer: &Linear, input: Tensor<2>) -> Tensor<2> {
        let output = Dispatch::vector_matrix(input.into_dispatch(), layer.weight.val().into_dispatch());
        let output = Tensor::<2>::from_dispatch(output);
        match &layer.bias {
            Some(bias) => output + bias.val().unsqueeze(),
            None => output,
        }
    }

    pub fn warp(
        source_image: &Tensor<4>,
        target_depth: &Tensor<4>,
        intrinsics: &Tensor<2>,
        source_from_target: &Tensor<3>,
        validity: Validity,
    ) -> (Tensor<4>, Tensor<4>) {
        let warped = Dispatch::warp(
            source_image.clone().into_dispatch(),
            target_depth.clone().into_dispatch(),
            intrinsics.clone().into_dispatch(),
            source_from_target.clone().into_dispatch(),
            validity,
        );
        (Tensor::from_dispatch(warped.image), Tensor::from_dispatch(warped.valid_mask))
    }

    /// Weight and moments after a step; they are changed in place when nobody else holds them.
    pub fn adam<const D: usize>(
        weight: Tensor<D>,
        gradient: Tensor<D>,
        moments: [Tensor<D>; 2],
        factors: AdamFactors,
    ) -> (Tensor<D>, [Tensor<D>; 2]) {
        let [moment_1, moment_2] = moments.map(Tensor::into_dispatch);
        let step = Dispatch::adam(weight.into_dispatch(), gradient.into_dispatch(), moment_1, moment_2, factors);
        let moments = [step.moment_1, step.moment_2].map(Tensor::from_dispatch);
        (Tensor::from_dispatch(step.weight), moments)
    }
}
