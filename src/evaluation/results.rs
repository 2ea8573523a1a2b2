//! The result of an evaluation: every system, relcov beside the baselines; `evaluation.json` and
//! `pairs.csv`.

use std::collections::BTreeSet;
use std::path::Path;

use serde::Serialize;

use super::metrics::{AgainstTrue, Metrics, evaluate, evaluate_full};
use super::perturbation::PerturbationResponse;
use super::prediction::{Prediction, share_at_floor};
use super::ranks::{auroc, median};
use crate::data::{BadFrame, Dataset, SplitName};
use crate::error::{Error, Place, Result};
use crate::files::write_atomically;
use crate::geometry::{Conventions, Covariance6, ErrorFrame};
use crate::training::{Manifest, SystemSummary};

/// Version of `evaluation.json`.
const SCHEMA: u32 = 1;

/// A way to give a measurement its covariance.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum MethodName {
    /// The trained model.
    Relcov,
    /// No error at all: what MDE alone may reward.
    Zero,
    /// The system's mean e² over the training set.
    Constant,
    /// [`LogLinear`](super::LogLinear) in the measured motion, fitted to the training set.
    LogLinear,
    /// The system's true covariance, known in rendered data. It knows the scene and not the realised
    /// error, so a model that sees misalignment may beat it.
    Oracle,
    /// The diagonal of the same: the best that a diagonal covariance can say without seeing the error.
    OracleDiagonal,
    /// What the system itself says of its covariance, in recorded data.
    Stated,
}

impl MethodName {
    /// Name in tables and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Relcov => "relcov",
            Self::Zero => "zero",
            Self::Constant => "constant",
            Self::LogLinear => "log_linear",
            Self::Oracle => "oracle",
            Self::OracleDiagonal => "oracle_diagonal",
            Self::Stated => "stated",
        }
    }
}

/// All systems of a split, all methods (`evaluation.json`).
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// Version of this format.
    pub schema: u32,
    /// How the error is formed.
    pub error: String,
    /// Axes of every number.
    pub error_frame: ErrorFrame,
    /// Names of the components.
    pub components: [String; 6],
    /// Their units.
    pub units: [String; 6],
    /// Run folder.
    pub run: String,
    /// Split.
    pub split: &'static str,
    /// Backend.
    pub device: String,
    /// Frames left out because they could not be read.
    pub unreadable_frames: Vec<String>,
    /// By system name.
    #[serde(serialize_with = "as_map")]
    pub systems: Vec<(String, SystemEvaluation)>,
    /// How well the model tells the first system from one that is the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub separation: Option<Separation>,
    /// The paper's thought experiment, where it was made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub perturbation_response: Option<PerturbationResponse>,
}

/// One system.
#[derive(Clone, Debug, Serialize)]
pub struct SystemEvaluation {
    /// Evaluated pairs.
    pub pairs: usize,
    /// By method name.
    #[serde(serialize_with = "as_map")]
    pub methods: Vec<(&'static str, Metrics)>,
}

/// Predictions for two systems on the same images.
#[derive(Clone, Debug, Serialize)]
pub struct Separation {
    /// The first system, and the one without error.
    pub systems: [String; 2],
    /// Median σ of the first over median σ of the second.
    pub median_sigma_ratio: [f64; 6],
    /// Chance that trace R of the first exceeds that of the second, over all pairs of predictions.
    pub auroc: f64,
}

/// Evaluates predictions and baselines, system by system.
///
/// # Errors
/// A system has no predictions. One the run was not trained on has no baselines fitted to it, which is
/// no error.
pub fn evaluate_run(
    predictions: &[Prediction],
    dataset: &Dataset,
    manifest: &Manifest,
    run: &Path,
    split: SplitName,
    device: String,
    bad_frames: &[BadFrame],
) -> Result<Evaluation> {
    let mut systems = Vec::new();
    for (index, name) in dataset.systems.iter().enumerate() {
        let rows: Vec<&Prediction> = predictions.iter().filter(|prediction| prediction.system == index).collect();
        if rows.is_empty() {
            return Err(Error::Data(format!(
                "split `{}`: no pair of system `{name}` could be evaluated",
                split.name()
            )));
        }
        let summary = manifest.systems.iter().find(|summary| &summary.name == name);
        let methods =
            evaluate_methods(&rows, summary, manifest.architecture.log_variance_floor, dataset.simulated[index]);
        systems.push((name.clone(), SystemEvaluation { pairs: rows.len(), methods }));
    }
    let Conventions { error, error_frame, components, units, .. } = manifest.conventions.clone();
    Ok(Evaluation {
        schema: SCHEMA,
        error,
        error_frame,
        components,
        units,
        run: run.display().to_string(),
        split: split.name(),
        device,
        unreadable_frames: bad_frames
            .iter()
            .map(|bad| format!("{} frame {}: {}", bad.drive, bad.frame, bad.problem))
            .collect(),
        systems,
        separation: separation(predictions, &dataset.systems),
        perturbation_response: None,
    })
}

/// The model and all baselines on the pairs of one system.
fn evaluate_methods(
    rows: &[&Prediction],
    summary: Option<&SystemSummary>,
    floor: Option<[f64; 6]>,
    simulated: bool,
) -> Vec<(&'static str, Metrics)> {
    let errors: Vec<[f64; 6]> = rows.iter().map(|row| row.error).collect();
    let stated: Option<Vec<Covariance6>> = rows.iter().map(|row| row.stated_covariance).collect();
    let true_variances: Option<Vec<[f64; 6]>> = stated
        .as_ref()
        .filter(|_| simulated)
        .map(|stated| stated.iter().map(|covariance| covariance.variance().into()).collect());
    let against_true = |variances: &[[f64; 6]]| AgainstTrue::compare(variances, true_variances.as_deref()?);
    let diagonal = |method: MethodName, variances: Vec<[f64; 6]>| {
        let metrics = evaluate(&variances, &errors).expect("not empty");
        (method.name(), Metrics { against_true: against_true(&variances), ..metrics })
    };

    let (name, mut relcov) = diagonal(MethodName::Relcov, rows.iter().map(|row| row.variance()).collect());
    relcov.at_floor = floor.map(|floor| share_at_floor(rows.iter().map(|row| &row.covariance), &floor));
    let mut methods = vec![(name, relcov), diagonal(MethodName::Zero, vec![[0.0; 6]; rows.len()])];
    if let Some(summary) = summary {
        methods.push(diagonal(MethodName::Constant, vec![summary.baselines.mean_squared_error; rows.len()]));
    }
    if let Some(log_linear) = summary.and_then(|summary| summary.baselines.log_linear) {
        let variances = rows.iter().map(|row| log_linear.variance(&row.motion)).collect();
        methods.push(diagonal(MethodName::LogLinear, variances));
    }
    if let Some(stated) = &stated {
        let name = if simulated { MethodName::Oracle } else { MethodName::Stated }.name();
        methods.push((name, evaluate_full(stated, &errors).expect("not empty")));
    }
    if let Some(variances) = &true_variances {
        methods.push((MethodName::OracleDiagonal.name(), evaluate(variances, &errors).expect("not empty")));
    }
    methods
}

/// The first system beside the first one that is the truth itself, on pairs that both have.
fn separation(predictions: &[Prediction], systems: &[String]) -> Option<Separation> {
    let of_system = |system: usize| predictions.iter().filter(move |prediction| prediction.system == system);
    let is_truth =
        |&system: &usize| of_system(system).all(|row| row.error == [0.0; 6]) && of_system(system).next().is_some();
    let truth = (1..systems.len()).find(is_truth)?;
    let pairs = |system: usize| of_system(system).map(|row| row.pair).collect::<BTreeSet<_>>();
    let shared: BTreeSet<_> = pairs(0).intersection(&pairs(truth)).copied().collect();
    let variances = |system: usize| -> Vec<[f64; 6]> {
        of_system(system).filter(|row| shared.contains(&row.pair)).map(Prediction::variance).collect()
    };
    let (first, second) = (variances(0), variances(truth));
    let median_sigma = |rows: &[[f64; 6]], c: usize| median(rows.iter().map(|row| row[c].sqrt()).collect());
    let traces = |rows: &[[f64; 6]]| rows.iter().map(|row| row.iter().sum()).collect::<Vec<f64>>();
    let auroc = auroc(&traces(&first), &traces(&second))?;
    let ratio = |c: usize| median_sigma(&first, c).zip(median_sigma(&second, c)).map_or(f64::NAN, |(a, b)| a / b);
    Some(Separation {
        systems: [0, truth].map(|system| systems[system].clone()),
        median_sigma_ratio: std::array::from_fn(ratio),
        auroc,
    })
}

/// Writes `evaluation.json` and `pairs.csv` into a folder.
///
/// # Errors
/// They cannot be written.
pub fn write_results(
    folder: &Path,
    evaluation: &Evaluation,
    predictions: &[Prediction],
    dataset: &Dataset,
) -> Result<()> {
    let json = serde_json::to_string_pretty(evaluation).expect("an evaluation is JSON");
    write_atomically(&folder.join("evaluation.json"), json.as_bytes())?;
    let path = folder.join("pairs.csv");
    let csv = pairs_csv(predictions, dataset)
        .map_err(|error| Error::malformed(&path, Place::Whole, error.to_string(), "rows of one length"))?;
    write_atomically(&path, &csv)
}

/// One row a pair: what was measured, by how much it was wrong, what variance was predicted.
fn pairs_csv(predictions: &[Prediction], dataset: &Dataset) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let columns = |prefix: &str| Conventions::COMPONENTS.map(|component| format!("{prefix}_{component}"));
    let keys = ["system", "drive", "source", "target"].map(str::to_owned);
    writer.write_record(keys.iter().chain(&columns("error")).chain(&columns("variance")))?;
    for prediction in predictions {
        let key = [
            dataset.systems[prediction.system].clone(),
            dataset.drives[prediction.pair.drive].name.clone(),
            prediction.pair.source.to_string(),
            prediction.pair.target.to_string(),
        ];
        let numbers = prediction.error.into_iter().chain(prediction.variance()).map(|value| format!("{value:e}"));
        writer.write_record(key.into_iter().chain(numbers))?;
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}

fn as_map<K: Serialize, V: Serialize, S: serde::Serializer>(
    entries: &[(K, V)],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_map(entries.iter().map(|(key, value)| (key, value)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::PairId;
    use crate::geometry::Tangent;

    fn prediction(system: usize, frame: usize, error: f64, variance: f64) -> Prediction {
        Prediction {
            pair: PairId { drive: 0, source: frame, target: frame + 1 },
            system,
            error: [error; 6],
            covariance: Covariance6::from_variances(&Tangent::repeat(variance)),
            motion: Tangent::zeros(),
            stated_covariance: Some(Covariance6::from_std_devs(&Tangent::repeat(0.2))),
        }
    }

    fn names(rows: &[Prediction], simulated: bool) -> Vec<&'static str> {
        let rows: Vec<&Prediction> = rows.iter().collect();
        evaluate_methods(&rows, None, None, simulated).into_iter().map(|(name, _)| name).collect()
    }

    #[test]
    fn a_stated_covariance_is_an_oracle_only_where_it_was_simulated() {
        let mut rows = vec![prediction(0, 0, 0.1, 0.01), prediction(0, 1, -0.3, 0.04)];
        assert_eq!(names(&rows, true), ["relcov", "zero", "oracle", "oracle_diagonal"]);
        assert_eq!(names(&rows, false), ["relcov", "zero", "stated"]);
        let methods = evaluate_methods(&rows.iter().collect::<Vec<_>>(), None, None, true);
        let ratio = methods[0].1.against_true.as_ref().unwrap().median_sigma_ratio;
        // σ of .1 and .2 beside a true .2.
        assert!(ratio.iter().all(|value| (value - 0.75).abs() < 1e-12), "{ratio:?}");
        rows[1].stated_covariance = None;
        assert_eq!(names(&rows, true), ["relcov", "zero"]);
    }

    #[test]
    fn systems_are_told_apart_on_the_images_they_share() {
        let systems = ["vo", "gnss"].map(str::to_owned);
        let mut rows: Vec<Prediction> = (0..4).map(|frame| prediction(0, frame, 0.1, 0.04)).collect();
        rows.extend((0..4).map(|frame| prediction(1, frame, 0.0, 0.01)));
        // A pair that only one of them measured counts for neither.
        rows.push(prediction(1, 9, 0.0, 100.0));
        let found = separation(&rows, &systems).unwrap();
        assert_eq!((found.systems, found.auroc), (systems.clone(), 1.0));
        assert!(found.median_sigma_ratio.iter().all(|ratio| (ratio - 2.0).abs() < 1e-12));
        // Without a system that is the truth there is nothing to tell apart.
        rows.retain(|row| row.system == 0);
        assert!(separation(&rows, &systems).is_none());
    }
}
