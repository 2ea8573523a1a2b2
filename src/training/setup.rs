//! What a run starts from: the model's shape, its first prediction, and the manifest that records both.

use burn::tensor::Device;

use super::manifest::{Manifest, SystemSummary};
use crate::config::{Config, MinLogVariance, WatchedSplit};
use crate::data::{Dataset, SplitName};
use crate::device::device_name;
use crate::evaluation::Prediction;
use crate::geometry::Conventions;
use crate::model::Architecture;

/// Least variance an initial log-variance stands for: that of a system without any error, ln m² or ln rad².
const LEAST_MEAN_SQUARED_ERROR: f64 = 1e-16;
/// The model's shape: configuration plus the floor, which depends on the training errors.
fn architecture(config: &Config, dataset: &Dataset) -> Architecture {
    let mean = initial_log_variance(config, dataset);
    Architecture {
        height: config.model.height,
        width: config.model.width,
        input: config.model.input,
        dropout: config.model.dropout,
        log_variance_floor: match config.model.min_log_variance {
            MinLogVariance::Off => None,
            MinLogVariance::BelowMean(nats) => Some(mean.map(|d| d - nats)),
            MinLogVariance::Absolute(floor) => Some(floor),
        },
    }
}

/// ln(mean e²) of the mixed training set: the best constant for its loss.
fn initial_log_variance(config: &Config, dataset: &Dataset) -> [f64; 6] {
    let mean: nalgebra::Vector6<f64> = config
        .systems
        .iter()
        .enumerate()
        .map(|(index, system)| system.share * dataset.train.mean_squared_error(index))
        .sum();
    mean.map(|value| value.max(LEAST_MEAN_SQUARED_ERROR).ln()).into()
}

pub(super) fn describe(config: &Config, dataset: &Dataset, device: &Device) -> Manifest {
    let systems = config.systems.iter().enumerate().map(|(index, system)| SystemSummary {
        name: system.name.clone(),
        share: system.share,
        training_pairs: dataset.train.systems[index].len(),
        mean_squared_error: dataset.train.mean_squared_error(index).into(),
    });
    Manifest::new(
        device_name(device),
        config.seed,
        Conventions::new(config.data.error_frame),
        architecture(config, dataset),
        initial_log_variance(config, dataset),
        systems.collect(),
        dataset.fingerprint(),
    )
}

/// Loss of the constant predictor of each system on the watched split.
pub(super) fn constant_loss(dataset: &Dataset, watched: SplitName, manifest: &Manifest) -> Vec<Option<f64>> {
    let split = dataset.split(watched);
    manifest
        .systems
        .iter()
        .zip(&split.systems)
        .map(|(system, range)| {
            let usable = !range.is_empty() && system.mean_squared_error.iter().all(|&value| value > 0.0);
            usable.then(|| {
                let log_variance = system.mean_squared_error.map(f64::ln);
                let losses = split.pairs[range.clone()].iter().map(|pair| {
                    Prediction { pair: pair.id, system: pair.system, error: pair.error.into(), log_variance }.loss()
                });
                losses.sum::<f64>() / range.len() as f64
            })
        })
        .collect()
}

pub(super) fn watched_split(config: &Config) -> SplitName {
    match config.training.watch {
        WatchedSplit::Validation => SplitName::Validation,
        WatchedSplit::Test => SplitName::Test,
    }
}

pub(super) fn watched_system(config: &Config) -> usize {
    let name = config.training.watch_system.as_deref();
    config.systems.iter().position(|system| Some(system.name.as_str()) == name).unwrap_or(0)
}
