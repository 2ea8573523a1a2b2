//! Results to be set side by side: loading them, and refusing or pointing out what does not compare.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};
use crate::evaluation::{Evaluation, Method, Metrics, PairRow, PairTable, SystemPairs, read_pairs};
use crate::geometry::ErrorFrame;
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
            return Err(Error::run(
                path,
                format!("holds no {EVALUATION}; `relcov eval --run {}` makes it", path.display()),
            ));
        }
        let folder = scores.parent().unwrap_or(Path::new("")).to_owned();
        let beside = scores.with_extension("csv");
        let pairs = if beside.is_file() { beside } else { folder.join(PAIRS) };
        let evaluation = Evaluation::read(&scores)?;
        let table = read_pairs(&pairs, evaluation.error_frame)?;
        let belongs = |(name, system): (&str, &crate::evaluation::SystemEvaluation)| {
            table.systems.iter().any(|pairs| pairs.name == name && pairs.rows.len() == system.pairs)
        };
        if evaluation.systems.0.len() != table.systems.len() || !evaluation.systems.iter().all(belongs) {
            let problem = format!(
                "{} holds other measurements than {}; run `relcov eval` again",
                pairs.display(),
                scores.display()
            );
            return Err(Error::run(&folder, problem));
        }
        let named = if path.is_dir() { path } else { Path::new(path.file_stem().unwrap_or(path.as_os_str())) };
        let canonical = named.canonicalize().unwrap_or_else(|_| named.to_owned());
        let name = canonical.file_name().unwrap_or(named.as_os_str()).to_string_lossy().into_owned();
        Ok(Self { name, evaluation, table, folder: Some(folder) })
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
        for index in 1..entries.len() {
            let twins = entries[..index].iter().filter(|other| other.name == entries[index].name).count();
            if twins > 0 {
                entries[index].name = format!("{} ({})", entries[index].name, twins + 1);
            }
        }
        let mut warnings = Vec::new();
        for entry in &entries[1..] {
            compare_pairs(&entries[0], entry, &mut warnings)?;
        }
        Ok(Self { entries, warnings })
    }

    /// The frame of all numbers.
    pub fn error_frame(&self) -> ErrorFrame {
        self.entries[0].evaluation.error_frame
    }

    /// Whether all entries are of the same measurements.
    pub fn is_of_one_data_set(&self) -> bool {
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
                let own = matches!(method, Method::Predicted | Method::Uncalibrated);
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

impl Judged<'_> {
    /// Its measurements of a system.
    pub fn pairs(&self, system: &str) -> &SystemPairs {
        self.entry.table.systems.iter().find(|pairs| pairs.name == system).expect("checked when it was read")
    }

    /// Its covariances, row by row.
    pub fn covariances(&self, system: &str) -> Vec<crate::geometry::Covariance6> {
        let evaluation = &self.entry.evaluation;
        let baselines = evaluation.systems.get(system).and_then(|system| system.baselines.as_ref());
        let factors = evaluation.origin.recalibration.as_ref().map(|recalibration| &recalibration.factors);
        self.method.covariances(self.pairs(system), baselines, factors).expect("it has scores")
    }
}

/// Results of the same split and drives must have the same pairs; others are pointed out.
fn compare_pairs(first: &Entry, other: &Entry, warnings: &mut Vec<String>) -> Result<()> {
    let (a, b) = (&first.evaluation.origin.split, &other.evaluation.origin.split);
    if a != b {
        warnings.push(format!(
            "`{}` is of split {a}, `{}` of split {b}: their scores are of different pairs",
            first.name, other.name
        ));
        return Ok(());
    }
    for system in &first.table.systems {
        let Some(twin) = other.table.systems.iter().find(|twin| twin.name == system.name) else {
            warnings.push(format!("`{}` has no system `{}`", other.name, system.name));
            continue;
        };
        let measurements =
            |entry: &Entry| entry.evaluation.systems.get(&system.name).map(|found| found.measurements.clone());
        if measurements(first) == measurements(other) {
            continue;
        }
        let drives = |rows: &[PairRow]| rows.iter().map(|row| row.drive.clone()).collect::<BTreeSet<_>>();
        if drives(&system.rows) != drives(&twin.rows) {
            warnings.push(format!("`{}` and `{}` are of different drives ({})", first.name, other.name, system.name));
            continue;
        }
        let keys = |rows: &[PairRow]| rows.iter().map(PairRow::key).collect::<BTreeSet<_>>();
        let (ours, theirs) = (keys(&system.rows), keys(&twin.rows));
        let missing = |from: &Entry, has: &Entry, (drive, source, target): &(std::sync::Arc<str>, usize, usize)| {
            Error::Data(format!(
                "`{}` has no prediction for {} {drive} frames {source} and {target}, which `{}` has; evaluate both on the same pairs",
                from.name, system.name, has.name
            ))
        };
        if let Some(key) = ours.difference(&theirs).next() {
            return Err(missing(other, first, key));
        }
        if let Some(key) = theirs.difference(&ours).next() {
            return Err(missing(first, other, key));
        }
        warnings.push(format!(
            "`{}` and `{}` have different errors for the same pairs of {}: other measurements or another truth",
            first.name, other.name, system.name
        ));
    }
    Ok(())
}
