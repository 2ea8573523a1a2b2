//! `relcov fuse`: several systems and absolute fixes to one trajectory.

mod arguments;
mod files;
mod measured;
mod reach;

use std::path::Path;

use anyhow::Context;

use super::output::make_folder;
use super::progress::{Progress, note};
use super::terminal::{Terminal, print_result};
use crate::error::{Error, Result};
use crate::evaluation::Method;
use crate::export::fused_trajectory;
use crate::files::{extension, fill_template, read_text, require_slots, write_atomically};
use crate::fusion::{Fix, FusedTrajectory, Odometry, SimulatedFixes, TrajectoryScores, fuse, parse_fixes};
use crate::recordings::Trajectory;
use crate::report::figures::{DrawnTrajectory, FusedDrive, draw_fusion, to_png};
use crate::report::{FusionRow, fusion_table};
use files::fuse_files;
use measured::{available, chosen_systems, drives_of, odometry_of, predicted, true_trajectory, without_model};
use reach::reached;

pub use arguments::FuseArguments;

/// What trained predictions are called.
const RELCOV: &str = "relcov";

/// Most drives in a picture.
const MOST_DRAWN: usize = 4;

pub fn run(arguments: &FuseArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if arguments.odometry.is_empty() { fuse_drives(arguments, terminal) } else { fuse_files(arguments, terminal) }
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
