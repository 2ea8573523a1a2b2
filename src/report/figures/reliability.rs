//! Reliability curves: how large errors are where σ is small and where it is large.

use plotters::prelude::*;

use super::canvas::{Drawing, GREY, component_label, draw_axes, draw_line, log_axis, sheet, style};
use super::series::{is_drawn, series};
use crate::evaluation::{CalibrationBin, calibration_bins};
use crate::report::Comparison;

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let curves: Vec<(String, [Vec<CalibrationBin>; 6])> = series(comparison, system, is_drawn)
        .into_iter()
        .filter(|series| !series.pairs.is_truth())
        .map(|series| {
            let bins = |c: usize| calibration_bins(&series.errors(c), &series.sigma(c));
            (series.label.clone(), std::array::from_fn(bins))
        })
        .collect();
    if curves.is_empty() {
        return Ok(None);
    }
    let legend: Vec<_> = curves.iter().enumerate().map(|(index, (label, _))| (label.clone(), style(index))).collect();
    let title = format!("{system}: reliability, errors in bins of σ");
    let svg = sheet(&title, [980, 620], [2, 3], &legend, |component, panel| {
        let bins = || curves.iter().flat_map(|(_, bins)| &bins[component]);
        let Some(axis) = log_axis(bins().flat_map(|bin| [bin.sigma, bin.error])) else { return Ok(()) };
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .x_label_area_size(36)
            .y_label_area_size(58)
            .build_cartesian_2d(axis, axis)?;
        draw_axes(&mut chart, &format!("σ of {}", component_label(component)), "RMSE")?;
        chart.draw_series(LineSeries::new([(axis.low, axis.low), (axis.high, axis.high)], GREY))?;
        for (index, (_, bins)) in curves.iter().enumerate() {
            let points = || bins[component].iter().map(|bin| (bin.sigma, bin.error));
            draw_line(&mut chart, points(), style(index))?;
            chart.draw_series(points().map(|point| Circle::new(point, 3, style(index).colour.filled())))?;
        }
        Ok(())
    })?;
    Ok(Some(svg))
}
