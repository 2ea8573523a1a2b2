//! `pairs.csv`: one row a measurement, with its error and its covariances.
//!
//! | columns | meaning |
//! |---|---|
//! | `system`, `drive`, `source`, `target` | which measurement |
//! | `error_x` … `error_yaw` | e, m and rad |
//! | `variance_x` … `variance_yaw` | diagonal of the predicted covariance, m² and rad² |
//! | `covariance_x_y` … `covariance_pitch_yaw` | the 15 entries above its diagonal; none of them: zero |
//! | `correction_x` … `correction_yaw` | μ, what was predicted of the error itself, m and rad; optional, empty for a measurement without |
//! | `corrected_x_x` … `corrected_yaw_yaw` | C, covariance of what the correction leaves of the error (21 entries); comes with it, and the predicted covariance is `C + μ μᵀ` |
//! | `no_verdict` | why the images say nothing of this error; optional, mostly empty |
//! | `motion_x` … `motion_yaw` | measured motion, vehicle axes, m and rad; optional |
//! | `interval_s` | time between the frames, s; optional |
//! | `simulated`, `stated_x_x` … `stated_yaw_yaw` | covariance that the measurement states (21 entries), and whether it is the true one; optional |
//!
//! Predictions of any other program can be judged in this form.

use std::path::Path;

use super::pair_table::PairTable;
use crate::alignment::NoVerdict;
use crate::error::{Error, Place, Result};
use crate::files::write_atomically;
use crate::geometry::{Conventions, Covariance6};

pub(super) const KEYS: [&str; 4] = ["system", "drive", "source", "target"];
pub(super) const INTERVAL: &str = "interval_s";
pub(super) const SIMULATED: &str = "simulated";
pub(super) const NO_VERDICT: &str = "no_verdict";

pub(super) fn columns(prefix: &str) -> [String; 6] {
    Conventions::COMPONENTS.map(|component| format!("{prefix}_{component}"))
}

/// Rows and columns of a symmetric matrix from the diagonal (or next to it) to the right.
pub(super) fn upper(offset: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(move |row| (row + offset..6).map(move |column| (row, column)))
}

pub(super) fn entry_columns(prefix: &str, offset: usize) -> Vec<String> {
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
    let corrected = rows().any(|row| row.posterior.is_some());
    let explained = rows().any(|row| row.no_verdict.is_some());
    let stated = rows().any(|row| row.stated.is_some());
    let moved = rows().any(|row| row.motion.is_some());
    let timed = rows().any(|row| row.interval_s.is_some());
    let mut header: Vec<String> = KEYS.map(str::to_owned).into();
    header.extend(timed.then(|| INTERVAL.to_owned()));
    header.extend(moved.then(|| columns("motion")).into_iter().flatten());
    header.extend(columns("error"));
    header.extend(predicted.then(|| columns("variance")).into_iter().flatten());
    header.extend(full.then(|| entry_columns("covariance", 1)).into_iter().flatten());
    if corrected {
        header.extend(columns("correction"));
        header.extend(entry_columns("corrected", 0));
    }
    header.extend(explained.then(|| NO_VERDICT.to_owned()));
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
            if corrected {
                record.extend((0..6).map(|c| cell(row.posterior.map(|posterior| posterior.mean[c]))));
                let left = row.posterior.map(|posterior| posterior.covariance);
                record.extend(upper(0).map(|at| entry(&left, at)));
            }
            if explained {
                record.push(row.no_verdict.map_or("", NoVerdict::name).to_owned());
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::evaluation::{PairRow, SystemPairs, read_pairs};
    use crate::geometry::{ErrorFrame, Posterior, Tangent};

    fn table() -> PairTable {
        let full = Covariance6::from_std_devs(&Tangent::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03))
            .transported(&crate::geometry::Pose::exp(&Tangent::new(0.3, 0.1, 0.2, 0.1, -0.2, 0.3)));
        let posterior = Posterior { mean: Tangent::new(0.07, -0.11, 0.2, 2e-3, 0.0, 0.04), covariance: full };
        let row = |source: usize, covariance| PairRow {
            drive: Arc::from("2011_09_30_drive_0034_sync"),
            source,
            target: source + 1,
            interval_s: Some(0.1),
            motion: Some([0.9, 0.0, 0.0, 0.0, 1e-3, 2e-2]),
            error: [0.1, -0.2, 0.3, 1e-3, 0.0, 1.0 / 3.0],
            covariance: Some(covariance),
            posterior: (source == 6).then_some(posterior),
            no_verdict: (source == 7).then_some(NoVerdict::Diverged),
            stated: (source == 7).then_some(full),
        };
        let rows = vec![row(6, posterior.second_moment()), row(7, Covariance6::from_std_devs(&Tangent::repeat(0.5)))];
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
            (row.posterior, row.no_verdict) = (None, None);
        }
        table.systems[0].simulated = false;
        assert_eq!(read(&to_csv(&table).unwrap()).unwrap(), table);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let good = String::from_utf8(to_csv(&table()).unwrap()).unwrap();
        let rows: Vec<&str> = good.lines().collect();
        for (text, expected) in [
            (good.replacen("vo,", ",", 1), "line 2: found nothing in column `system`"),
            (good.replacen("vo,", "../vo,", 1), "line 2: found a system named `../vo`"),
            (good.replacen(",3e-1,", ",3e9,", 1), "line 2: found `error_z` = `3e9`"),
            (good.replacen(",3e-1,", ",NaN,", 1), "line 2: found `error_z` = `NaN`; expected a finite number"),
            (
                good.replacen("2.5e-1", "-1", 1),
                "line 3: found `variance_x` = `-1`; expected a variance above zero, at most 1e12",
            ),
            (good.replacen("2.5e-1", "0", 1), "`variance_x` = `0`"),
            (good.replacen("2.5e-1", "", 1), "nothing in column `variance_x`"),
            (good.replacen("variance_yaw", "varianse_yaw", 1), "an unknown column `varianse_yaw`"),
            (good.replacen(",error_yaw", "", 1), "no column `error_yaw`"),
            (good.replacen(",7e-2,", ",,", 1), "line 2: found nothing in column `correction_x`"),
            (good.replacen(",7e-2,", ",7e-3,", 1), "corrected_x_x + correction_x * correction_x"),
            (good.replacen("corrected_x_yaw", "corected_x_yaw", 1), "an unknown column `corected_x_yaw`"),
            (good.replacen(",corrected_x_yaw", "", 1), "no column `corrected_x_yaw`"),
            (
                good.replacen("diverged", "lost", 1),
                "line 3: found `no_verdict` = `lost`; expected one of `no_depth`, `no_overlap`, `no_texture`, `diverged`",
            ),
            (
                format!("{good}{}\n", rows[1]),
                "line 4: found vo `2011_09_30_drive_0034_sync` frames 6 and 7 again, first on line 2",
            ),
            (format!("{}\n", rows[0]), "a header and no row"),
            (format!("{good}vo,a\n"), "line 4"),
        ] {
            let error = read(text.as_bytes()).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}\nexpected: {expected}");
        }
    }

    #[test]
    fn a_correction_comes_with_its_covariance_and_that_of_the_measurement() {
        let lines = |groups: &[&[String]]| {
            let columns = [&KEYS.map(str::to_owned)[..], &columns("error"), &groups.concat()].concat();
            format!("{}\nvo,a,0,1{}\n", columns.join(","), ",1".repeat(columns.len() - KEYS.len()))
        };
        let (variance, correction, corrected) =
            (columns("variance"), columns("correction"), entry_columns("corrected", 0));
        for (groups, expected) in [
            (&[&variance[..], &correction][..], "corrections without their covariance; expected corrected_x_x, "),
            (&[&variance, &corrected], "covariances of corrections without the corrections; expected correction_x, "),
            (&[&correction, &corrected], "corrections without predicted covariances; expected variance_x, "),
        ] {
            let error = read(lines(groups).as_bytes()).unwrap_err().to_string();
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
