//! Normalised estimation error squared along the sequence, with the band of its χ² distribution.

use plotters::prelude::*;

use super::canvas::{Drawing, ERROR, FONT, GREY, draw_axes, draw_line, full_line, log_axis, sheet, style};
use super::series::series;
use crate::evaluation::Method;
use crate::report::Comparison;

/// χ² with 6 degrees of freedom stays between these with probability 0.95.
const BAND: [f64; 2] = [1.2373, 14.4494];
/// Its mean.
const MEAN: f64 = 6.0;
/// Pairs in the running mean.
const WINDOW: usize = 51;
/// Most dots of a panel.
const MOST_DOTS: usize = 3000;

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let shown = |method: Method| matches!(method, Method::Predicted | Method::Corrected);
    let predictions: Vec<(String, Vec<f64>)> = series(comparison, system, |judged| shown(judged.method))
        .into_iter()
        .filter(|series| !series.pairs.is_truth())
        .map(|series| {
            let rows = series.covariances.iter().zip(&series.errors);
            let nees = rows
                .map(|(covariance, &error)| covariance.mahalanobis(&error.into()).map_or(f64::NAN, |(nees, _)| nees));
            (series.label.clone(), nees.collect())
        })
        .collect();
    if predictions.is_empty() {
        return Ok(None);
    }
    let line = style(0);
    let legend = [
        (format!("running mean of {WINDOW} pairs"), line),
        ("NEES".to_owned(), full_line(ERROR)),
        ("mean of χ² with 6 degrees of freedom, and its 95 % band".to_owned(), full_line(GREY)),
    ];
    let title = format!("{system}: normalised errors along the sequence");
    let size = [980, 38 + 210 * predictions.len() as u32];
    let svg = sheet(&title, size, [predictions.len(), 1], &legend, |index, panel| {
        let (label, nees) = &predictions[index];
        let Some(axis) = log_axis(nees.iter().copied().chain(BAND)) else { return Ok(()) };
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .caption(label, (FONT, 14))
            .x_label_area_size(36)
            .y_label_area_size(58)
            .build_cartesian_2d(0.0..nees.len() as f64, axis)?;
        draw_axes(&mut chart, "pair", "NEES")?;
        let end = nees.len() as f64;
        chart.draw_series([Rectangle::new([(0.0, BAND[0]), (end, BAND[1])], GREY.mix(0.2).filled())])?;
        chart.draw_series(LineSeries::new([(0.0, MEAN), (end, MEAN)], GREY.stroke_width(2)))?;
        let step = nees.len().div_ceil(MOST_DOTS).max(1);
        let dots = nees.iter().enumerate().step_by(step).map(|(pair, &nees)| (pair as f64, nees));
        chart.draw_series(dots.map(|point| Circle::new(point, 1, ERROR.mix(0.6).filled())))?;
        draw_line(&mut chart, running_mean(nees, step), line)
    })?;
    Ok(Some(svg))
}

fn running_mean(values: &[f64], step: usize) -> Vec<(f64, f64)> {
    let window = WINDOW.min(values.len());
    let centre = 0.5 * (window - 1) as f64;
    let means = values.windows(window).map(|values| values.iter().sum::<f64>() / window as f64);
    means.enumerate().step_by(step).map(|(first, mean)| (first as f64 + centre, mean)).collect()
}
