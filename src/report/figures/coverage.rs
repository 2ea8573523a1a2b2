//! Coverage bars: the share of errors within 1, 2 and 3 σ.

use plotters::prelude::*;

use super::canvas::{Drawing, FONT, draw_axes, sheet, style};
use super::series::is_drawn;
use crate::geometry::Conventions;
use crate::report::Comparison;

/// Of a Gaussian.
const TARGETS: [f64; 3] = [0.6827, 0.9545, 0.9973];

pub(super) fn draw(comparison: &Comparison, system: &str) -> Drawing<Option<String>> {
    let methods: Vec<(String, [[f64; 6]; 3])> = comparison
        .methods(system)
        .into_iter()
        .filter(|(_, judged)| is_drawn(judged))
        .filter_map(|(label, judged)| Some((label, judged.metrics.coverage?)))
        .collect();
    if methods.is_empty() {
        return Ok(None);
    }
    let legend: Vec<_> = methods
        .iter()
        .enumerate()
        .map(|(index, (label, _))| (format!("{} {label}", index + 1), style(index)))
        .collect();
    let title = format!("{system}: coverage");
    let width = 0.84 / methods.len() as f64;
    let svg = sheet(&title, [980, 640], [3, 1], &legend, |level, panel| {
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .x_label_area_size(22)
            .y_label_area_size(58)
            .build_cartesian_2d(0.0..6.0, 0.0..1.05)?;
        draw_axes(&mut chart, "", &format!("share within {} σ", level + 1))?;
        for (component, name) in Conventions::COMPONENTS.iter().enumerate() {
            for (index, (_, coverage)) in methods.iter().enumerate() {
                let left = component as f64 + 0.08 + index as f64 * width;
                let share = coverage[level][component];
                let corners = [(left, 0.0), (left + 0.9 * width, share)];
                chart.draw_series([Rectangle::new(corners, style(index).colour.mix(0.75).filled())])?;
                number_bar(&chart, panel, (left + 0.45 * width, share.max(0.12)), index + 1, width)?;
            }
            let (x, y) = chart.backend_coord(&(component as f64 + 0.5, 0.0));
            let (left, top) = panel.get_base_pixel();
            panel.draw(&Text::new(*name, (x - left - 3 * name.len() as i32, y - top + 5), (FONT, 12).into_font()))?;
        }
        chart.draw_series(LineSeries::new([(0.0, TARGETS[level]), (6.0, TARGETS[level])], BLACK.stroke_width(1)))?;
        Ok(())
    })?;
    Ok(Some(svg))
}

/// The method's number inside its bar, where bars are wide enough: colours alone do not print.
fn number_bar(
    chart: &ChartContext<
        SVGBackend,
        Cartesian2d<plotters::coord::types::RangedCoordf64, plotters::coord::types::RangedCoordf64>,
    >,
    panel: &super::canvas::Sheet,
    top: (f64, f64),
    number: usize,
    width: f64,
) -> Drawing<()> {
    if width < 0.04 {
        return Ok(());
    }
    let ((x, y), (left, upper)) = (chart.backend_coord(&top), panel.get_base_pixel());
    let font = (FONT, 11).into_font().color(&WHITE);
    panel.draw(&Text::new(number.to_string(), (x - left - 3, y - upper + 3), font))?;
    Ok(())
}
