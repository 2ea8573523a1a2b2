//! What an evaluation found, as tables: the three answers first, the MDE table (paper Table II), and for who looks closer
//! proper scores, calibration, and how systems are told apart.

use super::cells::{Intervals, anees_cell, cell, mde_cell, nll_cell, three_decimals, with_interval};
use super::columns::{named_columns, unit_columns};
use super::comparison::Comparison;
use super::conditional::conditional_table;
use super::full_table::full_table;
use super::method_table::method_table;
use super::notes::{notes, preface, separation_notes};
use super::summary::summary_table;
use super::table::{Better, Cell, Table, TableFormat, three_digits};
use super::table_two::table_two;
use crate::evaluation::Metrics;
use crate::geometry::Conventions;

/// How much people are shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detail {
    /// What is asked first, and the MDE table.
    Short,
    /// Every table.
    Full,
}

/// Everything in one form: text and Markdown for people, in short or in full; one wide table as CSV; the paper's
/// Table II as LaTeX.
pub fn render_results(comparison: &Comparison, format: TableFormat, intervals: Intervals, detail: Detail) -> String {
    match format {
        TableFormat::Csv => full_table(comparison).render(format),
        TableFormat::Latex => table_two(comparison, intervals).render(format),
        TableFormat::Text | TableFormat::Markdown => {
            let mut parts = vec![preface(comparison)];
            parts.extend(comparison.warnings.iter().map(|warning| format!("WARNING: {warning}\n")));
            for table in tables(comparison, intervals, detail) {
                let title = if format == TableFormat::Text { format!("\n{}\n", table.title) } else { "\n".to_owned() };
                parts.push(title + &table.render(format));
            }
            let mark = if format == TableFormat::Text { "*" } else { "bold" };
            let mut lines = notes(comparison, mark);
            if detail == Detail::Short {
                lines.splice(0..0, separation_notes(comparison));
                lines.push("more tables (CRPS, calibration, separation of systems): --full.".to_owned());
            }
            parts.push(format!("\n{}\n", lines.join("\n")));
            parts.concat()
        }
    }
}

/// The tables for people.
pub(super) fn tables(comparison: &Comparison, intervals: Intervals, detail: Detail) -> Vec<Table> {
    let mut tables = vec![summary_table(comparison, intervals), Some(score_table(comparison, intervals))];
    if detail == Detail::Full {
        tables.extend([
            Some(crps_table(comparison, intervals)),
            calibration_table(comparison),
            conditional_table(comparison),
            true_sigma_table(comparison),
            separation_table(comparison),
        ]);
    }
    tables.into_iter().flatten().collect()
}

/// MDE of every component, NLL and ANEES: methods below one another.
fn score_table(comparison: &Comparison, intervals: Intervals) -> Table {
    let header = named_columns(&["system", "method"]).chain(unit_columns("")).chain(named_columns(&["NLL", "ANEES"]));
    let row = |metrics: &Metrics| {
        let mut cells: Vec<Cell> = (0..6).map(|c| mde_cell(metrics, c, intervals)).collect();
        cells.extend([nll_cell(metrics, intervals), anees_cell(metrics, intervals)]);
        cells
    };
    let better = [[Better::Lower; 7].as_slice(), &[Better::Near(1.0)]].concat();
    method_table("MDE = median sqrt|R - e^2|", header.collect(), comparison, |_| true, row, &better)
}

/// CRPS of every component, and two joint scores.
fn crps_table(comparison: &Comparison, intervals: Intervals) -> Table {
    let joint = ["NLL - constant's", "e'R^-1 e < 12.6"];
    let header = named_columns(&["system", "method"]).chain(unit_columns("")).chain(named_columns(&joint));
    let row = |metrics: &Metrics| {
        let mut cells: Vec<Cell> = (0..6).map(|c| cell(metrics.crps.map(|crps| crps[c]), three_digits)).collect();
        let difference = metrics.nll_over_constant.map_or(Cell::default(), |difference| Cell {
            text: match intervals {
                Intervals::Shown => {
                    with_interval(three_decimals(difference.mean), Some(difference.interval), three_decimals)
                }
                Intervals::Hidden => three_decimals(difference.mean),
            },
            value: Some(difference.mean),
            best: false,
        });
        cells.extend([difference, cell(metrics.nees_below_95, |share| format!("{share:.3}"))]);
        cells
    };
    let better = [[Better::Lower; 6].as_slice(), &[Better::Neutral, Better::Near(0.95)]].concat();
    method_table(
        "CRPS (proper; lower is better); share of pairs within the 95 % ellipsoid",
        header.collect(),
        comparison,
        |_| true,
        row,
        &better,
    )
}

/// Calibration and sharpness of the predictions, component by component.
fn calibration_table(comparison: &Comparison) -> Option<Table> {
    type Score = (&'static str, fn(&Metrics) -> Option<[Option<f64>; 6]>);
    let scores: [Score; 10] = [
        ("mean σ [m, rad]", |metrics| Some(metrics.sharpness.map(Some))),
        ("mean z² (1)", |metrics| Some(metrics.zms?.map(Some))),
        ("within 1σ (.683)", |metrics| Some(metrics.coverage?[0].map(Some))),
        ("within 2σ (.954)", |metrics| Some(metrics.coverage?[1].map(Some))),
        ("within 3σ (.997)", |metrics| Some(metrics.coverage?[2].map(Some))),
        ("ENCE (0)", |metrics| Some(metrics.ence?.map(Some))),
        ("AUSE (0)", |metrics| Some(metrics.ause)),
        ("AURG (high)", |metrics| Some(metrics.aurg)),
        ("rank corr. of σ, |e|", |metrics| Some(metrics.spearman)),
        ("left of RMS e (low)", |metrics| Some(metrics.rms_ratio?.components)),
    ];
    let mut rows = Vec::new();
    for system in comparison.systems() {
        let predictions: Vec<_> =
            comparison.methods(system).into_iter().filter(|(_, judged)| judged.method.is_predicted()).collect();
        for (label, values) in scores {
            for (name, judged) in &predictions {
                let Some(values) = values(judged.metrics) else { continue };
                if values.iter().all(Option::is_none) {
                    continue;
                }
                let names = [Cell::name(system), Cell::name(label), Cell::name(name.clone())];
                rows.push(names.into_iter().chain(values.map(|value| cell(value, three_digits))).collect());
            }
        }
    }
    let header = named_columns(&["system", "score", "method"]).chain(Conventions::COMPONENTS.map(str::to_owned));
    let title = "calibration of the predictions".to_owned();
    (!rows.is_empty()).then(|| Table { title, header: header.collect(), names: 3, rows })
}

/// Predicted beside true σ, where the data state true covariances.
fn true_sigma_table(comparison: &Comparison) -> Option<Table> {
    let mut rows = Vec::new();
    for system in comparison.systems() {
        for (name, judged) in comparison.methods(system) {
            let Some(compared) = &judged.metrics.against_true else { continue };
            let ratios = compared.median_sigma_ratio.map(|ratio| cell(Some(ratio), three_digits));
            let correlations = compared.log_sigma_correlation.map(|value| cell(value, |value| format!("{value:.2}")));
            rows.push([vec![Cell::name(system), Cell::name(name)], ratios.into(), correlations.into()].concat());
        }
    }
    let columns = |prefix: &str| Conventions::COMPONENTS.map(|name| format!("{prefix} {name}"));
    let header = named_columns(&["system", "method"]).chain(columns("ratio")).chain(columns("corr."));
    let title = "against the true covariance: median of predicted / true σ, and correlation of their logarithms";
    (!rows.is_empty()).then(|| Table { title: title.to_owned(), header: header.collect(), names: 2, rows })
}

/// How well each entry tells an accurate system from an inaccurate one, and a wrong pose from a right one.
fn separation_table(comparison: &Comparison) -> Option<Table> {
    let mut rows = Vec::new();
    for entry in &comparison.entries {
        let (separation, response) = (&entry.evaluation.separation, &entry.evaluation.perturbation_response);
        if separation.is_none() && response.is_none() {
            continue;
        }
        let systems = separation.as_ref().map_or(String::new(), |found| found.systems.join(" / "));
        let ratio = |c: usize| cell(separation.as_ref().map(|found| found.median_sigma_ratio[c]), three_digits);
        let mut cells = vec![Cell::name(&entry.name), Cell::name(systems)];
        cells.extend((0..6).map(ratio));
        cells.push(cell(separation.as_ref().map(|found| found.auroc), |value| format!("{value:.3}")));
        cells.push(cell(response.as_ref().and_then(|found| found.spearman), |value| format!("{value:.2}")));
        rows.push(cells);
    }
    let header = named_columns(&["run", "σ of"])
        .chain(Conventions::COMPONENTS.map(str::to_owned))
        .chain(named_columns(&["AUROC", "response"]));
    let title = "median σ of one system / of the other on the same images; AUROC of telling them apart by trace R; rank correlation of σ with the size of an injected pose on identical images";
    (!rows.is_empty()).then(|| Table { title: title.to_owned(), header: header.collect(), names: 2, rows })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::evaluation::{Baselines, Origin, PairRow, PairTable, PerturbationResponse, SystemPairs, evaluate_table};
    use crate::geometry::{Covariance6, ErrorFrame, Tangent};
    use crate::report::Entry;

    fn comparison() -> Comparison {
        let row = |source: usize, size: f64, sigma: f64| PairRow {
            drive: Arc::from("drive"),
            source,
            target: source + 1,
            interval_s: Some(0.1),
            motion: Some([1.0, 0.0, 0.0, 0.0, 0.0, 0.01]),
            error: [0.04, -0.01, 0.02, 1e-3, -2e-4, 5e-6].map(|error| size * error),
            covariance: Some(Covariance6::from_std_devs(&(sigma * Tangent::new(0.03, 0.01, 0.02, 8e-4, 3e-4, 6e-6)))),
            posterior: None,
            no_verdict: None,
            stated: Some(Covariance6::from_std_devs(&Tangent::new(0.03, 0.01, 0.02, 8e-4, 3e-4, 6e-6))),
        };
        let system = |name: &str, rows| SystemPairs { name: name.to_owned(), simulated: true, rows };
        let vo = system("vo", vec![row(0, 1.0, 1.1), row(1, -0.5, 0.8), row(2, 1.5, 1.3), row(3, 0.2, 0.9)]);
        let gnss = system("gnss", (0..4).map(|source| row(source, 0.0, 0.1)).collect());
        let fitted = vec![("vo".to_owned(), Baselines::of_system(&vo))];
        let table = PairTable { error_frame: ErrorFrame::Vehicle, systems: vec![vo, gnss] };
        let origin = Origin::new("run".to_owned(), Some("relcov".to_owned()), "test");
        let mut evaluation = evaluate_table(&table, &fitted, origin).unwrap();
        evaluation.perturbation_response = Some(PerturbationResponse {
            pairs: 512,
            spearman: Some(0.912),
            spearman_by_component: [Some(0.5), None, Some(0.25), Some(0.5), Some(0.5), Some(0.5)],
            median_sigma_by_third: [0.3, 0.6, 1.2],
        });
        Comparison::new(vec![Entry { name: "run".to_owned(), evaluation, table, folder: None }]).unwrap()
    }

    #[test]
    fn results_state_split_frame_units_and_baselines() {
        let render = |format, intervals, detail| render_results(&comparison(), format, intervals, detail);
        insta::assert_snapshot!("text", render(TableFormat::Text, Intervals::Hidden, Detail::Short));
        insta::assert_snapshot!("full", render(TableFormat::Text, Intervals::Hidden, Detail::Full));
        insta::assert_snapshot!("latex", render(TableFormat::Latex, Intervals::Shown, Detail::Short));
    }

    #[test]
    fn the_table_for_programs_has_a_number_for_every_column() {
        let csv = render_results(&comparison(), TableFormat::Csv, Intervals::Hidden, Detail::Short);
        let mut reader = csv::Reader::from_reader(csv.as_bytes());
        let header = reader.headers().unwrap().clone();
        let rows: Vec<csv::StringRecord> = reader.records().collect::<Result<_, _>>().unwrap();
        let first = &rows[0];
        // Without a floor and without corrections.
        let absent = |name: &str| name == "at_floor" || name.starts_with("rms_ratio");
        assert_eq!((&first[0], &first[1]), ("vo", "relcov"));
        for (name, value) in header.iter().zip(first).skip(5) {
            assert!(value.parse::<f64>().is_ok_and(f64::is_finite) || absent(name), "{name}: `{value}`");
        }
    }
}
