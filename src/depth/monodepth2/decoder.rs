//! The U-Net decoder: five stages that double the size and take in the encoder's features of that size.

use burn::module::{Module, Param};
use burn::nn::Initializer;
use burn::nn::conv::Conv2d;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};

use super::{convolution_config, encoder};
use crate::kernels::{Activation, Block, Border};

/// Channels at full, half … 1/16 size.
const CHANNELS: [usize; 5] = [16, 32, 64, 128, 256];
/// Sizes at which a disparity is put out.
const SCALES: usize = 4;
/// Spread of the heads' first weights, beside √2 of other layers.
const HEAD_GAIN: f64 = 0.1;

#[derive(Module, Debug)]
pub(super) struct DepthDecoder {
    /// From the coarsest to the finest.
    pub stages: Vec<Stage>,
    /// From the finest to the coarsest, as the published files have them.
    pub heads: Vec<Conv2d>,
}

/// Convolution, nearest-neighbour doubling, the encoder's features beside it, convolution.
#[derive(Module, Debug)]
pub(super) struct Stage {
    pub before: Conv2d,
    pub after: Conv2d,
}

impl DepthDecoder {
    pub fn init(disparity: f64, device: &Device) -> Self {
        let mut inputs = encoder::CHANNELS[4];
        let stage = |level: usize| {
            let outputs = CHANNELS[level];
            let skip = level.checked_sub(1).map_or(0, |below| encoder::CHANNELS[below]);
            let inputs = std::mem::replace(&mut inputs, outputs);
            let layer = |inputs| convolution_config(inputs, outputs, 3, 1).init(device);
            Stage { before: layer(inputs), after: layer(outputs + skip) }
        };
        let stages = (0..CHANNELS.len()).rev().map(stage).collect();
        let bias = (disparity / (1.0 - disparity)).ln();
        let head = |scale: usize| {
            // Small, so that the first disparities are near the one asked for.
            let small = Initializer::KaimingUniform { gain: HEAD_GAIN, fan_out_only: false };
            let mut head: Conv2d = convolution_config(CHANNELS[scale], 1, 3, 1).with_initializer(small).init(device);
            head.bias = Some(Param::from_tensor(Tensor::full([1], bias, device)).set_require_grad(true));
            head
        };
        Self { stages, heads: (0..SCALES).map(head).collect() }
    }

    /// The four disparities, finest first.
    pub fn forward(&self, features: [Tensor<4>; 5]) -> [Tensor<4>; SCALES] {
        let levels = self.levels(features);
        std::array::from_fn(|scale| self.head(scale, levels[CHANNELS.len() - 1 - scale].clone()))
    }

    /// The finest disparity.
    pub fn finest(&self, features: [Tensor<4>; 5]) -> Tensor<4> {
        let finest = self.levels(features).pop().expect("five stages");
        self.head(0, finest)
    }

    /// Activations after each stage, coarsest first.
    fn levels(&self, features: [Tensor<4>; 5]) -> Vec<Tensor<4>> {
        let [skip1, skip2, skip3, skip4, deepest] = features;
        let skips = [Some(skip4), Some(skip3), Some(skip2), Some(skip1), None];
        let mut activation = deepest;
        let stages = self.stages.iter().zip(skips);
        stages
            .map(|(stage, skip)| {
                activation = stage.forward(activation.clone(), skip);
                activation.clone()
            })
            .collect()
    }

    fn head(&self, scale: usize, activation: Tensor<4>) -> Tensor<4> {
        sigmoid(Block { border: Border::Mirror, ..Block::of(&self.heads[scale]) }.forward(activation))
    }
}

impl Stage {
    fn forward(&self, input: Tensor<4>, skip: Option<Tensor<4>>) -> Tensor<4> {
        let (border, activation) = (Border::Mirror, Activation::Elu);
        let before = Block { border, activation, ..Block::of(&self.before) }.forward(input);
        Block { doubled: true, skip, border, activation, ..Block::of(&self.after) }.forward(before)
    }
}
