//! Systems in files: one trajectory.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;

use super::arguments::FuseArguments;
use super::reach::{reached, reached_frames};
use crate::cli::output::make_folder;
use crate::cli::progress::note;
use crate::cli::terminal::{Terminal, print_result};
use crate::error::{Error, Result};
use crate::export::fused_trajectory;
use crate::files::{read_text, require_apart, require_slots, write_atomically};
use crate::fusion::{Odometry, SimulatedFixes, TrajectoryScores, fuse, parse_fixes};
use crate::geometry::{Covariance6, ErrorFrame, Tangent};
use crate::recordings::{KittiPoses, Trajectory, parse_kitti_poses};
use crate::report::{FusionRow, fusion_table};
use crate::systems::{
    Joined, RelativePose, Statement, frames_of_rows, parse_bare_relative_poses, parse_relative_poses,
};

/// Systems in files: one trajectory.
pub(super) fn fuse_files(arguments: &FuseArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if !arguments.overrides.set.is_empty() || arguments.overrides.device.is_some() {
        return Err(Error::Data("--set and --device change nothing about --odometry; leave them out".to_owned()).into());
    }
    let mut constants = BTreeMap::new();
    for text in &arguments.constant {
        let (name, covariance) = parse_constant(text)?;
        if constants.insert(name.clone(), covariance).is_some() {
            return Err(Error::Data(format!("--constant {name} is given twice")).into());
        }
    }
    if let Some(out) = &arguments.out {
        require_slots(out, &[]).map_err(|_| {
            Error::Data(format!("--out {}: --odometry gives one trajectory, so nothing fills a slot", out.display()))
        })?;
        let odometry = arguments.odometry.iter().filter_map(|text| Some(Path::new(text.split_once('=')?.1)));
        let others = [&arguments.truth, &arguments.fixes].into_iter().filter_map(|path| path.as_deref());
        require_apart(out, &odometry.chain(others).collect::<Vec<_>>())?;
    }
    let read = arguments.odometry.iter().map(|text| read_odometry(text, &constants)).collect::<Result<Vec<_>>>()?;
    let frames: Vec<ErrorFrame> = read.iter().filter_map(|(_, frame)| *frame).collect();
    if let Some(other) = frames.iter().find(|frame| **frame != frames[0]) {
        let problem = format!(
            "the odometry is of different bodies: {} and {}, as the first lines of the files say; `relcov predict --frame` writes all of them in one",
            frames[0].name(),
            other.name()
        );
        return Err(Error::Data(problem).into());
    }
    if frames.contains(&ErrorFrame::World) {
        let problem = "the odometry is in axes of the world, which turn with respect to the body from motion to motion; `relcov predict --frame vehicle` writes that of the body";
        return Err(Error::Data(problem.to_owned()).into());
    }
    require_distinct(&arguments.odometry)?;
    let odometry: Vec<Odometry> = read.into_iter().map(|(odometry, _)| odometry).collect();
    if let Some(name) = constants.keys().find(|name| odometry.iter().all(|system| system.system != **name)) {
        return Err(Error::Data(format!("--constant {name}: no --odometry {name}=FILE")).into());
    }
    let truth = match &arguments.truth {
        None => None,
        Some(path) => Some(read_truth(path, &odometry)?),
    };
    let fixes = match (&arguments.fixes, arguments.simulate_fixes, &truth) {
        (Some(path), ..) => parse_fixes(&read_text(path)?, path)?,
        (None, Some((every, std_m)), Some(truth)) => {
            let reached = reached(truth, &odometry);
            SimulatedFixes { every, std_m, seed: arguments.seed }.draw(&reached, 0)
        }
        (None, Some(_), None) => return Err(Error::Data("--simulate-fixes needs --truth".to_owned()).into()),
        (None, None, _) => Vec::new(),
    };
    let fused = fuse(&odometry, &fixes)?;
    let text = fused_trajectory(&fused);
    let scores = truth.map(|truth| {
        TrajectoryScores::of(&fused, &truth).context(
            "--truth has nothing to judge by: it must know frames that motions reach, and without fixes the first of them and another",
        )
    });
    let table = match scores.transpose()? {
        None => String::new(),
        Some(scores) => {
            let row = FusionRow { drive: "-".to_owned(), method: "given".to_owned(), scores, best: false };
            fusion_table(&[row], arguments.format)
        }
    };
    let Some(path) = &arguments.out else {
        note(terminal.quiet || table.is_empty(), table.trim_end());
        return print_result(&text);
    };
    make_folder(path)?;
    write_atomically(path, text.as_bytes())?;
    note(terminal.quiet, &format!("wrote {}", path.display()));
    print_result(&table)
}

fn parse_constant(text: &str) -> Result<(String, Covariance6)> {
    let problem = || {
        Error::Data(format!(
            "--constant {text}: expected NAME=X,Y,Z,ROLL,PITCH,YAW, six standard deviations above zero, m and rad"
        ))
    };
    let (name, numbers) = text.split_once('=').ok_or_else(problem)?;
    let numbers: Option<Vec<f64>> = numbers.split(',').map(|word| word.trim().parse().ok()).collect();
    let numbers: [f64; 6] = numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(problem)?;
    let covariance = Covariance6::from_std_devs(&Tangent::from(numbers));
    if numbers.iter().all(|std| *std > 0.0) && covariance.is_positive() {
        return Ok((name.to_owned(), covariance));
    }
    Err(problem())
}

/// A system's motions, and the axes that the file says they are in.
fn read_odometry(text: &str, constants: &BTreeMap<String, Covariance6>) -> Result<(Odometry, Option<ErrorFrame>)> {
    let (name, path) =
        text.split_once('=').ok_or_else(|| Error::Data(format!("--odometry {text}: expected NAME=FILE")))?;
    let path = Path::new(path);
    let text = read_text(path)?;
    let motions = match constants.get(name) {
        None => parse_relative_poses(&text, path)?,
        Some(covariance) => {
            let bare = parse_bare_relative_poses(&text, path)?.into_iter();
            bare.map(|motion| RelativePose { covariance: Some(*covariance), ..motion }).collect()
        }
    };
    if let Some(bare) = motions.iter().find(|motion| motion.covariance.is_none()) {
        return Err(Error::Data(format!(
            "{}: frames {} and {} have no covariance; `relcov predict --format csv` gives them one, or --constant {name}=…",
            path.display(),
            bare.source,
            bare.target
        )));
    }
    let odometry = Odometry { system: name.to_owned(), motions };
    Ok((odometry, Statement::of(&text, path)?.frame))
}

/// That no system is counted twice: each name and each file once.
fn require_distinct(odometry: &[String]) -> Result<()> {
    let split: Vec<(&str, &str)> = odometry.iter().filter_map(|text| text.split_once('=')).collect();
    for (index, (name, path)) in split.iter().enumerate() {
        let twice = split[..index].iter().any(|(other, _)| other == name);
        let same =
            require_apart(Path::new(path), &split[..index].iter().map(|(_, path)| Path::new(path)).collect::<Vec<_>>());
        let problem = match (name.is_empty(), twice, same.is_err()) {
            (true, ..) => "names no system; expected NAME=FILE",
            (_, true, _) => "is a system that is there already; it would count twice",
            (.., true) => "is a file that is there already; it would count twice",
            _ => continue,
        };
        return Err(Error::Data(format!("--odometry {name}={path}: {problem}")));
    }
    Ok(())
}

/// True poses of the frames that the odometry reaches; a file that does not say its frames has a row for each.
fn read_truth(path: &Path, odometry: &[Odometry]) -> Result<Trajectory> {
    let poses = match parse_kitti_poses(&read_text(path)?, path)? {
        KittiPoses::Framed(trajectory) => return Ok(trajectory),
        KittiPoses::Rows(poses) => poses,
    };
    let reached = [reached_frames(odometry).into_iter().collect()];
    let joined = Joined { whose: "the odometry", sequence: None, sets: &reached };
    Ok(frames_of_rows(poses.len(), path, &joined)?.into_iter().zip(poses).collect())
}
