//! Arguments that change a configuration, and what a trained model's shape leaves of them.

use std::path::Path;

use clap::Args;

use crate::config::Config;
use crate::device::DEVICE_NAMES;
use crate::error::Error;
use crate::model::{MinLogVariance, ModelConfig};
use crate::training::{Manifest, RunFolder};

/// Arguments that change a configuration.
#[derive(Args)]
pub(super) struct Overrides {
    /// Override a configuration key (TOML value or plain text); repeatable
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
    #[arg(long, value_name = "DEVICE", help = format!("Where to compute: {DEVICE_NAMES} [default: the configuration's, else auto]"))]
    pub(super) device: Option<String>,
}

impl Overrides {
    pub(super) fn load(&self, path: &Path) -> Result<Config, Error> {
        let mut config = Config::load(path, &self.set)?;
        if let Some(device) = &self.device {
            config.device.clone_from(device);
        }
        Ok(config)
    }

    /// That they leave the shape of a trained model alone.
    pub(super) fn refuse_model_keys(&self) -> Result<(), Error> {
        match self.set.iter().find(|key| key.trim_start().starts_with("model.")) {
            Some(key) => Err(Error::config(key, "a trained model keeps its shape; train another run for another one")),
            None => Ok(()),
        }
    }

    /// The configuration of data for a trained model: another one's, or that of its run. The data may be another
    /// configuration's; the model is the run's.
    ///
    /// # Errors
    /// As [`Config::load`], or errors are in other axes than the model's covariances.
    pub(super) fn load_for_run(
        &self,
        config: Option<&Path>,
        run: &RunFolder,
        manifest: &Manifest,
    ) -> Result<Config, Error> {
        fit_to_run(self.load(config.unwrap_or(&run.config_path()))?, manifest)
    }

    /// The configuration of a run, for data that will take the place of its own.
    ///
    /// # Errors
    /// A key is set that those data replace.
    pub(super) fn load_for_other_data(&self, run: &RunFolder, manifest: &Manifest) -> Result<Config, Error> {
        let key = |text: &str| text.split('=').next().unwrap_or_default().trim().to_owned();
        let counts = |key: &String| KEYS_FOR_OTHER_DATA.iter().any(|prefix| key.starts_with(prefix));
        if let Some(key) = self.set.iter().map(|text| key(text)).find(|key| !counts(key)) {
            let problem = "changes nothing about --drive, --manifest or --stream; leave it out";
            return Err(Error::config(key, problem));
        }
        let mut config = Config::load_for_other_data(&run.config_path(), &self.set)?;
        if let Some(device) = &self.device {
            config.device.clone_from(device);
        }
        fit_to_run(config, manifest)
    }
}

/// Keys of a run's configuration that count where other data take the place of its own: how depth is made, and how it is
/// read and predicted.
const KEYS_FOR_OTHER_DATA: [&str; 12] = [
    "depth",
    "device",
    "data.camera",
    "data.gap",
    "data.max_bad_fraction",
    "data.cache_mb",
    "training.batch",
    "training.micro_batch",
    "training.loader_threads",
    "training.prefetch",
    "model",
    "checkpoints",
];

/// Gives a configuration the shape of a trained model.
fn fit_to_run(mut config: Config, manifest: &Manifest) -> Result<Config, Error> {
    let architecture = &manifest.architecture;
    config.model = ModelConfig {
        width: architecture.width,
        height: architecture.height,
        pair: architecture.pair,
        input: architecture.input,
        validity_mask: architecture.validity_mask,
        stereo: architecture.stereo,
        pose: architecture.pose,
        evidence: architecture.evidence,
        network: architecture.network,
        head: architecture.head,
        dropout: architecture.dropout,
        min_log_variance: architecture.log_variance_floor.map_or(MinLogVariance::Off, MinLogVariance::Absolute),
    };
    let (found, trained) = (config.data.error_frame, manifest.conventions.error_frame);
    if found == trained {
        return Ok(config);
    }
    let (found, trained) = (found.name(), trained.name());
    Err(Error::config(
        "data.error_frame",
        format!(
            "`{found}` is not the `{trained}` this model was trained for; covariances of a diagonal model cannot be compared across frames"
        ),
    ))
}
