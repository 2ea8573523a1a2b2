//! `relcov manifest`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::overrides::Overrides;
use super::progress::note;
use super::synth;
use super::terminal::Terminal;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::files::{extension, require_apart, write_atomically};
use crate::pairs::{Dataset, PairScope, Split, manifest_of};
use crate::systems::{SystemSource, measurement_file};

/// Arguments of `relcov manifest`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov manifest --config configs/redkitchen.toml --out pairs.csv
  relcov manifest --config configs/kitti_03.toml --set data.gap=5 --out pairs.csv

The pairs of recordings in any layout, listed as those of one's own robot are (docs/own_data.md): a row for each
measurement of each pair, poses in axes of the camera. A configuration with data.manifest = \"pairs.csv\" reads the same
images, depth maps and poses.")]
pub struct ManifestArguments {
    /// The experiment
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// The manifest to write; files below its folder are named from there, others by their whole paths
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
}

pub fn run(arguments: &ManifestArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if extension(&arguments.out) != "csv" {
        anyhow::bail!("--out {}: the file's name must end in .csv", arguments.out.display());
    }
    let config = arguments.overrides.load(&arguments.config)?;
    synth::make_if_asked(&config, terminal)?;
    let dataset = pairs_that_are_there(&config, terminal)?;
    require_apart(
        &arguments.out,
        &files_read(arguments, &config, &dataset).iter().map(PathBuf::as_path).collect::<Vec<_>>(),
    )?;
    let absolute = std::path::absolute(&arguments.out).map_err(Error::io("write", &arguments.out))?;
    let text = manifest_of(&dataset, &config.depth, absolute.parent().unwrap_or(Path::new("")));
    write_atomically(&arguments.out, text.as_bytes())?;
    let generated = config.systems.iter().filter(|system| matches!(system.source, SystemSource::Perturbation(_)));
    for system in generated {
        note(terminal.quiet, &format!("`{}` is generated; its rows are the first draw", system.name));
    }
    let rows = text.lines().count() - 1;
    note(terminal.quiet, &format!("{}: {rows} rows", arguments.out.display()));
    Ok(())
}

/// The pairs with images and depth, and with the truth where any is known.
fn pairs_that_are_there(config: &Config, terminal: &Terminal) -> Result<Dataset> {
    let count = |dataset: &Dataset| {
        let pairs = |split: &Split| split.pairs.len();
        pairs(&dataset.train) + pairs(&dataset.validation) + pairs(&dataset.test)
    };
    let judged = Dataset::load(&config.pairs(), PairScope::Images)?;
    if count(&judged) > 0 {
        return Ok(judged);
    }
    let measured = Dataset::load(&config.pairs(), PairScope::Measured)?;
    if count(&measured) > 0 {
        note(terminal.quiet, "no pair has a true pose: the columns true_x … true_qw stay empty");
        return Ok(measured);
    }
    Err(Error::Data("no pair has images, depth and a measured pose; relcov inspect shows what is there".to_owned()))
}

/// All that the manifest is made of.
fn files_read(arguments: &ManifestArguments, config: &Config, dataset: &Dataset) -> Vec<PathBuf> {
    let measured = dataset.drives.iter().flat_map(|drive| {
        config.systems.iter().filter_map(|system| measurement_file(system, drive, &config.data.root))
    });
    let recorded = dataset.drives.iter().flat_map(|drive| drive.files().map(Path::to_owned));
    [arguments.config.clone()].into_iter().chain(measured).chain(recorded).collect()
}
