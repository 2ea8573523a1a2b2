//! What the systems of a configuration measured, with every kind of covariance that there is.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context;

use super::arguments::FuseArguments;
use crate::cli::eval::{Recalibrate, baselines_of, fit_baselines, predict_table};
use crate::cli::progress::note;
use crate::cli::terminal::Terminal;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::evaluation::{Baselines, Method, PairTable, SystemPairs};
use crate::fusion::Odometry;
use crate::geometry::{Covariance6, ErrorFrame, Pose};
use crate::pairs::{Dataset, SplitName};
use crate::recordings::Trajectory;
use crate::systems::{RelativePose, SystemConfig, SystemSource, Truth};
use crate::training::{Manifest, RunFolder};

/// What there is to fuse: measurements, and what gives them covariances.
pub(super) struct Measured {
    config: Config,
    pub(super) dataset: Dataset,
    pub(super) table: PairTable,
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

/// The measurements of a configuration with predictions: each system's by the first of the runs that learned it.
pub(super) fn predicted(arguments: &FuseArguments, split: SplitName, terminal: &Terminal) -> anyhow::Result<Measured> {
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
        require_one_step(&config)?;
        // Nobody measured what was generated.
        let is_generated = |system: &SystemConfig| matches!(system.source, SystemSource::Perturbation(_));
        config.systems.retain(|system| {
            let asked = match arguments.system.is_empty() {
                true => !is_generated(system),
                false => arguments.system.contains(&system.name),
            };
            serving(&system.name) == index && asked
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

/// That motions follow one another: of several overlapping ones each error would count several times.
fn require_one_step(config: &Config) -> Result<()> {
    match config.data.gap.as_slice() {
        [] | [1] => Ok(()),
        gaps => {
            let problem = format!("{gaps:?}: fused motions are those of neighbouring frames; --set data.gap=1");
            Err(Error::config("data.gap", problem))
        }
    }
}

/// The same with covariances that need no model.
pub(super) fn without_model(arguments: &FuseArguments, split: SplitName) -> anyhow::Result<Measured> {
    let path = arguments.config.as_deref().expect("clap requires it");
    let config = arguments.overrides.load(path)?;
    require_one_step(&config)?;
    let (dataset, fitted) = fit_baselines(&config, split)?;
    let table = PairTable::from_split(dataset.require(split)?, &dataset, config.data.error_frame);
    Ok(Measured { config, dataset, table, baselines: fitted, recalibrations: BTreeMap::new() })
}

/// The systems that have errors, or those that were asked for.
pub(super) fn chosen_systems<'a>(arguments: &FuseArguments, table: &'a PairTable) -> Result<Vec<&'a SystemPairs>> {
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

/// The kinds of covariances that every system has. One of a component that never erred is none. Corrected measurements
/// are among them where a model predicts the error of one of the systems.
pub(super) fn available(measured: &Measured, systems: &[&SystemPairs]) -> Vec<Method> {
    let corrects = systems.iter().any(|system| system.rows.iter().any(|row| row.posterior.is_some()));
    let usable = |method: &Method| {
        *method != Method::Zero
            && (*method != Method::Corrected || corrects)
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
    let of = |method: Method| method.covariances(system, baselines, measured.recalibrations.get(&system.name));
    match method {
        // Beside corrected systems, one whose model does not predict errors stays as it is.
        Method::Corrected => of(method).or_else(|| of(Method::Predicted)),
        _ => of(method),
    }
}

/// Drives on which the systems measured.
pub(super) fn drives_of(dataset: &Dataset, systems: &[&SystemPairs]) -> Vec<usize> {
    let measured = |name: &str| systems.iter().any(|system| system.rows.iter().any(|row| *row.drive == *name));
    (0..dataset.drives.len()).filter(|&drive| measured(&dataset.drives[drive].name)).collect()
}

pub(super) fn true_trajectory(measured: &Measured, drive: usize) -> anyhow::Result<Trajectory> {
    let Measured { config, dataset, .. } = measured;
    let truth = Truth::load(&config.truth, &dataset.drives[drive], &config.data.root)?;
    let name = &dataset.drives[drive].name;
    truth.trajectory().with_context(|| format!("{name}: its true motions do not make one trajectory"))
}

/// What the systems measured on a drive, in axes of the vehicle; corrected by what the images show of each error, where
/// the method says so.
pub(super) fn odometry_of(
    measured: &Measured,
    systems: &[&SystemPairs],
    method: Method,
    drive: usize,
) -> Result<Vec<Odometry>> {
    let drive = &measured.dataset.drives[drive];
    let vehicle_from_errors = match measured.table.error_frame {
        ErrorFrame::Vehicle => Pose::identity(),
        ErrorFrame::Camera => drive.calibration.camera_from_vehicle.inverse(),
        ErrorFrame::World => {
            return Err(Error::config("data.error_frame", "`world` cannot be fused; take vehicle or camera"));
        }
    };
    let odometry = systems.iter().map(|system| {
        let covariances = covariances(measured, system, method).expect("checked before");
        let rows = system.rows.iter().zip(covariances).filter(|(row, _)| *row.drive == *drive.name);
        let motions = rows.map(|(row, covariance)| {
            let measured = Pose::exp(&row.motion.expect("a data set knows its motions").into());
            let posterior = row.posterior.filter(|_| method == Method::Corrected);
            RelativePose {
                source: row.source,
                target: row.target,
                source_from_target: posterior
                    .map_or(measured, |posterior| posterior.transported(&vehicle_from_errors).correct(&measured)),
                covariance: Some(covariance.transported(&vehicle_from_errors)),
            }
        });
        Odometry { system: system.name.clone(), motions: motions.collect() }
    });
    Ok(odometry.collect())
}
