//! The table in which methods stand below one another, system after system, and which of them compete to be the best.

use super::comparison::{Comparison, Judged};
use super::table::{Better, Cell, Table};
use crate::evaluation::{Method, Metrics};

/// A table of those methods below one another that a condition keeps, system after system.
pub(super) fn method_table(
    title: &str,
    header: Vec<String>,
    comparison: &Comparison,
    keep: impl Fn(Method) -> bool,
    row: impl Fn(&Metrics) -> Vec<Cell>,
    better: &[Better],
) -> Table {
    let mut rows = Vec::new();
    let mut outside = Vec::new();
    for system in comparison.systems() {
        for (name, judged) in comparison.methods(system).into_iter().filter(|(_, judged)| keep(judged.method)) {
            let cells = row(judged.metrics);
            if cells.iter().all(|cell| cell.text.is_empty()) {
                continue;
            }
            outside.push(!competes(&judged));
            rows.push([vec![Cell::name(system), Cell::name(name)], cells].concat());
        }
    }
    let excluded: Vec<(Cell, Cell)> = rows
        .iter()
        .zip(outside)
        .filter(|(_, outside)| *outside)
        .map(|(row, _)| (row[0].clone(), row[1].clone()))
        .collect();
    let mut table = Table { title: title.to_owned(), header, names: 2, rows };
    if comparison.is_fair() {
        table.mark_best(|row| !excluded.iter().any(|(system, method)| *system == row[0] && *method == row[1]), better);
    }
    table
}

pub(super) fn competes(judged: &Judged) -> bool {
    // Against a truth the smallest σ would win; a corrected measurement is another one, with other errors.
    judged.metrics.nll.is_some()
        && !matches!(judged.method, Method::Oracle | Method::OracleDiagonal | Method::Corrected)
}
