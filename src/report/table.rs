//! The MDE table (paper Table II): systems by components, baselines beside, proper scores at the end.

use comfy_table::{CellAlignment, Table, presets};

use crate::evaluation::{Evaluation, Metrics};

/// Renders an evaluation as plain text; frame and units stand in the header.
pub fn mde_table(evaluation: &Evaluation) -> String {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    let components = evaluation.components.iter().zip(&evaluation.units).map(|(name, unit)| format!("{name} [{unit}]"));
    let header = ["system", "method"].map(str::to_owned).into_iter().chain(components);
    table.set_header(header.chain(["NLL", "ANEES"].map(str::to_owned)));
    for (system, results) in &evaluation.systems {
        for (method, metrics) in &results.methods {
            table.add_row([system.clone(), (*method).to_owned()].into_iter().chain(cells(metrics)));
        }
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let mut text = String::new();
    if let Some(comparison) = against_true_table(evaluation) {
        text += &format!(
            "\nagainst the true covariance: median of predicted / true sigma, and correlation of their logarithms\n{comparison}\n"
        );
        text += "oracle: the system's true covariance; it knows the scene and not the realised error, which the warp shows, so a model may beat it\n";
    }
    if let Some(separation) = &evaluation.separation {
        let [first, second] = &separation.systems;
        let ratios = separation.median_sigma_ratio.map(three_digits).join(" ");
        text += &format!(
            "\nmedian sigma of {first} / median sigma of {second} on the same images: {ratios}; AUROC of telling them apart by trace R: {:.3}\n",
            separation.auroc
        );
    }
    if let Some(response) = &evaluation.perturbation_response {
        let correlation = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
        let components = response.spearman_by_component.map(correlation).join(" ");
        text += &format!(
            "identical images, pose exp(eps): rank correlation of sigma and |eps| {}; by component {components} ({} measurements)\n",
            correlation(response.spearman),
            response.pairs
        );
    }
    let pairs: Vec<String> =
        evaluation.systems.iter().map(|(name, results)| format!("{} {name}", results.pairs)).collect();
    let note = "MDE alone is an improper score (a prediction of zero can win it): read it with NLL (lower is better) and ANEES (1 is calibrated).";
    format!(
        "MDE = median sqrt|R - e^2|, split {}, pairs: {}\nerror frame: {} ({}); e = {}\n{table}\n{note}\n{text}",
        evaluation.split,
        pairs.join(", "),
        evaluation.error_frame.name(),
        evaluation.error_frame.axes(),
        evaluation.error,
    )
}

/// Ratios and correlations of every method, where the data state true covariances.
fn against_true_table(evaluation: &Evaluation) -> Option<Table> {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    let columns =
        |prefix: &str| evaluation.components.iter().map(|name| format!("{prefix} {name}")).collect::<Vec<_>>();
    let header = ["system", "method"].map(str::to_owned).into_iter();
    table.set_header(header.chain(columns("ratio")).chain(columns("corr.")));
    for (system, results) in &evaluation.systems {
        for (method, metrics) in &results.methods {
            let Some(comparison) = &metrics.against_true else { continue };
            let correlation = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
            let ratios = comparison.median_sigma_ratio.map(three_digits);
            let correlations = comparison.log_sigma_correlation.map(correlation);
            let names = [system.clone(), (*method).to_owned()];
            table.add_row(names.into_iter().chain(ratios).chain(correlations));
        }
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    (table.row_count() > 0).then_some(table)
}

fn cells(metrics: &Metrics) -> impl Iterator<Item = String> {
    let scores = [metrics.nll, metrics.anees].map(|score| score.map_or("-".to_owned(), |score| format!("{score:.3}")));
    metrics.mde.map(three_digits).into_iter().chain(scores)
}

/// Three significant digits, in powers of ten where decimals would run long.
fn three_digits(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    // Of the rounded value: 0.009996 is 0.0100.
    let scientific = format!("{value:.2e}");
    let exponent: i32 = scientific.rsplit('e').next().and_then(|exponent| exponent.parse().ok()).unwrap_or(0);
    if (-3..3).contains(&exponent) { format!("{value:.*}", (2 - exponent).max(0) as usize) } else { scientific }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_states_split_frame_units_and_baselines() {
        let errors = [[0.04, -0.01, 0.02, 1e-3, -2e-4, 5e-6], [-0.02, 0.01, 0.0, 0.0, 3e-4, -4e-6]];
        let metrics = |variance: f64| crate::evaluation::evaluate(&[[variance; 6]; 2], &errors).unwrap();
        let system = |methods| crate::evaluation::SystemEvaluation { pairs: 2, methods };
        let conventions = crate::geometry::Conventions::new(crate::geometry::ErrorFrame::Vehicle);
        let evaluation = Evaluation {
            schema: 1,
            error: conventions.error,
            error_frame: conventions.error_frame,
            components: conventions.components,
            units: conventions.units,
            run: "run".to_owned(),
            split: "test",
            device: "flex".to_owned(),
            unreadable_frames: Vec::new(),
            separation: Some(crate::evaluation::Separation {
                systems: ["vo", "gnss"].map(str::to_owned),
                median_sigma_ratio: [2.0, 3.0, 4.0, 5.0, 6.0, 7.5],
                auroc: 0.9876,
            }),
            perturbation_response: Some(crate::evaluation::PerturbationResponse {
                pairs: 512,
                spearman: Some(0.912),
                spearman_by_component: [Some(0.5), None, Some(0.25), Some(0.5), Some(0.5), Some(0.5)],
                median_sigma_by_third: [0.3, 0.6, 1.2],
            }),
            systems: vec![("vo".to_owned(), system(vec![("relcov", metrics(1e-4)), ("zero", metrics(0.0))]))],
        };
        insta::assert_snapshot!(mde_table(&evaluation));
    }

    #[test]
    fn numbers_have_three_significant_digits() {
        for (value, text) in [
            (0.0, "0"),
            (0.04937, "0.0494"),
            (0.00123, "0.00123"),
            (2.76e-6, "2.76e-6"),
            (12.34, "12.3"),
            (0.009996, "0.0100"),
            (4e-4, "4.00e-4"),
        ] {
            assert_eq!(three_digits(value), text);
        }
    }
}
