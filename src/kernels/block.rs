//! A convolution with what surrounds it in a network: one kernel where it is only used, Burn's operations where it
//! learns or where there is no kernel.

#[cfg(feature = "flex")]
use burn::backend::Dispatch;
use burn::nn::conv::Conv2d;
use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use burn::tensor::module::interpolate;
use burn::tensor::ops::{InterpolateMode, InterpolateOptions, PadMode};

use super::border::Border;
#[cfg(feature = "flex")]
use super::extension::{FusedPlan, Operations};
#[cfg(feature = "flex")]
use super::flex::{convolution_shape, takes_without_gradients};
use super::fused::Activation;
use super::operations::conv2d;

/// `activation(layer(border(cat(doubled(input), skip))) + shortcut)`.
pub(crate) struct Block<'a> {
    /// With [`Border::Mirror`] it has no padding of its own.
    pub layer: &'a Conv2d,
    /// Whether the input is doubled in size first, each pixel four times.
    pub doubled: bool,
    /// `[batch, channels, height, width]`, channels that follow those of the input.
    pub skip: Option<Tensor<4>>,
    /// What lies beyond the edge; zeros are left to the layer's padding.
    pub border: Border,
    /// As the output.
    pub shortcut: Option<Tensor<4>>,
    /// What comes last.
    pub activation: Activation,
}

impl<'a> Block<'a> {
    /// A layer as it is.
    pub fn of(layer: &'a Conv2d) -> Self {
        Self {
            layer,
            doubled: false,
            skip: None,
            border: Border::default(),
            shortcut: None,
            activation: Activation::default(),
        }
    }

    /// # Shapes
    /// - `input`: `[batch, channels, height, width]`, half the size if doubled
    pub fn forward(self, input: Tensor<4>) -> Tensor<4> {
        #[cfg(feature = "flex")]
        if let Some(output) = self.forward_fused(&input) {
            return output;
        }
        self.forward_separately(input)
    }

    /// A block as the fused kernel does it; `None` where only separate operations can: with gradients, or not on flex.
    #[cfg(feature = "flex")]
    fn forward_fused(&self, input: &Tensor<4>) -> Option<Tensor<4>> {
        let Self { layer, doubled, skip, border, shortcut, activation } = self;
        let weight = layer.weight.val();
        let tensors = [Some(input), Some(&weight), skip.as_ref(), shortcut.as_ref()];
        let taken = tensors.into_iter().flatten().all(takes_without_gradients);
        let bias = layer.bias.as_ref().filter(|_| taken)?.val();
        let mut shape = convolution_shape(layer, input)?;
        if *border == Border::Mirror {
            assert_eq!(shape.padding, [0, 0], "a mirrored border is all the padding there is");
            shape.padding = shape.kernel.map(|size| size / 2);
        }
        if *doubled {
            shape.size = shape.size.map(|size| 2 * size);
        }
        let skip_channels = skip.as_ref().map_or(0, |skip| skip.dims()[1]);
        shape.inputs += skip_channels;
        let plan = FusedPlan {
            shape,
            doubled: *doubled,
            skip_channels,
            border: *border,
            shortcut: shortcut.is_some(),
            activation: *activation,
        };
        let none = bias.clone().into_dispatch();
        let or_none = |tensor: &Option<Tensor<4>>| tensor.clone().map_or_else(|| none.clone(), Tensor::into_dispatch);
        Some(Tensor::from_dispatch(Dispatch::fused_convolution(
            input.clone().into_dispatch(),
            or_none(skip),
            weight.into_dispatch(),
            bias.into_dispatch(),
            or_none(shortcut),
            plan,
        )))
    }

    fn forward_separately(self, input: Tensor<4>) -> Tensor<4> {
        let Self { layer, doubled, skip, border, shortcut, activation } = self;
        let mut input = if doubled { double(input) } else { input };
        if let Some(skip) = skip {
            input = Tensor::cat(vec![input, skip], 1);
        }
        if border == Border::Mirror {
            let [rows, columns] = layer.kernel_size.map(|size| size / 2);
            input = input.pad([(rows, rows), (columns, columns)], PadMode::Reflect);
        }
        let output = conv2d(layer, input);
        let output = match shortcut {
            Some(shortcut) => output + shortcut,
            None => output,
        };
        match activation {
            Activation::None => output,
            Activation::Relu => relu(output),
            Activation::Elu => elu(output),
        }
    }
}

/// As Burn's, whose gradient is NaN where eˣ overflows.
fn elu(input: Tensor<4>) -> Tensor<4> {
    relu(input.clone()) + input.clamp_max(0.0).exp() - 1.0
}

/// Twice the size, each pixel four times.
pub(crate) fn double(image: Tensor<4>) -> Tensor<4> {
    let [_, _, height, width] = image.dims();
    let options = InterpolateOptions::new(InterpolateMode::Nearest).with_output_size([2 * height, 2 * width]);
    interpolate(image, options)
}

#[cfg(test)]
mod tests {
    use burn::nn::PaddingConfig2d;
    use burn::nn::conv::Conv2dConfig;
    use burn::tensor::{Device, Distribution};

    use super::*;

    #[test]
    fn the_kernel_and_separate_operations_agree() {
        let device = Device::flex();
        let random = |shape: [usize; 4]| Tensor::<4>::random(shape, Distribution::Normal(0.0, 1.0), &device);
        let mirrored = Conv2dConfig::new([5, 6], [3, 3]).init(&device);
        let padding = PaddingConfig2d::Explicit(3, 3, 3, 3);
        let padded = Conv2dConfig::new([3, 6], [7, 7]).with_stride([2, 2]).with_padding(padding).init(&device);
        let (input, skip) = (random([2, 3, 8, 10]), random([2, 2, 16, 20]));
        let shortcut = random([2, 6, 4, 5]);
        let decoder = || Block {
            doubled: true,
            skip: Some(skip.clone()),
            border: Border::Mirror,
            activation: Activation::Elu,
            ..Block::of(&mirrored)
        };
        let encoder = || Block { shortcut: Some(shortcut.clone()), activation: Activation::Relu, ..Block::of(&padded) };
        for (whole, parts) in [(decoder(), decoder()), (encoder(), encoder())] {
            let (whole, parts) = (whole.forward(input.clone()), parts.forward_separately(input.clone()));
            assert_eq!(whole.dims(), parts.dims());
            assert!((whole - parts).abs().max().into_scalar::<f32>() < 1e-5);
        }
    }
}
