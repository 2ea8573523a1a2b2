//! `relcov eval`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use burn::tensor::Device;
use clap::{ArgGroup, Args};

use super::choices::{FrameArgument, SplitArgument};
use super::output::OutputArguments;
use super::overrides::Overrides;
use super::progress::{Progress, note};
use super::synth;
use super::terminal::Terminal;
use crate::config::Config;
use crate::device::{device_name, open_device};
use crate::error::{Error, Place};
use crate::evaluation::{
    Baselines, Method, Origin, PairTable, Prediction, Recalibration, evaluate_table, perturbation_response,
    predict_split, read_pairs, write_pairs,
};
use crate::files::{own_name, require_apart};
use crate::geometry::{Conventions, ErrorFrame};
use crate::model::CovarianceModel;
use crate::pairs::{BadFrame, Dataset, PairReader, PairScope, SplitName};
use crate::report::figures::write_figures;
use crate::report::{Comparison, Entry};
use crate::training::{EVALUATION, FIGURES, Manifest, PAIRS, RunFolder};

/// What a trained model's predictions are called.
const RELCOV: &str = "relcov";

/// Arguments of `relcov eval`.
#[derive(Args)]
#[command(group(ArgGroup::new("judged").required(true).args(["run", "baselines_only", "pairs"])))]
#[command(after_help = "Examples:
  relcov eval --run checkpoints/kitti_sample
  relcov eval --run checkpoints/kitti_sample --full
  relcov eval --run checkpoints/kitti_sample --set depth.source=lidar --intervals
  relcov eval --run checkpoints/kitti --split validation --device wgpu --save-table table.tex
  relcov eval --baselines-only --config configs/kitti.toml --set data.root=../shared/kitti
  relcov eval --pairs mine.csv --fit training.csv --error-frame vehicle

--pairs judges the predictions of any program: a CSV with the columns system, drive, source, target,
error_x … error_yaw, variance_x … variance_yaw, and if you have them covariance_x_y … covariance_pitch_yaw
(the entries above the diagonal), motion_x … motion_yaw, interval_s, simulated, stated_x_x … stated_yaw_yaw;
of a predicted error correction_x … correction_yaw and corrected_x_x … corrected_yaw_yaw, the covariance of what
it leaves (the predicted covariance is their second moment), and no_verdict, the reason where images say nothing.
Order x, y, z, roll, pitch, yaw; metres and radians; e = log(measured * truth^-1), a left perturbation.")]
pub struct EvalArguments {
    /// Run folder of a trained model
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Judge the baselines alone, fitted to all training drives; needs measured and true poses, no image
    #[arg(long, requires = "config")]
    baselines_only: bool,
    /// Judge predictions in a CSV file (columns below)
    #[arg(long, value_name = "FILE", requires = "error_frame")]
    pairs: Option<PathBuf>,
    /// Evaluate on the data of another configuration
    #[arg(long, value_name = "FILE", conflicts_with = "pairs")]
    config: Option<PathBuf>,
    /// With --pairs: errors to fit the baselines to, in the same form
    #[arg(long, value_name = "FILE", requires = "pairs", conflicts_with_all = ["run", "baselines_only"])]
    fit: Option<PathBuf>,
    /// With --pairs: the axes of its errors and covariances
    #[arg(long, value_enum, requires = "pairs", conflicts_with_all = ["run", "baselines_only"])]
    error_frame: Option<FrameArgument>,
    /// Which pairs
    #[arg(long, value_enum, default_value = "test", conflicts_with = "pairs")]
    split: SplitArgument,
    /// Fit the factors that make variances right to the validation split again, and keep them in the run
    #[arg(long, requires = "run", conflicts_with_all = ["config", "pairs", "baselines_only"])]
    recalibrate: bool,
    #[command(flatten)]
    output: OutputArguments,
    #[command(flatten)]
    overrides: Overrides,
}

pub fn run(arguments: EvalArguments, terminal: &Terminal) -> anyhow::Result<()> {
    arguments.output.check(1)?;
    if let (Some(pairs), Some(fit)) = (&arguments.pairs, &arguments.fit)
        && require_apart(fit, &[pairs]).is_err()
    {
        note(false, "warning: --fit: baselines that are fitted to what they are judged on are too good");
    }
    let run = arguments.run.as_deref().map_or(Vec::new(), |run| RunFolder::at(run).files());
    let named = [&arguments.pairs, &arguments.fit, &arguments.config].into_iter().filter_map(|path| path.as_deref());
    let read: Vec<&Path> = named.chain(run.iter().map(PathBuf::as_path)).collect();
    arguments.output.require_apart(&read)?;
    let Overrides { set, device } = &arguments.overrides;
    if arguments.pairs.is_some() && !(set.is_empty() && device.is_none()) {
        return Err(Error::Data("--set and --device change nothing about --pairs; leave them out".to_owned()).into());
    }
    if arguments.run.is_some() {
        arguments.overrides.refuse_model_keys()?;
    }
    if arguments.output.replaces() {
        spare_data(&arguments)?;
    }
    let split = arguments.split.name();
    let entry = match (&arguments.run, &arguments.pairs, &arguments.config) {
        (Some(run), _, config) => {
            let recalibrate = if arguments.recalibrate { Recalibrate::Anew } else { Recalibrate::AsStored };
            evaluate_run(run, config.as_deref(), split, recalibrate, &arguments.overrides, terminal)?
        }
        (_, Some(pairs), _) => {
            let frame = arguments.error_frame.map_or(ErrorFrame::Vehicle, FrameArgument::frame);
            evaluate_file(pairs, arguments.fit.as_deref(), frame)?
        }
        (_, _, Some(config)) => evaluate_baselines(arguments.overrides.load(config)?, config, split)?,
        (None, None, None) => unreachable!("clap requires one of them"),
    };
    report_gaps(&entry, terminal);
    let comparison = Comparison::new(vec![entry])?;
    // The table first: a folder that cannot be written must not cost it.
    arguments.output.deliver(&comparison, terminal)?;
    store_in_run(&comparison, terminal)
}

/// Keeps scores, measurements and figures in the folder of the run they belong to.
pub fn store_in_run(comparison: &Comparison, terminal: &Terminal) -> anyhow::Result<()> {
    for entry in &comparison.entries {
        let Some(folder) = &entry.folder else { continue };
        RunFolder::open(folder)?.remove_figures()?;
        entry.evaluation.write(&folder.join(EVALUATION))?;
        write_pairs(&folder.join(PAIRS), &entry.table)?;
        let figures = write_figures(comparison, &folder.join(FIGURES))?;
        let text = format!("wrote {}, {PAIRS} and {figures} figures beside it", folder.join(EVALUATION).display());
        note(terminal.quiet, &text);
    }
    Ok(())
}

/// Which recalibration a run's predictions get.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Recalibrate {
    /// That of its folder, if there is one.
    AsStored,
    /// A new one, which is stored.
    Anew,
}

/// Evaluates a run.
pub fn evaluate_run(
    run_path: &Path,
    config: Option<&Path>,
    split: SplitName,
    recalibrate: Recalibrate,
    overrides: &Overrides,
    terminal: &Terminal,
) -> anyhow::Result<Entry> {
    let run = RunFolder::open(run_path)?;
    let manifest = run.manifest()?;
    let config = overrides.load_for_run(config, &run, &manifest)?;
    let PredictedTable { dataset, table, recalibration, reader, model, device } =
        predict_table(&run, &manifest, &config, split, recalibrate, terminal)?;
    let bad_frames = reader.bad_frames();
    let origin = Origin {
        run: run_path.display().to_string(),
        predicted: Some(RELCOV.to_owned()),
        split: split.name().to_owned(),
        device: device_name(&device),
        unreadable_frames: bad_frames.iter().map(describe).collect(),
        learned_systems: Some(learned_systems(&manifest).into_iter().map(str::to_owned).collect()),
        recalibration,
        log_variance_floor: manifest.architecture.floor_of_covariances(),
        configuration: Some(config.to_toml()),
    };
    let (fitted, error_frame) = (baselines(&manifest), manifest.conventions.error_frame);
    let mut evaluation = evaluate_table(&table, &fitted, origin)?;
    evaluation.perturbation_response =
        perturbation_response(&model, &reader, &dataset, dataset.require(split)?, &fitted, error_frame, &device)?;
    for bad in &bad_frames {
        note(false, &format!("left out: {}", describe(bad)));
    }
    note_blind_pairs(&reader.blind_pairs());
    Ok(Entry { name: own_name(run_path), evaluation, table, folder: Some(run.path().to_owned()) })
}

/// Says how many pairs a warp shows nothing of, and which is the first.
pub fn note_blind_pairs(blind: &[String]) {
    if let Some(first) = blind.first() {
        note(false, &format!("left out: {} pairs, the first: {first}", blind.len()));
    }
}

/// A split's measurements with a model's predictions, and what they were made with.
pub struct PredictedTable {
    /// The data.
    pub dataset: Dataset,
    /// Measurements and recalibrated predictions.
    pub table: PairTable,
    /// The recalibration that was applied.
    pub recalibration: Option<Recalibration>,
    reader: Arc<PairReader>,
    model: CovarianceModel,
    device: Device,
}

/// Predicts a split.
pub fn predict_table(
    run: &RunFolder,
    manifest: &Manifest,
    config: &Config,
    split: SplitName,
    recalibrate: Recalibrate,
    terminal: &Terminal,
) -> anyhow::Result<PredictedTable> {
    let device = open_device(&config.device)?;
    let model = run.load_model(manifest, &device)?;
    synth::make_if_asked(config, terminal)?;
    let dataset = Dataset::load(&config.pairs(), PairScope::Images)?;
    let predict = |split: SplitName, reader: &Arc<PairReader>| -> Result<Vec<Prediction>, Error> {
        let pairs = dataset.require(split)?;
        let mut progress = Progress::new(terminal.quiet, "evaluating", 0, pairs.pairs.len());
        predict_split(
            &model,
            reader,
            pairs,
            manifest.architecture.images(),
            &config.training.loading(),
            &device,
            &mut |done| {
                progress.set(done, "pairs");
                Ok(())
            },
        )
    };
    dataset.require(split)?;
    let recalibration = match recalibrate {
        Recalibrate::AsStored => run.recalibration()?,
        Recalibrate::Anew => {
            let reader = Arc::new(PairReader::new(&config.pairs(), &dataset, SplitName::Validation));
            let predictions = predict(SplitName::Validation, &reader)?;
            let learned = learned_systems(manifest);
            let fitted = Recalibration::fit(&predictions, &dataset.systems, &learned, SplitName::Validation.name());
            let fitted =
                fitted.ok_or_else(|| Error::Data("no factors can be fitted: every component of the learned systems needs errors on the validation pairs".to_owned()))?;
            run.write_recalibration(&fitted)?;
            Some(fitted)
        }
    };
    let reader = Arc::new(PairReader::new(&config.pairs(), &dataset, split));
    let mut predictions = predict(split, &reader)?;
    if let Some(recalibration) = &recalibration {
        predictions.iter_mut().for_each(|row| recalibration.apply_to(&mut row.covariance, &mut row.posterior));
    }
    let table = PairTable::from_predictions(&predictions, &dataset, manifest.conventions.error_frame);
    Ok(PredictedTable { dataset, table, recalibration, reader, model, device })
}

/// The systems that a run learned from.
fn learned_systems(manifest: &Manifest) -> Vec<&str> {
    let learned = manifest.systems.iter().filter(|system| system.share > 0.0);
    learned.map(|system| system.name.as_str()).collect()
}

/// The baselines that a run keeps of its systems.
fn baselines(manifest: &Manifest) -> Vec<(String, Baselines)> {
    manifest.systems.iter().map(|summary| (summary.name.clone(), summary.baselines)).collect()
}

fn describe(bad: &BadFrame) -> String {
    format!("{} frame {}: {}", bad.drive, bad.frame, bad.problem)
}

/// What a reader may miss in the table.
pub fn report_gaps(entry: &Entry, terminal: &Terminal) {
    for (name, system) in entry.evaluation.systems.iter() {
        if system.baselines.is_none() {
            note(terminal.quiet, &format!("no constant baseline for `{name}`: nothing was fitted to it"));
        }
    }
    for system in &entry.table.systems {
        for (c, component) in Conventions::COMPONENTS.iter().enumerate() {
            if !system.is_truth() && system.rows.iter().all(|row| row.error[c] == 0.0) {
                let text = format!(
                    "`{}` has no errors in {component}: baselines fitted to such have no likelihood",
                    system.name
                );
                note(terminal.quiet, &text);
            }
        }
        let (pairs, stated) = (system.rows.len(), system.rows.iter().filter(|row| row.stated.is_some()).count());
        if stated > 0 && stated < pairs {
            let name = &system.name;
            let text =
                format!("`{name}` states the covariance of {stated} of {pairs} pairs only: they are not evaluated");
            note(terminal.quiet, &text);
        }
    }
}

/// That no result is written over the data.
///
/// # Errors
/// One would be.
fn spare_data(arguments: &EvalArguments) -> anyhow::Result<()> {
    let of_run = arguments.run.as_deref().map(|run| RunFolder::at(run).config_path());
    let Some(path) = arguments.config.clone().or(of_run) else { return Ok(()) };
    let config = arguments.overrides.load(&path)?;
    // Data that are not there yet, or cannot be read, are told of where they are evaluated.
    let Ok(dataset) = Dataset::load(&config.pairs(), PairScope::Poses) else { return Ok(()) };
    let files = dataset.files(&config.pairs());
    Ok(arguments.output.require_apart(&files.iter().map(PathBuf::as_path).collect::<Vec<_>>())?)
}

/// The baselines, fitted to the training split, on another one; poses alone.
fn evaluate_baselines(config: Config, path: &Path, split: SplitName) -> anyhow::Result<Entry> {
    let (dataset, fitted) = fit_baselines(&config, split)?;
    let table = PairTable::from_split(dataset.require(split)?, &dataset, config.data.error_frame);
    let origin = Origin::new(path.display().to_string(), None, split.name());
    let evaluation = evaluate_table(&table, &fitted, origin)?;
    Ok(Entry { name: config.name, evaluation, table, folder: None })
}

/// The data of a configuration, poses alone, and the baselines fitted to its training split.
pub fn fit_baselines(config: &Config, split: SplitName) -> Result<(Dataset, Vec<(String, Baselines)>), Error> {
    let mut config = config.clone();
    if split != SplitName::Validation {
        // A baseline has no epochs to choose from: it learns from what a training would hold out.
        config.data.validation_fraction = 0.0;
    }
    let dataset = Dataset::load(&config.pairs(), PairScope::Poses)?;
    dataset.require(SplitName::Train)?;
    let fitted = baselines_of(&dataset);
    Ok((dataset, fitted))
}

/// The baselines of each system that has training pairs.
pub fn baselines_of(dataset: &Dataset) -> Vec<(String, Baselines)> {
    let systems = dataset.systems.iter().enumerate().map(|(index, name)| (name, dataset.train.pairs_of(index)));
    systems
        .filter(|(_, pairs)| !pairs.is_empty())
        .map(|(name, pairs)| (name.clone(), Baselines::of_pairs(pairs)))
        .collect()
}

/// Predictions that another program made.
fn evaluate_file(pairs: &Path, fit: Option<&Path>, frame: ErrorFrame) -> anyhow::Result<Entry> {
    let table = read_pairs(pairs, frame)?;
    if table.systems.iter().flat_map(|system| &system.rows).all(|row| row.covariance.is_none()) {
        let expected = "variance_x, variance_y, variance_z, variance_roll, variance_pitch, variance_yaw";
        return Err(Error::malformed(pairs, Place::Line(1), "no predicted variances", expected).into());
    }
    let fitted = match fit {
        None => Vec::new(),
        Some(path) => {
            let training = read_pairs(path, frame)?;
            training.systems.iter().map(|system| (system.name.clone(), Baselines::of_system(system))).collect()
        }
    };
    let mut name = pairs.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    if Method::is_taken(&name) {
        // A file called `constant` is not the constant baseline.
        name.insert_str(0, "predicted_");
    }
    let evaluation =
        evaluate_table(&table, &fitted, Origin::new(pairs.display().to_string(), Some(name.clone()), "given"))?;
    Ok(Entry { name, evaluation, table, folder: None })
}
