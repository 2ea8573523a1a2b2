//! ResNet-18 without its classifier (He, Zhang, Ren, Sun, "Deep residual learning for image recognition", 2016).

use burn::module::{Module, Param};
use burn::nn::conv::Conv2d;
use burn::tensor::{Device, Tensor};

use super::convolution;
use crate::kernels::{Activation, Block, conv2d, max_pool};

/// Channels of the five feature maps.
pub(super) const CHANNELS: [usize; 5] = [64, 64, 128, 256, 512];

/// The mean and spread of pixels that the published networks were trained with.
const PIXEL_MEAN: f64 = 0.45;
const PIXEL_SPREAD: f64 = 0.225;

#[derive(Module, Debug)]
pub(super) struct ResNet18 {
    pub conv1: Conv2d,
    /// Two in each of layer1…layer4.
    pub blocks: Vec<BasicBlock>,
}

/// Two 3x3 convolutions around which the input, if need be subsampled, is carried.
#[derive(Module, Debug)]
pub(super) struct BasicBlock {
    pub conv1: Conv2d,
    pub conv2: Conv2d,
    pub downsample: Option<Conv2d>,
}

impl ResNet18 {
    pub fn init(device: &Device) -> Self {
        let mut inputs = CHANNELS[0];
        let mut blocks = Vec::new();
        for (layer, &outputs) in CHANNELS[1..].iter().enumerate() {
            for index in 0..2 {
                let stride = if layer > 0 && index == 0 { 2 } else { 1 };
                blocks.push(BasicBlock::init(inputs, outputs, stride, device));
                inputs = outputs;
            }
        }
        Self { conv1: convolution(3, CHANNELS[0], 7, 2, device), blocks }
    }

    /// Features at 1/2, 1/4, 1/8, 1/16 and 1/32 of the image's size.
    pub fn forward(&self, images: Tensor<4>) -> [Tensor<4>; 5] {
        let first = with_relu(&self.conv1).forward((images - PIXEL_MEAN) / PIXEL_SPREAD);
        let mut features = max_pool(first.clone());
        let mut layer = |index: usize| {
            for block in &self.blocks[2 * index..2 * index + 2] {
                features = block.forward(features.clone());
            }
            features.clone()
        };
        [first, layer(0), layer(1), layer(2), layer(3)]
    }
}

impl BasicBlock {
    fn init(inputs: usize, outputs: usize, stride: usize, device: &Device) -> Self {
        let mut conv2 = convolution(outputs, outputs, 3, 1, device);
        // Without batch norms, a block that begins as its shortcut keeps a deep network stable (Zhang, Dauphin, Ma,
        // "Fixup initialization", 2019).
        conv2.weight = Param::from_tensor(Tensor::zeros(conv2.weight.dims(), device)).set_require_grad(true);
        let changes = stride != 1 || inputs != outputs;
        Self {
            conv1: convolution(inputs, outputs, 3, stride, device),
            conv2,
            downsample: changes.then(|| convolution(inputs, outputs, 1, stride, device)),
        }
    }

    fn forward(&self, input: Tensor<4>) -> Tensor<4> {
        let shortcut = match &self.downsample {
            Some(downsample) => conv2d(downsample, input.clone()),
            None => input.clone(),
        };
        let inner = with_relu(&self.conv1).forward(input);
        Block { shortcut: Some(shortcut), ..with_relu(&self.conv2) }.forward(inner)
    }
}

fn with_relu(layer: &Conv2d) -> Block<'_> {
    Block { activation: Activation::Relu, ..Block::of(layer) }
}
