//! The table that answers what is asked first of a covariance: is it better than a number typed in, is it honest, does
//! it see *this* error?

use super::cells::{Intervals, anees_cell, cell, nll_cell};
use super::columns::named_columns;
use super::comparison::Comparison;
use super::method_table::method_table;
use super::table::{Better, Cell, Table};
use crate::evaluation::{Method, Metrics};
use crate::geometry::{ROTATION, TRANSLATION};

/// What marks a system that a model was not trained on.
pub(super) const UNSEEN: &str = " (unseen)";

/// Predictions beside what else one could take, in a few numbers; `None` where no method has any.
pub(super) fn summary_table(comparison: &Comparison, intervals: Intervals) -> Option<Table> {
    let systems = comparison.systems();
    let corrected = systems
        .iter()
        .flat_map(|system| comparison.methods(system))
        .any(|(_, judged)| judged.method == Method::Corrected);
    let mut header = vec!["system", "method", "NLL", "ANEES (1)", "in 95 % (.95)", "rank xyz", "rank rpy"];
    let mut better = vec![Better::Lower, Better::Near(1.0), Better::Near(0.95), Better::Near(1.0), Better::Near(1.0)];
    let mut title = "better than a constant? NLL (low); honest? ANEES and share within the 95 % ellipsoid; sees this error? rank correlation of σ and |e|, mean of three components".to_owned();
    if corrected {
        header.extend(["left of RMS xyz", "left of RMS rpy"]);
        better.extend([Better::Neutral; 2]);
        title += "; left of RMS: error after the correction / before";
    }
    let two_decimals = |value: Option<f64>| cell(value, |value| format!("{value:.2}"));
    let row = |metrics: &Metrics| {
        let mut cells: Vec<Cell> = vec![nll_cell(metrics, intervals), anees_cell(metrics, intervals)];
        cells.push(cell(metrics.nees_below_95, |share| format!("{share:.3}")));
        cells.extend([TRANSLATION, ROTATION].map(|part| two_decimals(mean_of_known(&metrics.spearman[part]))));
        if corrected {
            let left = metrics.rms_ratio.map_or([None; 2], |ratio| [ratio.translation, ratio.rotation]);
            cells.extend(left.map(two_decimals));
        }
        cells
    };
    let mut table = method_table(&title, named_columns(&header).collect(), comparison, is_asked_for, row, &better);
    mark_unseen(comparison, &mut table);
    (!table.rows.is_empty()).then_some(table)
}

/// Variants of these stand in the other tables.
fn is_asked_for(method: Method) -> bool {
    matches!(
        method,
        Method::Predicted | Method::Corrected | Method::Constant | Method::LogLinear | Method::Stated | Method::Oracle
    )
}

fn mean_of_known(values: &[Option<f64>]) -> Option<f64> {
    let known: Vec<f64> = values.iter().copied().flatten().collect();
    (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
}

/// Marks systems that no model learned from, and where some did the predictions of those that did not.
fn mark_unseen(comparison: &Comparison, table: &mut Table) {
    for row in &mut table.rows {
        let system = row[0].text.clone();
        let judges = comparison.entries.iter().filter(|entry| entry.evaluation.systems.get(&system).is_some());
        let learned: Vec<bool> = judges.filter_map(|entry| entry.learned_from(&system)).collect();
        if !learned.is_empty() && !learned.contains(&true) {
            row[0].text += UNSEEN;
            continue;
        }
        let methods = comparison.methods(&system);
        let judged = methods.iter().find(|(label, _)| *label == row[1].text).map(|(_, judged)| judged);
        if judged.is_some_and(|found| found.method.is_predicted() && found.entry.learned_from(&system) == Some(false)) {
            row[1].text += UNSEEN;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::alignment::NoVerdict;
    use crate::evaluation::{Baselines, Origin, PairRow, PairTable, SystemPairs, evaluate_table};
    use crate::geometry::{Covariance6, ErrorFrame, Posterior, Tangent};
    use crate::report::{Detail, Entry, TableFormat, render_results};

    /// A model that sees four fifths of the errors of two systems, of which it learned from those that are named.
    fn entry(name: &str, learned: &[&str]) -> Entry {
        let row = |source: usize, size: f64| {
            let error = size * Tangent::new(0.04, -0.01, 0.02, 1e-3, -2e-4, 5e-5);
            let covariance = Covariance6::from_std_devs(&Tangent::new(9e-3, 2e-3, 4e-3, 2e-4, 4e-5, 1e-5));
            let posterior = Posterior { mean: 0.8 * error, covariance };
            PairRow {
                drive: Arc::from("drive"),
                source,
                target: source + 1,
                interval_s: Some(0.1),
                motion: Some([1.0, 0.0, 0.0, 0.0, 0.0, 0.01]),
                error: error.into(),
                covariance: Some(posterior.second_moment()),
                posterior: Some(posterior),
                no_verdict: None,
                stated: None,
            }
        };
        let prior = Covariance6::from_std_devs(&Tangent::new(0.04, 0.01, 0.02, 1e-3, 2e-4, 5e-5));
        let unknown = |source: usize, reason| PairRow {
            covariance: Some(prior),
            posterior: None,
            no_verdict: Some(reason),
            ..row(source, 0.7)
        };
        let rows = || vec![row(0, 1.0), row(1, -0.5), row(2, 1.5), row(3, 0.2)];
        let lost = [NoVerdict::NoOverlap, NoVerdict::Diverged, NoVerdict::Diverged];
        let lost = lost.into_iter().enumerate().map(|(index, reason)| unknown(4 + index, reason));
        let system = |name: &str, rows| SystemPairs { name: name.to_owned(), simulated: false, rows };
        let systems = vec![system("vo", rows()), system("wheel", rows().into_iter().chain(lost).collect())];
        let fitted: Vec<_> = systems.iter().map(|system| (system.name.clone(), Baselines::of_system(system))).collect();
        let table = PairTable { error_frame: ErrorFrame::Vehicle, systems };
        let origin = Origin {
            learned_systems: Some(learned.iter().map(|&name| name.to_owned()).collect()),
            ..Origin::new(name.to_owned(), Some("relcov".to_owned()), "test")
        };
        let evaluation = evaluate_table(&table, &fitted, origin).unwrap();
        Entry { name: name.to_owned(), evaluation, table, folder: None }
    }

    fn short(entries: Vec<Entry>) -> String {
        let comparison = Comparison::new(entries).unwrap();
        render_results(&comparison, TableFormat::Text, Intervals::Hidden, Detail::Short)
    }

    #[test]
    fn corrections_unseen_systems_and_missing_verdicts_stand_in_the_first_table() {
        insta::assert_snapshot!("corrected", short(vec![entry("run", &["vo"])]));
    }

    #[test]
    fn a_system_that_one_of_two_models_learned_from_is_unseen_for_the_other() {
        let text = short(vec![entry("narrow", &["vo"]), entry("broad", &["vo", "wheel"])]);
        assert!(text.contains("| wheel  | narrow (unseen) "), "{text}");
        assert!(text.contains("| wheel  | broad  ") && !text.contains("wheel (unseen)"), "{text}");
        assert!(text.contains("narrow: no verdict from the images: 3 of 7 wheel pairs"), "{text}");
    }
}
