//! The result of an evaluation: every system, relcov beside the baselines; `evaluation.json` and
//! `pairs.csv`.

use std::path::Path;

use serde::Serialize;

use super::metrics::{Metrics, evaluate};
use super::prediction::{Prediction, share_at_floor};
use crate::data::{BadFrame, Dataset, SplitName};
use crate::error::{Error, Place, Result};
use crate::files::write_atomically;
use crate::geometry::{Conventions, ErrorFrame};
use crate::training::Manifest;

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
}

impl MethodName {
    /// Name in tables and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Relcov => "relcov",
            Self::Zero => "zero",
            Self::Constant => "constant",
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

/// Evaluates predictions and baselines, system by system.
///
/// # Errors
/// A system has no predictions. One the run was not trained on has no constant baseline, which is no
/// error.
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
        let errors: Vec<[f64; 6]> = rows.iter().map(|row| row.error).collect();
        let variances: Vec<[f64; 6]> = rows.iter().map(|row| row.variance()).collect();
        let Some(mut relcov) = evaluate(&variances, &errors) else {
            return Err(Error::Data(format!(
                "split `{}`: no pair of system `{name}` could be evaluated",
                split.name()
            )));
        };
        relcov.at_floor = manifest.architecture.log_variance_floor.map(|floor| {
            let rows: Vec<Prediction> = rows.iter().map(|&row| row.clone()).collect();
            share_at_floor(&rows, &floor)
        });
        let mut methods = vec![(MethodName::Relcov.name(), relcov)];
        let mut baseline = |method: MethodName, variance: [f64; 6]| {
            let metrics = evaluate(&vec![variance; errors.len()], &errors).expect("not empty");
            methods.push((method.name(), metrics));
        };
        baseline(MethodName::Zero, [0.0; 6]);
        if let Some(summary) = manifest.systems.iter().find(|summary| &summary.name == name) {
            baseline(MethodName::Constant, summary.mean_squared_error);
        }
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
