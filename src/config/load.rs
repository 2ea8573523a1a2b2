//! Loads an experiment, and what follows from it.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{Config, default_checkpoints, default_device, overrides};
use crate::depth::DepthConfig;
use crate::error::{Error, Place, Result};
use crate::files::{read_text, sha256_hex};
use crate::pairs::{DataConfig, default_cache_mb, default_max_bad_fraction};
use crate::recordings::{DATA_ROOT_VARIABLE, MeasurementFrame};
use crate::schedule::{DepthTrainingConfig, TrainingConfig};
use crate::systems::{SystemConfig, SystemSource, TruthConfig};

impl Config {
    /// Reads a configuration file and applies `key=value` overrides.
    ///
    /// # Errors
    /// The file cannot be read, is not TOML, holds an unknown key or an unusable value; the message
    /// names the line or key.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self> {
        Self::load_edited(path, overrides, &|_| {})
    }

    /// The same for data other than those it describes: what it would render is no matter.
    pub(crate) fn load_for_other_data(path: &Path, overrides: &[String]) -> Result<Self> {
        Self::load_edited(path, overrides, &|table| {
            if let Some(toml::Value::Table(data)) = table.get_mut("data") {
                data.remove("synthetic");
            }
        })
    }

    fn load_edited(path: &Path, overrides: &[String], edit: &dyn Fn(&mut toml::Table)) -> Result<Self> {
        let text = read_text(path)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let data_root = std::env::var_os(DATA_ROOT_VARIABLE).map(PathBuf::from);
        let mut table = overrides::merge(&text, path, folder, data_root.as_deref(), overrides)?;
        edit(&mut table);
        let mut config = Self::deserialize(table).map_err(|error| {
            let expected = "a relcov configuration (README.md, \"Configuration\")";
            let place = Place::Whole;
            // The text knows its lines; the merged table only its keys.
            match toml::from_str::<Self>(&text) {
                Err(in_text) if in_text.message() == error.message() => {
                    Error::malformed(path, place, in_text.to_string().trim_end(), expected)
                }
                _ => Error::malformed(
                    path,
                    place,
                    format!("with its overrides, {}", error.to_string().trim_end()),
                    expected,
                ),
            }
        })?;
        // The default names a folder of the current one; the run's own copy must not take it for one of its own.
        config.checkpoints = std::path::absolute(&config.checkpoints).map_err(|_| {
            Error::config("checkpoints", "is empty; leave it out for `checkpoints` in the current folder")
        })?;
        config.name_depth_cache();
        config.validate()?;
        Ok(config)
    }

    /// Gives the depth maps of a network their default place.
    pub(crate) fn name_depth_cache(&mut self) {
        if let DepthConfig::Monodepth2(network) = &mut self.depth
            && network.cache.as_os_str().is_empty()
        {
            let name = network.weights.file_name().unwrap_or_default();
            network.cache = self.checkpoints.join("depth").join(name);
        }
    }

    /// The same drives with nothing but their true motions: every measured system replaced by the truth, and depth that
    /// needs nothing.
    pub(crate) fn with_truth_alone(&self) -> Self {
        let truth = SystemConfig { name: "truth".to_owned(), share: 1.0, source: SystemSource::Truth {} };
        Self { systems: vec![truth], depth: DepthConfig::default(), ..self.clone() }
    }

    /// The same with the sizes of generated errors that its training data gave, so that they stay what they were
    /// whatever data it is asked about later. `sizes`: for each system, where it is generated.
    pub(crate) fn with_generated_sizes(mut self, sizes: &[Option<[f64; 6]>]) -> Self {
        for (system, size) in self.systems.iter_mut().zip(sizes) {
            if let (SystemSource::Perturbation(perturbation), Some(size)) = (&mut system.source, size) {
                perturbation.base = Some(*size);
            }
        }
        self
    }

    /// Folder of this experiment's run.
    pub fn run_folder(&self) -> PathBuf {
        self.checkpoints.join(&self.name)
    }

    /// The whole configuration, defaults included, as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string_pretty(self).expect("a configuration is TOML")
    }

    /// A hash of everything that must stay the same when a run is resumed: all but its place, its
    /// device, and how long, fast and patiently it trains.
    pub fn experiment_fingerprint(&self) -> String {
        let defaults = TrainingConfig::default();
        let mut depth = self.depth.clone();
        if let DepthConfig::Monodepth2(network) = &mut depth {
            network.weights = network.weights.file_name().unwrap_or_default().into();
            network.cache = PathBuf::new();
        }
        let truth = match (&self.truth, &self.data.manifest) {
            // Under the names that the same had first.
            (TruthConfig::Recording {}, None) => TruthConfig::Oxts {},
            (TruthConfig::Recording {}, Some(_)) => TruthConfig::Manifest { frame: MeasurementFrame::Camera },
            (truth, _) => truth.clone(),
        };
        let experiment = Self {
            truth,
            name: String::new(),
            checkpoints: default_checkpoints(),
            device: default_device(),
            data: DataConfig {
                root: PathBuf::new(),
                manifest: self.data.manifest.as_ref().map(|_| PathBuf::new()),
                // However it is read, the pairs have a hash of their own.
                layout: None,
                max_bad_fraction: default_max_bad_fraction(),
                cache_mb: default_cache_mb(),
                ..self.data.clone()
            },
            training: TrainingConfig {
                batch: self.training.batch,
                batches_per_epoch: self.training.batches_per_epoch,
                evidence_epochs: self.training.evidence_epochs,
                corrected_share: self.training.corrected_share,
                watch: self.training.watch,
                watch_system: self.training.watch_system.clone(),
                ..defaults
            },
            depth,
            depth_training: DepthTrainingConfig::default(),
            ..self.clone()
        };
        let text = experiment.to_toml().replace("[depth]\nsource = \"recording\"", "[depth]\nsource = \"manifest\"");
        sha256_hex(text.as_bytes())
    }

    /// Exact number of pairs of each system in a mini-batch.
    pub fn pairs_per_batch(&self) -> Vec<usize> {
        self.systems.iter().map(|system| (system.share * self.training.batch as f64).round() as usize).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_run_would_render_is_no_matter_for_other_data() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.toml");
        let text = "name = \"a\"\n[data]\nroot = \"data\"\ntrain = []\ntest = []\n[data.synthetic]\nlidar_steps = 0\n\
                    [[systems]]\nname = \"vo\"\nshare = 1.0\nsource = \"truth\"\n[training]\nbatch = 4\n";
        std::fs::write(&path, text).unwrap();
        let lidar = ["depth.source=lidar".to_owned()];
        assert!(Config::load(&path, &lidar).unwrap_err().to_string().contains("lidar_steps"));
        assert_eq!(Config::load_for_other_data(&path, &lidar).unwrap().data.synthetic, None);
    }
}
