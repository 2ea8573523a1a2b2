//! Conditional calibration: normalised errors where the covariance is small and where it is large.

use plotters::prelude::*;

use super::canvas::{Drawing, GREY, component_label, draw_axes, draw_line, log_axis, sheet, style};
use super::series::is_drawn;
use crate::evaluation::{BinnedCalibration, ConditionalCalibration};
use crate::report::Comparison;

/// Panels: translation above rotation, whole covariances beside both.
const PANELS: [Option<Panel>; 8] = [
    Some(Panel::Component(0)),
    Some(Panel::Component(1)),
    Some(Panel::Component(2)),
    Some(Panel::Joint),
    Some(Panel::Component(3)),
    Some(Panel::Component(4)),
    Some(Panel::Component(5)),
    None,
];

#[derive(Clone, Copy)]
enum Panel {
    Component(usize),
    Joint,
}

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let methods: Vec<(String, &ConditionalCalibration)> = comparison
        .methods(system)
        .into_iter()
        .filter(|(_, judged)| is_drawn(judged))
        .filter_map(|(label, judged)| Some((label, judged.metrics.conditional.as_ref()?)))
        .collect();
    if methods.is_empty() {
        return Ok(None);
    }
    let legend: Vec<_> = methods.iter().enumerate().map(|(index, (label, _))| (label.clone(), style(index))).collect();
    let title = format!("{system}: normalised errors in bins of σ");
    let svg = sheet(&title, [1280, 620], [2, 4], &legend, |index, area| {
        let Some(panel) = PANELS[index] else { return Ok(()) };
        let curves: Vec<&BinnedCalibration> = methods.iter().map(|(_, found)| curve(found, panel)).collect();
        let sigmas = log_axis(curves.iter().flat_map(|curve| curve.sigma.iter().copied()));
        let squares = log_axis(curves.iter().flat_map(|curve| curve.anees.iter().copied()).chain([1.0]));
        let (Some(sigmas), Some(squares)) = (sigmas, squares) else { return Ok(()) };
        let mut chart = ChartBuilder::on(area)
            .margin(8)
            .x_label_area_size(36)
            .y_label_area_size(58)
            .build_cartesian_2d(sigmas, squares)?;
        let (x_name, y_name) = match panel {
            Panel::Component(component) => (format!("σ of {}", component_label(component)), "mean z²"),
            Panel::Joint => ("geometric mean σ of all".to_owned(), "ANEES"),
        };
        draw_axes(&mut chart, &x_name, y_name)?;
        chart.draw_series(LineSeries::new([(sigmas.low, 1.0), (sigmas.high, 1.0)], GREY.stroke_width(2)))?;
        for (index, curve) in curves.iter().enumerate() {
            let points = || curve.sigma.iter().copied().zip(curve.anees.iter().copied());
            draw_line(&mut chart, points(), style(index))?;
            chart.draw_series(points().map(|point| Circle::new(point, 3, style(index).colour.filled())))?;
        }
        Ok(())
    })?;
    Ok(Some(svg))
}

fn curve(found: &ConditionalCalibration, panel: Panel) -> &BinnedCalibration {
    match panel {
        Panel::Component(component) => &found.by_component[component],
        Panel::Joint => &found.joint,
    }
}
