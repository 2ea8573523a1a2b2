//! Fused trajectories: the way driven, and how far each estimate is off along it.

use nalgebra::Vector3;
use plotters::prelude::*;

use super::canvas::{Drawing, ERROR, FONT, GREY, Style, draw_axes, draw_line, full_line, sheet, style, thin};
use crate::recordings::Trajectory;

/// One drive's trajectories.
#[derive(Clone, Debug)]
pub struct FusedDrive {
    /// Its name.
    pub drive: String,
    /// `world_from_body`.
    pub truth: Trajectory,
    /// Measured positions, m.
    pub fixes: Vec<Vector3<f64>>,
    /// The estimates.
    pub fused: Vec<DrawnTrajectory>,
}

/// An estimate with its name.
#[derive(Clone, Debug)]
pub struct DrawnTrajectory {
    /// Name in the legend.
    pub label: String,
    /// `world_from_body`.
    pub poses: Trajectory,
}

/// Styles of the estimates, without the grey that is near the truth's.
fn look(index: usize) -> Style {
    style(if index < 4 { index } else { index + 1 })
}

/// Draws a row for each drive: the map from above, and the distance to the truth frame by frame.
///
/// # Errors
/// The drawing fails.
pub fn draw_fusion(drives: &[FusedDrive]) -> Drawing<String> {
    let labels = drives.first().map_or(&[][..], |drive| &drive.fused);
    let mut legend: Vec<_> = vec![("truth".to_owned(), full_line(GREY)), ("fixes".to_owned(), full_line(ERROR))];
    legend.extend(labels.iter().enumerate().map(|(index, drawn)| (drawn.label.clone(), look(index))));
    let size = [1100, 38 + 400 * drives.len() as u32];
    sheet("Fused trajectories: map, and distance to the truth", size, [drives.len(), 2], &legend, |index, panel| {
        let drive = &drives[index / 2];
        if index % 2 == 0 { draw_map(drive, panel) } else { draw_distance(drive, panel) }
    })
}

fn draw_map(drive: &FusedDrive, panel: &super::canvas::Sheet) -> Drawing<()> {
    let FusedDrive { drive: name, truth, fixes, fused } = drive;
    let origin = truth.values().next().map_or(Vector3::zeros(), |pose| pose.translation);
    let on_map = |position: &Vector3<f64>| (position.x - origin.x, position.y - origin.y);
    let points: Vec<(f64, f64)> = truth.values().map(|pose| on_map(&pose.translation)).collect();
    let range = |of: fn(&(f64, f64)) -> f64| {
        let values = points.iter().map(of);
        let (low, high) =
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        (0.5 * (low + high), 0.5 * (high - low))
    };
    // One scale for both axes.
    let ((x, half_x), (y, half_y)) = (range(|point| point.0), range(|point| point.1));
    let (width, height) = panel.dim_in_pixel();
    let metres_per_px = 1.1 * (2.0 * half_x / f64::from(width)).max(2.0 * half_y / f64::from(height)).max(1e-3);
    let half = [width, height].map(|pixels| 0.5 * metres_per_px * f64::from(pixels));
    let mut chart = ChartBuilder::on(panel)
        .margin(8)
        .caption(name, (FONT, 13))
        .x_label_area_size(36)
        .y_label_area_size(58)
        .build_cartesian_2d(x - half[0]..x + half[0], y - half[1]..y + half[1])?;
    draw_axes(&mut chart, "east [m]", "north [m]")?;
    draw_line(&mut chart, points, full_line(GREY))?;
    for (index, drawn) in fused.iter().enumerate() {
        draw_line(&mut chart, drawn.poses.values().map(|pose| on_map(&pose.translation)), thin(look(index)))?;
    }
    chart.draw_series(fixes.iter().map(|fix| Cross::new(on_map(fix), 4, ERROR.stroke_width(1))))?;
    Ok(())
}

fn draw_distance(drive: &FusedDrive, panel: &super::canvas::Sheet) -> Drawing<()> {
    let distances = |poses: &Trajectory| -> Vec<(f64, f64)> {
        let judged = poses.iter().filter_map(|(frame, pose)| Some((frame, pose, drive.truth.get(frame)?)));
        judged.map(|(&frame, pose, truth)| (frame as f64, (pose.translation - truth.translation).norm())).collect()
    };
    let lines: Vec<Vec<(f64, f64)>> = drive.fused.iter().map(|drawn| distances(&drawn.poses)).collect();
    let highest = lines.iter().flatten().map(|point| point.1).fold(0.0, f64::max).max(1e-9);
    let frames = drive.truth.keys().next().zip(drive.truth.keys().next_back());
    let (first, last) = frames.map_or((0.0, 1.0), |(&first, &last)| (first as f64, last as f64));
    let mut chart = ChartBuilder::on(panel)
        .margin(8)
        .x_label_area_size(36)
        .y_label_area_size(58)
        .build_cartesian_2d(first..last.max(first + 1.0), 0.0..1.05 * highest)?;
    draw_axes(&mut chart, "frame", "distance to the truth [m]")?;
    for (index, line) in lines.into_iter().enumerate() {
        draw_line(&mut chart, line, look(index))?;
    }
    Ok(())
}
