//! What a run starts from: the model's shape, its first prediction, and the manifest that records both.

use burn::tensor::Device;

use super::manifest::{BURN_VERSION, LAYOUT, Manifest, SystemSummary};
use crate::config::Config;
use crate::device::device_name;
use crate::evaluation::{Baselines, Prediction, mean_loss};
use crate::geometry::{Conventions, Covariance6};
use crate::model::{Architecture, MinLogVariance};
use crate::pairs::{Dataset, SplitName};
use crate::schedule::WatchedSplit;

/// Least variance an initial log-variance stands for: that of a system without any error, m² or rad².
const LEAST_MEAN_SQUARED_ERROR: f64 = 1e-16;

/// The model's shape: configuration plus the floor, which depends on the training errors.
fn architecture(config: &Config, dataset: &Dataset) -> Architecture {
    let mean = initial_log_variance(config, dataset);
    Architecture {
        height: config.model.height,
        width: config.model.width,
        pair: config.model.pair,
        input: config.model.input,
        validity_mask: config.model.validity_mask,
        stereo: config.model.stereo,
        pose: config.model.pose,
        evidence: config.model.evidence,
        network: config.model.network,
        head: config.model.head,
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
        baselines: Baselines::of_pairs(dataset.train.pairs_of(index)),
    });
    Manifest {
        layout: LAYOUT,
        relcov_version: env!("CARGO_PKG_VERSION").to_owned(),
        git_commit: crate::COMMIT.map(str::to_owned),
        burn_version: BURN_VERSION.to_owned(),
        device: device_name(device),
        seed: config.seed,
        conventions: Conventions::new(config.data.error_frame),
        architecture: architecture(config, dataset),
        initial_log_variance: initial_log_variance(config, dataset),
        camera_from_vehicle: dataset.train.pairs.first().map(|pair| {
            let matrix = dataset.drives[pair.id.drive].calibration.camera_from_vehicle.matrix();
            std::array::from_fn(|index| matrix[(index / 4, index % 4)])
        }),
        systems: systems.collect(),
        data_fingerprint: dataset.fingerprint(),
        experiment_fingerprint: config.experiment_fingerprint(),
    }
}

/// Loss of the constant predictor of each system on the watched split.
pub(super) fn constant_loss(dataset: &Dataset, watched: SplitName, manifest: &Manifest) -> Vec<Option<f64>> {
    let split = dataset.split(watched);
    manifest
        .systems
        .iter()
        .zip(&split.systems)
        .enumerate()
        .map(|(index, (system, range))| {
            let variances = system.baselines.mean_squared_error;
            let usable = variances.iter().all(|&value| value > 0.0);
            let covariance = Covariance6::from_variances(&variances.into());
            let pairs = if usable { &split.pairs[range.clone()] } else { &[] };
            let constant: Vec<Prediction> = pairs.iter().map(|pair| Prediction::constant(pair, covariance)).collect();
            // A constant corrects nothing: the share does not matter.
            mean_loss(&constant, index, 0.0)
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
