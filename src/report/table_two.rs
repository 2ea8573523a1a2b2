//! The form of the paper's Table II: systems and scores below one another, methods side by side.

use super::cells::{Intervals, anees_cell, mde_cell, nll_cell};
use super::columns::{named_columns, unit_columns};
use super::comparison::{Comparison, Judged};
use super::method_table::competes;
use super::notes::preface;
use super::table::{Better, Cell, Table, mark};
use crate::evaluation::Metrics;

/// The paper's Table II: systems and components below one another, methods side by side.
pub fn table_two(comparison: &Comparison, intervals: Intervals) -> Table {
    let mut labels: Vec<String> = Vec::new();
    let by_system: Vec<(&str, Vec<(String, Judged)>)> =
        comparison.systems().into_iter().map(|system| (system, comparison.methods(system))).collect();
    for (label, _) in by_system.iter().flat_map(|(_, methods)| methods) {
        if !labels.contains(label) {
            labels.push(label.clone());
        }
    }
    let mut rows = Vec::new();
    for (system, methods) in &by_system {
        let scores = unit_columns("MDE ").chain(named_columns(&["NLL", "ANEES"]));
        for (index, score) in scores.enumerate() {
            let value = |metrics: &Metrics| match index {
                6 => nll_cell(metrics, intervals),
                7 => anees_cell(metrics, intervals),
                c => mde_cell(metrics, c, intervals),
            };
            let found = |label: &String| methods.iter().find(|(name, _)| name == label);
            let mut cells: Vec<Cell> = labels
                .iter()
                .map(|label| found(label).map_or(Cell::default(), |(_, judged)| value(judged.metrics)))
                .collect();
            if cells.iter().all(|cell| cell.text.is_empty()) {
                continue;
            }
            let better = if index == 7 { Better::Near(1.0) } else { Better::Lower };
            let competing = |label: &String| found(label).is_some_and(|(_, judged)| competes(judged));
            let ranks: Vec<Option<f64>> = labels
                .iter()
                .zip(&cells)
                .map(|(label, cell)| cell.value.filter(|_| competing(label)).and_then(|value| better.rank(value)))
                .collect();
            if comparison.is_fair() {
                mark(cells.iter_mut(), &ranks);
            }
            rows.push([vec![Cell::name(*system), Cell::name(score)], cells].concat());
        }
    }
    let header = named_columns(&["Rel. Pose. Meas.", "Metric"]).chain(labels).collect();
    let warnings: String = comparison.warnings.iter().map(|warning| format!("WARNING: {warning}\n")).collect();
    Table { title: format!("{}{warnings}", preface(comparison)).trim_end().to_owned(), header, names: 2, rows }
}
