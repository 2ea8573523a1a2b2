//! The table of fused trajectories.

use super::table::{Cell, Table, TableFormat};
use crate::fusion::TrajectoryScores;

/// A row: one drive (or all) and one kind of covariances.
#[derive(Clone, Debug)]
pub struct FusionRow {
    /// Name of the drive.
    pub drive: String,
    /// What gave the covariances.
    pub method: String,
    /// Scores against the truth.
    pub scores: TrajectoryScores,
    /// Whether it may be the best: an oracle does not compete.
    pub best: bool,
}

/// ATE, RPE and ANEES of fused trajectories, in a form, ending with a line break.
pub fn fusion_table(rows: &[FusionRow], format: TableFormat) -> String {
    let header = ["drive", "covariances", "ATE [m]", "ATE [rad]", "RPE [m]", "RPE [rad]", "ANEES", "NEES < 95 %"]
        .map(str::to_owned);
    let numbers = |scores: &TrajectoryScores| {
        let TrajectoryScores { ate_m, ate_rad, rpe_m, rpe_rad, anees, nees_below_95, .. } = *scores;
        [ate_m, ate_rad, rpe_m, rpe_rad, anees, nees_below_95]
    };
    // What is to be small: the first four.
    let least = |drive: &str, score: usize| {
        let competing = rows.iter().filter(|row| row.drive == drive && row.best);
        competing.map(|row| numbers(&row.scores)[score]).fold(f64::INFINITY, f64::min)
    };
    let cells = |row: &FusionRow| {
        let competitors = rows.iter().filter(|other| other.drive == row.drive && other.best).count();
        let scores = numbers(&row.scores).into_iter().enumerate().map(|(score, value)| {
            let digits = if score == 1 || score == 3 { 5 } else { 4 };
            let best = score < 4 && row.best && competitors > 1 && value == least(&row.drive, score);
            let known = value.is_finite().then_some(value);
            Cell { text: known.map_or(String::new(), |value| format!("{value:.digits$}")), value: known, best }
        });
        [Cell::name(&row.drive), Cell::name(&row.method)].into_iter().chain(scores).collect()
    };
    let title = "Fused trajectories against the truth: root mean squared absolute (ATE) and relative (RPE, from frame to frame) errors; mean normalised squared error of the marginal covariances (1 is calibrated)".to_owned();
    Table { title, header: header.into(), names: 2, rows: rows.iter().map(cells).collect() }.render(format)
}
