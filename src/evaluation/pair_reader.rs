//! Reading `pairs.csv`: what is wrong is named by line and column, nothing is dropped.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use nalgebra::Matrix6;
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::Error as UnknownName;

use super::pair_file::{INTERVAL, KEYS, NO_VERDICT, SIMULATED, columns, entry_columns, upper};
use super::pair_table::{PairRow, PairTable, SystemPairs};
use crate::alignment::NoVerdict;
use crate::error::{Error, Place, Result};
use crate::files::is_plain;
use crate::geometry::{Conventions, Covariance6, ErrorFrame, Posterior};

/// Largest error that a relative pose can have, m or rad: scores of larger ones are no finite numbers.
const LARGEST: f64 = 1e6;
/// Largest difference of a predicted covariance from the second moment of what was predicted of the error, in
/// standard deviations: six digits of a file are enough.
const SECOND_MOMENT_TOLERANCE: f64 = 1e-5;

/// Reads a table.
///
/// # Errors
/// Names the line and column: a value is missing, not a number, or a covariance is not positive; a measurement
/// stands there twice; a column is unknown; a correction lacks its covariance, or the predicted covariance is not their
/// second moment.
pub fn read_pairs(path: &Path, error_frame: ErrorFrame) -> Result<PairTable> {
    let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
    // A line ends with its line feed, so that lines of Windows files are counted right.
    let mut reader = csv::ReaderBuilder::new()
        .terminator(csv::Terminator::Any(b'\n'))
        .trim(csv::Trim::All)
        .from_reader(std::io::BufReader::new(file));
    let broken = |line: u64, problem: String| {
        Error::malformed(path, Place::Line(line as usize), problem, "a row of pairs (`relcov eval --help`)")
    };
    let header = reader.headers().map_err(|error| broken(1, error.to_string()))?.clone();
    let layout = Layout::find(path, &header)?;
    let mut systems: Vec<SystemPairs> = Vec::new();
    let mut first_lines: HashMap<(usize, Arc<str>, usize, usize), u64> = HashMap::new();
    let mut drives: HashMap<String, Arc<str>> = HashMap::new();
    let mut record = csv::StringRecord::new();
    while reader
        .read_record(&mut record)
        .map_err(|error| broken(error.position().map_or(1, csv::Position::line), error.to_string()))?
    {
        let line = record.position().map_or(0, csv::Position::line);
        let row = Row { path, line, header: &header, record: &record };
        let name = row.text(layout.keys[0])?;
        if !is_plain(name) {
            return Err(row.broken(
                format!("a system named `{name}`"),
                "letters, digits, - and _, for it names files and columns",
            ));
        }
        let index = systems.iter().position(|system| system.name == name).unwrap_or_else(|| {
            systems.push(SystemPairs { name: name.to_owned(), simulated: false, rows: Vec::new() });
            systems.len() - 1
        });
        let drive = row.text(layout.keys[1])?;
        let drive = drives.entry(drive.to_owned()).or_insert_with(|| Arc::from(drive)).clone();
        let (source, target) = (row.frame(layout.keys[2])?, row.frame(layout.keys[3])?);
        if let Some(first) = first_lines.insert((index, drive.clone(), source, target), line) {
            let found = format!("{name} {drive} frames {source} and {target} again, first on line {first}");
            return Err(broken(line, found));
        }
        systems[index].simulated |= layout.simulated.map_or(Ok(false), |column| row.flag(column))?;
        let covariance = layout.predicted.as_ref().map(|entries| row.covariance(entries)).transpose()?;
        systems[index].rows.push(PairRow {
            drive,
            source,
            target,
            interval_s: layout.interval.map(|column| row.optional(column)).transpose()?.flatten(),
            motion: match &layout.motion {
                Some(columns) if !row.is_empty(columns[0]) => Some(row.numbers(columns)?),
                _ => None,
            },
            error: row.error(&layout.error)?,
            covariance,
            posterior: match (&layout.posterior, &covariance) {
                (Some(columns), Some(covariance)) => row.posterior(columns, covariance)?,
                _ => None,
            },
            no_verdict: layout.no_verdict.map(|column| row.no_verdict(column)).transpose()?.flatten(),
            stated: match &layout.stated {
                Some(entries) if !row.is_empty(entries[0].1) => Some(row.covariance(entries)?),
                _ => None,
            },
        });
    }
    if systems.is_empty() {
        return Err(broken(1, "a header and no row".to_owned()));
    }
    for system in &mut systems {
        system.rows.sort_by_key(PairRow::key);
    }
    Ok(PairTable { error_frame, systems })
}

/// Entries of a symmetric matrix and the columns that hold them.
type Entries = Vec<((usize, usize), usize)>;

/// Which columns hold what.
struct Layout {
    keys: [usize; 4],
    interval: Option<usize>,
    simulated: Option<usize>,
    no_verdict: Option<usize>,
    motion: Option<[usize; 6]>,
    error: [usize; 6],
    predicted: Option<Entries>,
    posterior: Option<([usize; 6], Entries)>,
    stated: Option<Entries>,
}

impl Layout {
    fn find(path: &Path, header: &csv::StringRecord) -> Result<Self> {
        let keys = KEYS.map(str::to_owned);
        let [error, variance, correction, motion] = ["error", "variance", "correction", "motion"].map(columns);
        let [beside, corrected, stated] =
            [("covariance", 1), ("corrected", 0), ("stated", 0)].map(|(prefix, offset)| entry_columns(prefix, offset));
        let single = [INTERVAL, SIMULATED, NO_VERDICT].map(str::to_owned);
        let groups: [&[String]; 9] =
            [&keys, &error, &variance, &beside, &correction, &corrected, &motion, &stated, &single];
        let broken = |found: String, expected: String| Error::malformed(path, Place::Line(1), found, expected);
        for (index, name) in header.iter().enumerate() {
            if header.iter().take(index).any(|before| before == name) {
                return Err(broken(format!("a second column `{name}`"), "each column once".to_owned()));
            }
            if !groups.iter().copied().flatten().any(|known| known == name) {
                return Err(broken(
                    format!("an unknown column `{name}`"),
                    "the columns that `relcov eval --help` lists".to_owned(),
                ));
            }
        }
        let position = |name: &str| header.iter().position(|column| column == name);
        let required = |names: &[String]| -> Result<Vec<usize>> {
            let found =
                |name: &String| position(name).ok_or_else(|| broken(format!("no column `{name}`"), names.join(", ")));
            names.iter().map(found).collect()
        };
        // All columns of a group or none.
        let optional = |names: &[String]| -> Result<Option<Vec<usize>>> {
            let any = names.iter().any(|name| position(name).is_some());
            any.then(|| required(names)).transpose()
        };
        let six = |columns: Vec<usize>| <[usize; 6]>::try_from(columns).expect("six columns");
        let diagonal: Option<Entries> = optional(&variance)?.map(|found| (0..6).map(|c| (c, c)).zip(found).collect());
        let above: Option<Entries> = optional(&beside)?.map(|found| upper(1).zip(found).collect());
        let lacking =
            |what: &str, lacks: &str, names: &[String]| broken(format!("{what} without {lacks}"), names.join(", "));
        if above.is_some() && diagonal.is_none() {
            return Err(lacking("covariances", "variances", &variance));
        }
        let posterior = match (optional(&correction)?, optional(&corrected)?) {
            (None, None) => None,
            (Some(_), None) => return Err(lacking("corrections", "their covariance", &corrected)),
            (None, Some(_)) => return Err(lacking("covariances of corrections", "the corrections", &correction)),
            (Some(_), Some(_)) if diagonal.is_none() => {
                return Err(lacking("corrections", "predicted covariances", &variance));
            }
            (Some(mean), Some(covariance)) => Some((six(mean), upper(0).zip(covariance).collect())),
        };
        Ok(Self {
            keys: required(&keys)?.try_into().expect("four columns"),
            interval: position(INTERVAL),
            simulated: position(SIMULATED),
            no_verdict: position(NO_VERDICT),
            motion: optional(&motion)?.map(six),
            error: six(required(&error)?),
            predicted: diagonal.map(|diagonal| diagonal.into_iter().chain(above.unwrap_or_default()).collect()),
            posterior,
            stated: optional(&stated)?.map(|found| upper(0).zip(found).collect()),
        })
    }
}

/// A row that knows its place.
struct Row<'a> {
    path: &'a Path,
    line: u64,
    header: &'a csv::StringRecord,
    record: &'a csv::StringRecord,
}

impl Row<'_> {
    fn broken(&self, found: String, expected: &str) -> Error {
        Error::malformed(self.path, Place::Line(self.line as usize), found, expected)
    }

    fn is_empty(&self, column: usize) -> bool {
        self.record[column].trim().is_empty()
    }

    fn text(&self, column: usize) -> Result<&str> {
        let text = self.record[column].trim();
        match text.is_empty() {
            true => Err(self.broken(format!("no `{}`", &self.header[column]), "a name")),
            false => Ok(text),
        }
    }

    fn frame(&self, column: usize) -> Result<usize> {
        let text = self.text(column)?;
        text.parse().map_err(|_| self.broken(format!("`{}` = `{text}`", &self.header[column]), "a frame number"))
    }

    fn number(&self, column: usize) -> Result<f64> {
        let text = self.record[column].trim();
        let value = text.parse::<f64>().ok().filter(|value| value.is_finite());
        value.ok_or_else(|| self.broken(format!("`{}` = `{text}`", &self.header[column]), "a finite number"))
    }

    fn flag(&self, column: usize) -> Result<bool> {
        match self.record[column].to_ascii_lowercase().as_str() {
            "true" | "1" | "yes" => Ok(true),
            "false" | "0" | "no" | "" => Ok(false),
            text => Err(self.broken(format!("`{}` = `{text}`", &self.header[column]), "true or false")),
        }
    }

    fn optional(&self, column: usize) -> Result<Option<f64>> {
        if self.is_empty(column) { Ok(None) } else { self.number(column).map(Some) }
    }

    fn numbers(&self, columns: &[usize; 6]) -> Result<[f64; 6]> {
        let mut numbers = [0.0; 6];
        for (number, &column) in numbers.iter_mut().zip(columns) {
            *number = self.number(column)?;
        }
        Ok(numbers)
    }

    fn error(&self, columns: &[usize; 6]) -> Result<[f64; 6]> {
        let error = self.numbers(columns)?;
        match error.iter().position(|value| value.abs() > LARGEST) {
            None => Ok(error),
            Some(c) => {
                let found = format!("`{}` = {:e}", &self.header[columns[c]], error[c]);
                Err(self.broken(found, "an error in metres or radians, at most 1e6"))
            }
        }
    }

    fn covariance(&self, entries: &Entries) -> Result<Covariance6> {
        let mut matrix = Matrix6::zeros();
        for &((row, column), place) in entries {
            let value = self.number(place)?;
            if row == column && !(value > 0.0 && value <= LARGEST * LARGEST) {
                let found = format!("`{}` = {value}", &self.header[place]);
                return Err(self.broken(found, "a variance above zero, at most 1e12"));
            }
            (matrix[(row, column)], matrix[(column, row)]) = (value, value);
        }
        let covariance = Covariance6::from_matrix(matrix).ok().filter(Covariance6::is_positive);
        let prefix = self.header[entries[0].1].split('_').next().unwrap_or_default();
        covariance.ok_or_else(|| {
            self.broken(format!("the entries `{prefix}_…` are no covariance"), "a positive definite matrix")
        })
    }

    /// What was predicted of the error itself; all of its cells, or none.
    fn posterior(&self, (mean, entries): &([usize; 6], Entries), predicted: &Covariance6) -> Result<Option<Posterior>> {
        if mean.iter().chain(entries.iter().map(|(_, place)| place)).all(|&column| self.is_empty(column)) {
            return Ok(None);
        }
        let posterior = Posterior { mean: self.error(mean)?.into(), covariance: self.covariance(entries)? };
        let (second_moment, std_devs) = (posterior.second_moment(), predicted.std_devs());
        let off = |&(row, column): &(usize, usize)| {
            let difference = predicted.matrix()[(row, column)] - second_moment.matrix()[(row, column)];
            difference.abs() > SECOND_MOMENT_TOLERANCE * std_devs[row] * std_devs[column]
        };
        match upper(0).find(off) {
            None => Ok(Some(posterior)),
            Some((row, column)) => {
                let [first, second] = [row, column].map(|component| Conventions::COMPONENTS[component]);
                let [found, expected] = [predicted, &second_moment].map(|matrix| matrix.matrix()[(row, column)]);
                let (name, corrected) = match row == column {
                    true => (format!("variance_{first}"), format!("corrected_{first}_{first}")),
                    false => (format!("covariance_{first}_{second}"), format!("corrected_{first}_{second}")),
                };
                let expected = format!("{expected:e}: {corrected} + correction_{first} * correction_{second}");
                Err(self.broken(format!("`{name}` = {found:e}"), &expected))
            }
        }
    }

    fn no_verdict(&self, column: usize) -> Result<Option<NoVerdict>> {
        let text = self.record[column].trim();
        if text.is_empty() {
            return Ok(None);
        }
        NoVerdict::deserialize(text.into_deserializer()).map(Some).map_err(|error: UnknownName| {
            // Its message ends with the names there are.
            let message = error.to_string();
            let expected = message.rsplit_once("expected ").map_or(message.as_str(), |(_, names)| names);
            self.broken(format!("`{}` = `{text}`", &self.header[column]), expected)
        })
    }
}
