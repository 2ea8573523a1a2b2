//! Reading `pairs.csv`: what is wrong is named by line and column, nothing is dropped.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use nalgebra::Matrix6;

use super::pair_file::{INTERVAL, KEYS, SIMULATED, columns, entry_columns, upper};
use super::pair_table::{PairRow, PairTable, SystemPairs};
use crate::error::{Error, Place, Result};
use crate::files::is_plain;
use crate::geometry::{Covariance6, ErrorFrame};

/// Largest error that a relative pose can have, m or rad: scores of larger ones are no finite numbers.
const LARGEST: f64 = 1e6;

/// Reads a table.
///
/// # Errors
/// Names the line and column: a value is missing, not a number, or a covariance is not positive; a measurement
/// stands there twice; a column is unknown.
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
            covariance: layout.predicted.as_ref().map(|entries| row.covariance(entries)).transpose()?,
            posterior: None,
            no_verdict: None,
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
    motion: Option<[usize; 6]>,
    error: [usize; 6],
    predicted: Option<Entries>,
    stated: Option<Entries>,
}

impl Layout {
    fn find(path: &Path, header: &csv::StringRecord) -> Result<Self> {
        let groups: [Vec<String>; 7] = [
            KEYS.map(str::to_owned).into(),
            columns("error").into(),
            columns("variance").into(),
            entry_columns("covariance", 1),
            columns("motion").into(),
            entry_columns("stated", 0),
            vec![INTERVAL.to_owned(), SIMULATED.to_owned()],
        ];
        let broken = |found: String, expected: String| Error::malformed(path, Place::Line(1), found, expected);
        for (index, name) in header.iter().enumerate() {
            if header.iter().take(index).any(|before| before == name) {
                return Err(broken(format!("a second column `{name}`"), "each column once".to_owned()));
            }
            if !groups.iter().flatten().any(|known| known == name) {
                return Err(broken(
                    format!("an unknown column `{name}`"),
                    "the columns that `relcov eval --help` lists".to_owned(),
                ));
            }
        }
        let position = |name: &String| header.iter().position(|column| column == name);
        // All columns of a group, or none of an optional one.
        let group = |names: &[String], optional: bool| -> Result<Option<Vec<usize>>> {
            let found: Vec<Option<usize>> = names.iter().map(position).collect();
            if optional && found.iter().all(Option::is_none) {
                return Ok(None);
            }
            match found.iter().position(Option::is_none) {
                None => Ok(Some(found.into_iter().flatten().collect())),
                Some(missing) => Err(broken(format!("no column `{}`", names[missing]), names.join(", "))),
            }
        };
        let required = |names: &[String]| group(names, false).map(|found| found.expect("required"));
        let six = |columns: Vec<usize>| <[usize; 6]>::try_from(columns).expect("six columns");
        let diagonal: Option<Entries> =
            group(&groups[2], true)?.map(|found| (0..6).map(|c| (c, c)).zip(found).collect());
        let beside: Option<Entries> = group(&groups[3], true)?.map(|found| upper(1).zip(found).collect());
        if beside.is_some() && diagonal.is_none() {
            return Err(broken("covariances without variances".to_owned(), groups[2].join(", ")));
        }
        Ok(Self {
            keys: required(&groups[0])?.try_into().expect("four columns"),
            interval: position(&groups[6][0]),
            simulated: position(&groups[6][1]),
            motion: group(&groups[4], true)?.map(six),
            error: six(required(&groups[1])?),
            predicted: diagonal.map(|diagonal| diagonal.into_iter().chain(beside.unwrap_or_default()).collect()),
            stated: group(&groups[5], true)?.map(|found| upper(0).zip(found).collect()),
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
}
