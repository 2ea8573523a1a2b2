//! The result of an evaluation, `evaluation.json`: every system, predictions beside baselines.

use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::against_true::AgainstTrue;
use super::baselines::Baselines;
use super::bootstrap::{BootstrapSettings, Resamples, optimal_block_length};
use super::by_name::ByName;
use super::correction::RmsRatio;
use super::joint_scores::JointScores;
use super::methods::Method;
use super::metrics::{Metrics, evaluate_over};
use super::pair_table::{PairRow, PairTable, SystemPairs};
use super::perturbation::PerturbationResponse;
use super::prediction::share_at_floor;
use super::recalibration::Recalibration;
use super::separation::{Separation, separation};
use crate::error::{Error, Place, Result, shortened};
use crate::files::{read_text, write_atomically};
use crate::geometry::{Conventions, Covariance6, ErrorFrame};

/// Version of `evaluation.json`.
const SCHEMA: u32 = 1;

/// All systems of a split, all methods (`evaluation.json`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// Where it comes from.
    #[serde(flatten)]
    pub origin: Origin,
    /// By system name.
    pub systems: ByName<SystemEvaluation>,
    /// How well the model tells the first system from one that is the truth.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub separation: Option<Separation>,
    /// The paper's thought experiment, where it was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub perturbation_response: Option<PerturbationResponse>,
}

/// Where predictions come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Origin {
    /// Run folder, or file of predictions.
    pub run: String,
    /// Name of the predictions among methods; `None` for baselines alone.
    pub predicted: Option<String>,
    /// Split.
    pub split: String,
    /// Backend.
    pub device: String,
    /// Frames left out because they could not be read.
    #[serde(default)]
    pub unreadable_frames: Vec<String>,
    /// Systems that the model learned from; `None` for predictions that came without one.
    #[serde(default)]
    pub learned_systems: Option<Vec<String>>,
    /// How predictions were recalibrated, if they were.
    #[serde(default)]
    pub recalibration: Option<Recalibration>,
    /// Floor under log-variances, ln m² and ln rad².
    #[serde(default)]
    pub log_variance_floor: Option<[f64; 6]>,
    /// The effective configuration it was made with, TOML; `None` for a file of predictions.
    #[serde(default)]
    pub configuration: Option<String>,
}

impl Origin {
    /// Of predictions that came without a model.
    pub fn new(run: String, predicted: Option<String>, split: &str) -> Self {
        Self {
            run,
            predicted,
            split: split.to_owned(),
            device: "none".to_owned(),
            unreadable_frames: Vec::new(),
            learned_systems: None,
            recalibration: None,
            log_variance_floor: None,
            configuration: None,
        }
    }
}

/// One system.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SystemEvaluation {
    /// Evaluated pairs.
    pub pairs: usize,
    /// Hash of which measurements they are and by how much they are wrong.
    pub measurements: String,
    /// How the intervals were made; `None` where there are too few pairs for any.
    pub bootstrap: Option<BootstrapSettings>,
    /// The baselines, fitted to the training set; `None` for a system that has none.
    pub baselines: Option<Baselines>,
    /// By method name.
    pub methods: ByName<Metrics>,
}

/// Evaluates predictions and baselines, system by system.
///
/// # Errors
/// A system has no pairs, or some of its pairs have a prediction and others none. A system without baselines
/// is no error.
pub fn evaluate_table(table: &PairTable, baselines: &[(String, Baselines)], origin: Origin) -> Result<Evaluation> {
    let Conventions { error, error_frame, components, units, .. } = Conventions::new(table.error_frame);
    let systems = table.systems.iter().map(|system| {
        let fitted = baselines.iter().find(|(name, _)| *name == system.name).map(|(_, fitted)| fitted);
        Ok((system.name.clone(), evaluate_system(system, fitted, &origin)?))
    });
    Ok(Evaluation {
        schema: SCHEMA,
        error,
        error_frame,
        components,
        units,
        systems: systems.collect::<Result<_>>()?,
        origin,
        separation: separation(table),
        perturbation_response: None,
    })
}

/// All methods on the pairs of one system.
fn evaluate_system(system: &SystemPairs, baselines: Option<&Baselines>, origin: &Origin) -> Result<SystemEvaluation> {
    let predicted = system.rows.iter().filter(|row| row.covariance.is_some()).count();
    if system.rows.is_empty() {
        let (split, name) = (&origin.split, &system.name);
        return Err(Error::Data(format!("split `{split}`: no pair of system `{name}` could be evaluated")));
    }
    if predicted > 0
        && let Some(bare) = system.rows.iter().find(|row| row.covariance.is_none())
    {
        let (name, run) = (&system.name, &origin.run);
        let place = format!("{} frames {} and {}", bare.drive, bare.source, bare.target);
        return Err(Error::Data(format!(
            "{run}: no prediction for `{name}`, {place}; predict every pair, or leave it out of the file"
        )));
    }
    let errors = system.errors();
    let resamples = Resamples::new(errors.len(), block_length(&errors));
    let recalibration = origin.recalibration.as_ref().map(|recalibration| &recalibration.factors);
    let covariances = |method: Method| method.covariances(system, baselines, recalibration);
    let truth = covariances(Method::OracleDiagonal);
    let constant = covariances(Method::Constant).and_then(|constant| JointScores::of(&constant, &errors));
    let reference = constant.as_ref().map(|constant| constant.nll.as_slice());
    let evaluate_method = |&method: &Method| -> Option<(String, Metrics)> {
        let covariances = covariances(method)?;
        let remaining = method.errors(system);
        let mut metrics = evaluate_over(&covariances, &remaining, resamples.as_ref(), reference)?;
        match method {
            // What it covers are not the errors that the true covariance is of.
            Method::Corrected => metrics.rms_ratio = Some(RmsRatio::compare(&remaining, &errors)),
            Method::Oracle | Method::OracleDiagonal => {}
            _ => metrics.against_true = truth.as_ref().and_then(|truth| AgainstTrue::compare(&covariances, truth)),
        }
        if method == Method::Predicted {
            metrics.at_floor = origin.log_variance_floor.and_then(|floor| share_at(system, recalibration, &floor));
        }
        Some((method.name(origin.predicted.as_deref().unwrap_or("predicted")), metrics))
    };
    let methods: Vec<Option<(String, Metrics)>> = Method::ALL.par_iter().map(evaluate_method).collect();
    Ok(SystemEvaluation {
        pairs: system.rows.len(),
        measurements: system.fingerprint(),
        bootstrap: resamples.as_ref().map(Resamples::settings),
        baselines: baselines.copied(),
        methods: methods.into_iter().flatten().collect(),
    })
}

/// Share of outputs on the floor, which lies under what the network puts out before recalibration: C where it predicts
/// the error too.
fn share_at(system: &SystemPairs, recalibration: Option<&[f64; 6]>, floor: &[f64; 6]) -> Option<f64> {
    let factors = recalibration.copied().unwrap_or([1.0; 6]);
    let floor: [f64; 6] = std::array::from_fn(|c| floor[c] + factors[c].ln());
    let outputs: Vec<Covariance6> = system.rows.iter().map(PairRow::corrected_covariance).collect::<Option<_>>()?;
    Some(share_at_floor(&outputs, &floor))
}

/// As long as squared errors stay correlated, in whichever component they do so longest.
fn block_length(errors: &[[f64; 6]]) -> usize {
    let squares = |c: usize| errors.iter().map(|error| error[c] * error[c]).collect::<Vec<f64>>();
    (0..6).map(|c| optimal_block_length(&squares(c))).fold(1.0, f64::max).ceil() as usize
}

impl Evaluation {
    /// Writes `evaluation.json`.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let json = serde_json::to_string_pretty(self).expect("an evaluation is JSON");
        write_atomically(path, json.as_bytes())
    }

    /// Reads `evaluation.json`.
    ///
    /// # Errors
    /// It cannot be read, or is not one that this program wrote.
    pub fn read(path: &Path) -> Result<Self> {
        let evaluation: Self = serde_json::from_str(&read_text(path)?).map_err(|error| {
            let expected = "an evaluation of this version of relcov; make it again with `relcov eval`";
            Error::malformed(path, Place::Line(error.line()), shortened(&error.to_string()), expected)
        })?;
        let ours = Conventions::new(evaluation.error_frame);
        let same = evaluation.schema == SCHEMA
            && (&evaluation.error, &evaluation.components, &evaluation.units)
                == (&ours.error, &ours.components, &ours.units);
        if !same {
            let found = format!("schema {}, e = {}, {:?}", evaluation.schema, evaluation.error, evaluation.components);
            let expected = format!("schema {SCHEMA}, e = {}, {:?}", ours.error, ours.components);
            return Err(Error::malformed(path, Place::Whole, found, expected));
        }
        Ok(evaluation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::PairRow;
    use crate::evaluation::pair_table::made_row as row;
    use crate::geometry::{Posterior, Tangent};

    fn origin() -> Origin {
        Origin::new("run".to_owned(), Some("relcov".to_owned()), "test")
    }

    fn evaluated(simulated: bool, rows: &[PairRow], origin: Origin) -> Result<SystemEvaluation> {
        let system = SystemPairs { name: "vo".to_owned(), simulated, rows: rows.to_vec() };
        evaluate_system(&system, None, &origin)
    }

    fn names(evaluation: &SystemEvaluation) -> Vec<&str> {
        evaluation.methods.iter().map(|(name, _)| name).collect()
    }

    #[test]
    fn a_stated_covariance_is_an_oracle_only_where_it_was_simulated() {
        let mut rows = vec![row(0, 0.1, 0.01), row(1, -0.3, 0.04)];
        let simulated = evaluated(true, &rows, origin()).unwrap();
        assert_eq!(names(&simulated), ["relcov", "zero", "oracle", "oracle_diagonal"]);
        assert_eq!(names(&evaluated(false, &rows, origin()).unwrap()), ["relcov", "zero", "stated"]);
        let ratio = simulated.methods.get("relcov").unwrap().against_true.as_ref().unwrap().median_sigma_ratio;
        // σ of .1 and .2 beside a true .2: the geometric mean of ½ and 1.
        assert!(ratio.iter().all(|value| (value - 0.5_f64.sqrt()).abs() < 1e-12), "{ratio:?}");
        rows[1].stated = None;
        assert_eq!(names(&evaluated(true, &rows, origin()).unwrap()), ["relcov", "zero"]);
    }

    #[test]
    fn recalibrated_predictions_stand_beside_what_they_were() {
        let rows = [row(0, 0.1, 0.01), row(1, -0.3, 0.04)];
        let recalibration = Recalibration {
            factors: [4.0; 6],
            split: "validation".to_owned(),
            systems: vec!["vo".to_owned()],
            pairs: 2,
        };
        let origin = Origin { recalibration: Some(recalibration), log_variance_floor: Some([0.0; 6]), ..origin() };
        let evaluation = evaluated(false, &rows, origin).unwrap();
        assert_eq!(names(&evaluation), ["relcov", "relcov_uncalibrated", "zero", "stated"]);
        let anees = |name: &str| evaluation.methods.get(name).unwrap().anees.unwrap();
        assert!((anees("relcov_uncalibrated") - 4.0 * anees("relcov")).abs() < 1e-12);
        assert_eq!(evaluation.methods.get("relcov").unwrap().at_floor, Some(1.0));
    }

    #[test]
    fn corrected_measurements_are_judged_on_what_is_left_of_their_errors() {
        let mean = Tangent::repeat(0.08);
        let posterior = Posterior { mean, covariance: Covariance6::from_std_devs(&Tangent::repeat(0.02)) };
        let seen =
            PairRow { covariance: Some(posterior.second_moment()), posterior: Some(posterior), ..row(0, 0.1, 1.0) };
        // A measurement without a verdict stays as it is.
        let rows = [seen, row(1, -0.3, 0.04)];
        let evaluation = evaluated(false, &rows, origin()).unwrap();
        assert_eq!(names(&evaluation), ["relcov", "relcov_corrected", "zero", "stated"]);
        let corrected = evaluation.methods.get("relcov_corrected").unwrap();
        // z² of .02 under a σ of .02, and of .3 under one of .2; all along one axis, where errors add up.
        assert!((corrected.anees.unwrap() - 0.5 * (1.0 + 2.25)).abs() < 1e-9, "{:?}", corrected.anees);
        let ratio = corrected.rms_ratio.unwrap();
        assert!((ratio.rotation.unwrap() - (0.0904_f64 / 0.1).sqrt()).abs() < 1e-9, "{ratio:?}");
        assert_eq!(evaluation.methods.get("relcov").unwrap().rms_ratio, None);
        assert_eq!(corrected.conditional.as_ref().unwrap().joint.sigma.len(), 2);
        assert_eq!(evaluation.methods.get("zero").unwrap().conditional, None);
    }

    #[test]
    fn a_pair_without_a_prediction_is_named() {
        let mut rows = vec![row(0, 0.1, 0.01), row(1, -0.3, 0.04)];
        rows[1].covariance = None;
        let error = evaluated(false, &rows, origin()).unwrap_err().to_string();
        assert!(error.contains("`vo`, drive frames 1 and 2"), "{error}");
        rows[0].covariance = None;
        assert_eq!(names(&evaluated(false, &rows, origin()).unwrap()), ["zero", "stated"]);
    }

    #[test]
    fn an_evaluation_survives_its_file() {
        let systems = vec![SystemPairs {
            name: "vo".to_owned(),
            simulated: false,
            rows: vec![row(0, 0.1, 0.01), row(1, 0.2, 0.02)],
        }];
        let table = PairTable { error_frame: ErrorFrame::Camera, systems };
        let evaluation = evaluate_table(&table, &[], origin()).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        evaluation.write(file.path()).unwrap();
        assert_eq!(Evaluation::read(file.path()).unwrap(), evaluation);
        std::fs::write(file.path(), "{\"schema\": 1}").unwrap();
        assert!(Evaluation::read(file.path()).unwrap_err().to_string().contains("make it again with `relcov eval`"));
    }
}
