//! `relcov inspect`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clap::Args;
use comfy_table::{CellAlignment, Table, presets};

use super::output::require_png;
use super::terminal::print_result;
use crate::config::Config;
use crate::depth::{DepthCache, DepthConfig};
use crate::device::open_device;
use crate::evaluation::warp_pair;
use crate::files::{require_apart, write_atomically};
use crate::geometry::{Pinhole, Pose};
use crate::pairs::{Coverage, Dataset, Pair, PairId, PairReader, PairSample, PairScope, SplitName};
use crate::recordings::Recording;
use crate::report::{CONTACT_SHEET_COLUMNS, SheetRow, contact_sheet};
use crate::synthetic::is_rendered;

/// Arguments of `relcov inspect`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov inspect --config configs/kitti_sample.toml
  relcov inspect --config configs/kitti.toml --set data.root=/data/kitti
  relcov inspect --config configs/synthetic.toml --contact-sheet sheet.png

A contact sheet has a row for each measurement of a few pairs: source image, target image, source
warped into the target by the measured pose, validity, their difference, and what direct alignment of
the two images leaves of it. Where poses, depth and calibration are right, little of the difference is
left; where only the pose is wrong, alignment takes it away.")]
pub struct InspectArguments {
    /// The experiment
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Override a configuration key (TOML value or plain text); repeatable
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Draw what the network sees of a few pairs
    #[arg(long, value_name = "PNG")]
    contact_sheet: Option<PathBuf>,
    /// Pairs on the contact sheet, a row for each system
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(1..), requires = "contact_sheet")]
    pairs: u8,
}

pub fn run(arguments: &InspectArguments) -> anyhow::Result<()> {
    arguments.contact_sheet.as_deref().map_or(Ok(()), require_png)?;
    let config = Config::load(&arguments.config, &arguments.set)?;
    if let Some(settings) = config.data.synthetic.as_ref().filter(|settings| !is_rendered(&config.data.root, settings))
    {
        anyhow::bail!(
            "{}: the synthetic data set ({} frames) is not rendered yet, or is another; render it with: relcov synth --config {} and the same --set, if any (train does it by itself)",
            config.data.root.display(),
            settings.drives * settings.frames,
            arguments.config.display()
        );
    }
    let (found, depth_problem) = with_maps_that_are_there(&config);
    let dataset = Dataset::load(&found.pairs(), PairScope::Images)?;
    print_result(&describe(&config, &dataset, depth_problem))?;
    match &arguments.contact_sheet {
        Some(path) => {
            let read = dataset.files(&found.pairs());
            require_apart(path, &read.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
            draw_contact_sheet(path, usize::from(arguments.pairs), &found, &dataset)
        }
        None => Ok(()),
    }
}

/// Pairs spread over all splits, seen with the pose of every system that measured them.
fn draw_contact_sheet(path: &Path, pairs: usize, config: &Config, dataset: &Dataset) -> anyhow::Result<()> {
    let splits = [SplitName::Train, SplitName::Validation, SplitName::Test].map(|name| dataset.split(name));
    let mut measured: BTreeMap<PairId, Vec<&Pair>> = BTreeMap::new();
    splits.iter().flat_map(|split| &split.pairs).for_each(|pair| measured.entry(pair.id).or_default().push(pair));
    anyhow::ensure!(!measured.is_empty(), "no pair has images and depth: there is nothing to draw");
    let reader = PairReader::new(&config.pairs(), dataset, SplitName::Test);
    let device = open_device(&config.device)?;
    let (mut rows, mut legend) = (Vec::new(), String::new());
    let count = measured.len();
    let pairs = pairs.min(count);
    for pair in (0..pairs).filter_map(|row| measured.values().nth((2 * row + 1) * count / (2 * pairs))).flatten() {
        let Some(sample) = reader.read(pair)? else { continue };
        let warped = warp_pair(&sample, &device)?;
        let PairId { drive, source, target } = pair.id;
        let difference =
            warped.mean_difference.map_or("no valid pixel".to_owned(), |levels| format!("{levels:.1} grey levels"));
        let evidence = sample.align(&Pose::identity());
        let aligned = match evidence.no_verdict {
            Some(_) => None,
            None => {
                let aligned_pose = Pose::exp(&-evidence.finest().error) * sample.source_from_target;
                Some(warp_pair(&PairSample { source_from_target: aligned_pose, ..sample.clone() }, &device)?)
            }
        };
        let after = match (evidence.no_verdict, aligned.as_ref().and_then(|aligned| aligned.mean_difference)) {
            (Some(none), _) => format!("no verdict: {}", none.reason()),
            (None, Some(levels)) => format!("{levels:.1} after alignment"),
            (None, None) => "no valid pixel after alignment".to_owned(),
        };
        legend += &format!(
            "  row {}: {} frames {source} and {target}, {}: mean difference {difference}, {after}\n",
            rows.len() + 1,
            dataset.drives[drive].name,
            dataset.systems[pair.system]
        );
        rows.push(SheetRow { sample, warped, aligned });
    }
    anyhow::ensure!(!rows.is_empty(), "none of the chosen pairs can be read; the warnings above say why");
    write_atomically(path, &contact_sheet(&rows))?;
    print_result(&format!("{}: columns: {}\n{legend}", path.display(), CONTACT_SHEET_COLUMNS.join(" | ")))
}

/// Where a network's depth is asked for: its cache taken for files, so that what is there is counted, and what is
/// wrong with it.
fn with_maps_that_are_there(config: &Config) -> (Config, Option<String>) {
    let DepthConfig::Monodepth2(network) = &config.depth else { return (config.clone(), None) };
    let cache = DepthCache::of(network);
    let depth = DepthConfig::Files { path: cache.map_template() };
    (Config { depth, ..config.clone() }, cache.require(network, &[]).err().map(|error| error.to_string()))
}

fn describe(config: &Config, dataset: &Dataset, depth_problem: Option<String>) -> String {
    let place = config.data.manifest.as_ref().unwrap_or(&dataset.root);
    let layouts: BTreeSet<&str> = dataset.drives.iter().map(|drive| drive.layout.name()).collect();
    let layouts = layouts.into_iter().collect::<Vec<_>>().join(", ");
    let mut text = format!("data: {} ({layouts})\n{}\n\n", place.display(), coverage_table(dataset));
    text += &cameras(dataset);
    for name in [SplitName::Train, SplitName::Validation, SplitName::Test] {
        text += &format!("{}\n", summary(dataset, name));
    }
    text += &format!(
        "mini-batch: {} pairs = {}\n",
        config.training.batch,
        config
            .systems
            .iter()
            .zip(config.pairs_per_batch())
            .map(|(system, pairs)| format!("{pairs} {}", system.name))
            .collect::<Vec<_>>()
            .join(" + ")
    );
    let problems: Vec<String> = problems(dataset).into_iter().chain(depth_problem).collect();
    if problems.is_empty() {
        text += "problems: none\n";
    } else {
        text += &format!("problems: {}\n", problems.len());
        problems.iter().for_each(|problem| text += &format!("  {problem}\n"));
    }
    text
}

/// The cameras of the images as they are read, and whose they are.
fn cameras(dataset: &Dataset) -> String {
    let mut drives: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for Recording { name, calibration, lens, .. } in &dataset.drives {
        let Pinhole { fx, fy, cx, cy, width, height } = calibration.camera;
        let undistorted = if lens.is_some() { ", undistorted" } else { "" };
        let camera = format!("{width}x{height} px, fx {fx:.1} fy {fy:.1} cx {cx:.1} cy {cy:.1}{undistorted}");
        drives.entry(camera).or_default().push(name);
    }
    drives.into_iter().map(|(camera, drives)| format!("camera: {camera}: {}\n", drives.join(", "))).collect()
}

fn coverage_table(dataset: &Dataset) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    let columns = [
        "split",
        "drive",
        "frames",
        "true poses",
        "images",
        "right",
        "scans",
        "pose pairs",
        "image pairs",
        "with depth",
    ];
    let measured = dataset.systems.iter().map(|system| format!("{system} measured"));
    table.set_header(columns.map(str::to_owned).into_iter().chain(measured));
    for coverage in &dataset.coverage {
        let drive = &dataset.drives[coverage.drive];
        let frames = coverage.frames.map_or("all".to_owned(), |[first, end]| format!("{first}..{end}"));
        let counts = [
            coverage.true_poses,
            coverage.images,
            coverage.right_images,
            coverage.scans,
            coverage.pose_pairs,
            coverage.image_pairs,
            coverage.depth_pairs,
        ];
        let cells = [coverage.split.name().to_owned(), drive.name.clone(), frames];
        let counts = counts.iter().chain(&coverage.measured_pairs).map(usize::to_string);
        table.add_row(cells.into_iter().chain(counts));
    }
    for column in table.column_iter_mut().skip(3) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

fn summary(dataset: &Dataset, name: SplitName) -> String {
    let of_split: Vec<&Coverage> = dataset.coverage.iter().filter(|coverage| coverage.split == name).collect();
    let pose_pairs: usize = of_split.iter().map(|coverage| coverage.pose_pairs).sum();
    let split = dataset.split(name);
    let usable: Vec<String> = dataset
        .systems
        .iter()
        .zip(&split.systems)
        .enumerate()
        .map(|(index, (system, range))| {
            let rms = split.mean_squared_error(index).map(f64::sqrt);
            let rms: Vec<String> = rms.iter().map(|value| format!("{value:.1e}")).collect();
            format!("{} {system} (RMS error {} m, rad)", range.len(), rms.join(" "))
        })
        .collect();
    let origin = if of_split.is_empty() && !split.pairs.is_empty() { " (held out of the training drives)" } else { "" };
    format!("{}: {pose_pairs} pose pairs{origin}; usable with images and depth: {}", name.name(), usable.join(", "))
}

fn problems(dataset: &Dataset) -> Vec<String> {
    let missing = dataset.coverage.iter().flat_map(|coverage| {
        coverage.missing_files.iter().zip(&dataset.systems).filter_map(|(path, system)| {
            let drive = &dataset.drives[coverage.drive].name;
            path.as_ref()
                .map(|path| format!("{drive}: no measurements of `{system}`: {} does not exist", path.display()))
        })
    });
    let unreadable = dataset
        .drives
        .iter()
        .flat_map(|drive| drive.problems.iter().chain(&drive.time_problems).chain(&drive.remarks).cloned());
    let name = |coverage: &Coverage| dataset.drives[coverage.drive].name.clone();
    let empty = dataset.coverage.iter().filter_map(|coverage| {
        let Coverage { pose_pairs, image_pairs, depth_pairs, .. } = *coverage;
        let drive = name(coverage);
        match (pose_pairs, image_pairs, depth_pairs) {
            (0, ..) => Some(format!("{drive}: no pairs of true poses")),
            (_, 0, _) => Some(format!("{drive}: no image pairs, so none of its {pose_pairs} pose pairs can be used")),
            (.., 0) => {
                let missing = coverage.missing_depth.as_ref();
                let looked = missing.map_or(String::new(), |path| format!(" (not found: {})", path.display()));
                Some(format!("{drive}: no depth{looked}, so none of its {image_pairs} image pairs can be used"))
            }
            _ => None,
        }
    });
    let gap = || match dataset.gaps.as_slice() {
        [] => String::new(),
        gaps => format!(" {gaps:?} frames apart (data.gap)"),
    };
    let unmeasured = dataset.coverage.iter().flat_map(|coverage| {
        let counts = coverage.measured_pairs.iter().zip(&coverage.missing_files).zip(&dataset.systems);
        let empty = counts.filter(|((measured, missing), _)| **measured == 0 && missing.is_none());
        empty
            .map(move |(_, system)| format!("{}: `{system}` measured no pair with true poses{}", name(coverage), gap()))
    });
    let absent = dataset.drives.iter().filter(|drive| drive.listed.is_some()).filter_map(|drive| {
        let absent: Vec<_> = drive.images.values().filter(|path| !path.is_file()).collect();
        let first = absent.first()?.display();
        Some(format!("{}: {} of its images are not there, the first: {first}", drive.name, absent.len()))
    });
    missing.chain(absent).chain(unreadable).chain(empty).chain(unmeasured).collect()
}
