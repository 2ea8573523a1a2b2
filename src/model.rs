//! The proposed method on one screen (paper Section IV): warp by the measured pose, predict
//! log-variances, score them by the likelihood of the errors. Beside the paper: evidence of direct alignment, and a
//! posterior of the error itself.

mod input;
mod settings;

use burn::module::{Module, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

use crate::alignment::{Evidence, EvidenceInput, FEATURES, NoVerdict};
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, Posterior, Tangent};
use crate::loss::{floored, gaussian_loss, posterior_loss};
use crate::network::{
    CovarianceNetwork, CovarianceNetworkConfig, EvidenceTensors, Head, ImageNetwork, PosteriorTensors, posterior,
};
use crate::pairs::PairBatch;
use crate::warp::Warp;

pub use input::{ImagePair, InputBasis, PoseInput};
pub use settings::{MinLogVariance, ModelConfig};

/// Components of a pose error.
const COMPONENTS: usize = 6;

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
    /// Whether the evidence of direct alignment is an input.
    #[serde(default)]
    pub evidence: EvidenceInput,
    /// What looks at the images.
    #[serde(default)]
    pub network: ImageNetwork,
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
    /// Of the evidence, for a posterior: `[6]`, in units of `sigma` for each metre of measured way.
    drift: Option<Param<Tensor<1>>>,
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
            evidence: EvidenceInput::Off,
            network: ImageNetwork::TableOne,
            head: Head::Diagonal,
            dropout: 0.5,
            log_variance_floor: None,
        }
    }

    /// The floor under the variances of predicted covariances; `None` with a posterior head, whose floor is its prior's.
    pub fn floor_of_covariances(&self) -> Option<[f64; 6]> {
        self.log_variance_floor.filter(|_| self.head != Head::Posterior)
    }

    /// Builds the model; every first prediction is `initial_log_variance` on the diagonal.
    pub fn init(&self, initial_log_variance: [f64; 6], device: &Device) -> CovarianceModel {
        let network = CovarianceNetworkConfig {
            network: self.network,
            evidence: (self.evidence == EvidenceInput::Alignment).then_some(FEATURES),
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
            drift: (self.head == Head::Posterior).then(|| {
                let still = Tensor::zeros([COMPONENTS], device);
                Param::from_tensor(still).set_require_grad(true)
            }),
            architecture: self.clone(),
            sigma: initial_log_variance.map(|d| (0.5 * d).exp()),
        }
    }
}

impl CovarianceModel {
    /// Predicts covariances: `d = network(I_{i+1}, warp(I_i, ⁱT̂ᵢ₊₁))` (paper Fig. 2), or what another head puts out.
    ///
    /// # Shapes
    /// - returns: `[batch, values]` as [`Head`] says: first d or p, ln m² and ln rad², order ρ then φ, axes of the
    ///   model's error frame
    pub fn forward(&self, pairs: &PairBatch) -> Tensor<2> {
        let outputs = self.network.forward(self.architecture.network_input(&self.warp, pairs));
        let log_variance = |floor: &[f64; 6]| {
            let floor = Tensor::<1>::from_floats(floor.map(|d| d as f32), &outputs.device());
            floored(outputs.clone().narrow(1, 0, COMPONENTS), floor.unsqueeze())
        };
        let first = self.architecture.log_variance_floor.as_ref().map(log_variance);
        let first = first.unwrap_or_else(|| outputs.clone().narrow(1, 0, COMPONENTS));
        let more = self.architecture.head.outputs() - COMPONENTS;
        match self.architecture.head {
            Head::Diagonal => first,
            Head::Full => Tensor::cat(vec![first, outputs.narrow(1, COMPONENTS, more)], 1),
            Head::Posterior => {
                // Residuals of neighbouring pixels are never worth more than independent ones.
                let no_less = Tensor::zeros([1, more], &outputs.device());
                let distrust = floored(outputs.narrow(1, COMPONENTS, more), no_less);
                Tensor::cat(vec![first, distrust, self.drift_of(pairs)], 1)
            }
        }
    }

    /// How far the evidence of pairs is off on average, `[batch, 6]`, m and rad: what pixels that are off the same way in
    /// every picture (a grazing road, a coarse depth map) add up to, as the way grows.
    fn drift_of(&self, pairs: &PairBatch) -> Tensor<2> {
        let drift = self.drift.as_ref().expect("a posterior has one").val();
        let sigma = Tensor::<1>::from_floats(self.sigma.map(|sigma| sigma as f32), &drift.device());
        let way = pairs.motion.clone().narrow(1, 0, 3).square().sum_dim(1).sqrt();
        way * (drift * sigma).unsqueeze::<2>()
    }

    /// Outputs as [`CovarianceModel::forward`] gives them, and the loss of each pair (paper Eq. 7, or that of
    /// posteriors), `[batch]`.
    pub fn forward_loss(&self, pairs: &PairBatch, corrected_share: f64) -> (Tensor<2>, Tensor<1>) {
        let outputs = self.forward(pairs);
        let head = self.architecture.head;
        let loss = match head {
            Head::Diagonal | Head::Full => {
                let error = head.decorrelate(&outputs, pairs.error.clone(), &self.sigma);
                gaussian_loss(outputs.clone().narrow(1, 0, COMPONENTS), error)
            }
            Head::Posterior => {
                let evidence = pairs.evidence.as_ref().expect("a model with evidence is given it");
                let evidence =
                    EvidenceTensors { estimate: evidence.estimate.clone(), information: evidence.information.clone() };
                let scored = PosteriorTensors::new(&outputs, &evidence, pairs.error.clone(), &self.sigma);
                posterior_loss(scored.log_determinant, scored.whitened_mean, scored.whitened_rest, corrected_share)
            }
        };
        (outputs, loss)
    }

    /// What rows of outputs and the evidence of their pairs stand for.
    ///
    /// # Errors
    /// An output is not finite, or a variance is too small or too large for a number: the weights are not usable.
    pub fn estimates(&self, outputs: &[f64], evidence: &[Option<Evidence>]) -> Result<Vec<Estimate>> {
        let rows = outputs.chunks_exact(self.architecture.head.values());
        assert_eq!(rows.len(), evidence.len(), "one evidence, or none, a row of outputs");
        rows.zip(evidence).map(|(row, evidence)| self.estimate(row, evidence.as_ref())).collect()
    }

    fn estimate(&self, row: &[f64], evidence: Option<&Evidence>) -> Result<Estimate> {
        let no_verdict = evidence.and_then(|evidence| evidence.no_verdict);
        let estimate = match self.architecture.head {
            head @ (Head::Diagonal | Head::Full) => {
                Estimate { covariance: head.covariance(row, &self.sigma), posterior: None, no_verdict }
            }
            Head::Posterior => {
                let (estimate, information) = evidence.expect("a model with evidence is given it").judged();
                let judged = posterior(row, &estimate, &information).map(|posterior| (posterior, no_verdict));
                // Information beyond all numbers is none.
                let prior = || Some((posterior(row, &Tangent::zeros(), &Matrix6::zeros())?, Some(NoVerdict::Diverged)));
                let (posterior, no_verdict) = judged.or_else(prior).ok_or_else(|| unusable(&[f64::NAN; 6]))?;
                Estimate { covariance: posterior.second_moment(), posterior: Some(posterior), no_verdict }
            }
        };
        let narrowest = estimate.posterior.map_or(estimate.covariance, |posterior| posterior.covariance);
        match narrowest.is_positive() && estimate.covariance.is_positive() {
            true => Ok(estimate),
            false => Err(unusable(narrowest.variance().as_slice())),
        }
    }

    /// The network behind the warp.
    pub fn network(&self) -> &CovarianceNetwork {
        &self.network
    }
}

/// What a model says of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// R, m² and rad²: of the measurement as it is.
    pub covariance: Covariance6,
    /// What is known of the error itself, of a model with a posterior head.
    pub posterior: Option<Posterior>,
    /// Why the images say nothing of this error, where they do not: the covariance is then the prior's.
    pub no_verdict: Option<NoVerdict>,
}

fn unusable(found: &[f64]) -> Error {
    let found: Vec<String> = found.iter().map(|value| format!("{value:.3e}")).collect();
    let found = found.join(", ");
    Error::Data(format!("the model predicts the variances {found}; its weights are not usable"))
}

/// A part of a mini-batch that fits memory, with its share in the batch's mean loss.
#[derive(Clone, Debug)]
pub struct MicroBatch {
    /// The pairs.
    pub pairs: PairBatch,
    /// One over the number of pairs of the whole mini-batch.
    pub weight: f32,
    /// `training.corrected_share`.
    pub corrected_share: f64,
}

impl CovarianceModel {
    /// The forward and backward pass of a training step: Eq. 7 of each pair, `[batch]`, and the gradients of its share in
    /// the mini-batch's mean loss.
    pub fn step(&self, batch: &MicroBatch) -> (Tensor<1>, GradientsParams) {
        let (_, loss) = self.forward_loss(&batch.pairs, batch.corrected_share);
        let gradients = (loss.clone().sum() * batch.weight).backward();
        (loss.inner(), GradientsParams::from_grads(gradients, self))
    }
}
