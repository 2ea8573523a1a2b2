//! Sparsification curves: does σ find the pairs with large errors?

use plotters::prelude::*;

use super::canvas::{Drawing, draw_axes, draw_line, sheet, style};
use super::series::{is_drawn, series};
use crate::evaluation::sparsification_curve;
use crate::geometry::Conventions;
use crate::report::Comparison;

/// Points of a drawn curve.
const POINTS: usize = 200;

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let drawn = series(comparison, system, is_drawn);
    let Some(first) = drawn.first().filter(|series| !series.pairs.is_truth()) else { return Ok(None) };
    if (0..6).any(|c| first.errors(c).iter().all(|&error| error == 0.0)) {
        return Ok(None);
    }
    let legend: Vec<_> = drawn.iter().enumerate().map(|(index, series)| (series.label.clone(), style(index))).collect();
    let title = format!("{system}: sparsification (dotted: by |e| itself)");
    let svg = sheet(&title, [980, 560], [2, 3], &legend, |component, panel| {
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .x_label_area_size(36)
            .y_label_area_size(58)
            .build_cartesian_2d(0.0..1.0, 0.0..1.4)?;
        draw_axes(
            &mut chart,
            "share left out",
            &format!("mean |e| of {}, relative", Conventions::COMPONENTS[component]),
        )?;
        let errors = first.errors(component);
        let sizes: Vec<f64> = errors.iter().map(|error| error.abs()).collect();
        let perfect = thinned(sparsification_curve(&sizes, &errors));
        chart.draw_series(perfect.iter().step_by(4).map(|&point| Circle::new(point, 1, BLACK.filled())))?;
        for (index, series) in drawn.iter().enumerate() {
            let curve = sparsification_curve(&series.sigma(component), &series.errors(component));
            draw_line(&mut chart, thinned(curve).into_iter().map(|(x, y)| (x, y.min(1.4))), style(index))?;
        }
        Ok(())
    })?;
    Ok(Some(svg))
}

/// Points of a curve over the share left out.
fn thinned(curve: Vec<f64>) -> Vec<(f64, f64)> {
    let count = curve.len();
    let step = count.div_ceil(POINTS).max(1);
    curve.into_iter().enumerate().step_by(step).map(|(index, value)| (index as f64 / count as f64, value)).collect()
}
