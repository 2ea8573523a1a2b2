//! The MDE table (paper Table II): systems by components, baselines beside, proper scores at the end.

use comfy_table::{CellAlignment, Table, presets};

use crate::evaluation::{Evaluation, Metrics};

/// Renders an evaluation as plain text; frame and units stand in the header.
pub fn mde_table(evaluation: &Evaluation) -> String {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN);
    let components = evaluation.components.iter().zip(evaluation.units).map(|(name, unit)| format!("{name} [{unit}]"));
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
    let pairs: Vec<String> =
        evaluation.systems.iter().map(|(name, results)| format!("{} {name}", results.pairs)).collect();
    let note = "MDE alone is an improper score (a prediction of zero can win it): read it with NLL (lower is better) and ANEES (1 is calibrated).";
    format!(
        "MDE = median sqrt|R - e^2|, split {}, pairs: {}\nerror frame: {} ({}); e = log(measured * truth^-1)\n{table}\n{note}\n",
        evaluation.split,
        pairs.join(", "),
        evaluation.error_frame.name(),
        evaluation.error_frame.axes(),
    )
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
    let exponent = value.abs().log10().floor() as i32;
    if (-3..3).contains(&exponent) {
        format!("{value:.*}", (2 - exponent).max(0) as usize)
    } else {
        format!("{value:.2e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_significant_digits() {
        for (value, text) in [
            (0.0, "0"),
            (0.04937, "0.0494"),
            (0.00123, "0.00123"),
            (2.76e-6, "2.76e-6"),
            (12.34, "12.3"),
            (4e-4, "4.00e-4"),
        ] {
            assert_eq!(three_digits(value), text);
        }
    }
}
