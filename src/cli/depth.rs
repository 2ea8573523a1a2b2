//! `relcov depth`.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use comfy_table::{CellAlignment, Table, presets};

use super::output::require_png;
use super::overrides::Overrides;
use super::progress::{Progress, note};
use super::synth;
use super::terminal::{Terminal, print_result};
use crate::config::Config;
use crate::depth::{
    DepthCache, DepthConfig, DepthEstimator, DepthJudge, DepthScores, FrameId, Present, ScaleRule, precompute,
};
use crate::device::{device_name, open_device};
use crate::error::Error;
use crate::evaluation::{SourceScores, compare_depth_sources};
use crate::files::{DEPTH_SLOTS, require_slots, write_atomically};
use crate::pairs::{Dataset, Pair, PairScope};
use crate::report::{CONTACT_SHEET_COLUMNS, SheetRow, contact_sheet};

/// Arguments of `relcov depth`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov depth --config configs/kitti.toml
  relcov depth --config configs/kitti.toml --set depth.weights=weights/stereo_640x192 --set 'depth.scale={fixed=5.4}'
  relcov depth --config configs/kitti_sample.toml --set depth.source=lidar --evaluate
  relcov depth --config configs/kitti_sample.toml --compare lidar --compare ground_plane --contact-sheet sheet.png
  relcov depth --config configs/synthetic.toml --evaluate --truth '{date}/{drive}/depth_02/data/{frame}.png'

Fills the cache of a configuration whose depth.source is monodepth2, with the depth of every target image. What is
there is kept, so an interrupted command goes on where it stopped. train and eval then need neither the network nor
its weights. --evaluate judges any depth source against LiDAR, on the Eigen crop up to 80 m (LiDAR itself at the
network's size, by rings left out); --compare by how well it warps. docs/depth.md tells which source to choose and where weights come from.")]
pub struct DepthArguments {
    /// The experiment
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Remove the maps that are there, and make them anew
    #[arg(long)]
    force: bool,
    /// Judge the depth of the experiment's frames against their LiDAR scans, and print the field's table
    #[arg(long, conflicts_with = "force")]
    evaluate: bool,
    /// Warp the test pairs by their true motion with the depth of each source, and print how well it explains them: ground_plane, lidar, files=PATH, monodepth2=WEIGHTS; repeatable
    #[arg(long, value_name = "SOURCE", conflicts_with_all = ["force", "evaluate"])]
    compare: Vec<String>,
    /// Draw one pair warped with the depth of each source
    #[arg(long, value_name = "PNG", requires = "compare")]
    contact_sheet: Option<PathBuf>,
    /// Judge against depth files (16-bit PNG, metres x 256) in place of scans: a path below data.root with {date}, {drive}, {frame}
    #[arg(long, value_name = "PATH", requires = "evaluate", conflicts_with_all = ["force", "compare"])]
    truth: Option<String>,
    #[command(flatten)]
    overrides: Overrides,
}

pub fn run(arguments: &DepthArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if let Some(truth) = &arguments.truth {
        let problem = |problem| Error::Data(format!("--truth {truth}: {problem}"));
        require_slots(truth.as_ref(), &DEPTH_SLOTS).map_err(problem)?;
    }
    arguments.contact_sheet.as_deref().map_or(Ok(()), require_png)?;
    let config = arguments.overrides.load(&arguments.config)?;
    if arguments.evaluate {
        return evaluate(&config, arguments.truth.as_deref(), terminal);
    }
    if !arguments.compare.is_empty() {
        return compare(&config, &arguments.compare, arguments.contact_sheet.as_deref());
    }
    let DepthConfig::Monodepth2(network) = &config.depth else {
        anyhow::bail!(
            "{}: depth.source is not monodepth2: there is no network to run; such a source needs no cache (--evaluate judges it)",
            arguments.config.display()
        );
    };
    let device = open_device(&config.device)?;
    let estimator = DepthEstimator::load(&network.weights, &device)?;
    synth::make_if_asked(&config, terminal)?;
    let dataset = every_image_pair(&config)?;
    let frames = target_frames(&dataset);
    anyhow::ensure!(!frames.is_empty(), "no pair has images and a true pose: there is no frame to make depth for");
    let cache = DepthCache::of(network);
    let scale = network.scale.unwrap_or(estimator.default_scale);
    note(
        terminal.quiet,
        &format!(
            "device: {}; {} frames, network of {}x{}, {}",
            device_name(&device),
            frames.len(),
            estimator.width,
            estimator.height,
            if scale.needs_lidar() { "metres by LiDAR" } else { "metres by a known factor" }
        ),
    );
    let mut progress: Option<Progress> = None;
    let begin = std::time::Instant::now();
    let present = if arguments.force { Present::Replace } else { Present::Keep };
    let allowed = config.data.max_bad_fraction;
    let summary = precompute(&estimator, network, &dataset.drives, &frames, allowed, present, &mut |done, total| {
        let rate = done as f64 / begin.elapsed().as_secs_f64();
        progress
            .get_or_insert_with(|| Progress::new(terminal.quiet, "depth", 0, total))
            .set(done, &format!("{rate:.1} frames/s"));
        Ok(())
    })?;
    drop(progress);
    if !summary.unreadable.is_empty() {
        note(false, &format!("{} frames could not be read and have no depth map", summary.unreadable.len()));
    }
    print_result(&describe(&cache, &summary, scale))
}

fn describe(cache: &DepthCache, summary: &crate::depth::PrecomputeSummary, scale: ScaleRule) -> String {
    let mut text = format!("{}: {} maps made, {} kept\n", cache.folder().display(), summary.made, summary.kept);
    if scale.needs_lidar() {
        text += &format!(
            "scaled by the frame's own scan: {}; by the sequence's factor: {}\n",
            summary.by_own_scan, summary.by_sequence
        );
        for (drive, factor) in &summary.sequence_factors {
            text += &format!("  {drive}: {factor:.3} m a unit\n");
        }
        for (drive, factor) in summary.borrowed.iter().filter_map(|drive| Some((drive, summary.borrowed_factor?))) {
            text += &format!("  {drive}: {factor:.3} m a unit (no scan: mean of the others)\n");
        }
    }
    text
}

/// All pairs of the experiment's drives that have images and true poses, whatever measured them and whichever of them
/// are held out.
fn every_image_pair(config: &Config) -> anyhow::Result<Dataset> {
    let mut config = config.with_truth_alone();
    config.data.validation_fraction = 0.0;
    Ok(Dataset::load(&config.pairs(), PairScope::Images)?)
}

/// Target frames of all pairs, each once, drive by drive.
fn target_frames(dataset: &Dataset) -> Vec<FrameId> {
    let pairs = [&dataset.train, &dataset.validation, &dataset.test].into_iter().flat_map(|split| &split.pairs);
    let frames: BTreeSet<FrameId> = pairs.map(|Pair { id, .. }| (id.drive, id.target)).collect();
    frames.into_iter().collect()
}

fn evaluate(config: &Config, truth: Option<&str>, terminal: &Terminal) -> anyhow::Result<()> {
    let dataset = Dataset::load(&config.pairs(), PairScope::Images)?;
    let judge = DepthJudge::new(
        &config.depth,
        truth,
        &config.data.root,
        [config.model.width, config.model.height],
        config.data.max_bad_fraction,
    );
    let mut progress: Option<Progress> = None;
    let frames = target_frames(&dataset);
    let judged = judge.scores(&dataset.drives, &frames, &mut |done| {
        progress.get_or_insert_with(|| Progress::new(terminal.quiet, "judging", 0, frames.len())).set(done, "frames");
    })?;
    drop(progress);
    let scores = DepthScores::mean(&judged.scores).with_context(|| {
        format!("none of the {} frames has a true depth to be judged by: {}", frames.len(), judge.truth_name())
    })?;
    let median_scaled = DepthScores::mean(&judged.median_scaled).expect("judged too");
    let mut text = format!(
        "depth of {} of {} frames against {}; {} pixels, {:.1} % of the true ones\n{}\n",
        scores.images,
        frames.len(),
        judge.truth_name(),
        scores.pixels,
        100.0 * scores.pixels as f64 / (scores.pixels + scores.unknown) as f64,
        scores_table(&[("as it is", scores), ("median-scaled", median_scaled)])
    );
    for (count, what) in
        [(judged.without_truth, "no truth"), (judged.unreadable, "an unreadable image, depth or truth")]
    {
        if count > 0 {
            text += &format!("{count} frames have {what}\n");
        }
    }
    print_result(&text)
}

fn compare(config: &Config, names: &[String], sheet: Option<&Path>) -> anyhow::Result<()> {
    let sources = names
        .iter()
        .map(|text| {
            // By its name alone, unless that stands for several.
            let name = |text: &str| text.split('=').next().unwrap_or_default().to_owned();
            let alone = names.iter().filter(|other| name(other) == name(text)).count() == 1;
            Ok((if alone { name(text) } else { text.clone() }, parse_source(config, text)?))
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let comparison = compare_depth_sources(config, &sources, &open_device(&config.device)?)?;
    if let Some(path) = sheet {
        let rows: Vec<SheetRow> =
            comparison.example.into_iter().map(|(sample, warped)| SheetRow { sample, warped, aligned: None }).collect();
        write_atomically(path, &contact_sheet(&rows))?;
        let columns = CONTACT_SHEET_COLUMNS[..5].join(" | ");
        print_result(&format!("{}: a row for each source; columns: {columns}\n", path.display()))?;
    }
    let mut table = numbers_table(["depth", "known", "valid", "difference", "where all are valid"].map(str::to_owned));
    let percent = |share: f64| format!("{:.0} %", 100.0 * share);
    for SourceScores { name, known, valid, difference, common_difference } in &comparison.sources {
        table.add_row([
            name.clone(),
            percent(*known),
            percent(*valid),
            format!("{difference:.2}"),
            format!("{common_difference:.2}"),
        ]);
    }
    let without = format!("{:.2}", comparison.unwarped_difference);
    table.add_row(["no warp".to_owned(), "–".to_owned(), "–".to_owned(), "–".to_owned(), without]);
    print_result(&format!(
        "{} pairs warped by the true motion, {}x{}; mean differences in grey levels; {} of the pixels are valid by all\n{table}\n",
        comparison.pairs,
        config.model.width,
        config.model.height,
        percent(comparison.common),
    ))
}

/// `lidar`, `files=PATH` and the like; a name alone that is the configured source takes its keys from there.
fn parse_source(config: &Config, text: &str) -> anyhow::Result<DepthConfig> {
    let (name, value) = text.split_once('=').map_or((text, None), |(name, value)| (name, Some(value)));
    let mut table = toml::Table::new();
    let configured = toml::Table::try_from(&config.depth)?;
    if value.is_none() && configured.get("source").and_then(toml::Value::as_str) == Some(name) {
        table = configured;
    }
    table.insert("source".to_owned(), name.into());
    let key = match name {
        "files" => Some("path"),
        "monodepth2" => Some("weights"),
        _ => None,
    };
    match (key, value) {
        (Some(key), Some(value)) => {
            table.insert(key.to_owned(), value.into());
        }
        (None, Some(_)) => anyhow::bail!("--compare {text}: `{name}` takes no value"),
        (_, None) => {}
    }
    let depth = table.try_into().map_err(|error: toml::de::Error| {
        anyhow::anyhow!(
            "--compare {text}: {}; expected ground_plane, lidar, files=PATH or monodepth2=WEIGHTS",
            error.message()
        )
    })?;
    let mut config = Config { depth, ..config.clone() };
    config.name_depth_cache();
    config.validate()?;
    Ok(config.depth)
}

fn numbers_table(header: impl IntoIterator<Item = String>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    table.set_header(header);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

fn scores_table(rows: &[(&str, DepthScores)]) -> Table {
    let header = ["depth", "abs_rel", "sq_rel (m)", "rmse (m)", "rmse_log", "d < 1.25", "d < 1.25²", "d < 1.25³"];
    let mut table = numbers_table(header.map(str::to_owned));
    for (name, scores) in rows {
        let DepthScores { abs_rel, sq_rel, rmse, rmse_log, below, .. } = scores;
        let numbers = [*abs_rel, *sq_rel, *rmse, *rmse_log].into_iter().chain(*below);
        table.add_row([(*name).to_owned()].into_iter().chain(numbers.map(|number| format!("{number:.3}"))));
    }
    table
}
