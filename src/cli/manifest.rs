//! `relcov manifest`.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::Args;
use nalgebra::UnitQuaternion;

use super::overrides::Overrides;
use super::progress::note;
use super::synth;
use super::terminal::Terminal;
use crate::config::Config;
use crate::depth::DepthConfig;
use crate::error::Error;
use crate::files::{extension, require_apart, write_atomically};
use crate::pairs::{Dataset, PairScope, manifest_of};
use crate::recordings::camera_axes_from_vehicle;
use crate::systems::SystemSource;

/// Arguments of `relcov manifest`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov manifest --config configs/redkitchen.toml --out pairs.csv
  relcov manifest --config configs/kitti_03.toml --set data.gap=5 --out pairs.csv

The pairs of recordings in any layout, listed as those of one's own robot are (docs/own_data.md): a row for each
measurement of each pair, poses in axes of the camera. A configuration with data.manifest = \"pairs.csv\" reads the same
images and poses from it, and the same depth maps where they lie in files. Where vehicle axes are others than the camera's,
data.camera_from_vehicle says so; what else a manifest cannot say is noted.")]
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
    let dataset = Dataset::load(&config.pairs(), PairScope::Measured)?;
    let read = [vec![arguments.config.clone()], dataset.files(&config.pairs())].concat();
    require_apart(&arguments.out, &read.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
    let absolute = std::path::absolute(&arguments.out).map_err(Error::io("write", &arguments.out))?;
    let splits = [&dataset.train, &dataset.validation, &dataset.test];
    if splits.iter().all(|split| split.pairs.is_empty()) {
        let problem = "no pair has images, depth and a measured pose (a generated one needs a true pose); relcov inspect shows what is there";
        return Err(Error::Data(problem.to_owned()).into());
    }
    let text = manifest_of(&dataset, &config.depth, absolute.parent().unwrap_or(Path::new("")));
    write_atomically(&arguments.out, text.as_bytes())?;
    let rows = text.lines().count() - 1;
    note(terminal.quiet, &format!("{}: {rows} rows", arguments.out.display()));
    what_is_left_out(&config, &dataset).iter().for_each(|line| note(terminal.quiet, line));
    Ok(())
}

/// What the manifest does not say, or says in its own way.
fn what_is_left_out(config: &Config, dataset: &Dataset) -> Vec<String> {
    let mut lines = Vec::new();
    for system in &config.systems {
        if matches!(system.source, SystemSource::Perturbation(_)) {
            lines.push(format!("`{}` is generated; its rows are the first draw", system.name));
        }
    }
    let pairs = || [&dataset.train, &dataset.validation, &dataset.test].into_iter().flat_map(|split| &split.pairs);
    let unjudged = pairs().filter(|pair| !pair.is_judged).count();
    if unjudged > 0 {
        lines.push(format!("no true pose of {unjudged} of {} pairs: their true_… stay empty", pairs().count()));
    }
    let axes = dataset.drives.iter().map(|drive| drive.calibration.camera_from_vehicle);
    let told = axes.filter(|axes| *axes != camera_axes_from_vehicle()).map(|axes| {
        let [x, y, z, w] = UnitQuaternion::from_rotation_matrix(&axes.rotation).coords.into();
        let t = axes.translation;
        format!(
            "its vehicle axes are those of: data.camera_from_vehicle = [{}, {}, {}, {x}, {y}, {z}, {w}]",
            t.x, t.y, t.z
        )
    });
    lines.extend(told.collect::<BTreeSet<_>>());
    let lenses = dataset.drives.iter().any(|drive| drive.lens.is_some());
    match &config.depth {
        DepthConfig::GroundPlane { .. } | DepthConfig::Lidar { .. } => lines.push(
            "this depth lies in no file: the column depth stays empty, and depth.source says what it is made of".to_owned(),
        ),
        DepthConfig::Files { .. } | DepthConfig::Monodepth2(_) if lenses => lines.push(
            "these depth maps are of undistorted images, and the images in the files are distorted: the column depth stays empty where they are"
                .to_owned(),
        ),
        _ => {}
    }
    if dataset.drives.iter().any(|drive| !drive.right_images.is_empty()) {
        lines.push("a manifest has no right images: they are left out".to_owned());
    }
    lines
}
