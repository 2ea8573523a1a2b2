//! What an evaluation found, as tables: the MDE table (paper Table II) with proper scores beside it,
//! calibration, and how systems are told apart.

use super::comparison::{Comparison, Judged};
use super::table::{Better, Cell, Table, TableFormat, three_digits};
use crate::evaluation::{Method, Metrics};
use crate::geometry::Conventions;

/// Whether values come with their block-bootstrap intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Intervals {
    /// `0.0494 [0.0481, 0.0507]`
    Shown,
    /// `0.0494`
    Hidden,
}

/// Everything in one form: text and Markdown for people, one wide table of all scores as CSV, the paper's
/// Table II as LaTeX.
pub fn render_results(comparison: &Comparison, format: TableFormat, intervals: Intervals) -> String {
    match format {
        TableFormat::Csv => full_table(comparison).render(format),
        TableFormat::Latex => table_two(comparison, intervals).render(format),
        TableFormat::Text | TableFormat::Markdown => {
            let mut parts = vec![preface(comparison)];
            parts.extend(comparison.warnings.iter().map(|warning| format!("WARNING: {warning}\n")));
            let tables = [
                Some(score_table(comparison, intervals)),
                Some(crps_table(comparison)),
                Some(calibration_table(comparison)),
                true_sigma_table(comparison),
                separation_table(comparison),
            ];
            for table in tables.into_iter().flatten() {
                let title = if format == TableFormat::Text { format!("\n{}\n", table.title) } else { "\n".to_owned() };
                parts.push(title + &table.render(format));
            }
            parts.push(format!("\n{}\n", notes(comparison).join("\n")));
            parts.concat()
        }
    }
}

/// Frame, order, side and what was evaluated: stands above every table.
pub fn preface(comparison: &Comparison) -> String {
    let first = &comparison.entries[0].evaluation;
    let pairs: Vec<String> = first.systems.iter().map(|(name, system)| format!("{} {name}", system.pairs)).collect();
    format!(
        "split {}, pairs: {}\nerror frame: {} ({}); e = {}\n",
        first.origin.split,
        pairs.join(", "),
        first.error_frame.name(),
        first.error_frame.axes(),
        first.error
    )
}

/// How to read the tables.
pub fn notes(comparison: &Comparison) -> Vec<String> {
    let mut notes = vec![
        "MDE = median sqrt|R - e^2| alone is an improper score (a prediction of zero can win it): read it with NLL (lower is better), CRPS (lower is better) and ANEES (1 is calibrated).".to_owned(),
        "* best of those that compete: not a variance of zero, nor an oracle, which knows the truth.".to_owned(),
    ];
    let has = |method: Method| {
        let systems = comparison.systems();
        systems.iter().any(|system| comparison.methods(system).iter().any(|(_, judged)| judged.method == method))
    };
    if has(Method::Oracle) {
        notes.push("oracle: the system's true covariance; it knows the scene and not the realised error, which the warp shows, so a model may beat it.".to_owned());
    }
    for entry in &comparison.entries {
        if let Some(recalibration) = &entry.evaluation.origin.recalibration {
            let factors = recalibration.factors.map(three_digits).join(" ");
            notes.push(format!(
                "{}: variances times {factors} (x … yaw), fitted to {} pairs of split {}; uncalibrated: without.",
                entry.name, recalibration.pairs, recalibration.split
            ));
        }
    }
    if let Some((system, settings)) =
        comparison.entries[0].evaluation.systems.iter().find_map(|(name, system)| Some((name, system.bootstrap?)))
    {
        notes.push(format!(
            "intervals: {:.0} %, circular block bootstrap, blocks of {} pairs ({system}), {} resamples, seed {}.",
            100.0 * settings.level,
            settings.block_length,
            settings.replicates,
            settings.seed
        ));
    }
    notes
}

/// MDE of every component, NLL and ANEES: methods below one another.
pub fn score_table(comparison: &Comparison, intervals: Intervals) -> Table {
    let header = named_columns(&["system", "method"]).chain(unit_columns("")).chain(named_columns(&["NLL", "ANEES"]));
    let row = |metrics: &Metrics| {
        let mut cells: Vec<Cell> = (0..6).map(|c| mde_cell(metrics, c, intervals)).collect();
        cells.extend([nll_cell(metrics, intervals), anees_cell(metrics, intervals)]);
        cells
    };
    let better = [[Better::Lower; 7].as_slice(), &[Better::Near(1.0)]].concat();
    method_table("MDE = median sqrt|R - e^2|", header.collect(), comparison, row, &better)
}

/// CRPS of every component, and two joint scores.
pub fn crps_table(comparison: &Comparison) -> Table {
    let joint = ["NLL - constant's", "e'R^-1 e < 12.6"];
    let header = named_columns(&["system", "method"]).chain(unit_columns("")).chain(named_columns(&joint));
    let row = |metrics: &Metrics| {
        let mut cells: Vec<Cell> = (0..6).map(|c| cell(metrics.crps.map(|crps| crps[c]), three_digits)).collect();
        let difference = metrics.nll_over_constant.map_or(Cell::default(), |difference| Cell {
            text: with_interval(format!("{:.3}", difference.mean), Some(difference.interval), |value| {
                format!("{value:.3}")
            }),
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
        row,
        &better,
    )
}

/// A table of methods below one another, system after system.
fn method_table(
    title: &str,
    header: Vec<String>,
    comparison: &Comparison,
    row: impl Fn(&Metrics) -> Vec<Cell>,
    better: &[Better],
) -> Table {
    let mut rows = Vec::new();
    let mut outside = Vec::new();
    for system in comparison.systems() {
        for (name, judged) in comparison.methods(system) {
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
    if comparison.is_of_one_data_set() {
        table.mark_best(|row| !excluded.iter().any(|(system, method)| *system == row[0] && *method == row[1]), better);
    }
    table
}

fn competes(judged: &Judged) -> bool {
    let knows = matches!(judged.method, Method::Oracle | Method::OracleDiagonal);
    !knows && judged.metrics.sharpness.iter().all(|&sigma| sigma > 0.0)
}

/// Calibration and sharpness of the predictions, component by component.
pub fn calibration_table(comparison: &Comparison) -> Table {
    type Score = (&'static str, fn(&Metrics) -> Option<[Option<f64>; 6]>, Better);
    let scores: [Score; 9] = [
        ("mean σ [m, rad]", |metrics| Some(metrics.sharpness.map(Some)), Better::Neutral),
        ("mean z² (1)", |metrics| Some(metrics.zms?.map(Some)), Better::Near(1.0)),
        ("within 1σ (.683)", |metrics| Some(metrics.coverage?[0].map(Some)), Better::Near(0.683)),
        ("within 2σ (.954)", |metrics| Some(metrics.coverage?[1].map(Some)), Better::Near(0.954)),
        ("within 3σ (.997)", |metrics| Some(metrics.coverage?[2].map(Some)), Better::Near(0.997)),
        ("ENCE (0)", |metrics| Some(metrics.ence?.map(Some)), Better::Lower),
        ("AUSE (0)", |metrics| Some(metrics.ause?.map(Some)), Better::Lower),
        ("AURG (high)", |metrics| Some(metrics.aurg?.map(Some)), Better::Higher),
        ("rank corr. of σ, |e|", |metrics| Some(metrics.spearman), Better::Higher),
    ];
    let mut rows = Vec::new();
    for system in comparison.systems() {
        let predictions: Vec<_> =
            comparison.methods(system).into_iter().filter(|(_, judged)| judged.method == Method::Predicted).collect();
        for (label, values, _) in scores {
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
    Table { title: "calibration of the predictions".to_owned(), header: header.collect(), names: 3, rows }
}

/// Predicted beside true σ, where the data state true covariances.
pub fn true_sigma_table(comparison: &Comparison) -> Option<Table> {
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
pub fn separation_table(comparison: &Comparison) -> Option<Table> {
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
            let distance = |value: f64| if index == 7 { (value - 1.0).abs() } else { value };
            let competing = |label: &String| found(label).is_some_and(|(_, judged)| competes(judged));
            let ranks: Vec<Option<f64>> = labels
                .iter()
                .zip(&cells)
                .map(|(label, cell)| cell.value.filter(|_| competing(label)).map(distance))
                .collect();
            let best = ranks.iter().flatten().copied().fold(f64::INFINITY, f64::min);
            if comparison.is_of_one_data_set() && ranks.iter().flatten().count() > 1 {
                for (cell, rank) in cells.iter_mut().zip(ranks) {
                    cell.best = rank == Some(best);
                }
            }
            rows.push([vec![Cell::name(*system), Cell::name(score)], cells].concat());
        }
    }
    let header = named_columns(&["Rel. Pose. Meas.", "Metric"]).chain(labels).collect();
    let warnings: String = comparison.warnings.iter().map(|warning| format!("WARNING: {warning}\n")).collect();
    Table { title: format!("{}{warnings}", preface(comparison)).trim_end().to_owned(), header, names: 2, rows }
}

/// Every score of every method, one row each.
pub fn full_table(comparison: &Comparison) -> Table {
    let mut header: Vec<String> =
        named_columns(&["system", "method", "run", "split", "error_frame", "pairs"]).collect();
    let per_component: [(&str, bool); 17] = [
        ("mde", true),
        ("mde_low", true),
        ("mde_high", true),
        ("de_25", true),
        ("de_75", true),
        ("crps", true),
        ("mean_sigma", true),
        ("nll", false),
        ("zms", false),
        ("within_1_sigma", false),
        ("within_2_sigma", false),
        ("within_3_sigma", false),
        ("ence", false),
        ("ause", false),
        ("aurg", false),
        ("spearman", false),
        ("true_sigma_ratio", false),
    ];
    let joint = [
        "nll [nats]",
        "nll_low",
        "nll_high",
        "nll_over_constant",
        "nll_over_constant_low",
        "nll_over_constant_high",
        "anees",
        "anees_low",
        "anees_high",
        "nees_below_95",
        "at_floor",
    ];
    header.extend(named_columns(&joint));
    for (name, has_unit) in per_component {
        let units = Conventions::COMPONENTS.iter().zip(Conventions::UNITS);
        header.extend(units.map(|(component, unit)| match has_unit {
            true => format!("{name}_{component} [{unit}]"),
            false => format!("{name}_{component}"),
        }));
    }
    let mut rows = Vec::new();
    for system in comparison.systems() {
        for (name, Judged { entry, metrics, .. }) in comparison.methods(system) {
            let origin = &entry.evaluation.origin;
            let pairs = entry.evaluation.systems.get(system).map_or(0, |system| system.pairs);
            let frame = entry.evaluation.error_frame.name();
            let mut row: Vec<Cell> =
                [system, &name, &origin.run, &origin.split, frame, &pairs.to_string()].map(Cell::name).into();
            let bounds = |interval: Option<[f64; 2]>| [0, 1].map(|side| interval.map(|interval| interval[side]));
            let [nll_low, nll_high] = bounds(metrics.nll_interval);
            let [anees_low, anees_high] = bounds(metrics.anees_interval);
            let [difference_low, difference_high] =
                bounds(metrics.nll_over_constant.map(|difference| difference.interval));
            row.extend(
                [
                    metrics.nll,
                    nll_low,
                    nll_high,
                    metrics.nll_over_constant.map(|difference| difference.mean),
                    difference_low,
                    difference_high,
                    metrics.anees,
                    anees_low,
                    anees_high,
                    metrics.nees_below_95,
                    metrics.at_floor,
                ]
                .map(full_cell),
            );
            let all: [Option<[Option<f64>; 6]>; 17] = [
                Some(metrics.mde.map(Some)),
                metrics.mde_interval.map(|bounds| bounds[0].map(Some)),
                metrics.mde_interval.map(|bounds| bounds[1].map(Some)),
                Some(metrics.de_quartiles[0].map(Some)),
                Some(metrics.de_quartiles[2].map(Some)),
                metrics.crps.map(|values| values.map(Some)),
                Some(metrics.sharpness.map(Some)),
                metrics.nll_by_component.map(|values| values.map(Some)),
                metrics.zms.map(|values| values.map(Some)),
                metrics.coverage.map(|values| values[0].map(Some)),
                metrics.coverage.map(|values| values[1].map(Some)),
                metrics.coverage.map(|values| values[2].map(Some)),
                metrics.ence.map(|values| values.map(Some)),
                metrics.ause.map(|values| values.map(Some)),
                metrics.aurg.map(|values| values.map(Some)),
                Some(metrics.spearman),
                metrics.against_true.as_ref().map(|compared| compared.median_sigma_ratio.map(Some)),
            ];
            row.extend(all.into_iter().flat_map(|values| values.unwrap_or([None; 6])).map(full_cell));
            rows.push(row);
        }
    }
    Table { title: "all scores".to_owned(), header, names: 6, rows }
}

fn named_columns(names: &[&str]) -> impl Iterator<Item = String> {
    names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>().into_iter()
}

fn unit_columns(prefix: &str) -> impl Iterator<Item = String> {
    let named = Conventions::COMPONENTS.iter().zip(Conventions::UNITS);
    named.map(move |(name, unit)| format!("{prefix}{name} [{unit}]")).collect::<Vec<_>>().into_iter()
}

fn cell(value: Option<f64>, show: impl Fn(f64) -> String) -> Cell {
    Cell { text: value.map_or(String::new(), show), value, best: false }
}

fn full_cell(value: Option<f64>) -> Cell {
    cell(value, |value| value.to_string())
}

fn with_interval(text: String, interval: Option<[f64; 2]>, show: impl Fn(f64) -> String) -> String {
    interval.map_or(text.clone(), |[low, high]| format!("{text} [{}, {}]", show(low), show(high)))
}

fn interval_cell(value: Option<f64>, interval: Option<[f64; 2]>, shown: Intervals, show: fn(f64) -> String) -> Cell {
    let mut cell = cell(value, show);
    if shown == Intervals::Shown && value.is_some() {
        cell.text = with_interval(cell.text, interval, show);
    }
    cell
}

fn mde_cell(metrics: &Metrics, c: usize, shown: Intervals) -> Cell {
    interval_cell(
        Some(metrics.mde[c]),
        metrics.mde_interval.map(|bounds| bounds.map(|bound| bound[c])),
        shown,
        three_digits,
    )
}

/// A logarithm: its decimals are its significant digits.
fn nll_cell(metrics: &Metrics, shown: Intervals) -> Cell {
    interval_cell(metrics.nll, metrics.nll_interval, shown, |value| format!("{value:.3}"))
}

fn anees_cell(metrics: &Metrics, shown: Intervals) -> Cell {
    interval_cell(metrics.anees, metrics.anees_interval, shown, |value| format!("{value:.3}"))
}
