//! A tiny world, rendered, aligned and learned from: the main job in seconds.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Context;
use burn::tensor::Device;
use nalgebra::Vector6;

use super::finding::{Finding, Say};
use crate::cli::exit_codes::INTERRUPTED;
use crate::config::Config;
use crate::device::device_name;
use crate::error::{Error, Result};
use crate::pairs::{Dataset, PairReader, PairScope, SplitName};
use crate::predict::Model;
use crate::synthetic::{Replace, record};
use crate::training::{Event, Learner};

/// Two short drives; Table I beside the evidence.
const EXPERIMENT: &str = include_str!("trial.toml");

/// A step of the trial: how it went.
type Step = fn(&Config, &Device) -> Result<Finding>;

/// Each step tells how it went; the first that fails ends the trial.
pub fn run(device: &Device, say: Say) -> anyhow::Result<()> {
    let elsewhere = "point TMPDIR to a folder that can be written and has 200 MB";
    let folder = match tempfile::tempdir() {
        Ok(folder) => folder,
        Err(error) => return say("trial", Finding::wrong(format!("no temporary folder: {error}"), elsewhere)),
    };
    clear_on_ctrl_c(folder.path())?;
    let steps: [(&str, Step); 3] = [("rendering", render), ("alignment", align), ("training", train)];
    let config = load(folder.path())?;
    for (topic, step) in steps {
        let finding = step(&config, device).unwrap_or_else(|error| match error {
            Error::Io { .. } => Finding::wrong(error.to_string(), elsewhere),
            error => Finding::wrong(error.to_string(), "try another --device; if it stays, report it as an issue"),
        });
        let ends = matches!(finding, Finding::Wrong { .. });
        say(topic, finding)?;
        if ends {
            break;
        }
    }
    Ok(())
}

fn clear_on_ctrl_c(folder: &Path) -> anyhow::Result<()> {
    let folder = folder.to_owned();
    ctrlc::set_handler(move || {
        // What cannot be removed is left to the system.
        let _ = std::fs::remove_dir_all(&folder);
        std::process::exit(i32::from(INTERRUPTED));
    })
    .context("cannot listen for Ctrl-C")
}

fn load(folder: &Path) -> Result<Config> {
    let path = folder.join("trial.toml");
    std::fs::write(&path, EXPERIMENT).map_err(Error::io("write", &path))?;
    Config::load(&path, &[])
}

fn render(config: &Config, _: &Device) -> Result<Finding> {
    let begin = Instant::now();
    let settings = config.data.synthetic.as_ref().expect("the trial renders its world");
    record(&config.data.root, settings, Replace::Never, &mut |_| Ok(()))?;
    let frames = settings.drives * settings.frames;
    Ok(Finding::Ok(format!("{frames} stereo frames, {:.0} a second", frames as f64 / begin.elapsed().as_secs_f64())))
}

/// Of the errors of visual odometry, alignment must find most.
fn align(config: &Config, _: &Device) -> Result<Finding> {
    let dataset = Dataset::load(&config.pairs(), PairScope::Images)?;
    let split = dataset.require(SplitName::Train)?;
    let reader = PairReader::new(&config.pairs(), &dataset, SplitName::Train);
    let (mut before, mut after, mut pairs, mut seconds) = (Vector6::zeros(), Vector6::zeros(), 0, 0.0);
    for pair in split.pairs_of(0) {
        let Some(sample) = reader.read(pair)? else { continue };
        let begin = Instant::now();
        let (estimate, _) = sample.align(&pair.errors_from_camera).judged();
        seconds += begin.elapsed().as_secs_f64();
        before += pair.error.component_mul(&pair.error);
        after += (pair.error - estimate).map(|left| left * left);
        pairs += 1;
    }
    // The median component: sizes differ by orders of magnitude.
    let mut left: Vec<f64> = after.component_div(&before).iter().map(|ratio| ratio.sqrt()).collect();
    left.sort_by(f64::total_cmp);
    let left = left[3];
    let text = format!("leaves {left:.2} of a measurement's error, {:.1} ms a pair", 1e3 * seconds / f64::from(pairs));
    Ok(match left < 0.5 {
        true => Finding::Ok(text),
        false => Finding::wrong(text, "expected less than 0.5: report this processor as an issue"),
    })
}

/// Losses must fall, and the kept model must load.
fn train(config: &Config, device: &Device) -> Result<Finding> {
    let dataset = Arc::new(Dataset::load(&config.pairs(), PairScope::Images)?);
    let mut learner = Learner::start(config.clone(), dataset, device, false)?;
    let (mut losses, mut pairs_per_second) = (Vec::new(), 0.0);
    learner.train(&mut |event| {
        if let Event::Epoch { row, .. } = event {
            losses.extend(row.training_loss[0]);
            pairs_per_second = row.pairs_per_second;
        }
    })?;
    let run = learner.run().path().to_owned();
    drop(learner);
    Model::load(run, device)?;
    let (first, last) = (losses.first().copied().unwrap_or(f64::NAN), losses.last().copied().unwrap_or(f64::NAN));
    let text = format!(
        "on {}: loss {first:.1}, after {} epochs {last:.1}; {pairs_per_second:.0} pairs a second",
        device_name(device),
        losses.len()
    );
    Ok(match last < first {
        true => Finding::Ok(text),
        false => Finding::wrong(text, "expected a falling loss: try another --device, and report this machine"),
    })
}
