//! How a run is trained: mini-batches, steps, what is watched, when to stop.

use serde::{Deserialize, Serialize};

use crate::pairs::Loading;

/// How the network is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingConfig {
    /// Pairs in a mini-batch. Default: 84 (paper Section V-A).
    pub batch: usize,
    /// Pairs that are on the device at once; the gradient is that of the whole batch. Default: 12.
    pub micro_batch: usize,
    /// Adam's learning rate. Default: 1e-4 (paper Section V-A).
    pub learning_rate: f64,
    /// How it changes over the epochs. Default: constant (the paper).
    pub schedule: Schedule,
    /// Most epochs. Default: 100.
    pub epochs: usize,
    /// Mini-batches in an epoch. Default: until the first system's pairs were seen once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub batches_per_epoch: Option<usize>,
    /// Epochs at the start in which a network that has evidence is shown that alone; images join afterwards. Evidence
    /// is learned a hundred times faster. Default: 0.
    pub evidence_epochs: usize,
    /// Adam's learning rate in mini-batches that show images. Default: learning_rate.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub image_learning_rate: Option<f64>,
    /// With `model.head = "posterior"`: the share of the corrected error's likelihood, `e ~ N(μ, C)`, in the loss; the
    /// rest is that of the error itself, `e ~ N(0, R)`. Default: 0.5.
    pub corrected_share: f64,
    /// Which pairs the stop rule and the best checkpoint watch. Default: validation. `test` is the
    /// paper's way, and leaks.
    pub watch: WatchedSplit,
    /// The system whose loss they watch. Default: the first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub watch_system: Option<String>,
    /// When to stop.
    pub stop: StopConfig,
    /// Threads that read and resize images. Default: 2.
    pub loader_threads: usize,
    /// Most micro-batches kept ready ahead of the network. Default: 4.
    pub prefetch: usize,
    /// Most memory that micro-batches kept ready may take, MB; one is kept ready in any case.
    /// Default: 256.
    pub prefetch_mb: usize,
}

impl Default for TrainingConfig {
    fn default() -> Self {
        Self {
            batch: 84,
            micro_batch: 12,
            learning_rate: 1e-4,
            schedule: Schedule::default(),
            epochs: 100,
            batches_per_epoch: None,
            evidence_epochs: 0,
            image_learning_rate: None,
            corrected_share: 0.5,
            watch: WatchedSplit::default(),
            watch_system: None,
            stop: StopConfig::default(),
            loader_threads: 2,
            prefetch: 4,
            prefetch_mb: 256,
        }
    }
}

impl TrainingConfig {
    /// How its micro-batches are read ahead.
    pub fn loading(&self) -> Loading {
        Loading {
            batch: self.micro_batch,
            threads: self.loader_threads,
            prefetch: self.prefetch,
            prefetch_mb: self.prefetch_mb,
        }
    }
}

/// The learning rate over a training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Schedule {
    /// The same in every step.
    #[default]
    Constant,
    /// Rises linearly during the first 5 % of `training.epochs`, then falls along half a cosine to zero
    /// (Loshchilov and Hutter 2017): noise of the steps dies away towards the end. The epochs of evidence alone
    /// (`evidence_epochs`) and those after them each have such a course. A run resumed with other epochs takes the rate
    /// that belongs to them.
    Cosine,
}

/// The split that the stop rule and the best checkpoint watch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WatchedSplit {
    /// Held-out pairs.
    #[default]
    Validation,
    /// The test pairs (the paper).
    Test,
}

/// When training and evaluation loss count as diverging; see [`crate::schedule::DivergenceRule`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StopConfig {
    /// Whether to stop before `training.epochs` at all. Default: true.
    pub enabled: bool,
    /// Epochs in the moving mean of both losses. Default: 3.
    pub smoothing: usize,
    /// Epochs since the lowest smoothed evaluation loss. Default: 5.
    pub window: usize,
    /// Least rise of the smoothed evaluation loss over its lowest, nats. Default: 0.05.
    pub tolerance: f64,
    /// Epochs before which the rule is silent. Default: 10.
    pub min_epochs: usize,
}

impl Default for StopConfig {
    fn default() -> Self {
        Self { enabled: true, smoothing: 3, window: 5, tolerance: 0.05, min_epochs: 10 }
    }
}
