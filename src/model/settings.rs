//! Configuration of the covariance network.

use serde::{Deserialize, Serialize};

use super::input::{ImagePair, InputBasis, PoseInput};
use crate::alignment::EvidenceInput;
use crate::network::{Head, ImageNetwork};
use crate::pairs::PairInput;

/// The covariance network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Input width, px. Default: 512.
    pub width: usize,
    /// Input height, px. Default: 160.
    pub height: usize,
    /// `warped` (the paper) or `raw` (the source image as it is, as in the paper's references 5 and 7: the
    /// network does not see the measured pose). Default: warped.
    pub pair: ImagePair,
    /// `pair` (the paper) or `residual` (learns faster). Default: residual.
    pub input: InputBasis,
    /// Whether each warped image comes with a channel that says where it is valid. Default: false (the paper).
    pub validity_mask: bool,
    /// Whether the right camera's images are seen too (the paper's footnote 1). Default: false (the paper).
    pub stereo: bool,
    /// `none` (the paper) or `mlp`: the measured pose as a 6-vector beside the images. Default: none.
    pub pose: PoseInput,
    /// `off` (the paper) or `alignment`: what direct alignment of the two images says of the measured pose's error,
    /// beside the images ([`crate::alignment`]). Default: off.
    pub evidence: EvidenceInput,
    /// `table_one` (the paper) or `none`: evidence alone. Default: table_one.
    pub network: ImageNetwork,
    /// `diagonal` (the paper), `full` (`L D Lᵀ`, 21 values) or `posterior` (needs evidence; a full covariance, and an
    /// estimate of the error itself). Default: diagonal.
    pub head: Head,
    /// Dropout after each convolution. Default: 0.5 (paper Section V-A).
    pub dropout: f64,
    /// Floor under predicted log-variances. Default: 12 nats below the mean.
    pub min_log_variance: MinLogVariance,
}

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            width: 512,
            height: 160,
            pair: ImagePair::default(),
            input: InputBasis::default(),
            validity_mask: false,
            stereo: false,
            pose: PoseInput::default(),
            evidence: EvidenceInput::default(),
            network: ImageNetwork::default(),
            head: Head::default(),
            dropout: 0.5,
            min_log_variance: MinLogVariance::BelowMean(12.0),
        }
    }
}

/// Floor under predicted log-variances. With error-free measurements in training the loss has no
/// lower bound without one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MinLogVariance {
    /// No floor (the paper).
    Off,
    /// This many nats below the training set's ln(mean e²), for each component.
    BelowMean(f64),
    /// These values, ln m² and ln rad².
    Absolute([f64; 6]),
}

impl ModelConfig {
    /// What the model needs of a pair.
    pub fn pair_input(&self) -> PairInput {
        PairInput {
            width: self.width,
            height: self.height,
            stereo: self.stereo,
            evidence: self.evidence,
            needs_overlap: self.pair.needs_overlap(self.evidence),
        }
    }
}
