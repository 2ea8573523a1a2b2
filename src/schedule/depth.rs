//! How a depth network is trained on the true motion between images.

use serde::{Deserialize, Serialize};

use super::settings::Schedule;
use crate::depth::DepthRange;

/// Self-supervised training of the depth network (`relcov train-depth`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthTrainingConfig {
    /// Input width of the network, px, a multiple of 32. Default: 416.
    pub width: usize,
    /// Input height, px, a multiple of 32. Default: 128.
    pub height: usize,
    /// Target images in a mini-batch, each with the image before and the one after it. Default: 12 (Godard et al.
    /// 2019).
    pub batch: usize,
    /// Passes over the target images. Default: 20 (Godard et al. 2019).
    pub epochs: usize,
    /// Most mini-batches in an epoch. Default: until every target was seen once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batches_per_epoch: Option<usize>,
    /// Adam's learning rate. Default: 1e-4 (Godard et al. 2019).
    pub learning_rate: f64,
    /// How it changes over the epochs. Default: cosine.
    pub schedule: Schedule,
    /// Nearest and farthest depth that the network can state, m. Default: 1 and 100.
    pub range_m: DepthRange,
    /// Depth at which it starts, m, everywhere. Default: 10.
    pub initial_depth_m: f64,
}

impl Default for DepthTrainingConfig {
    fn default() -> Self {
        Self {
            width: 416,
            height: 128,
            batch: 12,
            epochs: 20,
            batches_per_epoch: None,
            learning_rate: 1e-4,
            schedule: Schedule::Cosine,
            range_m: DepthRange { min: 1.0, max: 100.0 },
            initial_depth_m: 10.0,
        }
    }
}

impl DepthTrainingConfig {
    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}
