//! The pairs of an experiment: measured pose, true pose and images joined, split by split.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Vector6;
use sha2::{Digest, Sha256};

use super::coverage::Coverage;
use super::drive::Drive;
use super::generated::generate;
use super::pairing::Pairing;
use crate::config::{
    Config, DepthConfig, DriveConfig, RelativeConfig, SystemConfig, SystemSource, TruthConfig, WatchedSplit,
};
use crate::depth::DepthCache;
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, Pose, Tangent};
use crate::synthetic::{SYSTEMS, is_synthetic};
use crate::systems::Perturbation;

/// What an experiment works with.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Which pairs it keeps.
    pub scope: PairScope,
    /// Folder of the data.
    pub root: PathBuf,
    /// What tells the depth maps of a network from those of another; none for other sources.
    pub depth: Option<String>,
    /// Every drive named by a split, once.
    pub drives: Vec<Drive>,
    /// Names of the systems.
    pub systems: Vec<String>,
    /// For each system: whether its measurements were rendered, so that the covariances they state are the
    /// true ones.
    pub simulated: Vec<bool>,
    /// For each system: the middle size of its errors, where its measurements are generated; order ρ then φ, m and rad.
    pub generated_sizes: Vec<Option<[f64; 6]>>,
    /// Pairs to learn from.
    pub train: Split,
    /// Pairs to watch.
    pub validation: Split,
    /// Pairs of the table.
    pub test: Split,
    /// What was found in each drive of each split.
    pub coverage: Vec<Coverage>,
}

/// A role of pairs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SplitName {
    /// Learned from.
    Train,
    /// Watched during training.
    Validation,
    /// Evaluated at the end.
    Test,
}

impl SplitName {
    /// Name as in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }
}

/// The pairs of one role, system by system.
#[derive(Clone, Debug)]
pub struct Split {
    /// Its role.
    pub name: SplitName,
    /// Its pairs, ordered by system, drive and frame.
    pub pairs: Vec<Pair>,
    /// Each system's range of `pairs`.
    pub systems: Vec<Range<usize>>,
}

/// One measurement: two frames, the measured pose and its error.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// Which frames.
    pub id: PairId,
    /// Index of the system that measured it.
    pub system: usize,
    /// Measured `ⁱT̂ᵢ₊₁` in axes of camera 2, m: what the warp uses.
    pub source_from_target: Pose,
    /// `e = log(T̂ T⁻¹)` (paper Eq. 2) in the configured error frame, m and rad.
    pub error: Tangent,
    /// `log ⁱT̂ᵢ₊₁` in vehicle axes, m and rad: what baselines know of a measurement.
    pub motion: Tangent,
    /// Axes of the errors from those of camera 2, where and when the measurement was made.
    pub errors_from_camera: Pose,
    /// What generates the measurement, where it is no system's.
    pub generated: Option<Arc<Perturbation>>,
    /// Covariance of the error that the measurement states, in the error frame: the true one in simulated data.
    pub stated_covariance: Option<Covariance6>,
}

impl Pair {
    /// Measured `ⁱT̂ᵢ₊₁` (axes of camera 2, m) and its error; of a generated measurement those of a draw, where one is
    /// asked for.
    pub fn measured(&self, draw: Option<usize>) -> (Pose, Tangent) {
        match (&self.generated, draw) {
            (Some(perturbation), Some(draw)) => {
                let error = perturbation.draw(self.id, draw);
                (self.wrong_by(&error), error)
            }
            _ => (self.source_from_target, self.error),
        }
    }

    /// The pose that a measurement with this error would have: `exp(e) exp(−e₀) T̂₀`.
    pub(super) fn wrong_by(&self, error: &Tangent) -> Pose {
        let change = Pose::exp(error) * Pose::exp(&-self.error);
        change.conjugated_by(&self.errors_from_camera.inverse()) * self.source_from_target
    }
}

/// Two frames of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PairId {
    /// Index into [`Dataset::drives`].
    pub drive: usize,
    /// Frame i.
    pub source: usize,
    /// Frame i + 1.
    pub target: usize,
}

/// Which measured pairs a data set keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PairScope {
    /// Those with images and depth: what a network needs.
    Images,
    /// All with a measured and a true pose: what statistics of errors need.
    Poses,
    /// Those with images and depth, whether or not the truth is known: what a prediction needs. The error of a pair
    /// whose truth is not known is zero and means nothing.
    Measured,
}

impl Dataset {
    /// Finds everything a configuration asks for.
    ///
    /// # Errors
    /// A drive, calibration or measurement file is missing or malformed, or too many packets are
    /// unreadable; or the depth maps of a network are missing or stale. Splits may come out empty; see
    /// [`Dataset::require`].
    pub fn load(config: &Config, scope: PairScope) -> Result<Self> {
        let network = if let DepthConfig::Monodepth2(network) = &config.depth { Some(network) } else { None };
        let network = network.filter(|_| scope != PairScope::Poses);
        // Before anything is read: the maps must be there, and be those of the configuration.
        network.map_or(Ok(String::new()), |network| DepthCache::of(network).require(network, &[]))?;
        let mut pairing = Pairing::new(config, scope)?;
        let held_out = config.data.validation.is_empty() && config.training.watch == WatchedSplit::Validation;
        let mut coverage = Vec::new();
        let mut collect = |name, drives: &[DriveConfig]| -> Result<Vec<Pair>> {
            let mut pairs = Vec::new();
            for drive in drives {
                let (drive_coverage, drive_pairs) = pairing.pair_drive(name, drive)?;
                coverage.push(drive_coverage);
                pairs.extend(drive_pairs);
            }
            Ok(pairs)
        };
        let train = collect(SplitName::Train, &config.data.train)?;
        let validation = collect(SplitName::Validation, &config.data.validation)?;
        let test = collect(SplitName::Test, &config.data.test)?;
        let (train, validation) =
            if held_out { hold_out(train, config.data.validation_fraction) } else { (train, validation) };
        let systems = config.systems.len();
        let drives = pairing.into_drives();
        let mut splits = [train, validation, test];
        let generated_sizes = generate(config, &drives, &mut splits)?;
        let [train, validation, test] = splits;
        let depth = network.map(|network| DepthCache::of(network).require(network, &drives)).transpose()?;
        let dataset = Self {
            scope,
            root: config.data.root.clone(),
            drives,
            depth,
            systems: config.systems.iter().map(|system| system.name.clone()).collect(),
            simulated: config.systems.iter().map(|system| is_simulated(config, system)).collect(),
            train: Split::new(SplitName::Train, train, systems),
            validation: Split::new(SplitName::Validation, validation, systems),
            test: Split::new(SplitName::Test, test, systems),
            coverage,
            generated_sizes,
        };
        dataset.refuse_overlap(&dataset.validation)?;
        dataset.refuse_overlap(&dataset.test)?;
        network.map_or(Ok(()), |_| dataset.require_depth(config))?;
        Ok(dataset)
    }

    /// A pair that is learned from proves nothing when it is evaluated.
    fn refuse_overlap(&self, evaluated: &Split) -> Result<()> {
        let learned: BTreeSet<PairId> = self.train.pairs.iter().map(|pair| pair.id).collect();
        let Some(shared) = evaluated.pairs.iter().find(|pair| learned.contains(&pair.id)) else { return Ok(()) };
        Err(Error::config(
            format!("data.{}", evaluated.name.name()),
            format!(
                "{} frames {} and {} are in data.train too; give the splits different drives or frames",
                self.drives[shared.id.drive].name, shared.id.source, shared.id.target
            ),
        ))
    }

    /// The split of that role.
    pub fn split(&self, name: SplitName) -> &Split {
        match name {
            SplitName::Train => &self.train,
            SplitName::Validation => &self.validation,
            SplitName::Test => &self.test,
        }
    }

    /// A split in which every system has pairs.
    ///
    /// # Errors
    /// A system has none; the message says what was missing.
    pub fn require(&self, name: SplitName) -> Result<&Split> {
        let split = self.split(name);
        for (system, range) in split.systems.iter().enumerate() {
            if range.is_empty() {
                return Err(self.explain_empty(name, system));
            }
        }
        Ok(split)
    }

    /// That no more image pairs lack depth than may be unreadable: where a network makes it, it can be made for all.
    ///
    /// # Errors
    /// More lack it; the message says how many.
    fn require_depth(&self, config: &Config) -> Result<()> {
        let count = |of: fn(&Coverage) -> usize| self.coverage.iter().map(of).sum::<usize>();
        let (pairs, with_depth) = (count(|coverage| coverage.image_pairs), count(|coverage| coverage.depth_pairs));
        if (pairs - with_depth) as f64 > config.data.max_bad_fraction * pairs as f64 {
            return Err(Error::Data(format!(
                "the depth cache lacks the maps of {} of {pairs} image pairs; make them with: relcov depth --config … (and the same --set)",
                pairs - with_depth
            )));
        }
        Ok(())
    }

    /// A hash of every pair and error: two runs compare only when it agrees.
    pub fn fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        self.depth.iter().for_each(|depth| hash.update(depth));
        for split in [&self.train, &self.validation, &self.test] {
            hash.update(split.name.name());
            for pair in &split.pairs {
                hash.update(&self.drives[pair.id.drive].name);
                hash.update(&self.systems[pair.system]);
                for index in [pair.id.source, pair.id.target] {
                    hash.update((index as u64).to_le_bytes());
                }
                for value in pair.error.iter() {
                    // A tenth of a micrometre: the same on every machine's libm.
                    hash.update(((value * 1e7).round() as i64).to_le_bytes());
                }
            }
        }
        hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

impl Split {
    /// Sorts pairs by system; `systems` is how many there are.
    fn new(name: SplitName, mut pairs: Vec<Pair>, systems: usize) -> Self {
        pairs.sort_by_key(|pair| (pair.system, pair.id));
        pairs.dedup_by_key(|pair| (pair.system, pair.id));
        let start = |system| pairs.partition_point(|pair: &Pair| pair.system < system);
        let ranges = (0..systems).map(|system| start(system)..start(system + 1)).collect();
        Self { name, systems: ranges, pairs }
    }

    /// The pairs of some systems alone; others are there and have none.
    pub fn of_systems(&self, wanted: impl Fn(usize) -> bool) -> Self {
        let pairs = self.pairs.iter().filter(|pair| wanted(pair.system)).cloned().collect();
        Self::new(self.name, pairs, self.systems.len())
    }

    /// The pairs of one system.
    pub fn pairs_of(&self, system: usize) -> &[Pair] {
        &self.pairs[self.systems[system].clone()]
    }

    /// Mean of e² over one system's pairs, m² and rad².
    pub fn mean_squared_error(&self, system: usize) -> Vector6<f64> {
        let pairs = self.pairs_of(system);
        let sum: Vector6<f64> = pairs.iter().map(|pair| pair.error.component_mul(&pair.error)).sum();
        sum / pairs.len().max(1) as f64
    }
}

/// Whether a system is one that was rendered together with the data, judged by the truth it was drawn around.
fn is_simulated(config: &Config, system: &SystemConfig) -> bool {
    let SystemSource::Relative(RelativeConfig { path, .. }) = &system.source else { return false };
    let rendered = SYSTEMS.iter().any(|name| *path == Path::new(&format!("measurements/{name}/{{drive}}.csv")));
    rendered && config.truth == TruthConfig::Oxts {} && is_synthetic(&config.data.root)
}

/// Gives the last part of each drive to the second set; the pair before it, which shares an image with
/// it, goes to neither.
fn hold_out(pairs: Vec<Pair>, fraction: f64) -> (Vec<Pair>, Vec<Pair>) {
    let mut sources: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for pair in &pairs {
        sources.entry(pair.id.drive).or_default().insert(pair.id.source);
    }
    let first_held_out: BTreeMap<usize, usize> = sources
        .into_iter()
        .filter_map(|(drive, frames)| {
            let kept = frames.len() - (frames.len() as f64 * fraction).floor() as usize;
            Some((drive, *frames.iter().nth(kept)?))
        })
        .collect();
    let first = |pair: &Pair| first_held_out.get(&pair.id.drive).copied().unwrap_or(usize::MAX);
    let (held_out, kept): (Vec<Pair>, Vec<Pair>) = pairs.into_iter().partition(|pair| pair.id.source >= first(pair));
    (kept.into_iter().filter(|pair| pair.id.target < first(pair)).collect(), held_out)
}
