//! Paper Fig. 3: predicted σ over |e| along the sequence, component by component, systems and methods side by side.

use plotters::prelude::*;

use super::canvas::{Drawing, ERROR, FONT, GREY, component_label, draw_axes, draw_line, full_line, sheet, style, thin};
use super::series::{Series, series};
use crate::evaluation::Method;
use crate::report::Comparison;

/// More pairs than this are drawn as root mean squares of groups.
const MOST_POINTS: usize = 1500;
/// Results side by side; more would not fit a screen.
const MOST_RESULTS: usize = 4;
/// Share of points that an axis must hold.
const SHOWN: f64 = 0.995;

pub(super) fn draw(comparison: &Comparison) -> Drawing<Option<String>> {
    let columns: Vec<(String, Series)> = comparison
        .systems()
        .into_iter()
        .flat_map(|system| {
            let predictions = series(comparison, system, |judged| judged.method == Method::Predicted);
            predictions
                .into_iter()
                .take(MOST_RESULTS)
                .map(move |series| (format!("{system}, {}", series.label), series))
        })
        .collect();
    if columns.is_empty() {
        return Ok(None);
    }
    let group = columns.iter().map(|(_, series)| series.covariances.len()).max().unwrap_or(1).div_ceil(MOST_POINTS);
    let grouped = |values: Vec<f64>| -> Vec<f64> {
        let mean_square = |group: &[f64]| group.iter().map(|value| value * value).sum::<f64>() / group.len() as f64;
        values.chunks(group).map(|group| mean_square(group).sqrt()).collect()
    };
    let shown: Vec<Vec<[Vec<f64>; 2]>> = (0..6)
        .map(|c| columns.iter().map(|(_, series)| [grouped(series.errors(c)), grouped(series.sigma(c))]).collect())
        .collect();
    let highest: Vec<f64> = shown.iter().map(|columns| highest(columns)).collect();
    let mut title = "Predicted σ and |e| along the sequence".to_owned();
    if group > 1 {
        title += &format!(", root mean squares of {group} pairs");
    }
    if comparison.entries.len() > MOST_RESULTS {
        title += &format!(", the first {MOST_RESULTS} of {} results", comparison.entries.len());
    }
    let size = [60 + 440 * columns.len() as u32, 38 + 6 * 150];
    let line = style(0);
    let legend = [("predicted σ".to_owned(), line), ("|e|".to_owned(), full_line(ERROR))];
    let svg = sheet(&title, size, [6, columns.len()], &legend, |index, panel| {
        let (component, column) = (index / columns.len(), index % columns.len());
        let [errors, sigma] = &shown[component][column];
        let pairs = columns[column].1.covariances.len() as f64;
        let mut builder = ChartBuilder::on(panel);
        builder.margin(6).x_label_area_size(if component == 5 { 38 } else { 22 }).y_label_area_size(58);
        if component == 0 {
            builder.caption(&columns[column].0, (FONT, 14));
        }
        let mut chart = builder.build_cartesian_2d(0.0..pairs, 0.0..highest[component])?;
        let name = if column == 0 { component_label(component) } else { String::new() };
        draw_axes(&mut chart, if component == 5 { "pair" } else { " " }, &name)?;
        for border in columns[column].1.pairs.drives().iter().skip(1).map(|drive| drive.start as f64) {
            chart.draw_series(LineSeries::new([(border, 0.0), (border, highest[component])], GREY.mix(0.5)))?;
        }
        let place = |index: usize| (index * group) as f64 + 0.5 * (group - 1) as f64;
        let top = highest[component];
        let dots = errors.iter().enumerate().map(|(index, error)| (place(index), error.abs().min(top)));
        chart.draw_series(dots.map(|point| Circle::new(point, 2, ERROR.mix(0.4).filled())))?;
        draw_line(&mut chart, sigma.iter().enumerate().map(|(index, sigma)| (place(index), sigma.min(top))), thin(line))
    })?;
    Ok(Some(svg))
}

/// Top of an axis: above nearly all dots and lines of its row.
fn highest(columns: &[[Vec<f64>; 2]]) -> f64 {
    let mut values: Vec<f64> = columns.iter().flatten().flatten().map(|value| value.abs()).collect();
    values.sort_unstable_by(f64::total_cmp);
    let place = ((values.len() as f64 * SHOWN) as usize).min(values.len().saturating_sub(1));
    values.get(place).copied().filter(|value| *value > 0.0).map_or(1.0, |value| 1.08 * value)
}
