//! Paper Fig. 4: box plots of dispersion errors.

use plotters::prelude::*;

use super::canvas::{Drawing, FONT, component_label, draw_axes, log_axis, sheet, style};
use super::series::{is_drawn, series};
use crate::evaluation::quantile;
use crate::report::Comparison;

/// Whiskers, quartiles and median.
const SHARES: [f64; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let boxes: Vec<(String, [[f64; 5]; 6])> = series(comparison, system, is_drawn)
        .into_iter()
        .map(|series| {
            let quantiles = |c: usize| {
                let pairs = series.errors(c).into_iter().zip(series.sigma(c));
                let mut dispersion: Vec<f64> = pairs.map(|(e, sigma)| (sigma * sigma - e * e).abs().sqrt()).collect();
                dispersion.sort_unstable_by(f64::total_cmp);
                SHARES.map(|share| quantile(&dispersion, share))
            };
            (series.label.clone(), std::array::from_fn(quantiles))
        })
        // What is nowhere above zero has no place on a logarithmic axis.
        .filter(|(_, quantiles): &(_, [[f64; 5]; 6])| quantiles.iter().all(|quantiles| quantiles[2] > 0.0))
        .collect();
    if boxes.is_empty() {
        return Ok(None);
    }
    let legend: Vec<_> =
        boxes.iter().enumerate().map(|(index, (label, _))| (format!("{} {label}", index + 1), style(index))).collect();
    let title = format!("{system}: dispersion errors √|R − e²|");
    let svg = sheet(&title, [980, 560], [2, 3], &legend, |component, panel| {
        let quantiles = || boxes.iter().enumerate().map(|(index, (_, quantiles))| (index, quantiles[component]));
        let Some(axis) = log_axis(quantiles().flat_map(|(_, quantiles)| quantiles)) else { return Ok(()) };
        // A whisker at zero ends at the axis.
        let floor = axis.low;
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .x_label_area_size(22)
            .y_label_area_size(58)
            .build_cartesian_2d(0.0..boxes.len() as f64, axis)?;
        draw_axes(&mut chart, "", &component_label(component))?;
        for (index, quantiles) in quantiles() {
            let [low, lower, middle, upper, high] = quantiles.map(|value| value.max(floor));
            let colour = style(index).colour;
            let (centre, half) = (index as f64 + 0.5, 0.28);
            let bar = |y: f64, half: f64| [(centre - half, y), (centre + half, y)];
            chart.draw_series([Rectangle::new(
                [(centre - half, lower), (centre + half, upper)],
                colour.mix(0.3).filled(),
            )])?;
            chart.draw_series([Rectangle::new([(centre - half, lower), (centre + half, upper)], colour)])?;
            for whisker in
                [[(centre, low), (centre, lower)], [(centre, upper), (centre, high)], bar(low, 0.12), bar(high, 0.12)]
            {
                chart.draw_series(LineSeries::new(whisker, colour))?;
            }
            chart.draw_series(LineSeries::new(bar(middle, half), colour.stroke_width(3)))?;
            let (x, y) = chart.backend_coord(&(centre, floor));
            let (left, top) = panel.get_base_pixel();
            panel.draw(&Text::new((index + 1).to_string(), (x - left - 4, y - top + 6), (FONT, 12).into_font()))?;
        }
        Ok(())
    })?;
    Ok(Some(svg))
}
