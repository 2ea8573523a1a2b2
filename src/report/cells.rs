//! Scores as cells of a table, with their block-bootstrap intervals where these are asked for.

use super::table::{Cell, three_digits};
use crate::evaluation::Metrics;

/// Whether values come with their block-bootstrap intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Intervals {
    /// `0.0494 [0.0481, 0.0507]`
    Shown,
    /// `0.0494`
    Hidden,
}

pub(super) fn cell(value: Option<f64>, show: impl Fn(f64) -> String) -> Cell {
    Cell { text: value.map_or(String::new(), show), value, best: false }
}

pub(super) fn with_interval(text: String, interval: Option<[f64; 2]>, show: impl Fn(f64) -> String) -> String {
    interval.map_or(text.clone(), |[low, high]| format!("{text} [{}, {}]", show(low), show(high)))
}

fn interval_cell(value: Option<f64>, interval: Option<[f64; 2]>, shown: Intervals, show: fn(f64) -> String) -> Cell {
    let mut cell = cell(value, show);
    if shown == Intervals::Shown && value.is_some() {
        cell.text = with_interval(cell.text, interval, show);
    }
    cell
}

pub(super) fn mde_cell(metrics: &Metrics, c: usize, shown: Intervals) -> Cell {
    interval_cell(
        Some(metrics.mde[c]),
        metrics.mde_interval.map(|bounds| bounds.map(|bound| bound[c])),
        shown,
        three_digits,
    )
}

/// Without the sign of a zero.
pub(super) fn three_decimals(value: f64) -> String {
    let text = format!("{value:.3}");
    if text == "-0.000" { "0.000".to_owned() } else { text }
}

/// A logarithm: its decimals are its significant digits.
pub(super) fn nll_cell(metrics: &Metrics, shown: Intervals) -> Cell {
    interval_cell(metrics.nll, metrics.nll_interval, shown, three_decimals)
}

pub(super) fn anees_cell(metrics: &Metrics, shown: Intervals) -> Cell {
    interval_cell(metrics.anees, metrics.anees_interval, shown, three_decimals)
}
