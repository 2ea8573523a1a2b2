//! The one TOML file that describes an experiment: the sections of all rooms, composed.
//!
//! Order of precedence: defaults < the file that `extends` names < file < `RELCOV_DATA_ROOT` (for recorded data, not for
//! `data.synthetic`) < `--set key=value`. Relative paths
//! resolve against the file that holds them (those of `--set` and the environment against the
//! current folder). Unknown keys are errors.

mod load;
mod overrides;
mod validate;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::depth::DepthConfig;
use crate::model::ModelConfig;
use crate::pairs::{DataConfig, PairSettings};
use crate::schedule::{DepthTrainingConfig, TrainingConfig, WatchedSplit};
use crate::systems::{SystemConfig, TruthConfig};

/// An experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of the run folder.
    pub name: String,
    /// Folder that holds run folders. Default: `checkpoints` in the current folder.
    #[serde(default = "default_checkpoints")]
    pub checkpoints: PathBuf,
    /// Seed of weights, batches and dropout. Default: 0.
    #[serde(default)]
    pub seed: u64,
    /// `auto | flex | ndarray | wgpu | vulkan | cuda[:i]`. Default: auto. `--device` overrides it.
    #[serde(default = "default_device")]
    pub device: String,
    /// Where the images and true poses are.
    pub data: DataConfig,
    /// What counts as the true pose.
    #[serde(default)]
    pub truth: TruthConfig,
    /// The systems whose measurements are learned; the first is the paper's System 1.
    pub systems: Vec<SystemConfig>,
    /// Where the depth of the target image comes from.
    #[serde(default)]
    pub depth: DepthConfig,
    /// The covariance network.
    #[serde(default)]
    pub model: ModelConfig,
    /// How it is trained.
    #[serde(default)]
    pub training: TrainingConfig,
    /// How `relcov train-depth` trains a depth network. Default: its defaults.
    #[serde(default, skip_serializing_if = "DepthTrainingConfig::is_default")]
    pub depth_training: DepthTrainingConfig,
}

impl Config {
    /// What says which pairs there are, and how they are read.
    pub fn pairs(&self) -> PairSettings<'_> {
        PairSettings {
            data: &self.data,
            truth: &self.truth,
            systems: &self.systems,
            depth: &self.depth,
            input: self.model.pair_input(),
            seed: self.seed,
            held_out: self.data.validation.is_empty() && self.training.watch == WatchedSplit::Validation,
        }
    }
}

fn default_checkpoints() -> PathBuf {
    "checkpoints".into()
}

fn default_device() -> String {
    "auto".to_owned()
}
