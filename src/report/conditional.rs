//! Calibration where σ is small and where it is large, as a table: the worst of ten bins.

use super::cells::cell;
use super::columns::named_columns;
use super::comparison::Comparison;
use super::method_table::method_table;
use super::table::{Better, Table, three_digits};
use crate::evaluation::Metrics;
use crate::geometry::Conventions;

/// The bin of σ that is farthest from calibrated, of every covariance that changes from pair to pair.
pub(super) fn conditional_table(comparison: &Comparison) -> Option<Table> {
    let row = |metrics: &Metrics| {
        let found = metrics.conditional.as_ref();
        let joint = cell(found.map(|found| found.joint.worst()), three_digits);
        let component = |c: usize| cell(found.map(|found| found.by_component[c].worst()), three_digits);
        std::iter::once(joint).chain((0..6).map(component)).collect()
    };
    let header =
        named_columns(&["system", "method", "joint"]).chain(Conventions::COMPONENTS.map(str::to_owned)).collect();
    let title =
        "conditional calibration: mean z² (joint: ANEES) of that one of ten bins of σ where it is farthest from 1";
    let table = method_table(title, header, comparison, |_| true, row, &[Better::Neutral; 7]);
    (!table.rows.is_empty()).then_some(table)
}
