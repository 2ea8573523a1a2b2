//! `pairs.csv`: one row a measurement, with its error and its covariances.
//!
//! | columns | meaning |
//! |---|---|
//! | `system`, `drive`, `source`, `target` | which measurement |
//! | `error_x` … `error_yaw` | e, m and rad |
//! | `variance_x` … `variance_yaw` | diagonal of the predicted covariance, m² and rad² |
//! | `covariance_x_y` … `covariance_pitch_yaw` | the 15 entries above its diagonal; none of them: zero |
//! | `motion_x` … `motion_yaw` | measured motion, vehicle axes, m and rad; optional |
//! | `interval_s` | time between the frames, s; optional |
//! | `simulated`, `stated_x_x` … `stated_yaw_yaw` | covariance that the measurement states (21 entries), and whether it is the true one; optional |
//!
//! Predictions of any other program can be judged in this form.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use nalgebra::Matrix6;

use super::pair_table::{PairRow, PairTable, SystemPairs};
use crate::error::{Error, Place, Result};
use crate::files::{is_plain, write_atomically};
use crate::geometry::{Conventions, Covariance6, ErrorFrame};

const KEYS: [&str; 4] = ["system", "drive", "source", "target"];
/// Largest error that a relative pose can have, m or rad: scores of larger ones are no finite numbers.
const LARGEST: f64 = 1e6;
const INTERVAL: &str = "interval_s";
const SIMULATED: &str = "simulated";

fn columns(prefix: &str) -> [String; 6] {
    Conventions::COMPONENTS.map(|component| format!("{prefix}_{component}"))
}

/// Rows and columns of a symmetric matrix from the diagonal (or next to it) to the right.
fn upper(offset: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(move |row| (row + offset..6).map(move |column| (row, column)))
}

fn entry_columns(prefix: &str, offset: usize) -> Vec<String> {
    let name = |(row, column): (usize, usize)| {
        format!("{prefix}_{}_{}", Conventions::COMPONENTS[row], Conventions::COMPONENTS[column])
    };
    upper(offset).map(name).collect()
}

/// Writes a table.
///
/// # Errors
/// The file cannot be written.
pub fn write_pairs(path: &Path, table: &PairTable) -> Result<()> {
    let csv =
        to_csv(table).map_err(|error| Error::malformed(path, Place::Whole, error.to_string(), "rows of one length"))?;
    write_atomically(path, &csv)
}

fn to_csv(table: &PairTable) -> Result<Vec<u8>, csv::Error> {
    let rows = || table.systems.iter().flat_map(|system| &system.rows);
    let predicted = rows().any(|row| row.covariance.is_some());
    let full = rows().any(|row| row.covariance.is_some_and(|covariance| !covariance.is_diagonal()));
    let stated = rows().any(|row| row.stated.is_some());
    let moved = rows().any(|row| row.motion.is_some());
    let timed = rows().any(|row| row.interval_s.is_some());
    let mut header: Vec<String> = KEYS.map(str::to_owned).into();
    header.extend(timed.then(|| INTERVAL.to_owned()));
    header.extend(moved.then(|| columns("motion")).into_iter().flatten());
    header.extend(columns("error"));
    header.extend(predicted.then(|| columns("variance")).into_iter().flatten());
    header.extend(full.then(|| entry_columns("covariance", 1)).into_iter().flatten());
    if stated {
        header.push(SIMULATED.to_owned());
        header.extend(entry_columns("stated", 0));
    }
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(&header)?;
    let cell = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:e}"));
    for system in &table.systems {
        for row in &system.rows {
            let mut record =
                vec![system.name.clone(), row.drive.to_string(), row.source.to_string(), row.target.to_string()];
            if timed {
                record.push(cell(row.interval_s));
            }
            let entry =
                |covariance: &Option<Covariance6>, at| cell(covariance.map(|covariance| covariance.matrix()[at]));
            if moved {
                record.extend((0..6).map(|c| cell(row.motion.map(|motion| motion[c]))));
            }
            record.extend(row.error.map(|error| cell(Some(error))));
            if predicted {
                record.extend((0..6).map(|c| entry(&row.covariance, (c, c))));
            }
            if full {
                record.extend(upper(1).map(|at| entry(&row.covariance, at)));
            }
            if stated {
                record.push(system.simulated.to_string());
                record.extend(upper(0).map(|at| entry(&row.stated, at)));
            }
            writer.write_record(&record)?;
        }
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}

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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Tangent;

    fn table() -> PairTable {
        let full = Covariance6::from_std_devs(&Tangent::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03))
            .transported(&crate::geometry::Pose::exp(&Tangent::new(0.3, 0.1, 0.2, 0.1, -0.2, 0.3)));
        let row = |source: usize, covariance| PairRow {
            drive: Arc::from("2011_09_30_drive_0034_sync"),
            source,
            target: source + 1,
            interval_s: Some(0.1),
            motion: Some([0.9, 0.0, 0.0, 0.0, 1e-3, 2e-2]),
            error: [0.1, -0.2, 0.3, 1e-3, 0.0, 1.0 / 3.0],
            covariance: Some(covariance),
            stated: (source == 7).then_some(full),
        };
        let rows = vec![row(6, full), row(7, Covariance6::from_std_devs(&Tangent::repeat(0.5)))];
        let systems = vec![SystemPairs { name: "vo".to_owned(), simulated: true, rows }];
        PairTable { error_frame: ErrorFrame::Vehicle, systems }
    }

    fn read(text: &[u8]) -> Result<PairTable> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        read_pairs(file.path(), ErrorFrame::Vehicle)
    }

    #[test]
    fn a_table_survives_its_file() {
        let mut table = table();
        let csv = to_csv(&table).unwrap();
        assert_eq!(read(&csv).unwrap(), table);
        // As a spreadsheet on Windows writes it.
        let windows = format!("\u{feff}{}", String::from_utf8(csv).unwrap().replace('\n', "\r\n"));
        assert_eq!(read(windows.as_bytes()).unwrap(), table);
        let broken = windows.replace("2.5e-1", "-1");
        assert!(read(broken.as_bytes()).unwrap_err().to_string().contains("line 3"));
        for row in &mut table.systems[0].rows {
            (row.motion, row.interval_s, row.covariance, row.stated) = (None, None, None, None);
        }
        table.systems[0].simulated = false;
        assert_eq!(read(&to_csv(&table).unwrap()).unwrap(), table);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let good = String::from_utf8(to_csv(&table()).unwrap()).unwrap();
        let rows: Vec<&str> = good.lines().collect();
        for (text, expected) in [
            (good.replacen("vo,", ",", 1), "line 2: found no `system`"),
            (good.replacen("vo,", "../vo,", 1), "line 2: found a system named `../vo`"),
            (good.replacen(",3e-1,", ",3e9,", 1), "line 2: found `error_z` = 3e9"),
            (good.replacen(",3e-1,", ",NaN,", 1), "line 2: found `error_z` = `NaN`; expected a finite number"),
            (
                good.replacen("2.5e-1", "-1", 1),
                "line 3: found `variance_x` = -1; expected a variance above zero, at most 1e12",
            ),
            (good.replacen("2.5e-1", "0", 1), "`variance_x` = 0"),
            (good.replacen("2.5e-1", "", 1), "`variance_x` = ``"),
            (good.replacen("variance_yaw", "varianse_yaw", 1), "an unknown column `varianse_yaw`"),
            (good.replacen(",error_yaw", "", 1), "no column `error_yaw`"),
            (
                format!("{good}{}\n", rows[1]),
                "line 4: found vo 2011_09_30_drive_0034_sync frames 6 and 7 again, first on line 2",
            ),
            (format!("{}\n", rows[0]), "a header and no row"),
            (format!("{good}vo,a\n"), "line 4"),
        ] {
            let error = read(text.as_bytes()).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}\nexpected: {expected}");
        }
    }

    #[test]
    fn a_matrix_that_is_no_covariance_is_named() {
        let columns = format!(
            "{},{},{},{}",
            KEYS.join(","),
            columns("error").join(","),
            columns("variance").join(","),
            entry_columns("covariance", 1).join(",")
        );
        let row = format!("vo,a,0,1,{},{},2{}", ["0"; 6].join(","), ["1"; 6].join(","), ",0".repeat(14));
        let error = read(format!("{columns}\n{row}\n").as_bytes()).unwrap_err().to_string();
        assert!(error.contains("line 2: found the entries `variance_…` are no covariance"), "{error}");
    }

    proptest! {
        #[test]
        fn no_text_makes_the_reader_panic(text in "(system|vo|,|\n|1|NaN|-|\"|error_x| ){0,60}") {
            let _ = read(text.as_bytes());
        }
    }
}
