//! How weights begin.

use burn::nn::Initializer;

/// He's initialisation (He et al. 2015), which keeps the variance of activations through ReLU layers;
/// Burn draws biases from the same law, where He's are zero.
pub(super) const HE_UNIFORM: Initializer =
    Initializer::KaimingUniform { gain: std::f64::consts::SQRT_2, fan_out_only: false };
