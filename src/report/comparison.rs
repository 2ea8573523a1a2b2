//! Results to be set side by side: loading them, and refusing or pointing out what does not compare.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::error::{Error, Place, Result};
use crate::evaluation::{Evaluation, Method, Metrics, PairRow, PairTable, SystemEvaluation, SystemPairs, read_pairs};
use crate::files::own_name;
use crate::geometry::{Covariance6, ErrorFrame};
use crate::training::{EVALUATION, PAIRS};

/// Results of one or more evaluations in one error frame.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// At least one.
    pub entries: Vec<Entry>,
    /// What a reader must know before comparing them.
    pub warnings: Vec<String>,
}

/// One evaluation.
#[derive(Clone, Debug)]
pub struct Entry {
    /// What it is called: the run folder's name.
    pub name: String,
    /// Its scores.
    pub evaluation: Evaluation,
    /// The measurements behind them.
    pub table: PairTable,
    /// The folder it was found in, with a run's configuration and losses; `None` for one that was just made.
    pub folder: Option<PathBuf>,
}

impl Entry {
    /// Reads `evaluation.json` and `pairs.csv` of a run folder; or a file of scores with its measurements
    /// beside it (`NAME.json`, `NAME.csv`, or `pairs.csv`).
    ///
    /// # Errors
    /// One of them is missing or damaged, or they do not belong together.
    pub fn load(path: &Path) -> Result<Self> {
        let scores = if path.is_dir() { path.join(EVALUATION) } else { path.to_owned() };
        if !scores.is_file() {
            let problem = format!("holds no {EVALUATION}; `relcov eval --run {}` makes it", path.display());
            return Err(Error::run(path, problem));
        }
        let folder = scores.parent().unwrap_or(Path::new("")).to_owned();
        let beside = scores.with_extension("csv");
        let pairs = if path.is_file() && beside.is_file() { beside } else { folder.join(PAIRS) };
        let evaluation = Evaluation::read(&scores)?;
        let table = read_pairs(&pairs, evaluation.error_frame)?;
        let belongs = |(name, system): (&str, &SystemEvaluation)| {
            table.systems.iter().any(|pairs| pairs.name == name && pairs.fingerprint() == system.measurements)
        };
        if evaluation.systems.0.len() != table.systems.len() || !evaluation.systems.iter().all(belongs) {
            let expected = format!("the measurements that {} was made from; run `relcov eval` again", scores.display());
            return Err(Error::malformed(&pairs, Place::Whole, "other measurements", expected));
        }
        let named = if path.is_dir() { path } else { Path::new(path.file_stem().unwrap_or(path.as_os_str())) };
        let entry = Self { name: own_name(named), evaluation, table, folder: Some(folder) };
        entry.check_methods(&scores)?;
        Ok(entry)
    }

    /// Every method that has scores must be one whose covariances can be made again.
    fn check_methods(&self, path: &Path) -> Result<()> {
        for (name, system) in self.evaluation.systems.iter() {
            let pairs = self.pairs(name);
            let predicted = self.evaluation.origin.predicted.as_deref().unwrap_or_default();
            for (method, _) in system.methods.iter() {
                let known = Method::ALL.into_iter().find(|known| known.name(predicted) == method);
                if known.and_then(|known| self.covariances(known, pairs)).is_none() {
                    let place = Place::Field(format!("systems.{name}.methods.{method}"));
                    let expected = "a method that its baselines and measurements give; run `relcov eval` again";
                    return Err(Error::malformed(path, place, "scores without covariances", expected));
                }
            }
        }
        Ok(())
    }

    /// The measurements of a system that has scores.
    fn pairs(&self, system: &str) -> &SystemPairs {
        self.table.systems.iter().find(|pairs| pairs.name == system).expect("scores come from measurements")
    }

    /// Whether its model learned from a system; `None` for predictions that came without one.
    pub fn learned_from(&self, system: &str) -> Option<bool> {
        let learned = self.evaluation.origin.learned_systems.as_ref()?;
        Some(learned.iter().any(|name| name == system))
    }

    fn covariances(&self, method: Method, pairs: &SystemPairs) -> Option<Vec<Covariance6>> {
        let baselines = self.evaluation.systems.get(&pairs.name).and_then(|system| system.baselines.as_ref());
        let factors = self.evaluation.origin.recalibration.as_ref().map(|recalibration| &recalibration.factors);
        method.covariances(pairs, baselines, factors)
    }
}

/// A method of an entry for one system, under the name that tables and figures give it.
#[derive(Clone, Copy)]
pub struct Judged<'a> {
    /// Where its numbers are.
    pub entry: &'a Entry,
    /// What it is.
    pub method: Method,
    /// Its scores.
    pub metrics: &'a Metrics,
}

impl Comparison {
    /// Sets results side by side.
    ///
    /// # Errors
    /// They are in different error frames; or one lacks a pair that another has of the same split and drives.
    pub fn new(mut entries: Vec<Entry>) -> Result<Self> {
        let first = entries.first().ok_or_else(|| Error::Data("no result to report; give a run folder".to_owned()))?;
        for entry in &entries[1..] {
            if entry.evaluation.error_frame != first.evaluation.error_frame {
                return Err(Error::Data(format!(
                    "`{}` is in {} axes and `{}` in {} axes: their numbers do not compare; evaluate both in one data.error_frame",
                    first.name,
                    first.evaluation.error_frame.name(),
                    entry.name,
                    entry.evaluation.error_frame.name()
                )));
            }
        }
        let names: Vec<String> = entries.iter().map(|entry| entry.name.clone()).collect();
        for (index, entry) in entries.iter_mut().enumerate() {
            let twins = names[..index].iter().filter(|name| **name == names[index]).count();
            if Method::is_taken(&names[index]) {
                // A run called `constant` is not the baseline.
                entry.name += " (run)";
            }
            if twins > 0 {
                entry.name += &format!(" ({})", twins + 1);
            }
        }
        let mut warnings = Vec::new();
        for (index, first) in entries.iter().enumerate() {
            let origin = &first.evaluation.origin;
            if origin.recalibration.as_ref().is_some_and(|recalibration| recalibration.split == origin.split) {
                warnings.push(format!(
                    "`{}` is judged on split {}, which its recalibration was fitted to: its calibration looks too good",
                    first.name, origin.split
                ));
            }
            for other in &entries[index + 1..] {
                compare_pairs(first, other, &mut warnings)?;
            }
        }
        Ok(Self { entries, warnings })
    }

    /// The frame of all numbers.
    pub fn error_frame(&self) -> ErrorFrame {
        self.entries[0].evaluation.error_frame
    }

    /// Whether nothing keeps the best from being called so.
    pub fn is_fair(&self) -> bool {
        self.warnings.is_empty()
    }

    /// Names of all systems, in order.
    pub fn systems(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for (name, _) in self.entries.iter().flat_map(|entry| entry.evaluation.systems.iter()) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }

    /// The methods of one system: first the predictions of every entry, then the baselines, each once where
    /// entries agree on it.
    pub fn methods(&self, system: &str) -> Vec<(String, Judged<'_>)> {
        let mut found: Vec<(String, Judged)> = Vec::new();
        for method in Method::ALL {
            for entry in &self.entries {
                let Some(evaluated) = entry.evaluation.systems.get(system) else { continue };
                let own = method.is_predicted();
                let predicted = match &entry.evaluation.origin.predicted {
                    Some(name) => name,
                    None if own => continue,
                    None => &entry.name,
                };
                let Some(metrics) = evaluated.methods.get(&method.name(predicted)) else { continue };
                let base = method.name(if self.entries.len() > 1 { &entry.name } else { predicted });
                let twin = found.iter().any(|(_, other)| other.method == method && other.metrics == metrics);
                let clash = found.iter().any(|(_, other)| other.method == method);
                let label = if clash && !own { format!("{base} ({})", entry.name) } else { base };
                if own || !twin {
                    found.push((label, Judged { entry, method, metrics }));
                }
            }
        }
        found
    }
}

impl<'a> Judged<'a> {
    /// Its measurements of a system.
    pub fn pairs(&self, system: &str) -> &'a SystemPairs {
        self.entry.pairs(system)
    }

    /// Its covariances, row by row.
    pub fn covariances(&self, system: &str) -> Vec<Covariance6> {
        self.entry.covariances(self.method, self.pairs(system)).expect("it has scores")
    }

    /// The errors that they should cover, row by row, m and rad.
    pub fn errors(&self, system: &str) -> Vec<[f64; 6]> {
        self.method.errors(self.pairs(system))
    }
}

/// Results of the same split and drives must have the same pairs; others are pointed out.
fn compare_pairs(first: &Entry, other: &Entry, warnings: &mut Vec<String>) -> Result<()> {
    let systems = |entry: &Entry| entry.table.systems.iter().map(|system| system.name.clone()).collect::<BTreeSet<_>>();
    let (ours, theirs) = (systems(first), systems(other));
    for (has, lacks, difference) in [(first, other, ours.difference(&theirs)), (other, first, theirs.difference(&ours))]
    {
        warnings.extend(difference.map(|system| format!("`{}` has system `{system}`, `{}` not", has.name, lacks.name)));
    }
    for system in ours.intersection(&theirs) {
        let measurements = |entry: &Entry| entry.evaluation.systems.get(system).map(|found| found.measurements.clone());
        if measurements(first) != measurements(other) {
            warnings.push(explain_difference(first, other, system)?);
        }
    }
    Ok(())
}

/// Why two results have different measurements of a system.
///
/// # Errors
/// One lacks a pair that the other has of the same split and drives.
fn explain_difference(first: &Entry, other: &Entry, system: &str) -> Result<String> {
    let (a, b) = (&first.evaluation.origin.split, &other.evaluation.origin.split);
    let both = format!("`{}` and `{}`", first.name, other.name);
    if a != b {
        return Ok(format!("{both} are of splits {a} and {b}: scores of {system} are of different pairs"));
    }
    let drives = |rows: &[PairRow]| rows.iter().map(|row| row.drive.clone()).collect::<BTreeSet<_>>();
    let (ours, theirs) = (&first.pairs(system).rows, &other.pairs(system).rows);
    if drives(ours) != drives(theirs) {
        return Ok(format!("{both} are of different drives: scores of {system} are of different pairs"));
    }
    let keys = |rows: &[PairRow]| rows.iter().map(PairRow::key).collect::<BTreeSet<_>>();
    let (ours, theirs) = (keys(ours), keys(theirs));
    for (has, lacks, difference) in [(first, other, ours.difference(&theirs)), (other, first, theirs.difference(&ours))]
    {
        if let Some((drive, source, target)) = difference.into_iter().next() {
            return Err(Error::Data(format!(
                "`{}` has no prediction for {system} {drive} frames {source} and {target}, which `{}` has; evaluate both on the same pairs",
                lacks.name, has.name
            )));
        }
    }
    Ok(format!("{both} have different errors for the same pairs of {system}: other measurements or another truth"))
}
