//! The proposed method on one screen (paper Section IV): warp by the measured pose, predict
//! log-variances, score them by the likelihood of the errors.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use burn::train::{InferenceStep, TrainOutput, TrainStep};
use serde::{Deserialize, Serialize};

use crate::data::PairBatch;
use crate::loss::{floored, gaussian_loss};
use crate::network::{CovarianceNetwork, CovarianceNetworkConfig};
use crate::warp::{Warp, Warped};

/// Images lie in 0…1; the network sees them around 0.
const IMAGE_MEAN: f32 = 0.5;
/// Scale of the residual image, which brings it to the contrast of an image.
const RESIDUAL_GAIN: f32 = 4.0;

/// What the network sees of target and warped image: the same information in two bases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InputBasis {
    /// `(I_{i+1}, I^w_{i+1})`, the paper's.
    Pair,
    /// `(I_{i+1}, 4 (I^w_{i+1} − I_{i+1}))` on valid pixels: learns far faster.
    #[default]
    Residual,
}

/// Everything that fixes the shape of a [`CovarianceModel`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    /// Input height, px.
    pub height: usize,
    /// Input width, px.
    pub width: usize,
    /// Basis of the network's input.
    pub input: InputBasis,
    /// Dropout probability after each convolution.
    pub dropout: f64,
    /// Floor under each log-variance, ln m² and ln rad²; `None` for the paper's unbounded outputs.
    pub log_variance_floor: Option<[f64; 6]>,
}

/// Warp layer, network and variance floor: images, depth and measured pose in, log-variances out.
#[derive(Module, Debug)]
pub struct CovarianceModel {
    warp: Warp,
    network: CovarianceNetwork,
    #[module(skip)]
    input: InputBasis,
    #[module(skip)]
    log_variance_floor: Option<[f64; 6]>,
}

impl Architecture {
    /// Builds the model; every first prediction is `initial_log_variance`.
    pub fn init(&self, initial_log_variance: [f64; 6], device: &Device) -> CovarianceModel {
        let network =
            CovarianceNetworkConfig { channels: 6, height: self.height, width: self.width, dropout: self.dropout };
        CovarianceModel {
            warp: Warp,
            network: network.init(initial_log_variance, device),
            input: self.input,
            log_variance_floor: self.log_variance_floor,
        }
    }
}

impl CovarianceModel {
    /// Predicts log-variances: `d = network(I_{i+1}, warp(I_i, ⁱT̂ᵢ₊₁))` (paper Fig. 2).
    ///
    /// # Shapes
    /// - returns: `[batch, 6]`, d; order ρ then φ, ln m² and ln rad², axes of the model's error frame
    pub fn forward(&self, pairs: &PairBatch) -> Tensor<2> {
        let warped = self.warp.forward(
            pairs.source_image.clone(),
            pairs.target_depth.clone(),
            pairs.intrinsics.clone(),
            pairs.source_from_target.clone(),
        );
        let log_variance = self.network.forward(self.network_input(pairs.target_image.clone(), warped));
        match self.log_variance_floor {
            Some(floor) => {
                let floor = Tensor::<1>::from_floats(floor.map(|d| d as f32), &log_variance.device());
                floored(log_variance, floor.unsqueeze())
            }
            None => log_variance,
        }
    }

    /// Log-variances and the loss of each pair (paper Eq. 7), `[batch, 6]` and `[batch]`.
    pub fn forward_loss(&self, pairs: &PairBatch) -> (Tensor<2>, Tensor<1>) {
        let log_variance = self.forward(pairs);
        let loss = gaussian_loss(log_variance.clone(), pairs.error.clone());
        (log_variance, loss)
    }

    /// The network behind the warp.
    pub fn network(&self) -> &CovarianceNetwork {
        &self.network
    }

    fn network_input(&self, target_image: Tensor<4>, warped: Warped) -> Tensor<4> {
        let target = target_image.clone() - IMAGE_MEAN;
        let second = match self.input {
            InputBasis::Pair => warped.image - IMAGE_MEAN,
            InputBasis::Residual => (warped.image - target_image) * warped.valid_mask * RESIDUAL_GAIN,
        };
        Tensor::cat(vec![target, second], 1)
    }
}

/// A part of a mini-batch that fits memory, with its share in the batch's mean loss.
#[derive(Clone, Debug)]
pub struct MicroBatch {
    /// The pairs.
    pub pairs: PairBatch,
    /// One over the number of pairs of the whole mini-batch.
    pub weight: f32,
}

/// What a step reports, for each pair of its batch.
#[derive(Clone, Debug)]
pub struct PairOutputs {
    /// `[batch, 6]`, d.
    pub log_variance: Tensor<2>,
    /// `[batch]`, Eq. 7.
    pub loss: Tensor<1>,
}

impl burn::train::ItemLazy for PairOutputs {
    fn sync(self) -> Result<Self, burn::tensor::ExecutionError> {
        Ok(self)
    }
}

impl TrainStep for CovarianceModel {
    type Input = MicroBatch;
    type Output = PairOutputs;

    fn step(&self, batch: MicroBatch) -> TrainOutput<PairOutputs> {
        let (log_variance, loss) = self.forward_loss(&batch.pairs);
        let gradients = (loss.clone().sum() * batch.weight).backward();
        TrainOutput::new(self, gradients, PairOutputs { log_variance: log_variance.inner(), loss: loss.inner() })
    }
}

impl InferenceStep for CovarianceModel {
    type Input = PairBatch;
    type Output = PairOutputs;

    fn step(&self, pairs: PairBatch) -> PairOutputs {
        let (log_variance, loss) = self.forward_loss(&pairs);
        PairOutputs { log_variance, loss }
    }
}
