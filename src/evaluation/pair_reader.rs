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
use crate::error::{Result, excerpt};
use crate::files::{Form, Header, Row, Table, is_plain, read_text};
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
    let text = read_text(path)?;
    let names = ColumnNames::new();
    let form = Form { columns: &names.all(), widths: &[], described: "the columns that `relcov eval --help` lists" };
    let mut table = Table::open(&text, path, &form)?;
    let layout = Layout::find(&table.header, &names)?;
    let mut systems: Vec<SystemPairs> = Vec::new();
    let mut first_lines: HashMap<(usize, Arc<str>, usize, usize), usize> = HashMap::new();
    let mut drives: HashMap<String, Arc<str>> = HashMap::new();
    while let Some(row) = table.next()? {
        let name = row.text(layout.keys[0])?;
        if !is_plain(name) {
            let expected = "letters, digits, - and _, for it names files and columns";
            return Err(row.broken(format!("a system named {}", excerpt(name)), expected));
        }
        let index = systems.iter().position(|system| system.name == name).unwrap_or_else(|| {
            systems.push(SystemPairs { name: name.to_owned(), simulated: false, rows: Vec::new() });
            systems.len() - 1
        });
        let drive = row.text(layout.keys[1])?;
        let drive = drives.entry(drive.to_owned()).or_insert_with(|| Arc::from(drive)).clone();
        let (source, target) = (row.frame(layout.keys[2])?, row.frame(layout.keys[3])?);
        if let Some(first) = first_lines.insert((index, drive.clone(), source, target), row.line) {
            let found = format!("{name} {} frames {source} and {target} again, first on line {first}", excerpt(&drive));
            return Err(row.broken(found, "each measurement once"));
        }
        systems[index].simulated |= layout.simulated.map_or(Ok(false), |column| row.flag(column))?;
        let covariance = layout.predicted.as_ref().map(|entries| covariance(&row, entries)).transpose()?;
        systems[index].rows.push(PairRow {
            drive,
            source,
            target,
            interval_s: layout.interval.map(|column| row.optional(column)).transpose()?.flatten(),
            motion: match &layout.motion {
                Some(columns) => row.all_or_none(columns)?,
                None => None,
            },
            error: error(&row, &layout.error)?,
            covariance,
            posterior: match (&layout.posterior, &covariance) {
                (Some(columns), Some(covariance)) => posterior(&row, columns, covariance)?,
                _ => None,
            },
            no_verdict: layout.no_verdict.map(|column| no_verdict(&row, column)).transpose()?.flatten(),
            stated: match &layout.stated {
                Some(entries) if entries.iter().any(|(_, place)| !row.is_empty(*place)) => {
                    Some(self::covariance(&row, entries)?)
                }
                _ => None,
            },
        });
    }
    if systems.is_empty() {
        return Err(table.header.broken("a header and no row", "a row for each measurement"));
    }
    for system in &mut systems {
        system.rows.sort_by_key(PairRow::key);
    }
    Ok(PairTable { error_frame, systems })
}

/// Names of all columns, group by group.
struct ColumnNames {
    /// Six each: `error`, `variance`, `correction`, `motion`.
    sixes: [[String; 6]; 4],
    /// Entries of matrices: `covariance`, `corrected`, `stated`.
    matrices: [Vec<String>; 3],
}

impl ColumnNames {
    fn new() -> Self {
        let matrices = [("covariance", 1), ("corrected", 0), ("stated", 0)];
        Self {
            sixes: ["error", "variance", "correction", "motion"].map(columns),
            matrices: matrices.map(|(prefix, offset)| entry_columns(prefix, offset)),
        }
    }

    fn all(&self) -> Vec<&str> {
        let groups = self.sixes.iter().flatten().chain(self.matrices.iter().flatten()).map(String::as_str);
        KEYS.into_iter().chain([INTERVAL, SIMULATED, NO_VERDICT]).chain(groups).collect()
    }
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
    fn find(header: &Header, names: &ColumnNames) -> Result<Self> {
        let [error, variance, correction, motion] = &names.sixes;
        let [beside, corrected, stated] = &names.matrices;
        let six = |columns: Vec<usize>| <[usize; 6]>::try_from(columns).expect("six columns");
        let diagonal: Option<Entries> =
            header.group(variance)?.map(|found| (0..6).map(|c| (c, c)).zip(found).collect());
        let above: Option<Entries> = header.group(beside)?.map(|found| upper(1).zip(found).collect());
        let lacking = |what: &str, lacks: &str, names: &[String]| {
            header.broken(format!("{what} without {lacks}"), &names.join(", "))
        };
        if above.is_some() && diagonal.is_none() {
            return Err(lacking("covariances", "variances", variance));
        }
        let posterior = match (header.group(correction)?, header.group(corrected)?) {
            (None, None) => None,
            (Some(_), None) => return Err(lacking("corrections", "their covariance", corrected)),
            (None, Some(_)) => return Err(lacking("covariances of corrections", "the corrections", correction)),
            (Some(_), Some(_)) if diagonal.is_none() => {
                return Err(lacking("corrections", "predicted covariances", variance));
            }
            (Some(mean), Some(covariance)) => Some((six(mean), upper(0).zip(covariance).collect())),
        };
        Ok(Self {
            keys: header.require(&KEYS)?.try_into().expect("four columns"),
            interval: header.position(INTERVAL),
            simulated: header.position(SIMULATED),
            no_verdict: header.position(NO_VERDICT),
            motion: header.group(motion)?.map(six),
            error: six(header.require(error)?),
            predicted: diagonal.map(|diagonal| diagonal.into_iter().chain(above.unwrap_or_default()).collect()),
            posterior,
            stated: header.group(stated)?.map(|found| upper(0).zip(found).collect()),
        })
    }
}

fn error(row: &Row, columns: &[usize; 6]) -> Result<[f64; 6]> {
    let error = row.numbers::<6>(columns)?;
    match error.iter().position(|value| value.abs() > LARGEST) {
        None => Ok(error),
        Some(c) => Err(row.broken_cell(columns[c], "an error in metres or radians, at most 1e6")),
    }
}

fn covariance(row: &Row, entries: &Entries) -> Result<Covariance6> {
    let mut matrix = Matrix6::zeros();
    for &((line, column), place) in entries {
        let value = row.number(place)?;
        if line == column && !(value > 0.0 && value <= LARGEST * LARGEST) {
            return Err(row.broken_cell(place, "a variance above zero, at most 1e12"));
        }
        (matrix[(line, column)], matrix[(column, line)]) = (value, value);
    }
    let covariance = Covariance6::from_matrix(matrix).ok().filter(Covariance6::is_positive);
    let prefix = row.name(entries[0].1).split('_').next().unwrap_or_default();
    covariance
        .ok_or_else(|| row.broken(format!("the entries `{prefix}_…` are no covariance"), "a positive definite matrix"))
}

/// What was predicted of the error itself; all of its cells, or none.
fn posterior(row: &Row, (mean, entries): &([usize; 6], Entries), predicted: &Covariance6) -> Result<Option<Posterior>> {
    if mean.iter().chain(entries.iter().map(|(_, place)| place)).all(|&column| row.is_empty(column)) {
        return Ok(None);
    }
    let posterior = Posterior { mean: error(row, mean)?.into(), covariance: covariance(row, entries)? };
    let (second_moment, std_devs) = (posterior.second_moment(), predicted.std_devs());
    let off = |&(line, column): &(usize, usize)| {
        let difference = predicted.matrix()[(line, column)] - second_moment.matrix()[(line, column)];
        difference.abs() > SECOND_MOMENT_TOLERANCE * std_devs[line] * std_devs[column]
    };
    match upper(0).find(off) {
        None => Ok(Some(posterior)),
        Some((line, column)) => {
            let [first, second] = [line, column].map(|component| Conventions::COMPONENTS[component]);
            let [found, expected] = [predicted, &second_moment].map(|matrix| matrix.matrix()[(line, column)]);
            let (name, corrected) = match line == column {
                true => (format!("variance_{first}"), format!("corrected_{first}_{first}")),
                false => (format!("covariance_{first}_{second}"), format!("corrected_{first}_{second}")),
            };
            let expected = format!("{expected:e}: {corrected} + correction_{first} * correction_{second}");
            Err(row.broken(format!("`{name}` = {found:e}"), &expected))
        }
    }
}

fn no_verdict(row: &Row, column: usize) -> Result<Option<NoVerdict>> {
    if row.is_empty(column) {
        return Ok(None);
    }
    let text = row.cell(column);
    NoVerdict::deserialize(text.into_deserializer()).map(Some).map_err(|error: UnknownName| {
        // Its message ends with the names there are.
        let message = error.to_string();
        let expected = message.rsplit_once("expected ").map_or(message.as_str(), |(_, names)| names);
        row.broken_cell(column, expected)
    })
}
