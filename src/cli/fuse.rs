//! `relcov fuse`: several systems and absolute fixes to one trajectory.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{ArgGroup, Args};

use super::eval::{Recalibrate, baselines_of, fit_baselines, predict_table};
use super::output::make_folder;
use super::progress::{Progress, note};
use super::{Overrides, SplitArgument, Terminal, print_result};
use crate::config::Config;
use crate::data::{Dataset, SplitName};
use crate::error::{Error, Result};
use crate::evaluation::{Baselines, Method, PairTable, SystemPairs};
use crate::export::fused_trajectory;
use crate::files::{read_text, write_atomically};
use crate::fusion::{DEVIATIONS, Fix, Odometry, SimulatedFixes, TrajectoryScores, fuse, parse_fixes};
use crate::geometry::{Covariance6, ErrorFrame, Pose, Tangent};
use crate::report::figures::{DrawnTrajectory, FusedDrive, draw_fusion, to_png};
use crate::report::{FusionRow, TableFormat, fusion_table};
use crate::systems::{RelativePose, Trajectory, Truth, parse_kitti_trajectory, parse_relative_poses, stated_frame};
use crate::training::{Manifest, RunFolder};

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
  relcov fuse --run checkpoints/synthetic_vo --run checkpoints/synthetic_wheel --config configs/synthetic_fusion.toml --simulate-fixes 100,0.5
  relcov fuse --baselines-only --config configs/kitti.toml --set data.root=../shared/kitti --simulate-fixes 50,1

--odometry reads relative poses with their covariances (the csv of `relcov predict`, or any program's:
source,target,x,y,z,qx,qy,qz,qw and 36 values). --run and --baselines-only fuse the systems of a configuration's
test drives, once with each way to give them covariances, and score all of them against the truth.
Fixes are CSV: frame,x,y,z,std_x,std_y,std_z, and for whole poses qx,qy,qz,qw,std_roll,std_pitch,std_yaw.
How it works and what it is worth: docs/fusion.md.")]
pub struct FuseArguments {
    /// One system's relative poses; repeatable
    #[arg(long, value_name = "NAME=FILE")]
    odometry: Vec<String>,
    /// Give a system of --odometry one covariance: six standard deviations, m and rad
    #[arg(long, value_name = "NAME=X,Y,Z,ROLL,PITCH,YAW", requires = "odometry")]
    constant: Vec<String>,
    /// With --odometry: true poses to score against, KITTI rows of 12, or 13 with the frame
    #[arg(long, value_name = "FILE", requires = "odometry")]
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
    #[arg(long, default_value_t = 0, requires = "simulate_fixes")]
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

/// Systems in files: one trajectory.
fn fuse_files(arguments: &FuseArguments, terminal: &Terminal) -> anyhow::Result<()> {
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
    let read = arguments.odometry.iter().map(|text| read_odometry(text, &constants)).collect::<Result<Vec<_>>>()?;
    let frames: Vec<&String> = read.iter().filter_map(|(_, frame)| frame.as_ref()).collect();
    if let Some(other) = frames.iter().find(|frame| **frame != frames[0]) {
        let problem = format!(
            "the odometry is of different bodies: {} and {other}, as the first lines of the files say; `relcov predict --frame` writes all of them in one",
            frames[0]
        );
        return Err(Error::Data(problem).into());
    }
    let odometry: Vec<Odometry> = read.into_iter().map(|(odometry, _)| odometry).collect();
    if let Some(name) = constants.keys().find(|name| odometry.iter().all(|system| system.system != **name)) {
        return Err(Error::Data(format!("--constant {name}: no --odometry {name}=FILE")).into());
    }
    let truth = match &arguments.truth {
        None => None,
        Some(path) => Some(parse_kitti_trajectory(&read_text(path)?, path, 0)?),
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
fn read_odometry(text: &str, constants: &BTreeMap<String, Covariance6>) -> Result<(Odometry, Option<String>)> {
    let (name, path) =
        text.split_once('=').ok_or_else(|| Error::Data(format!("--odometry {text}: expected NAME=FILE")))?;
    let path = Path::new(path);
    let text = read_text(path)?;
    let mut motions = parse_relative_poses(&text, path)?;
    if let Some(covariance) = constants.get(name) {
        motions.iter_mut().for_each(|motion| motion.covariance = Some(*covariance));
    }
    if let Some(bare) = motions.iter().find(|motion| motion.covariance.is_none()) {
        return Err(Error::Data(format!(
            "{}: frames {} and {} have no covariance; `relcov predict --format csv` gives them one, or --constant {name}=…",
            path.display(),
            bare.source,
            bare.target
        )));
    }
    let odometry = Odometry { system: name.to_owned(), motions };
    Ok((odometry, stated_frame(&text).map(str::to_owned)))
}

/// The true poses of frames that some motion reaches.
fn reached(truth: &Trajectory, odometry: &[Odometry]) -> Trajectory {
    let motions = odometry.iter().flat_map(|system| &system.motions);
    let frames: std::collections::BTreeSet<usize> = motions.flat_map(|motion| [motion.source, motion.target]).collect();
    truth.iter().filter(|(frame, _)| frames.contains(frame)).map(|(&frame, &pose)| (frame, pose)).collect()
}

/// What there is to fuse: measurements, and what gives them covariances.
struct Measured {
    config: Config,
    dataset: Dataset,
    table: PairTable,
    baselines: Vec<(String, Baselines)>,
    /// Factors that predictions were scaled by, system by system.
    recalibrations: BTreeMap<String, [f64; 6]>,
}

impl Measured {
    /// Adds the systems of another model on the same drives.
    fn join(&mut self, other: Self) -> Result<()> {
        let (ours, theirs) = (self.table.error_frame, other.table.error_frame);
        if ours != theirs {
            let problem = format!(
                "the runs have errors in axes `{}` and `{}`; fuse runs of one kind",
                ours.name(),
                theirs.name()
            );
            return Err(Error::Data(problem));
        }
        self.table.systems.extend(other.table.systems);
        self.baselines.extend(other.baselines);
        self.recalibrations.extend(other.recalibrations);
        Ok(())
    }
}

/// The systems of a configuration, drive by drive, with every kind of covariance that there is.
fn fuse_drives(arguments: &FuseArguments, terminal: &Terminal) -> anyhow::Result<()> {
    if let Some(path) = &arguments.save_plot {
        let extension = path.extension().and_then(|extension| extension.to_str());
        anyhow::ensure!(
            matches!(extension, Some("svg" | "png")),
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
    let total = drives.len() * methods.len() * arguments.draws as usize;
    let mut progress = Progress::new(terminal.quiet, "fusing", 0, total);
    let (mut scored, mut drawn, mut trajectories, mut done) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for drive in drives {
        let name = &measured.dataset.drives[drive].name;
        let truth = true_trajectory(&measured, drive)?;
        let mut draw =
            FusedDrive { drive: name.clone(), truth: Trajectory::new(), fixes: Vec::new(), fused: Vec::new() };
        for method in &methods {
            let odometry = odometry_of(&measured, &systems, *method, drive)?;
            let truth = reached(&truth, &odometry);
            let mut scores = Vec::new();
            for draw_number in 0..arguments.draws {
                let seed = arguments.seed.wrapping_add(draw_number);
                let fixes = fixes_of(arguments, name, drive, &truth, seed)?;
                let fused = fuse(&odometry, &fixes).with_context(|| format!("{name}, {}", method.name(RELCOV)))?;
                let unjudged = || format!("{name}: the truth does not know the first frame and another");
                scores.push(TrajectoryScores::of(&fused, &truth).with_context(unjudged)?);
                if draw_number == 0 {
                    if let Some(folder) = &arguments.out {
                        let path = folder.join(format!("{name}_{}.tum", method.name(RELCOV)));
                        trajectories.push((path, fused_trajectory(&fused)));
                    }
                    if let Some(placed) = fused.in_world_of(&truth).filter(|_| is_drawn(*method)) {
                        draw.fused.push(DrawnTrajectory { label: method.name(RELCOV), poses: placed.poses });
                    }
                    (draw.truth, draw.fixes) = (truth.clone(), fixes.iter().map(|fix| fix.position).collect());
                }
                done += 1;
                progress.set(done, "graphs");
            }
            scored.push((name.clone(), *method, scores));
        }
        drawn.push(draw);
        drawn.truncate(MOST_DRAWN);
    }
    drop(progress);
    for (path, text) in &trajectories {
        write_atomically(path, text.as_bytes())?;
    }
    if let Some(folder) = &arguments.out {
        note(terminal.quiet, &format!("wrote {} trajectories into {}", trajectories.len(), folder.display()));
    }
    print_result(&describe(arguments, &scored, &methods))?;
    if let Some(path) = &arguments.save_plot {
        let svg = draw_fusion(&drawn).map_err(|problem| anyhow::anyhow!("the picture cannot be drawn: {problem}"))?;
        let svg_wanted = path.extension().is_some_and(|extension| extension == "svg");
        let bytes = if svg_wanted { svg.into_bytes() } else { to_png(&svg).map_err(anyhow::Error::msg)? };
        write_atomically(path, &bytes)?;
        note(terminal.quiet, &format!("wrote {}", path.display()));
    }
    Ok(())
}

/// The measurements of a configuration with predictions: each system's by the first of the runs that learned it.
fn predicted(arguments: &FuseArguments, split: SplitName, terminal: &Terminal) -> anyhow::Result<Measured> {
    arguments.overrides.refuse_model_keys()?;
    let open = |path: &PathBuf| RunFolder::open(path).and_then(|run| Ok((run.manifest()?, run)));
    let runs = arguments.run.iter().map(open).collect::<Result<Vec<(Manifest, RunFolder)>>>()?;
    let learned = |manifest: &Manifest, name: &str| {
        manifest.systems.iter().any(|system| system.name == name && system.share > 0.0)
    };
    if arguments.run.len() > 1 && arguments.config.is_none() {
        let problem = "several --run need --config, which says the drives and systems that all of them are for";
        return Err(Error::Data(problem.to_owned()).into());
    }
    let serving = |name: &str| runs.iter().position(|(manifest, _)| learned(manifest, name)).unwrap_or(0);
    let mut measured: Option<Measured> = None;
    for (index, (manifest, run)) in runs.iter().enumerate() {
        let mut config = arguments.overrides.load_for_run(arguments.config.as_deref(), run, manifest)?;
        config.systems.retain(|system| {
            serving(&system.name) == index && (arguments.system.is_empty() || arguments.system.contains(&system.name))
        });
        if config.systems.is_empty() {
            continue;
        }
        for system in config.systems.iter().filter(|system| !learned(manifest, &system.name)) {
            let (name, run) = (&system.name, run.path().display());
            note(false, &format!("warning: no run learned `{name}`; {run} predicts it all the same"));
        }
        let predicted = predict_table(run, manifest, &config, split, Recalibrate::AsStored, terminal)?;
        let factors = predicted.recalibration.map(|recalibration| recalibration.factors);
        let baselines = baselines_of(&predicted.dataset);
        let names = predicted.table.systems.iter().map(|system| system.name.clone());
        let recalibrations = names.filter_map(|name| Some((name, factors?))).collect();
        let part = Measured { config, dataset: predicted.dataset, table: predicted.table, baselines, recalibrations };
        match &mut measured {
            None => measured = Some(part),
            Some(whole) => whole.join(part)?,
        }
    }
    let asked = arguments.system.join(", ");
    measured.with_context(|| format!("--system {asked}: the configuration has no such system"))
}

/// The same with covariances that need no model.
fn without_model(arguments: &FuseArguments, split: SplitName) -> anyhow::Result<Measured> {
    let path = arguments.config.as_deref().expect("clap requires it");
    let config = arguments.overrides.load(path)?;
    let (dataset, fitted) = fit_baselines(&config, split)?;
    let table = PairTable::from_split(dataset.require(split)?, &dataset, config.data.error_frame);
    Ok(Measured { config, dataset, table, baselines: fitted, recalibrations: BTreeMap::new() })
}

/// The systems that have errors, or those that were asked for.
fn chosen_systems<'a>(arguments: &FuseArguments, table: &'a PairTable) -> Result<Vec<&'a SystemPairs>> {
    let known: Vec<&str> = table.systems.iter().map(|system| system.name.as_str()).collect();
    if let Some(name) = arguments.system.iter().find(|name| !known.contains(&name.as_str())) {
        return Err(Error::Data(format!("--system {name}: the configuration has {}", known.join(", "))));
    }
    let wanted = |system: &&SystemPairs| match arguments.system.is_empty() {
        true => !system.is_truth() && !system.rows.is_empty(),
        false => arguments.system.contains(&system.name),
    };
    let chosen: Vec<&SystemPairs> = table.systems.iter().filter(wanted).collect();
    match chosen.iter().find(|system| system.is_truth()) {
        Some(truth) => {
            Err(Error::Data(format!("`{}` is the truth itself: there is nothing to fuse it with", truth.name)))
        }
        None if chosen.is_empty() => {
            Err(Error::Data(format!("no system has errors; the configuration has {}", known.join(", "))))
        }
        None => Ok(chosen),
    }
}

/// The kinds of covariances that every system has. One of a component that never erred is none.
fn available(measured: &Measured, systems: &[&SystemPairs]) -> Vec<Method> {
    let usable = |method: &Method| {
        *method != Method::Zero
            && systems.iter().all(|system| {
                covariances(measured, system, *method)
                    .is_some_and(|covariances| covariances.iter().all(Covariance6::is_positive))
            })
    };
    let mut methods = Method::ALL.to_vec();
    // Correlations count where errors add up.
    let constant = methods.iter().position(|method| *method == Method::Constant).map_or(0, |index| index + 1);
    methods.insert(constant, Method::ConstantFull);
    methods.into_iter().filter(usable).collect()
}

fn covariances(measured: &Measured, system: &SystemPairs, method: Method) -> Option<Vec<Covariance6>> {
    let baselines = measured.baselines.iter().find(|(name, _)| *name == system.name).map(|(_, baselines)| baselines);
    method.covariances(system, baselines, measured.recalibrations.get(&system.name))
}

/// Drives on which the systems measured.
fn drives_of(dataset: &Dataset, systems: &[&SystemPairs]) -> Vec<usize> {
    let measured = |name: &str| systems.iter().any(|system| system.rows.iter().any(|row| *row.drive == *name));
    (0..dataset.drives.len()).filter(|&drive| measured(&dataset.drives[drive].name)).collect()
}

fn true_trajectory(measured: &Measured, drive: usize) -> anyhow::Result<Trajectory> {
    let Measured { config, dataset, .. } = measured;
    let truth = Truth::load(&config.truth, &dataset.drives[drive], &config.data.root)?;
    let name = &dataset.drives[drive].name;
    truth.trajectory().with_context(|| format!("{name}: its true motions do not make one trajectory"))
}

/// What the systems measured on a drive, in axes of the vehicle.
fn odometry_of(measured: &Measured, systems: &[&SystemPairs], method: Method, drive: usize) -> Result<Vec<Odometry>> {
    let drive = &measured.dataset.drives[drive];
    let vehicle_from_errors = match measured.table.error_frame {
        ErrorFrame::Vehicle => Pose::identity(),
        ErrorFrame::Camera => drive.calibration.camera2_from_vehicle.inverse(),
        ErrorFrame::World => {
            return Err(Error::config("data.error_frame", "`world` cannot be fused; take vehicle or camera"));
        }
    };
    let odometry = systems.iter().map(|system| {
        let covariances = covariances(measured, system, method).expect("checked before");
        let rows = system.rows.iter().zip(covariances).filter(|(row, _)| *row.drive == *drive.name);
        let motions = rows.map(|(row, covariance)| {
            let motion = row.motion.expect("a data set knows its motions");
            RelativePose {
                source: row.source,
                target: row.target,
                source_from_target: Pose::exp(&motion.into()),
                covariance: Some(covariance.transported(&vehicle_from_errors)),
            }
        });
        Odometry { system: system.name.clone(), motions: motions.collect() }
    });
    Ok(odometry.collect())
}

fn fixes_of(arguments: &FuseArguments, drive: &str, number: usize, truth: &Trajectory, seed: u64) -> Result<Vec<Fix>> {
    match (&arguments.fixes, arguments.simulate_fixes) {
        (Some(template), _) => {
            let path = PathBuf::from(template.display().to_string().replace("{drive}", drive));
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
