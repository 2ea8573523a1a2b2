//! The proposed method on one screen (paper Section IV): warp by the measured pose, predict
//! log-variances, score them by the likelihood of the errors.

mod input;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use burn::train::{InferenceStep, TrainOutput, TrainStep};
use serde::{Deserialize, Serialize};

use crate::data::PairBatch;
use crate::error::{Error, Result};
use crate::geometry::Covariance6;
use crate::loss::{floored, gaussian_loss};
use crate::network::{CovarianceNetwork, CovarianceNetworkConfig, Head};
use crate::warp::Warp;

pub use input::{ImagePair, InputBasis, PoseInput};

/// Everything that fixes the shape of a [`CovarianceModel`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    /// Input height, px.
    pub height: usize,
    /// Input width, px.
    pub width: usize,
    /// Which source image stands beside the target's.
    #[serde(default)]
    pub pair: ImagePair,
    /// Basis of the network's input.
    pub input: InputBasis,
    /// Whether each warped image comes with a channel that says where it is valid.
    #[serde(default)]
    pub validity_mask: bool,
    /// Whether the right camera's images are seen too.
    #[serde(default)]
    pub stereo: bool,
    /// Whether the measured pose is an input beside the images.
    #[serde(default)]
    pub pose: PoseInput,
    /// Form of the predicted covariance.
    #[serde(default)]
    pub head: Head,
    /// Dropout probability after each convolution.
    pub dropout: f64,
    /// Floor under each log-variance, ln m² and ln rad²; `None` for the paper's unbounded outputs.
    pub log_variance_floor: Option<[f64; 6]>,
}

/// Warp layer, network and variance floor: images, depth and measured pose in, covariances out.
#[derive(Module, Debug)]
pub struct CovarianceModel {
    warp: Warp,
    network: CovarianceNetwork,
    #[module(skip)]
    architecture: Architecture,
    /// Of the training set, m and rad: units of the full head.
    #[module(skip)]
    sigma: [f64; 6],
}

impl Architecture {
    /// The paper's model for images of this size: warped pair, diagonal covariance, dropout one half, no floor.
    pub fn paper(width: usize, height: usize) -> Self {
        Self {
            height,
            width,
            pair: ImagePair::Warped,
            input: InputBasis::Pair,
            validity_mask: false,
            stereo: false,
            pose: PoseInput::None,
            head: Head::Diagonal,
            dropout: 0.5,
            log_variance_floor: None,
        }
    }

    /// Builds the model; every first prediction is `initial_log_variance` on the diagonal.
    pub fn init(&self, initial_log_variance: [f64; 6], device: &Device) -> CovarianceModel {
        let network = CovarianceNetworkConfig {
            channels: self.channels(),
            pose: self.pose == PoseInput::Mlp,
            head: self.head,
            height: self.height,
            width: self.width,
            dropout: self.dropout,
        };
        CovarianceModel {
            warp: Warp,
            network: network.init(initial_log_variance, device),
            architecture: self.clone(),
            sigma: initial_log_variance.map(|d| (0.5 * d).exp()),
        }
    }
}

impl CovarianceModel {
    /// Predicts covariances: `d = network(I_{i+1}, warp(I_i, ⁱT̂ᵢ₊₁))` (paper Fig. 2).
    ///
    /// # Shapes
    /// - returns: `[batch, 6]`, d; order ρ then φ, ln m² and ln rad², axes of the model's error frame; or
    ///   `[batch, 21]` as [`Head::Full`] says
    pub fn forward(&self, pairs: &PairBatch) -> Tensor<2> {
        let images = self.architecture.network_input(&self.warp, pairs);
        let outputs = self.network.forward(images, self.architecture.pose_input(pairs));
        let Some(floor) = self.architecture.log_variance_floor else { return outputs };
        let floor = Tensor::<1>::from_floats(floor.map(|d| d as f32), &outputs.device());
        let [batch, values] = outputs.dims();
        let log_variance = floored(outputs.clone().slice([0..batch, 0..6]), floor.unsqueeze());
        match values {
            6 => log_variance,
            values => Tensor::cat(vec![log_variance, outputs.slice([0..batch, 6..values])], 1),
        }
    }

    /// Outputs as [`CovarianceModel::forward`] gives them, and the loss of each pair (paper Eq. 7), `[batch]`.
    pub fn forward_loss(&self, pairs: &PairBatch) -> (Tensor<2>, Tensor<1>) {
        let outputs = self.forward(pairs);
        let error = self.architecture.head.decorrelate(&outputs, pairs.error.clone(), &self.sigma);
        let batch = pairs.len();
        let loss = gaussian_loss(outputs.clone().slice([0..batch, 0..6]), error);
        (outputs, loss)
    }

    /// The covariances that rows of outputs stand for, m² and rad².
    ///
    /// # Errors
    /// An output is not finite, or a variance is too small or too large for a number: the weights are not usable.
    pub fn covariances(&self, outputs: &[f64]) -> Result<Vec<Covariance6>> {
        let head = self.architecture.head;
        let covariance = |row: &[f64]| {
            let covariance = head.covariance(row, &self.sigma);
            if covariance.is_positive() {
                return Ok(covariance);
            }
            let variances: Vec<String> = covariance.variance().iter().map(|value| format!("{value:.3e}")).collect();
            let found = variances.join(", ");
            Err(Error::Data(format!("the model predicts the variances {found}; its weights are not usable")))
        };
        outputs.chunks_exact(head.outputs()).map(covariance).collect()
    }

    /// The network behind the warp.
    pub fn network(&self) -> &CovarianceNetwork {
        &self.network
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
    /// As [`CovarianceModel::forward`] gives them.
    pub outputs: Tensor<2>,
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
        let (outputs, loss) = self.forward_loss(&batch.pairs);
        let gradients = (loss.clone().sum() * batch.weight).backward();
        TrainOutput::new(self, gradients, PairOutputs { outputs: outputs.inner(), loss: loss.inner() })
    }
}

impl InferenceStep for CovarianceModel {
    type Input = PairBatch;
    type Output = PairOutputs;

    fn step(&self, pairs: PairBatch) -> PairOutputs {
        let (outputs, loss) = self.forward_loss(&pairs);
        PairOutputs { outputs, loss }
    }
}
