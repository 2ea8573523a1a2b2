//! `losses.svg`: training and evaluation loss of each system over the epochs.

use plotters::prelude::*;

use super::history::History;

/// Size of the picture, px.
const SIZE: (u32, u32) = (720, 420);

/// Of the systems: told apart in grey too.
const COLOURS: [RGBColor; 4] =
    [RGBColor(20, 60, 130), RGBColor(222, 112, 20), RGBColor(90, 90, 90), RGBColor(60, 140, 90)];

/// Height kept free above the curves for the legend, as a share of their range.
const ROOM_FOR_LEGEND: f64 = 0.35;

/// Draws the loss curves; `None` before the first epoch is done.
pub fn loss_curves(history: &History, systems: &[String]) -> Option<String> {
    let curves: Vec<(String, bool, Vec<f64>)> = systems
        .iter()
        .enumerate()
        .flat_map(|(index, name)| {
            [
                (format!("{name}, training"), false, history.training_losses(index)),
                (format!("{name}, evaluation"), true, history.evaluation_losses(index)),
            ]
        })
        .filter(|(_, _, losses)| losses.iter().any(|loss| loss.is_finite()))
        .collect();
    let finite = || curves.iter().flat_map(|(_, _, losses)| losses.iter().copied()).filter(|loss| loss.is_finite());
    let (low, high) = (finite().reduce(f64::min)?, finite().reduce(f64::max)?);
    let range = (high - low).max(1.0);

    let mut svg = String::new();
    draw(&mut svg, &curves, history.rows.len(), low - 0.05 * range..high + (0.05 + ROOM_FOR_LEGEND) * range)
        .unwrap_or_else(|error| tracing::warn!("losses.svg could not be drawn: {error}"));
    Some(svg)
}

fn draw(
    svg: &mut String,
    curves: &[(String, bool, Vec<f64>)],
    epochs: usize,
    losses: std::ops::Range<f64>,
) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&root)
        .caption("Loss (Eq. 7, mean over pairs)", ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(1.0..(epochs.max(2) as f64), losses)?;
    chart
        .configure_mesh()
        .x_desc("epoch")
        .y_desc("nats")
        .light_line_style(WHITE.mix(0.0))
        .x_labels(epochs.clamp(2, 12))
        // A tick between two epochs has no name.
        .x_label_formatter(&|epoch| if epoch.fract() == 0.0 { format!("{epoch:.0}") } else { String::new() })
        .draw()?;
    for (index, (name, dashed, losses)) in curves.iter().enumerate() {
        let style = COLOURS[index / 2 % COLOURS.len()].stroke_width(2);
        let points = losses.iter().enumerate().map(|(epoch, &loss)| (epoch as f64 + 1.0, loss));
        let series = if *dashed {
            chart.draw_series(DashedLineSeries::new(points, 6, 4, style))?
        } else {
            chart.draw_series(LineSeries::new(points, style))?
        };
        let dashed = *dashed;
        series.label(name).legend(move |(x, y)| {
            let end = if dashed { x + 8 } else { x + 18 };
            PathElement::new(vec![(x, y), (end, y)], style)
        });
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .draw()?;
    root.present()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_show_every_system_once_there_is_an_epoch() {
        let systems = ["vo".to_owned(), "gnss".to_owned()];
        let mut history = History::new(2);
        assert!(loss_curves(&history, &systems).is_none());
        for epoch in 1..4 {
            history.batches = epoch;
            history.seconds = 1.0;
            (0..2).for_each(|system| history.add(system, -(epoch as f64)));
            history.finish_epoch(vec![Some(-1.0), None], 0.0);
        }
        let svg = loss_curves(&history, &systems).unwrap();
        for label in ["vo, training", "vo, evaluation", "gnss, training"] {
            assert!(svg.contains(label), "{label}");
        }
        assert!(!svg.contains("gnss, evaluation"), "a curve without values has no label");
    }
}
