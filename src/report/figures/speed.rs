//! What σ follows: predictions against the measured speed.

use plotters::prelude::*;

use super::canvas::{Drawing, component_label, draw_axes, draw_line, log_axis, sheet, style};
use super::series::{Series, series};
use crate::evaluation::Method;
use crate::report::Comparison;

/// Bins of equal count, whose medians are drawn.
const BINS: usize = 12;
/// Most dots of a series.
const MOST_DOTS: usize = 800;

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let wanted = |method: Method| matches!(method, Method::Predicted | Method::LogLinear | Method::OracleDiagonal);
    let drawn: Vec<(Series, Vec<f64>)> = series(comparison, system, |judged| wanted(judged.method))
        .into_iter()
        .filter_map(|series| {
            let speeds: Option<Vec<f64>> =
                series.pairs.rows.iter().map(crate::evaluation::PairRow::speed_m_s).collect();
            Some((series, speeds?))
        })
        .collect();
    let fastest = drawn.iter().flat_map(|(_, speeds)| speeds).copied().fold(0.0, f64::max);
    if drawn.is_empty() || fastest == 0.0 {
        return Ok(None);
    }
    let legend: Vec<_> =
        drawn.iter().enumerate().map(|(index, (series, _))| (series.label.clone(), style(index))).collect();
    let title = format!("{system}: predicted σ against measured speed");
    let svg = sheet(&title, [980, 560], [2, 3], &legend, |component, panel| {
        let sigmas: Vec<Vec<f64>> = drawn.iter().map(|(series, _)| series.sigma(component)).collect();
        let Some(axis) = log_axis(sigmas.iter().flatten().copied()) else { return Ok(()) };
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .x_label_area_size(36)
            .y_label_area_size(58)
            .build_cartesian_2d(0.0..1.05 * fastest, axis)?;
        draw_axes(&mut chart, "speed [m/s]", &format!("σ of {}", component_label(component)))?;
        for (index, ((series, speeds), sigma)) in drawn.iter().zip(&sigmas).enumerate() {
            // Dots of predictions only: those of a law lie on its curve.
            if series.method == Method::Predicted {
                let step = sigma.len().div_ceil(MOST_DOTS).max(1);
                let dots = speeds.iter().copied().zip(sigma.iter().copied()).step_by(step);
                chart.draw_series(dots.map(|point| Circle::new(point, 1, style(index).colour.mix(0.35).filled())))?;
            }
            draw_line(&mut chart, binned_medians(speeds, sigma), style(index))?;
        }
        Ok(())
    })?;
    Ok(Some(svg))
}

fn binned_medians(speeds: &[f64], sigma: &[f64]) -> Vec<(f64, f64)> {
    let mut order: Vec<usize> = (0..speeds.len()).collect();
    order.sort_unstable_by(|&a, &b| speeds[a].total_cmp(&speeds[b]));
    let middle = |values: &mut Vec<f64>| {
        values.sort_unstable_by(f64::total_cmp);
        values[values.len() / 2]
    };
    order
        .chunks(order.len().div_ceil(BINS).max(1))
        .map(|bin| {
            let of = |values: &[f64]| bin.iter().map(|&index| values[index]).collect::<Vec<f64>>();
            (middle(&mut of(speeds)), middle(&mut of(sigma)))
        })
        .collect()
}
