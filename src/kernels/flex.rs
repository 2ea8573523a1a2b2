//! The way from tensors to the kernels.

use burn::backend::{Dispatch, DispatchDevice};
use burn::nn::conv::Conv2d;
use burn::nn::{Dropout, Linear, PaddingConfig2d};
use burn::tensor::{DType, Distribution, Int, Tensor};

use super::activation::DropoutRate;
use super::adam::AdamFactors;
use super::extension::{Layers, Operations};
use super::instructions::Instructions;
use super::shape::ConvolutionShape;
use super::warp::Validity;

/// Whether the kernels can take this tensor.
pub(super) fn takes<const D: usize>(tensor: &Tensor<D>) -> bool {
    let device = tensor.device().inner();
    let on_flex = matches!(device.as_dispatch(), DispatchDevice::Flex(_));
    on_flex && tensor.dtype() == DType::F32 && Instructions::chosen().is_ok_and(|chosen| chosen.is_some())
}

/// Whether they can, and no gradient is asked for.
pub(super) fn takes_without_gradients<const D: usize>(tensor: &Tensor<D>) -> bool {
    takes(tensor) && !tensor.device().is_autodiff()
}

/// The shape of a layer that the kernels know.
pub(super) fn convolution_shape(layer: &Conv2d, input: &Tensor<4>) -> Option<ConvolutionShape> {
    let padding = match layer.padding {
        PaddingConfig2d::Valid => [0, 0],
        PaddingConfig2d::Explicit(top, left, bottom, right) if (top, left) == (bottom, right) => [top, left],
        PaddingConfig2d::Explicit(..) | PaddingConfig2d::Same => return None,
    };
    let known = takes(input) && input.shape().num_elements() > 0 && layer.groups == 1 && layer.dilation == [1, 1];
    let [batch, inputs, height, width] = input.dims();
    let [outputs, ..] = layer.weight.dims();
    let (kernel, stride) = (layer.kernel_size, layer.stride);
    known.then_some(ConvolutionShape { batch, inputs, outputs, size: [height, width], kernel, stride, padding })
}

pub(super) fn conv2d(layer: &Conv2d, input: Tensor<4>, shape: ConvolutionShape) -> Tensor<4> {
    let weight = layer.weight.val();
    let bias = match &layer.bias {
        Some(bias) => bias.val(),
        None => Tensor::zeros([shape.outputs], &weight.device().inner()),
    };
    let output = Dispatch::convolution(input.into_dispatch(), weight.into_dispatch(), bias.into_dispatch(), shape);
    Tensor::from_dispatch(output)
}

pub(super) fn max_pool(input: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::max_pool(input.into_dispatch()))
}

pub(super) fn relu_dropout<const D: usize>(layer: &Dropout, input: Tensor<D>) -> Tensor<D> {
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

/// Whether this is a product of one row without gradients.
pub(super) fn takes_row(layer: &Linear, input: &Tensor<2>) -> bool {
    input.dims()[0] == 1 && takes_without_gradients(input) && takes_without_gradients(&layer.weight.val())
}

pub(super) fn linear_row(layer: &Linear, input: Tensor<2>) -> Tensor<2> {
    let output = Dispatch::vector_matrix(input.into_dispatch(), layer.weight.val().into_dispatch());
    let output = Tensor::<2>::from_dispatch(output);
    match &layer.bias {
        Some(bias) => output + bias.val().unsqueeze(),
        None => output,
    }
}

pub(super) fn warp(
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
pub(super) fn adam<const D: usize>(
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

#[cfg(test)]
mod tests {
    use burn::module::Module;
    use burn::nn::conv::Conv2dConfig;
    use burn::nn::{DropoutConfig, LinearConfig};
    use burn::tensor::Device;
    use burn::tensor::activation::relu;

    use super::*;

    fn worst<const D: usize>(a: Tensor<D>, b: Tensor<D>) -> f32 {
        (a - b).abs().max().into_scalar::<f32>()
    }

    #[test]
    fn one_row_of_a_linear_layer_agrees_with_burns() {
        let device = Device::flex();
        let layer = LinearConfig::new(1037, 70).init(&device);
        let input = relu(Tensor::random([1, 1037], Distribution::Normal(0.0, 1.0), &device));
        assert!(takes_row(&layer, &input));
        assert!(worst(linear_row(&layer, input.clone()), layer.forward(input.clone())) < 1e-5);
        let several = Tensor::cat(vec![input.clone(), input], 0);
        assert!(!takes_row(&layer, &several));
    }

    #[test]
    fn a_convolution_without_bias_has_burns_gradients() {
        let device = Device::flex().autodiff();
        let config = Conv2dConfig::new([5, 9], [3, 5]).with_stride([2, 1]).with_bias(false);
        let layer = config.init(&device);
        let input = Tensor::<4>::random([2, 5, 14, 17], Distribution::Normal(0.0, 1.0), &device).require_grad();
        let shape = convolution_shape(&layer, &input).expect("a shape that the kernels know");
        let gradients = |output: Tensor<4>| {
            let gradients = output.square().sum().backward();
            (input.grad(&gradients).unwrap(), layer.weight.val().grad(&gradients).unwrap())
        };
        let (ours_input, ours_weight) = gradients(conv2d(&layer, input.clone(), shape));
        let (input_gradient, weight_gradient) = gradients(layer.forward(input.clone()));
        assert!(worst(ours_input, input_gradient) < 1e-4);
        assert!(worst(ours_weight, weight_gradient) < 1e-3);
    }

    #[test]
    fn paddings_that_differ_between_sides_are_left_to_burn() {
        let device = Device::flex();
        let mut layer = Conv2dConfig::new([1, 1], [3, 3]).init(&device);
        let input = Tensor::<4>::zeros([1, 1, 8, 8], &device);
        for padding in [PaddingConfig2d::Same, PaddingConfig2d::Explicit(1, 0, 0, 1)] {
            layer.padding = padding;
            assert_eq!(convolution_shape(&layer, &input), None);
        }
    }

    /// With gradients values are dropped and their gradients with them; without, and in a frozen layer,
    /// nothing is. The device's seed decides which.
    #[test]
    fn dropout_acts_where_burns_does() {
        let device = Device::flex().autodiff();
        let layer = DropoutConfig::new(0.5).init();
        let input = Tensor::<2>::random([40, 50], Distribution::Uniform(-1.0, 3.0), &device).require_grad();
        let dropped = || {
            device.seed(4);
            relu_dropout(&layer, input.clone())
        };
        let output = dropped();
        assert_eq!(worst(output.clone(), dropped()), 0.0);
        let gradient = input.grad(&output.clone().sum().backward()).unwrap();
        let kept = output.clone().inner().not_equal_elem(0.0).float();
        let share = kept.clone().mean().into_scalar::<f32>();
        assert!((0.33..0.42).contains(&share), "three quarters are positive, half of them kept: {share}");
        assert_eq!(worst(gradient, kept.clone() * 2.0), 0.0);
        assert!(worst(output.inner(), input.clone().inner() * kept * 2.0) < 1e-6);

        let plain = relu(input.clone().inner());
        assert_eq!(worst(relu_dropout(&layer, input.clone().inner()), plain.clone()), 0.0);
        assert_eq!(worst(relu_dropout(&layer.freeze(), input).inner(), plain), 0.0);
    }

    /// What is shared is copied before a kernel writes to it.
    #[test]
    fn inputs_are_not_changed() {
        let device = Device::flex();
        let input = Tensor::<2>::random([4, 5], Distribution::Normal(0.0, 1.0), &device);
        let copy: Tensor<2> = Tensor::from_data(input.clone().into_data(), &device);
        let layer = DropoutConfig::new(0.5).init();
        let part = input.clone().slice([1..3, 0..5]);
        assert_eq!(worst(relu_dropout(&layer, part.clone()), relu(part)), 0.0);
        let _ = relu_dropout(&layer, input.clone());
        assert_eq!(worst(input, copy), 0.0);
    }
}
