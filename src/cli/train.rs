//! `relcov train`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clap::Args;

use super::eval::{self, Recalibrate};
use super::exit_codes::INTERRUPTED;
use super::output::DetailArgument;
use super::overrides::Overrides;
use super::progress::{Progress, note};
use super::synth;
use super::terminal::{Terminal, print_result};
use crate::device::{device_name, is_slow_to_train, open_device};
use crate::error::Error;
use crate::pairs::{Dataset, PairScope, SplitName};
use crate::report::{Comparison, Intervals, TableFormat, render_results};
use crate::training::{Event, Learner, RunFolder, StopReason};

/// Arguments of `relcov train`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov train --config configs/kitti_sample.toml
  relcov train --config configs/kitti.toml --set data.root=/data/kitti --device wgpu
  relcov train --config configs/kitti_sample.toml --set training.epochs=2 --set name=trial
  relcov train --resume checkpoints/kitti_sample

Ctrl-C (or SIGTERM) finishes the mini-batch under way and saves it; --resume continues from there
to the same result. Ctrl-C again stops at once.")]
pub struct TrainArguments {
    /// The experiment
    #[arg(long, value_name = "FILE", required_unless_present = "resume", conflicts_with = "resume")]
    config: Option<PathBuf>,
    /// Continue the run in this folder
    #[arg(long, value_name = "RUN")]
    resume: Option<PathBuf>,
    /// Replace the run that the folder holds already
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    #[command(flatten)]
    detail: DetailArgument,
    #[command(flatten)]
    overrides: Overrides,
}

pub fn run(arguments: TrainArguments, terminal: &Terminal) -> anyhow::Result<()> {
    let mut learner = prepare(&arguments, terminal)?;
    let training = Arc::new(AtomicBool::new(true));
    interrupt_on_ctrl_c(learner.interrupt_flag(), training.clone())?;
    let outcome = learner.train(&mut observer(terminal.quiet));
    training.store(false, Ordering::Relaxed);
    let outcome = match outcome {
        Err(Error::Interrupted) => {
            note(
                false,
                &format!("interrupted; continue with: relcov train --resume {}", learner.run().path().display()),
            );
            return Err(Error::Interrupted.into());
        }
        outcome => outcome?,
    };
    let reason = match outcome.reason {
        StopReason::Diverged => "training and evaluation loss diverged",
        StopReason::AllEpochs => "all epochs are done",
    };
    note(
        terminal.quiet,
        &format!("stopped after epoch {}: {reason}; kept the model of epoch {}", outcome.epochs, outcome.best_epoch),
    );
    let bad = learner.bad_frames();
    if !bad.is_empty() {
        note(false, &format!("{} frames could not be read and were left out", bad.len()));
    }
    eval::note_blind_pairs(&learner.blind_pairs());
    let run = learner.run().path().to_owned();
    drop(learner);
    let entry = eval::evaluate_run(&run, None, SplitName::Test, Recalibrate::AsStored, &arguments.overrides, terminal)?;
    eval::report_gaps(&entry, terminal);
    let comparison = Comparison::new(vec![entry])?;
    print_result(&render_results(&comparison, TableFormat::Text, Intervals::Hidden, arguments.detail.detail()))?;
    eval::store_in_run(&comparison, terminal)
}

fn prepare(arguments: &TrainArguments, terminal: &Terminal) -> anyhow::Result<Learner> {
    let resumed = arguments.resume.as_deref().map(RunFolder::open).transpose()?;
    let config_path = match (&resumed, &arguments.config) {
        (Some(run), _) => run.config_path(),
        (None, Some(path)) => path.clone(),
        (None, None) => unreachable!("clap requires one of them"),
    };
    let config = arguments.overrides.load(&config_path)?;
    let device = open_device(&config.device)?;
    note(terminal.quiet, &format!("device: {}", device_name(&device)));
    if is_slow_to_train(&device) {
        tracing::warn!(
            "ndarray trains this network some 40 times slower than flex; --device flex is the fast CPU backend"
        );
    }
    if resumed.is_none() && !arguments.force {
        // Found now rather than after data are rendered and read.
        RunFolder::require_free(&config.run_folder())?;
    }
    synth::make_if_asked(&config, terminal)?;
    let dataset = Arc::new(Dataset::load(&config.pairs(), PairScope::Images)?);
    for split in [&dataset.train, &dataset.validation, &dataset.test] {
        let counts: Vec<String> =
            dataset.systems.iter().zip(&split.systems).map(|(name, range)| format!("{} {name}", range.len())).collect();
        note(terminal.quiet, &format!("{}: {} pairs", split.name.name(), counts.join(", ")));
    }
    // Found now rather than after hours of training.
    dataset.require(SplitName::Test)?;
    Ok(match resumed {
        Some(run) => Learner::resume(config, dataset, &device, run)?,
        None => Learner::start(config, dataset, &device, arguments.force)?,
    })
}

/// The first Ctrl-C (or SIGTERM, as job schedulers send it) saves; the second one, or one after
/// training, stops at once.
pub fn interrupt_on_ctrl_c(flag: Arc<AtomicBool>, training: Arc<AtomicBool>) -> anyhow::Result<()> {
    ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::Relaxed) || !training.load(Ordering::Relaxed) {
            std::process::exit(i32::from(INTERRUPTED));
        }
        note(false, "finishing this mini-batch, then saving (Ctrl-C again stops at once)");
    })
    .context("cannot listen for Ctrl-C")
}

fn observer(quiet: bool) -> impl FnMut(Event) {
    let mut progress: Option<Progress> = None;
    let mut batches_per_epoch = 0;
    move |event| match event {
        Event::Started { batches_done, batches_per_epoch: batches, parameters, constant_loss } => {
            batches_per_epoch = batches;
            let constants: Vec<String> = constant_loss.iter().flatten().map(|loss| format!("{loss:.3}")).collect();
            let from =
                if batches_done > 0 { format!(", continuing after mini-batch {batches_done}") } else { String::new() };
            let weights = match parameters {
                0..1_000_000 => format!("{:.1} thousand", parameters as f64 / 1e3),
                _ => format!("{:.1} M", parameters as f64 / 1e6),
            };
            note(quiet, &format!("{weights} weights, {batches} mini-batches an epoch{from}"));
            note(
                quiet,
                &format!("evaluation loss of the constant baseline: {} nats (the one to beat)", constants.join(", ")),
            );
        }
        Event::Batch { epoch, batch, pairs_per_second, loss } => {
            progress
                .get_or_insert_with(|| Progress::new(quiet, &format!("epoch {epoch}"), batch - 1, batches_per_epoch))
                .set(batch, &format!("loss {loss:.3}, {pairs_per_second:.1} pairs/s"));
            if batch == batches_per_epoch {
                progress = None;
            }
        }
        Event::Evaluation { done, pairs } => {
            progress.get_or_insert_with(|| Progress::new(quiet, "evaluating", 0, pairs)).set(done, "pairs");
        }
        Event::Epoch { row, best } => {
            progress = None;
            let join = |losses: &[Option<f64>]| {
                let texts = losses.iter().map(|loss| loss.map_or("-".to_owned(), |loss| format!("{loss:.3}")));
                texts.collect::<Vec<_>>().join(" / ")
            };
            let (training, evaluation) = (join(&row.training_loss), join(&row.evaluation_loss));
            let mark = if best { ", best so far" } else { "" };
            let floor = if row.at_floor > 0.0 {
                format!(", {:.0} % at the floor", 100.0 * row.at_floor)
            } else {
                String::new()
            };
            note(
                quiet,
                &format!(
                    "epoch {}: training loss {training}, evaluation loss {evaluation}, {:.1} pairs/s{floor}{mark}",
                    row.epoch, row.pairs_per_second
                ),
            );
        }
    }
}
