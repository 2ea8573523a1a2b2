//! Arguments of `relcov fuse`.

use std::path::PathBuf;

use clap::{ArgGroup, Args};

use crate::cli::choices::SplitArgument;
use crate::cli::overrides::Overrides;
use crate::fusion::DEVIATIONS;
use crate::report::TableFormat;

/// Arguments of `relcov fuse`.
#[derive(Args)]
#[command(group(ArgGroup::new("input").required(true).args(["odometry", "run", "baselines_only"])))]
#[command(after_help = "Examples:
  relcov fuse --odometry vo=vo.csv --odometry wheel=wheel.csv --fixes gnss.csv --out fused.tum
  relcov fuse --odometry vo=vo.csv --constant vo=.05,.02,.02,1e-3,1e-3,2e-3 --truth poses.txt
  relcov fuse --run checkpoints/synthetic --config configs/synthetic_fusion.toml --simulate-fixes 100,0.5
  relcov fuse --baselines-only --config configs/kitti.toml --set data.root=../shared/kitti --simulate-fixes 50,1

--odometry reads relative poses with their covariances (the csv of `relcov predict`, or any program's:
source,target,x,y,z,qx,qy,qz,qw and 36 values). --run and --baselines-only fuse the systems of a configuration's
test drives, once with each way to give them covariances, and score all of them against the truth; models with
model.head = posterior also correct the measurements by the errors that the images show (relcov_corrected).
Fixes are CSV: frame,x,y,z,std_x,std_y,std_z, and for whole poses qx,qy,qz,qw,std_roll,std_pitch,std_yaw.
How it works and what it is worth: docs/fusion.md.")]
pub struct FuseArguments {
    /// One system's relative poses; repeatable
    #[arg(long, value_name = "NAME=FILE")]
    pub(super) odometry: Vec<String>,
    /// Give a system of --odometry one covariance: six standard deviations, m and rad
    #[arg(long, value_name = "NAME=X,Y,Z,ROLL,PITCH,YAW", requires = "odometry", conflicts_with_all = ["run", "baselines_only"])]
    pub(super) constant: Vec<String>,
    /// With --odometry: true poses to score against, KITTI rows of 12, or 13 with the frame
    #[arg(long, value_name = "FILE", requires = "odometry", conflicts_with_all = ["run", "baselines_only"])]
    pub(super) truth: Option<PathBuf>,
    /// Predict the covariances by a trained model; repeatable: each system takes the first run that learned it
    #[arg(long, value_name = "RUN")]
    pub(super) run: Vec<PathBuf>,
    /// Take covariances that need no model, fitted to the training drives
    #[arg(long, requires = "config")]
    baselines_only: bool,
    /// The data of another configuration
    #[arg(long, value_name = "FILE", conflicts_with = "odometry")]
    pub(super) config: Option<PathBuf>,
    /// Which pairs of the configuration
    #[arg(long, value_enum, default_value = "test", conflicts_with = "odometry")]
    pub(super) split: SplitArgument,
    /// Only these systems of the configuration; repeatable [default: all that have errors]
    #[arg(long, value_name = "NAME", conflicts_with = "odometry")]
    pub(super) system: Vec<String>,
    /// Absolute fixes; {drive} stands for a drive's name
    #[arg(long, value_name = "FILE")]
    pub(super) fixes: Option<PathBuf>,
    /// Draw fixes around the truth: a position every N frames, errors of STD metres along each axis
    #[arg(long, value_name = "N,STD", value_parser = parse_simulated, conflicts_with = "fixes")]
    pub(super) simulate_fixes: Option<(usize, f64)>,
    /// Seed of simulated fixes
    #[arg(long, default_value_t = 0, requires = "simulate_fixes", conflicts_with = "fixes")]
    pub(super) seed: u64,
    /// Fuse so many times, with other simulated fixes each time, and score all of them
    #[arg(long, default_value_t = 1, requires = "simulate_fixes", conflicts_with = "odometry", value_parser = clap::value_parser!(u64).range(1..10_000))]
    pub(super) draws: u64,
    /// Write trajectories with their marginal covariances: of --odometry to this file, else into this folder
    #[arg(long, value_name = "PATH")]
    pub(super) out: Option<PathBuf>,
    /// Draw the trajectories of the first four drives: a .svg or .png file
    #[arg(long, value_name = "FILE", conflicts_with = "odometry")]
    pub(super) save_plot: Option<PathBuf>,
    /// Form of the table on stdout
    #[arg(long, value_enum, default_value = "text", value_name = "FORM")]
    pub(super) format: TableFormat,
    #[command(flatten)]
    pub(super) overrides: Overrides,
}

fn parse_simulated(text: &str) -> Result<(usize, f64), String> {
    let parsed =
        text.split_once(',').and_then(|(every, std)| Some((every.trim().parse().ok()?, std.trim().parse().ok()?)));
    let usable = parsed.filter(|(every, std): &(usize, f64)| *every > 0 && DEVIATIONS.contains(std));
    usable.ok_or_else(|| format!("`{text}` is not N,STD; a fix every 50 frames with half a metre: 50,0.5"))
}
