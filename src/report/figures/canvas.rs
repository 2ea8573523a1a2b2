//! What all figures share: a titled sheet of panels, a legend below, and line styles that differ in
//! brightness and in dashes, so that they can be told apart in grey.

use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, ValueFormatter};
use plotters::prelude::*;

use crate::geometry::Conventions;

/// What drawing may run into.
pub type Drawing<T> = std::result::Result<T, Box<dyn std::error::Error>>;

pub(super) type Sheet<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// The colour of errors.
pub(super) const ERROR: RGBColor = RGBColor(196, 78, 60);
/// Of what is only there to compare with.
pub(super) const GREY: RGBColor = RGBColor(130, 130, 130);
pub(super) const FONT: &str = "sans-serif";

/// Neighbours differ in brightness too; after the last they come again with other dashes.
const COLOURS: [RGBColor; 8] = [
    RGBColor(20, 60, 130),
    RGBColor(222, 112, 20),
    RGBColor(60, 140, 90),
    RGBColor(150, 80, 160),
    RGBColor(90, 90, 90),
    RGBColor(70, 160, 200),
    RGBColor(200, 30, 90),
    RGBColor(160, 140, 0),
];
/// Length of dashes and gaps, px; the first is a full line.
const DASHES: [(i32, i32); 4] = [(1, 0), (8, 4), (3, 3), (12, 3)];

/// How a series is drawn.
#[derive(Clone, Copy)]
pub(super) struct Style {
    pub(super) colour: RGBColor,
    dash: (i32, i32),
    width: u32,
}

/// A thin line for many points.
pub(super) fn thin(style: Style) -> Style {
    Style { width: 1, ..style }
}

/// A full line of a colour.
pub(super) fn full_line(colour: RGBColor) -> Style {
    Style { colour, dash: (1, 0), width: 2 }
}

pub(super) fn style(index: usize) -> Style {
    Style {
        colour: COLOURS[index % COLOURS.len()],
        dash: DASHES[(index + index / COLOURS.len()) % DASHES.len()],
        width: 2,
    }
}

/// Draws a sheet: title, `rows x columns` panels, a legend of labels and styles.
pub(super) fn sheet(
    title: &str,
    [width, height]: [u32; 2],
    [rows, columns]: [usize; 2],
    legend: &[(String, Style)],
    mut draw: impl FnMut(usize, &Sheet) -> Drawing<()>,
) -> Drawing<String> {
    let mut svg = String::new();
    {
        let lines = legend_lines(legend, width);
        let root = SVGBackend::with_string(&mut svg, (width, height + 20 * lines.len() as u32)).into_drawing_area();
        root.fill(&WHITE)?;
        root.draw(&Text::new(title.to_owned(), (14, 10), (FONT, 17).into_font()))?;
        let (body, below) = root.margin(34, 4, 4, 4).split_vertically(height - 38);
        for (index, panel) in body.split_evenly((rows, columns)).iter().enumerate() {
            draw(index, panel)?;
        }
        for (line, entries) in lines.iter().enumerate() {
            for (left, label, style) in entries {
                let middle = 8 + 20 * line as i32;
                stroke(&below, &[(*left, middle), (left + 28, middle)], *style)?;
                below.draw(&Text::new(label.clone(), (left + 34, middle - 7), (FONT, 13).into_font()))?;
            }
        }
        root.present()?;
    }
    Ok(join_dots(&svg))
}

/// Where labels stand, line by line.
fn legend_lines(legend: &[(String, Style)], width: u32) -> Vec<Vec<(i32, String, Style)>> {
    let mut lines: Vec<Vec<(i32, String, Style)>> = Vec::new();
    let mut left = i32::MAX;
    for (label, style) in legend {
        let length = 54 + 7 * label.chars().count() as i32;
        if left.saturating_add(length) > width as i32 {
            left = 14;
            lines.push(Vec::new());
        }
        lines.last_mut().expect("just pushed").push((left, label.clone(), *style));
        left += length;
    }
    lines
}

/// A polyline in pixels.
fn stroke(area: &Sheet, points: &[(i32, i32)], style: Style) -> Drawing<()> {
    let line = style.colour.stroke_width(2);
    match style.dash {
        (_, 0) => area.draw(&PathElement::new(points.to_vec(), line))?,
        (dash, gap) => area.draw(&plotters::element::DashedPathElement::new(points.to_vec(), dash, gap, line))?,
    }
    Ok(())
}

/// Draws a line into a chart, in pieces where a value is missing.
pub(super) fn draw_line<X, Y>(
    chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
    points: impl IntoIterator<Item = (f64, f64)>,
    style: Style,
) -> Drawing<()>
where
    X: Ranged<ValueType = f64>,
    Y: Ranged<ValueType = f64>,
{
    let points: Vec<(f64, f64)> = points.into_iter().collect();
    let line = style.colour.stroke_width(style.width);
    for piece in points.split(|(x, y)| !(x.is_finite() && y.is_finite())).filter(|piece| !piece.is_empty()) {
        match style.dash {
            (_, 0) => chart.draw_series(LineSeries::new(piece.to_vec(), line))?,
            (dash, gap) => chart.draw_series(DashedLineSeries::new(piece.to_vec(), dash as u32, gap as u32, line))?,
        };
    }
    Ok(())
}

/// A component with its unit.
pub(super) fn component_label(component: usize) -> String {
    format!("{} [{}]", Conventions::COMPONENTS[component], Conventions::UNITS[component])
}

/// Makes one path of dots that look the same and follow one another: a tenth of the bytes.
fn join_dots(svg: &str) -> String {
    let mut joined = String::with_capacity(svg.len());
    let mut path: Option<(&str, String)> = None;
    for line in svg.lines().map(Some).chain([None]) {
        let dot = line.and_then(parse_dot);
        // Another look, or something else: the path is complete.
        if let Some((look, places)) = path.take_if(|(look, _)| dot.is_none_or(|(_, _, other)| other != *look)) {
            joined += &dots_path(look, &places);
        }
        match (dot, line) {
            (Some((x, y, look)), _) => path.get_or_insert((look, String::new())).1 += &format!("M{x} {y}h.01"),
            (None, Some(line)) => {
                joined += line;
                joined.push('\n');
            }
            (None, None) => {}
        }
    }
    joined
}

/// Column, row and look of a filled circle.
fn parse_dot(line: &str) -> Option<(&str, &str, &str)> {
    let (x, rest) = line.strip_prefix("<circle cx=\"")?.split_once("\" cy=\"")?;
    let (y, look) = rest.split_once("\" ")?;
    look.contains("stroke=\"none\"").then_some((x, y, look))
}

/// Strokes without length but with round ends.
fn dots_path(look: &str, places: &str) -> String {
    let value = |name: &str| look.split(&format!("{name}=\"")).nth(1).and_then(|rest| rest.split('"').next());
    let width = 2.0 * value("r").and_then(|radius| radius.parse::<f64>().ok()).unwrap_or(1.0);
    let (opacity, colour) = (value("opacity").unwrap_or("1"), value("fill").unwrap_or("#000000"));
    format!(
        "<path d=\"{places}\" fill=\"none\" stroke=\"{colour}\" stroke-opacity=\"{opacity}\" stroke-width=\"{width}\" stroke-linecap=\"round\"/>\n"
    )
}

/// Draws grid, ticks and names of axes; an x-axis without a name has no ticks either.
pub(super) fn draw_axes<X, Y>(
    chart: &mut ChartContext<'_, SVGBackend<'_>, Cartesian2d<X, Y>>,
    x_name: &str,
    y_name: &str,
) -> Drawing<()>
where
    X: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let mut mesh = chart.configure_mesh();
    mesh.light_line_style(WHITE).bold_line_style(GREY.mix(0.25)).label_style((FONT, 11)).axis_desc_style((FONT, 12));
    mesh.x_desc(x_name).y_desc(y_name).x_labels(6).y_labels(7).x_label_formatter(&tick).y_label_formatter(&tick);
    if x_name.is_empty() {
        mesh.disable_x_mesh().x_labels(0);
    }
    mesh.draw()?;
    Ok(())
}

/// A tick with as many digits as it needs.
pub(super) fn tick(value: &f64) -> String {
    if *value == 0.0 {
        return "0".to_owned();
    }
    match value.abs() {
        size if (1e-3..1e4).contains(&size) => {
            let text = format!("{value:.4}");
            text.trim_end_matches('0').trim_end_matches('.').to_owned()
        }
        _ => format!("{value:.1e}").replace(".0e", "e"),
    }
}

/// A logarithmic axis around positive values; `None` without any.
pub(super) fn log_axis(values: impl IntoIterator<Item = f64>) -> Option<LogAxis> {
    let (mut low, mut high) = (f64::INFINITY, 0.0_f64);
    for value in values.into_iter().filter(|value| value.is_finite() && *value > 0.0) {
        (low, high) = (low.min(value), high.max(value));
    }
    (high > 0.0).then_some(LogAxis { low: 0.8 * low, high: 1.25 * high })
}

/// A logarithmic axis whose ticks are round numbers however short it is.
#[derive(Clone, Copy)]
pub(super) struct LogAxis {
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Ranged for LogAxis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        let share = (value.max(self.low) / self.low).ln() / (self.high / self.low).ln();
        limit.0 + (share * f64::from(limit.1 - limit.0)).round() as i32
    }

    fn key_points<H: KeyPointHint>(&self, hint: H) -> Vec<f64> {
        let most = hint.max_num_points().max(2);
        let decades = self.low.log10().floor() as i32..=self.high.log10().ceil() as i32;
        let within = |factors: &[f64]| -> Vec<f64> {
            let points =
                decades.clone().flat_map(|decade| factors.iter().map(move |factor| factor * 10_f64.powi(decade)));
            points.filter(|point| (self.low..=self.high).contains(point)).collect()
        };
        let every = [&[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0][..], &[1.0, 2.0, 5.0], &[1.0, 3.0], &[1.0]];
        let fitting = every.iter().map(|factors| within(factors)).find(|points| points.len() <= most);
        fitting.unwrap_or_else(|| {
            let powers = within(&[1.0]);
            let step = powers.len().div_ceil(most);
            powers.into_iter().step_by(step).collect()
        })
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.low..self.high
    }
}
