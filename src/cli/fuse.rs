//! `relcov fuse`: several systems and absolute fixes to one trajectory.

mod files;
mod measured;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{ArgGroup, Args};

use super::output::make_folder;
use super::progress::{Progress, note};
use super::{Overrides, SplitArgument, Terminal, print_result};
use crate::error::{Error, Result};
use crate::evaluation::Method;
use crate::export::fused_trajectory;
use crate::files::{extension, fill_template, read_text, require_slots, write_atomically};
use crate::fusion::{DEVIATIONS, Fix, FusedTrajectory, Odometry, SimulatedFixes, TrajectoryScores, fuse, parse_fixes};
use crate::recordings::Trajectory;
use crate::report::figures::{DrawnTrajectory, FusedDrive, draw_fusion, to_png};
use crate::report::{FusionRow, TableFormat, fusion_table};
use files::fuse_files;
use measured::{available, chosen_systems, drives_of, odometry_of, predicted, true_trajectory, without_model};

/// What trained predictions are called.
const RELCOV: &str = "relcov";

/// Most drives in a picture.
const MOST_DRAWN: usize = 4;

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
    odometry: Vec<String>,
    /// Give a system of --odometry one covariance: six standard deviations, m and rad
    #[arg(long, value_name = "NAME=X,Y,Z,ROLL,PITCH,YAW", requires = "odometry", conflicts_with_all = ["run", "baselines_only"])]
    constant: Vec<String>,
    /// With --odometry: true poses to score against, KITTI rows of 12, or 13 with the frame
    #[arg(long, value_name = "FILE", requires = "odometry", conflicts_with_all = ["run", "baselines_only"])]
    truth: Option<PathBuf>,
    /// Predict the covariances by a trained model; repeatable: each system takes the first run that learned it
    #[arg(long, value_name = "RUN")]
    run: Vec<PathBuf>,
    /// Take covariances that need no model, fitted to the training drives
    #[arg(long, requires = "config")]
    baselines_only: bool,
    /// The data of another configuration
    #[arg(long, value_name = "FILE", conflicts_with = "odometry")]
    config: Option<PathBuf>,
    /// Which pairs of the configuration
    #[arg(long, value_enum, default_value = "test", conflicts_with = "odometry")]
    split: SplitArgument,
    /// Only these systems of the configuration; repeatable [default: all that have errors]
    #[arg(long, value_name = "NAME", conflicts_with = "odometry")]
    system: Vec<String>,
    /// Absolute fixes; {drive} stands for a drive's name
    #[arg(long, value_name = "FILE")]
    fixes: Option<PathBuf>,
    /// Draw fixes around the truth: a position every N frames, errors of STD metres along each axis
    #[arg(long, value_name = "N,STD", value_parser = parse_simulated, conflicts_with = "fixes")]
    simulate_fixes: Option<(usize, f64)>,
    /// Seed of simulated fixes
    #[arg(long, default_value_t = 0, requires = "simulate_fixes", conflicts_with = "fixes")]
    seed: u64,
    /// Fuse so many times, with other simulated fixes each time, and score all of them
    #[arg(long, default_value_t = 1, requires = "simulate_fixes", conflicts_with = "odometry", value_parser = clap::value_parser!(u64).range(1..10_000))]
    draws: u64,
    /// Write trajectories with their marginal covariances: of --odometry to this file, else into this folder
    #[arg(long, value_name = "PATH")]
    out: Option<PathBuf>,
    /// Draw the trajectories of the first four drives: a .svg or .png file
    #[arg(long, value_name = "FILE", conflicts_with = "odometry")]
    save_plot: Option<PathBuf>,
    /// Form of the table on stdout
    #[arg(long, value_enum, default_value = "text", value_name = "FORM")]
    format: TableFormat,
    #[command(flatten)]
    overrides: Overrides,
}

fn parse_simulated(text: &str) -> Result<(usize, f64), String> {
    let parsed =
        text.split_once(',').and_then(|(every, std)| Some((every.trim().parse().ok()?, std.trim().parse().ok()?)));
    let usable = parsed.filter(|(every, std): &(usize, f64)| *every > 0 && DEVIATIONS.contains(std));
    usable.ok_or_else(|| format!("`{text}` is not N,STD; a fix every 50 frames with half a metre: 50,0.5"))
}

pub fn run(arguments: &FuseArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if arguments.odometry.is_empty() { fuse_drives(arguments, terminal) } else { fuse_files(arguments, terminal) }
}

/// The frames that some motion reaches.
fn reached_frames(odometry: &[Odometry]) -> BTreeSet<usize> {
    let motions = odometry.iter().flat_map(|system| &system.motions);
    motions.flat_map(|motion| [motion.source, motion.target]).collect()
}

/// The true poses of frames that some motion reaches.
fn reached(truth: &Trajectory, odometry: &[Odometry]) -> Trajectory {
    let frames = reached_frames(odometry);
    truth.iter().filter(|(frame, _)| frames.contains(frame)).map(|(&frame, &pose)| (frame, pose)).collect()
}

/// The systems of a configuration, drive by drive, with every kind of covariance that there is.
fn fuse_drives(arguments: &FuseArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if let Some(path) = &arguments.save_plot {
        anyhow::ensure!(
            matches!(extension(path).as_str(), "svg" | "png"),
            "--save-plot {}: the file's name must end in .svg or .png",
            path.display()
        );
        make_folder(path)?;
    }
    if let Some(folder) = &arguments.out {
        std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
    }
    let split = arguments.split.name();
    let measured = match arguments.run.is_empty() {
        false => predicted(arguments, split, terminal)?,
        true => without_model(arguments, split)?,
    };
    let systems = chosen_systems(arguments, &measured.table)?;
    let methods = available(&measured, &systems);
    anyhow::ensure!(!methods.is_empty(), "no kind of covariance is known for all of the systems");
    let names: Vec<&str> = systems.iter().map(|system| system.name.as_str()).collect();
    note(terminal.quiet, &format!("fusing {}", names.join(" + ")));

    let drives: Vec<usize> = drives_of(&measured.dataset, &systems);
    if let Some(fixes) = &arguments.fixes {
        let problem = |problem| Error::Data(format!("--fixes {}: {problem}", fixes.display()));
        require_slots(fixes, &["{drive}"]).map_err(problem)?;
    }
    if let Some(fixes) = arguments.fixes.as_deref().filter(|_| drives.len() > 1) {
        let problem = "one file of fixes for several drives; name it by {drive}";
        anyhow::ensure!(fixes.to_string_lossy().contains("{drive}"), "--fixes {}: {problem}", fixes.display());
    }
    let mut progress = Progress::new(terminal.quiet, "fusing", 0, drives.len() * methods.len());
    let (mut scored, mut drawn, mut trajectories) = (Vec::new(), Vec::new(), Vec::new());
    for drive in drives {
        let name = &measured.dataset.drives[drive].name;
        let truth = true_trajectory(&measured, drive)?;
        let mut picture =
            FusedDrive { drive: name.clone(), truth: Trajectory::new(), fixes: Vec::new(), fused: Vec::new() };
        for method in &methods {
            let odometry = odometry_of(&measured, &systems, *method, drive)?;
            let truth = reached(&truth, &odometry);
            let draws = fuse_draws(arguments, name, drive, &odometry, &truth)
                .with_context(|| format!("{name}, {}", method.name(RELCOV)))?;
            if let Some(folder) = &arguments.out {
                let path = folder.join(format!("{name}_{}.tum", method.name(RELCOV)));
                trajectories.push((path, fused_trajectory(&draws.first)));
            }
            if let Some(placed) = draws.first.in_world_of(&truth).filter(|_| is_drawn(*method)) {
                picture.fused.push(DrawnTrajectory { label: method.name(RELCOV), poses: placed.poses });
            }
            (picture.truth, picture.fixes) = (truth, draws.fixes.iter().map(|fix| fix.position).collect());
            scored.push((name.clone(), *method, draws.scores));
            progress.set(scored.len(), "graphs");
        }
        drawn.push(picture);
        drawn.truncate(MOST_DRAWN);
    }
    drop(progress);
    trajectories.iter().try_for_each(|(path, text)| write_atomically(path, text.as_bytes()))?;
    if let Some(folder) = &arguments.out {
        note(terminal.quiet, &format!("wrote {} trajectories into {}", trajectories.len(), folder.display()));
    }
    print_result(&describe(arguments, &scored, &methods))?;
    arguments.save_plot.as_ref().map_or(Ok(()), |path| save_plot(path, &drawn, terminal))
}

/// What came of fusing the same odometry with several draws of fixes.
struct Draws {
    /// Of each draw.
    scores: Vec<TrajectoryScores>,
    /// Trajectory and fixes of the first.
    first: FusedTrajectory,
    fixes: Vec<Fix>,
}

fn fuse_draws(
    arguments: &FuseArguments,
    drive: &str,
    number: usize,
    odometry: &[Odometry],
    truth: &Trajectory,
) -> anyhow::Result<Draws> {
    let fuse_draw = |draw: u64| -> anyhow::Result<_> {
        let fixes = fixes_of(arguments, drive, number, truth, arguments.seed.wrapping_add(draw))?;
        let fused = fuse(odometry, &fixes)?;
        let scores =
            TrajectoryScores::of(&fused, truth).context("the truth does not know the first frame and another")?;
        Ok((scores, fused, fixes))
    };
    let (scores, first, fixes) = fuse_draw(0)?;
    let others = (1..arguments.draws).map(|draw| Ok(fuse_draw(draw)?.0));
    let scores = std::iter::once(Ok(scores)).chain(others).collect::<anyhow::Result<_>>()?;
    Ok(Draws { scores, first, fixes })
}

fn save_plot(path: &Path, drawn: &[FusedDrive], terminal: &Terminal) -> anyhow::Result<()> {
    let svg = draw_fusion(drawn).map_err(|problem| anyhow::anyhow!("the picture cannot be drawn: {problem}"))?;
    let bytes = if extension(path) == "svg" { svg.into_bytes() } else { to_png(&svg).map_err(anyhow::Error::msg)? };
    write_atomically(path, &bytes)?;
    note(terminal.quiet, &format!("wrote {}", path.display()));
    Ok(())
}

fn fixes_of(arguments: &FuseArguments, drive: &str, number: usize, truth: &Trajectory, seed: u64) -> Result<Vec<Fix>> {
    match (&arguments.fixes, arguments.simulate_fixes) {
        (Some(template), _) => {
            let path = fill_template(template, &[("{drive}", drive)]);
            parse_fixes(&read_text(&path)?, &path)
        }
        (None, Some((every, std_m))) => Ok(SimulatedFixes { every, std_m, seed }.draw(truth, number)),
        (None, None) => Ok(Vec::new()),
    }
}

/// More lines than a reader can follow are left out.
fn is_drawn(method: Method) -> bool {
    !matches!(method, Method::Uncalibrated | Method::ConstantMad | Method::OracleDiagonal)
}

fn describe(
    arguments: &FuseArguments,
    scored: &[(String, Method, Vec<TrajectoryScores>)],
    methods: &[Method],
) -> String {
    let row = |drive: &str, method: Method, scores: &[TrajectoryScores]| FusionRow {
        drive: drive.to_owned(),
        method: method.name(RELCOV),
        scores: TrajectoryScores::mean(scores).expect("every drive has frames"),
        best: !matches!(method, Method::Oracle | Method::OracleDiagonal),
    };
    let mut rows: Vec<FusionRow> = scored.iter().map(|(drive, method, scores)| row(drive, *method, scores)).collect();
    if rows.len() > methods.len() {
        rows.extend(methods.iter().map(|method| {
            let of_method = scored.iter().filter(|(_, other, _)| other == method);
            row("all", *method, &of_method.flat_map(|(.., scores)| scores.clone()).collect::<Vec<_>>())
        }));
    }
    let fixes = match (&arguments.fixes, arguments.simulate_fixes) {
        (Some(path), _) => format!("fixes: {}", path.display()),
        (None, Some((every, std))) => format!(
            "fixes: a position every {every} frames, σ {std} m along each axis, one attitude at the first frame (σ .02 rad); {} draws from seed {}",
            arguments.draws, arguments.seed
        ),
        (None, None) => "no fixes: the first frame is laid onto the truth".to_owned(),
    };
    format!("{fixes}\n{}", fusion_table(&rows, arguments.format))
}
