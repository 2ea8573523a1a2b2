//! A small multilayer perceptron that reads the evidence of a pair.

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor};

use super::initialisation::HE_UNIFORM;

/// Units of its hidden layers.
const UNITS: usize = 64;

/// Maps features of the evidence to what they add to fc1: the same as if their encoding stood beside those of the
/// images, with weights of its own.
#[derive(Module, Debug)]
pub(super) struct EvidenceEncoder {
    first: Linear,
    second: Linear,
    join: Linear,
}

impl EvidenceEncoder {
    pub(super) fn init(features: usize, outputs: usize, device: &Device) -> Self {
        let layer = |inputs, outputs| LinearConfig::new(inputs, outputs).with_initializer(HE_UNIFORM).init(device);
        Self { first: layer(features, UNITS), second: layer(UNITS, UNITS), join: layer(UNITS, outputs) }
    }

    /// # Shapes
    /// - `features`: `[batch, features]`, about 1 in size
    /// - returns: `[batch, outputs]`, before fc1's activation
    pub(super) fn forward(&self, features: Tensor<2>) -> Tensor<2> {
        self.join.forward(relu(self.second.forward(relu(self.first.forward(features)))))
    }
}
