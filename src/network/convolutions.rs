//! c1…c5 of Table I.

use burn::module::Module;
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::{Dropout, DropoutConfig, PaddingConfig2d};
use burn::tensor::{Device, Tensor};

use super::initialisation::HE_UNIFORM;
use crate::kernels::{conv2d, relu_dropout};

/// Table I: kernel size, stride and outputs of c1…c5.
const CONVOLUTIONS: [(usize, usize, usize); 5] = [(5, 2, 64), (5, 2, 128), (3, 2, 256), (3, 2, 512), (3, 1, 1024)];

/// The five convolutions, each with ReLU and dropout.
#[derive(Module, Debug)]
pub(super) struct Convolutions {
    c1: Conv2d,
    c2: Conv2d,
    c3: Conv2d,
    c4: Conv2d,
    c5: Conv2d,
    dropout: Dropout,
}

/// Outputs of c5 times its height and width, for images of a size.
pub(super) fn features(height: usize, width: usize) -> usize {
    let size = |input: usize| {
        CONVOLUTIONS.iter().fold(input, |size, &(kernel, stride, _)| (size + 2 * (kernel / 2) - kernel) / stride + 1)
    };
    let (_, _, outputs) = CONVOLUTIONS[CONVOLUTIONS.len() - 1];
    outputs * size(height) * size(width)
}

impl Convolutions {
    pub(super) fn init(channels: usize, dropout: f64, device: &Device) -> Self {
        let mut channels = channels;
        let [c1, c2, c3, c4, c5] = CONVOLUTIONS.map(|(kernel, stride, outputs)| {
            let inputs = std::mem::replace(&mut channels, outputs);
            let pad = kernel / 2;
            Conv2dConfig::new([inputs, outputs], [kernel, kernel])
                .with_stride([stride, stride])
                .with_padding(PaddingConfig2d::Explicit(pad, pad, pad, pad))
                .with_initializer(HE_UNIFORM)
                .init(device)
        });
        Self { c1, c2, c3, c4, c5, dropout: DropoutConfig::new(dropout).init() }
    }

    /// # Shapes
    /// - `images`: `[batch, channels, height, width]`
    /// - returns: `[batch, 1024, height / 16, width / 16]`, rounded up
    pub(super) fn forward(&self, images: Tensor<4>) -> Tensor<4> {
        self.layers().into_iter().fold(images, |images, layer| self.layer(layer, images))
    }

    /// The activations of c1…c5.
    pub(super) fn activations(&self, images: Tensor<4>) -> [Tensor<4>; 5] {
        let mut activation = images;
        self.layers().map(|layer| {
            activation = self.layer(layer, activation.clone());
            activation.clone()
        })
    }

    pub(super) fn layers(&self) -> [&Conv2d; 5] {
        [&self.c1, &self.c2, &self.c3, &self.c4, &self.c5]
    }

    fn layer(&self, convolution: &Conv2d, images: Tensor<4>) -> Tensor<4> {
        relu_dropout(&self.dropout, conv2d(convolution, images))
    }
}
