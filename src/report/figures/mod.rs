//! Figures of results, drawn once as SVG and rasterised for PNG: those of the paper, calibration, and what
//! σ follows. All from the measurements of a [`Comparison`], none from tensors.

mod canvas;
mod conditional;
mod coverage;
mod dispersion;
mod nees;
mod raster;
mod reliability;
mod sequence;
mod series;
mod sparsification;
mod speed;
mod trajectory;

use std::path::Path;

use super::comparison::Comparison;
use crate::error::{Error, Result};
use crate::files::{read_text, write_atomically};
use crate::training::LOSSES;

pub use canvas::Drawing;
pub use raster::to_png;
pub use trajectory::{DrawnTrajectory, FusedDrive, draw_fusion};

/// A picture with its place in a report.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// File name without extension.
    pub name: String,
    /// What it shows and how to read it.
    pub caption: String,
    /// The picture.
    pub svg: String,
}

/// Name, caption and drawing of a figure that each system has.
type SystemFigure = (&'static str, &'static str, fn(&Comparison, &str) -> Drawing<Option<String>>);

const BY_SYSTEM: [SystemFigure; 7] = [
    (
        "dispersion",
        "dispersion errors √|R − e²| (paper Fig. 4): boxes from the lower to the upper quartile, line at the median (MDE), whiskers from 5 to 95 %. An improper score: a prediction of zero can win it.",
        dispersion::draw,
    ),
    (
        "reliability",
        "errors (RMSE) where σ is small and where it is large, ten bins of equal count. Calibrated predictions lie on the diagonal; below it they are too large.",
        reliability::draw,
    ),
    (
        "conditional",
        "normalised errors where the covariance is small and where it is large, ten bins of equal count: mean z² by σ of each component, ANEES by the geometric mean σ of all. Calibrated predictions stay at 1; above it they are too small there.",
        conditional::draw,
    ),
    ("coverage", "share of errors within 1, 2 and 3 σ. Calibrated predictions reach the lines.", coverage::draw),
    (
        "sparsification",
        "mean |e| of the pairs that are left when those of the largest σ are left out first. The nearer to the dotted line (by |e| itself) the better σ ranks errors; a constant stays at 1.",
        sparsification::draw,
    ),
    (
        "nees",
        "normalised errors eᵀR⁻¹e along the sequence. Calibrated ones lie within the band (95 % of χ² with 6 degrees of freedom) 95 % of the time; line: running mean, which should be 6.",
        nees::draw,
    ),
    ("speed", "predicted σ against measured speed; lines: medians of bins of equal count.", speed::draw),
];

/// Draws every figure that the results allow.
///
/// # Errors
/// A run's loss curves cannot be read.
pub fn draw_figures(comparison: &Comparison) -> Result<Vec<Figure>> {
    let mut figures = Vec::new();
    let mut add = |name: String, caption: String, drawn: Drawing<Option<String>>| match drawn {
        Ok(Some(svg)) => figures.push(Figure { name, caption, svg }),
        Ok(None) => {}
        Err(error) => tracing::warn!("figure {name} could not be drawn: {error}"),
    };
    add(
        "sequence".to_owned(),
        "Predicted σ (line) over |e| (dots) along the sequence, each system and method (paper Fig. 3). A good line follows the upper edge of most dots.".to_owned(),
        sequence::draw(comparison),
    );
    for system in comparison.systems() {
        for (name, caption, draw) in BY_SYSTEM {
            add(format!("{name}_{system}"), format!("{system}: {caption}"), draw(comparison, system));
        }
    }
    for entry in &comparison.entries {
        let Some(path) = entry.folder.as_ref().map(|folder| folder.join(LOSSES)).filter(|path| path.is_file()) else {
            continue;
        };
        figures.push(Figure {
            name: format!("losses_{}", entry.name.replace(|c: char| !c.is_alphanumeric(), "_")),
            caption: format!("{}: loss over the epochs of its training; dashed: on the watched pairs.", entry.name),
            svg: read_text(&path)?,
        });
    }
    Ok(figures)
}

/// Writes every figure into a folder as SVG and PNG; how many there are.
///
/// # Errors
/// A file cannot be written.
pub fn write_figures(comparison: &Comparison, folder: &Path) -> Result<usize> {
    std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
    let figures = draw_figures(comparison)?;
    for figure in &figures {
        write_atomically(&folder.join(format!("{}.svg", figure.name)), figure.svg.as_bytes())?;
        let png = folder.join(format!("{}.png", figure.name));
        let pixels = to_png(&figure.svg).map_err(|problem| {
            Error::malformed(&png, crate::error::Place::Whole, problem, "a picture that can be drawn")
        })?;
        write_atomically(&png, &pixels)?;
    }
    Ok(figures.len())
}
