//! `relcov synth`, and the data sets that a configuration asks for.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;

use super::progress::{Progress, note};
use super::terminal::{Terminal, print_result};
use crate::config::Config;
use crate::synthetic::{RecordingProgress, Replace, SyntheticSettings, record};

/// Arguments of `relcov synth`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov synth --out data/street
  relcov synth --out data/street --drives 8 --frames 500 --size 512x160 --seed 7
  relcov synth --out data/street --image-noise 2 --shutter 0.01
  relcov synth --config configs/synthetic.toml

The folder has the KITTI raw layout, with depth maps beside the images and measurements of four
systems (vo, wheel, icp, coarse_gnss) with their true covariances. The same settings give the same
bytes on every machine. An interrupted command continues where it stopped.")]
pub struct SynthArguments {
    /// Folder of the data set
    #[arg(long, value_name = "DIR", required_unless_present = "config")]
    out: Option<PathBuf>,
    /// Render what a configuration asks for (data.synthetic), where it asks for it (data.root)
    #[arg(long, value_name = "FILE", conflicts_with_all = ["out", "seed", "drives", "frames", "size", "lidar_steps", "image_noise", "shutter", "exposure_jitter", "vo_pixel_noise", "vo_landmarks"])]
    config: Option<PathBuf>,
    /// Seed of all worlds
    #[arg(long, default_value_t = SyntheticSettings::default().seed)]
    seed: u64,
    /// Number of drives; each is a street of its own
    #[arg(long, default_value_t = SyntheticSettings::default().drives)]
    drives: usize,
    /// Frames of each drive, 10 a second
    #[arg(long, default_value_t = SyntheticSettings::default().frames)]
    frames: usize,
    /// Size of the images, px
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = parse_size, default_value = "512x160")]
    size: [usize; 2],
    /// Steps of each of the LiDAR's 64 beams in a turn; 0 leaves the scans out
    #[arg(long, value_name = "N", default_value_t = SyntheticSettings::default().lidar_steps)]
    lidar_steps: usize,
    /// Standard deviation of pixel noise, grey levels
    #[arg(long, value_name = "LEVELS", default_value_t = SyntheticSettings::default().image_noise)]
    image_noise: f64,
    /// Time the shutter is open, s: above zero, images are blurred by the car's motion
    #[arg(long, value_name = "SECONDS", default_value_t = SyntheticSettings::default().shutter_s)]
    shutter: f64,
    /// Standard deviation of the camera's gain from frame to frame, beside its slow drift
    #[arg(long, value_name = "SHARE", default_value_t = SyntheticSettings::default().exposure_jitter)]
    exposure_jitter: f64,
    /// Standard deviation of the visual odometry's landmarks, px
    #[arg(long, value_name = "PX", default_value_t = SyntheticSettings::default().vo_pixel_noise)]
    vo_pixel_noise: f64,
    /// Most landmarks it follows, of 192 places it looks at
    #[arg(long, value_name = "N", default_value_t = SyntheticSettings::default().vo_landmarks)]
    vo_landmarks: usize,
    /// Override a key of the configuration; repeatable
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "config", conflicts_with = "out")]
    set: Vec<String>,
    /// Replace the synthetic data set that is there
    #[arg(long)]
    force: bool,
}

fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let size = text.split_once('x').and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
    size.ok_or_else(|| format!("`{text}` is no size; write it like 512x160"))
}

pub fn run(arguments: &SynthArguments, terminal: &Terminal) -> anyhow::Result<()> {
    let replace = if arguments.force { Replace::Synthetic } else { Replace::Never };
    let (out, settings) = match (&arguments.config, &arguments.out) {
        (Some(path), _) => {
            let config = Config::load(path, &arguments.set)?;
            let asks_for_none =
                || format!("{}: has no table data.synthetic: there is nothing to render", path.display());
            (config.data.root, config.data.synthetic.with_context(asks_for_none)?)
        }
        (None, Some(out)) => (out.clone(), settings(arguments)),
        (None, None) => unreachable!("clap requires one of them"),
    };
    make(&out, &settings, replace, terminal)?;
    print_result(&format!("{}\n", out.display()))
}

fn settings(arguments: &SynthArguments) -> SyntheticSettings {
    SyntheticSettings {
        seed: arguments.seed,
        drives: arguments.drives,
        frames: arguments.frames,
        size: arguments.size,
        lidar_steps: arguments.lidar_steps,
        image_noise: arguments.image_noise,
        shutter_s: arguments.shutter,
        exposure_jitter: arguments.exposure_jitter,
        vo_pixel_noise: arguments.vo_pixel_noise,
        vo_landmarks: arguments.vo_landmarks,
    }
}

/// Makes the data set that a configuration asks for, if it is not there yet.
pub fn make_if_asked(config: &Config, terminal: &Terminal) -> anyhow::Result<()> {
    let Some(settings) = &config.data.synthetic else { return Ok(()) };
    let root = &config.data.root;
    make(root, settings, Replace::Never, terminal).with_context(|| {
        format!("the configuration asks for a synthetic data set (data.synthetic) at data.root = {}; `relcov synth --config FILE`, with the same --set, renders it; with --force in place of another", root.display())
    })
}

fn make(out: &Path, settings: &SyntheticSettings, replace: Replace, terminal: &Terminal) -> anyhow::Result<()> {
    let begin = std::time::Instant::now();
    let mut progress: Option<Progress> = None;
    let made = record(out, settings, replace, &mut |RecordingProgress { done, frames }| {
        progress
            .get_or_insert_with(|| Progress::new(terminal.quiet, "rendering", 0, frames))
            .set(done, "stereo frames");
        Ok(())
    })?;
    drop(progress);
    if made {
        let SyntheticSettings { drives, frames, size: [width, height], .. } = settings;
        let seconds = begin.elapsed().as_secs_f64();
        note(
            terminal.quiet,
            &format!(
                "made a synthetic data set in {}: {} frames ({drives} x {frames}), {width}x{height}, {seconds:.0} s",
                out.display(),
                drives * frames
            ),
        );
    }
    Ok(())
}
