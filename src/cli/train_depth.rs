//! `relcov train-depth`.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;

use super::overrides::Overrides;
use super::progress::{Progress, note};
use super::synth;
use super::terminal::{Terminal, print_result};
use super::train::interrupt_on_ctrl_c;
use crate::depth::DepthConfig;
use crate::device::{device_name, open_device};
use crate::error::Error;
use crate::training::RunFolder;
use crate::training::depth::{DepthEvent, DepthLearner};

/// Arguments of `relcov train-depth`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov train-depth --config configs/synthetic_depth.toml
  relcov train-depth --config configs/kitti.toml --set data.root=/data/kitti --out weights/own --device wgpu
  relcov train-depth --resume weights/own

Learns depth from images and the true motion between them (truth: GNSS, or a trajectory), by making each image from
its neighbours: no LiDAR, no foreign weights, and metres from the start. Then:

  [depth]
  source = \"monodepth2\"
  weights = \"weights/own\"

and `relcov depth` makes the maps. Ctrl-C saves; --resume goes on.")]
pub struct TrainDepthArguments {
    /// The experiment: its drives, its truth and its table depth_training
    #[arg(long, value_name = "FILE", required_unless_present = "resume", conflicts_with = "resume")]
    config: Option<PathBuf>,
    /// Folder of the weights [default: the configuration's depth.weights, else NAME_depth beside its run]
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Go on with the training in this folder
    #[arg(long, value_name = "DIR")]
    resume: Option<PathBuf>,
    /// Replace the training that the folder holds already
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    #[command(flatten)]
    overrides: Overrides,
}

pub fn run(arguments: &TrainDepthArguments, terminal: &Terminal) -> anyhow::Result<()> {
    let mut learner = prepare(arguments, terminal)?;
    let training = Arc::new(AtomicBool::new(true));
    interrupt_on_ctrl_c(learner.interrupt_flag(), training.clone())?;
    let outcome = learner.train(&mut observer(terminal.quiet));
    training.store(false, Ordering::Relaxed);
    let best = match outcome {
        Err(Error::Interrupted) => {
            let folder = learner.folder().display();
            note(false, &format!("interrupted; continue with: relcov train-depth --resume {folder}"));
            return Err(Error::Interrupted.into());
        }
        outcome => outcome?,
    };
    print_result(&format!(
        "{}: weights of epoch {}, photometric loss {:.4}\n",
        learner.folder().display(),
        best.epoch,
        best.evaluation_loss
    ))
}

fn prepare(arguments: &TrainDepthArguments, terminal: &Terminal) -> anyhow::Result<DepthLearner> {
    let path = match (&arguments.resume, &arguments.config) {
        (Some(folder), _) => RunFolder::at(folder).config_path(),
        (None, Some(path)) => path.clone(),
        (None, None) => unreachable!("clap requires one of them"),
    };
    let config = arguments.overrides.load(&path)?;
    let device = open_device(&config.device)?;
    note(terminal.quiet, &format!("device: {}", device_name(&device)));
    if let Some(folder) = &arguments.resume {
        return Ok(DepthLearner::resume(config, folder, &device)?);
    }
    let out = match (&arguments.out, &config.depth) {
        (Some(out), _) => out.clone(),
        (None, DepthConfig::Monodepth2(network)) => network.weights.clone(),
        (None, _) => config.checkpoints.join(format!("{}_depth", config.name)),
    };
    // Found now rather than after data are rendered and read.
    DepthLearner::require_free(&out, arguments.force)?;
    synth::make_if_asked(&config, terminal)?;
    Ok(DepthLearner::start(config, &out, &device, arguments.force)?)
}

fn observer(quiet: bool) -> impl FnMut(DepthEvent) {
    let mut progress: Option<Progress> = None;
    let mut per_epoch = 0;
    move |event| match event {
        DepthEvent::Started { batches_done, batches_per_epoch, targets, initial_loss } => {
            per_epoch = batches_per_epoch;
            let from =
                if batches_done > 0 { format!(", continuing after mini-batch {batches_done}") } else { String::new() };
            note(quiet, &format!("{targets} target images, {batches_per_epoch} mini-batches an epoch{from}"));
            note(quiet, &format!("photometric loss before the first step: {initial_loss:.4}"));
        }
        DepthEvent::Batch { epoch, batch, loss, targets_per_second } => {
            progress.get_or_insert_with(|| Progress::new(quiet, &format!("epoch {epoch}"), batch - 1, per_epoch)).set(
                batch,
                &loss.map_or("skipped: an unreadable image".to_owned(), |loss| {
                    format!("loss {loss:.4}, {targets_per_second:.1} images/s")
                }),
            );
            if batch == per_epoch {
                progress = None;
            }
        }
        DepthEvent::Epoch { row, best } => {
            progress = None;
            let mark = if best { ", best so far" } else { "" };
            note(
                quiet,
                &format!(
                    "epoch {}: training loss {:.4}, photometric loss {:.4}{mark}",
                    row.epoch, row.training_loss, row.evaluation_loss
                ),
            );
        }
    }
}
