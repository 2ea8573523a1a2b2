//! A small multilayer perceptron that reads the measured pose (SS-DPC-Net's way).

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor};

use super::initialisation::HE_UNIFORM;

/// Units of both layers.
pub(super) const UNITS: usize = 64;

/// Maps a pose 6-vector to features that join those of the images.
#[derive(Module, Debug)]
pub(super) struct PoseEncoder {
    hidden: Linear,
    output: Linear,
}

impl PoseEncoder {
    pub(super) fn init(device: &Device) -> Self {
        let layer = |inputs| LinearConfig::new(inputs, UNITS).with_initializer(HE_UNIFORM).init(device);
        Self { hidden: layer(6), output: layer(UNITS) }
    }

    /// # Shapes
    /// - `motion`: `[batch, 6]`, about 1 in size
    /// - returns: `[batch, 64]`
    pub(super) fn forward(&self, motion: Tensor<2>) -> Tensor<2> {
        relu(self.output.forward(relu(self.hidden.forward(motion))))
    }
}
