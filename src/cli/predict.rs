//! `relcov predict`: covariances of new measurements.

mod arguments;
mod inputs;
mod sink;
mod stream;
mod verdicts;

use std::collections::BTreeSet;
use std::path::PathBuf;

use super::choices::FrameArgument;
use super::progress::{Progress, note};
use super::synth;
use super::terminal::Terminal;
use crate::config::Config;
use crate::depth::{DepthCache, DepthConfig, DepthEstimator, Present, precompute};
use crate::device::{device_name, open_device};
use crate::error::Error;
use crate::export::{Format, MeasuredMotions};
use crate::pairs::{Dataset, PairScope, Split, SplitName};
use crate::predict::Model;
use crate::training::RunFolder;
use inputs::{lenient, of_drive, of_manifest, with_system};
use sink::Sink;
use stream::stream;
use verdicts::describe_verdicts;

pub use arguments::PredictArguments;

pub fn run(arguments: &PredictArguments, terminal: &Terminal) -> anyhow::Result<()> {
    arguments.format.check(&arguments.options())?;
    if arguments.measurement_frame.is_some() && arguments.drive.is_none() && arguments.manifest.is_none() {
        let problem =
            "--measurement-frame is for --drive and --manifest; a configuration says the frame of each system";
        return Err(Error::Data(problem.to_owned()).into());
    }
    arguments.overrides.refuse_model_keys()?;
    let run = RunFolder::open(&arguments.run)?;
    let manifest = run.manifest()?;
    arguments.check_model(&manifest)?;
    let other_data = arguments.stream || arguments.drive.is_some() || arguments.manifest.is_some();
    let config = match other_data {
        true => arguments.overrides.load_for_other_data(&run, &manifest)?,
        false => arguments.overrides.load_for_run(arguments.config.as_deref(), &run, &manifest)?,
    };
    let device = open_device(&config.device)?;
    let model = Model::load(&arguments.run, &device)?;
    if arguments.stream {
        return stream(arguments, &config, &model);
    }
    note(terminal.quiet, &format!("device: {}", device_name(&device)));
    let config = lenient(arguments, config);
    let (config, split) = match (&arguments.drive, &arguments.manifest) {
        (Some(drive), _) => (of_drive(arguments, config, drive)?, SplitName::Test),
        (_, Some(manifest)) => (of_manifest(arguments, config, manifest)?, SplitName::Test),
        (None, None) => {
            synth::make_if_asked(&config, terminal)?;
            (config, arguments.split.name())
        }
    };
    let config = with_system(arguments, config)?;
    make_depth_maps(&config, split, &device, terminal)?;
    let dataset = Dataset::load(&config.pairs(), PairScope::Measured)?;
    let pairs = dataset.require(split)?;
    let owners: BTreeSet<(usize, usize)> = pairs.pairs.iter().map(|pair| (pair.system, pair.id.drive)).collect();
    let names = |&(system, drive): &(usize, usize)| (&*dataset.systems[system], &*dataset.drives[drive].name);
    let sink = Sink::new(arguments, &files_read(arguments, &config, &dataset), owners.iter().map(names))?;
    let frame = arguments.frame.map(FrameArgument::frame).or(arguments.format.usual_frame());
    let frame = frame.unwrap_or(model.error_frame());
    arguments.format.check_frame(frame)?;
    let mut progress = Progress::new(terminal.quiet, "predicting", 0, pairs.pairs.len());
    let begin = std::time::Instant::now();
    let predicted = model.predict_measurements(&config, &dataset, pairs, frame, &mut |done| {
        progress.set(done, &format!("pairs, {:.1} pairs/s", done as f64 / begin.elapsed().as_secs_f64()));
        Ok(())
    })?;
    drop(progress);
    let count: usize = predicted.iter().map(|measured| measured.motions.len()).sum();
    if count == 0 {
        return Err(Error::Data("not one pair could be read; the warnings above say why".to_owned()).into());
    }
    warn_of_missing_times(arguments.format, &predicted, &dataset);
    sink.write(&predicted, terminal)?;
    let rate = count as f64 / begin.elapsed().as_secs_f64();
    let (gaps, verdicts) = (describe_gaps(&dataset, pairs, count), describe_verdicts(&predicted, arguments.poses()));
    note(terminal.quiet, &format!("{count} covariances, {rate:.1} a second{gaps}{verdicts}"));
    Ok(())
}

/// All that predictions are made of.
fn files_read(arguments: &PredictArguments, config: &Config, dataset: &Dataset) -> Vec<PathBuf> {
    let named = [&arguments.measurements, &arguments.manifest, &arguments.config].into_iter().flatten().cloned();
    named.chain(RunFolder::at(&arguments.run).files()).chain(dataset.files(&config.pairs())).collect()
}

/// Says what stands in place of times that are not known, in formats that have them.
fn warn_of_missing_times(format: Format, predicted: &[MeasuredMotions], dataset: &Dataset) {
    let instead = match format {
        Format::Ros => "their stamps are 0",
        Format::Tum => "t is the frame",
        _ => return,
    };
    for MeasuredMotions { drive, motions, .. } in predicted {
        let untimed = motions.iter().filter(|motion| motion.times.is_none()).count();
        let missing = dataset.drives.iter().find(|known| known.name == *drive).map_or("", |drive| drive.layout.times());
        if untimed > 0 {
            let count = motions.len();
            let text = format!("warning: {drive}: {untimed} of {count} motions have no times ({missing}); {instead}");
            note(false, &text);
        }
    }
}

/// Which measurements got no covariance, and why.
fn describe_gaps(dataset: &Dataset, split: &Split, predicted: usize) -> String {
    let of_split = || dataset.coverage.iter().filter(|coverage| coverage.split == split.name);
    let measured: usize = of_split().flat_map(|coverage| &coverage.measured_pairs).sum();
    // Of training drives some pairs may be held out, which lack nothing.
    let lacking = if split.name == SplitName::Test { measured.saturating_sub(split.pairs.len()) } else { 0 };
    let missing = of_split().find_map(|coverage| coverage.missing_depth.as_ref());
    let missing = missing.map_or(String::new(), |path| format!(" (not found: {}, …)", path.display()));
    let unusable = (split.pairs.len() - predicted, "could not be used, as said above".to_owned());
    let gaps = [unusable, (lacking, format!("have no images or no depth{missing}"))];
    gaps.iter().filter(|(pairs, _)| *pairs > 0).map(|(pairs, why)| format!("; {pairs} {why}")).collect()
}

/// Makes the maps that a depth network owes to the pairs, where depth comes from one.
fn make_depth_maps(
    config: &Config,
    split: SplitName,
    device: &burn::tensor::Device,
    terminal: &Terminal,
) -> anyhow::Result<()> {
    let DepthConfig::Monodepth2(network) = &config.depth else { return Ok(()) };
    let without = Config { depth: DepthConfig::default(), ..config.clone() };
    let dataset = Dataset::load(&without.pairs(), PairScope::Measured)?;
    let targets = dataset.require(split)?.pairs.iter().map(|pair| (pair.id.drive, pair.id.target));
    let frames: Vec<_> = targets.collect::<BTreeSet<_>>().into_iter().collect();
    let estimator = DepthEstimator::load(&network.weights, device)?;
    let mut progress: Option<Progress> = None;
    let bad = config.data.max_bad_fraction;
    let summary = precompute(&estimator, network, &dataset.drives, &frames, bad, Present::Keep, &mut |done, total| {
        progress.get_or_insert_with(|| Progress::new(terminal.quiet, "depth", 0, total)).set(done, "frames");
        Ok(())
    })?;
    if summary.made > 0 {
        let folder = DepthCache::of(network).folder().display().to_string();
        note(terminal.quiet, &format!("made {} depth maps in {folder}", summary.made));
    }
    Ok(())
}
