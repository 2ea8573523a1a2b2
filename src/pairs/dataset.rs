//! The pairs of an experiment: measured pose, true pose and images joined, split by split.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::coverage::{Absence, Coverage};
use super::generated::generate;
use super::pair::{Pair, PairId, PairScope};
use super::pairing::Pairing;
use super::settings::{DriveConfig, PairSettings};
use super::split::{Split, SplitName};
use crate::depth::{DepthCache, DepthConfig, depth_file};
use crate::error::{Error, Result};
use crate::recordings::Recording;
use crate::synthetic::{SYSTEMS, is_synthetic};
use crate::systems::{RelativeConfig, SystemConfig, SystemSource, TruthConfig, measurement_file, truth_file};

/// What an experiment works with.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// Which pairs it keeps.
    pub scope: PairScope,
    /// Folder of the data.
    pub root: PathBuf,
    /// How many frames apart pairs were asked for; none: not asked for.
    pub gaps: Vec<usize>,
    /// What tells the depth maps of a network from those of another; none for other sources.
    pub depth: Option<String>,
    /// Every drive named by a split, once.
    pub drives: Vec<Recording>,
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

impl Dataset {
    /// Finds everything a configuration asks for.
    ///
    /// # Errors
    /// A drive, calibration or measurement file is missing or malformed, or too many packets are
    /// unreadable; or the depth maps of a network are missing or stale. Splits may come out empty; see
    /// [`Dataset::require`].
    pub fn load(config: &PairSettings, scope: PairScope) -> Result<Self> {
        let network = if let DepthConfig::Monodepth2(network) = config.depth { Some(network) } else { None };
        let network = network.filter(|_| scope != PairScope::Poses);
        // Before anything is read: the maps must be there, and be those of the configuration.
        network.map_or(Ok(String::new()), |network| DepthCache::of(network).require(network, &[]))?;
        let mut pairing = Pairing::new(config, scope)?;
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
            if config.held_out { hold_out(train, config.data.validation_fraction) } else { (train, validation) };
        let systems = config.systems.len();
        let drives = pairing.into_drives();
        let mut splits = [train, validation, test];
        let generated_sizes = generate(config, &drives, &mut splits)?;
        let [train, validation, test] = splits;
        let depth = network.map(|network| DepthCache::of(network).require(network, &drives)).transpose()?;
        let dataset = Self {
            scope,
            root: config.data.root.clone(),
            gaps: config.data.gap.clone(),
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

    /// All files that it was read from, and is to be read from.
    pub(crate) fn files(&self, config: &PairSettings) -> Vec<PathBuf> {
        let named = self.drives.iter().flat_map(|drive| {
            let measured = config.systems.iter().filter_map(|system| measurement_file(system, drive, &self.root));
            measured.chain(truth_file(config.truth, drive, &self.root))
        });
        let depth = self.drives.iter().flat_map(|drive| {
            drive.images.keys().filter_map(|&frame| depth_file(config.depth, drive, frame, &self.root))
        });
        let recorded = self.drives.iter().flat_map(|drive| drive.files().map(Path::to_owned));
        recorded.chain(named).chain(depth).collect()
    }

    /// A pair that is learned from proves nothing when it is evaluated.
    fn refuse_overlap(&self, evaluated: &Split) -> Result<()> {
        let learned: BTreeSet<PairId> = self.train.pairs.iter().map(|pair| pair.id).collect();
        let in_range = |id: &PairId, of: &Coverage| {
            of.split == SplitName::Train
                && of.drive == id.drive
                && of.frames.is_none_or(|[first, end]| (first..end).contains(&id.source))
        };
        // Of pairs over several frames not one may be in both, and their frames are.
        let is_listed = self.coverage.iter().any(|coverage| coverage.split == evaluated.name);
        let shares = |id: &PairId| {
            learned.contains(id) || is_listed && self.coverage.iter().any(|coverage| in_range(id, coverage))
        };
        let Some(shared) = evaluated.pairs.iter().find(|pair| shares(&pair.id)) else { return Ok(()) };
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
                let absence =
                    Absence { coverage: &self.coverage, recordings: &self.drives, scope: self.scope, gaps: &self.gaps };
                return Err(absence.explain(name, system, &self.systems[system]));
            }
        }
        Ok(split)
    }

    /// That no more image pairs lack depth than may be unreadable: where a network makes it, it can be made for all.
    ///
    /// # Errors
    /// More lack it; the message says how many.
    fn require_depth(&self, config: &PairSettings) -> Result<()> {
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

/// Whether a system is one that was rendered together with the data, judged by the truth it was drawn around.
fn is_simulated(config: &PairSettings, system: &SystemConfig) -> bool {
    let SystemSource::Relative(RelativeConfig { path, .. }) = &system.source else { return false };
    let rendered = SYSTEMS.iter().any(|name| *path == Path::new(&format!("measurements/{name}/{{drive}}.csv")));
    rendered
        && matches!(config.truth, TruthConfig::Oxts {} | TruthConfig::Recording {})
        && is_synthetic(&config.data.root)
}

/// Gives the last part of each drive to the second set; pairs that reach into it from before go to neither.
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
