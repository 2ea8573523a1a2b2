//! `relcov eval`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::{Args, ValueEnum};

use super::progress::{Progress, note};
use super::{Overrides, Terminal, print_result, synth};
use crate::data::{Dataset, PairReader, PairScope, SplitName};
use crate::device::{device_name, open_device};
use crate::error::Error;
use crate::evaluation::{MethodName, evaluate_run, perturbation_response, predict_split, write_results};
use crate::report::mde_table;
use crate::training::RunFolder;

/// Arguments of `relcov eval`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov eval --run checkpoints/kitti_sample
  relcov eval --run checkpoints/kitti_sample --set depth.source=lidar
  relcov eval --run checkpoints/kitti --split validation --device wgpu")]
pub struct EvalArguments {
    /// Run folder of a trained model
    #[arg(long, value_name = "RUN")]
    run: PathBuf,
    /// Evaluate on the data of another configuration
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Which pairs
    #[arg(long, value_enum, default_value = "test")]
    split: SplitArgument,
    #[command(flatten)]
    overrides: Overrides,
}

#[derive(Clone, Copy, ValueEnum)]
enum SplitArgument {
    Train,
    Validation,
    Test,
}

pub fn run(arguments: EvalArguments, terminal: &Terminal) -> anyhow::Result<()> {
    let split = match arguments.split {
        SplitArgument::Train => SplitName::Train,
        SplitArgument::Validation => SplitName::Validation,
        SplitArgument::Test => SplitName::Test,
    };
    evaluate(&arguments.run, arguments.config.as_deref(), split, &arguments.overrides, terminal)
}

/// Evaluates a run, writes its results into its folder and prints the table.
pub fn evaluate(
    run_path: &Path,
    config: Option<&Path>,
    split: SplitName,
    overrides: &Overrides,
    terminal: &Terminal,
) -> anyhow::Result<()> {
    let run = RunFolder::open(run_path)?;
    let manifest = run.manifest()?;
    let mut config = overrides.load(config.unwrap_or(&run.config_path()))?;
    let (width, height) = (manifest.architecture.width, manifest.architecture.height);
    (config.model.width, config.model.height) = (width, height);
    if config.data.error_frame != manifest.conventions.error_frame {
        return Err(Error::config(
            "data.error_frame",
            format!(
                "`{}` is not the `{}` this model was trained for; covariances of a diagonal model cannot be compared across frames",
                config.data.error_frame.name(),
                manifest.conventions.error_frame.name()
            ),
        )
        .into());
    }
    let device = open_device(&config.device)?;
    let model = run.load_model(&manifest, &device)?;
    synth::make_if_asked(&config, terminal)?;
    let dataset = Dataset::load(&config, PairScope::Images)?;
    let pairs = dataset.require(split)?;
    let reader = Arc::new(PairReader::new(&config, &dataset, split));

    let mut progress = Progress::new(terminal.quiet, "evaluating", 0, pairs.pairs.len());
    let predictions = predict_split(&model, &reader, pairs, &config.training, &device, &mut |done| {
        progress.set(done, "pairs");
        Ok(())
    })?;
    drop(progress);
    let bad_frames = reader.bad_frames();
    let mut evaluation =
        evaluate_run(&predictions, &dataset, &manifest, run_path, split, device_name(&device), &bad_frames)?;
    evaluation.perturbation_response = perturbation_response(&model, &reader, &dataset, pairs, &manifest, &device)?;
    // The table first: a folder that cannot be written must not cost it.
    print_result(&mde_table(&evaluation))?;
    for (system, results) in &evaluation.systems {
        if results.methods.iter().all(|(name, _)| *name != MethodName::Constant.name()) {
            note(terminal.quiet, &format!("no constant baseline for `{system}`: the run was not trained on it"));
        }
    }
    for (index, system) in dataset.systems.iter().enumerate() {
        let rows: Vec<_> = predictions.iter().filter(|prediction| prediction.system == index).collect();
        let stated = rows.iter().filter(|prediction| prediction.stated_covariance.is_some()).count();
        if stated > 0 && stated < rows.len() {
            let text = format!(
                "`{system}` states the covariance of {stated} of {} pairs only: they are not evaluated",
                rows.len()
            );
            note(terminal.quiet, &text);
        }
    }
    for bad in &bad_frames {
        note(false, &format!("left out: {} frame {}: {}", bad.drive, bad.frame, bad.problem));
    }
    write_results(run.path(), &evaluation, &predictions, &dataset)?;
    note(terminal.quiet, &format!("wrote {} and pairs.csv beside it", run.path().join("evaluation.json").display()));
    Ok(())
}
