//! From a depth network's own units to metres, by LiDAR (the paper's way) or by a known factor.

use serde::{Deserialize, Serialize};

use super::DepthMap;
use super::scores::EigenCrop;
use crate::error::{Error, Result};
use crate::geometry::Pinhole;

/// What makes a network's depths metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleRule {
    /// Mean radial distance of the LiDAR's returns over the mean radial distance predicted at their pixels (the
    /// paper).
    Mean,
    /// Median depth of the returns in the Eigen crop, up to 80 m, over the median depth predicted at their pixels
    /// (Monodepth2's own way in its evaluation).
    Median,
    /// A known factor, which needs no LiDAR: 5.4 for the published networks that were trained on stereo pairs, 1 for
    /// those trained here.
    Fixed(f64),
}

/// Which returns a frame's factor is taken from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScaleScope {
    /// Those of the frame; a frame without a scan takes the sequence's factor (the paper).
    #[default]
    Frame,
    /// Those of up to 50 scans spread over the sequence: one factor, their mean, for all its frames.
    Sequence,
}

impl ScaleRule {
    /// Whether LiDAR is needed where the network runs.
    pub fn needs_lidar(&self) -> bool {
        !matches!(self, Self::Fixed(_))
    }

    /// The factor for one frame.
    ///
    /// - `predicted`: depth in the network's units, any size
    /// - `returns`: a projected scan at the camera's size ([`project_scan`](super::project_scan)), m
    ///
    /// # Errors
    /// No return falls on the image, or the ratio is no positive number.
    pub fn factor(&self, predicted: &DepthMap, returns: &DepthMap, camera: &Pinhole) -> Result<f64> {
        let (measured, predicted) = match self {
            Self::Fixed(factor) => return Ok(*factor),
            Self::Mean => mean_radial_distances(predicted, returns, camera),
            Self::Median => median_depths(predicted, returns),
        }
        .ok_or_else(|| {
            Error::Data(
                "no LiDAR return falls on the image (for the median: on its Eigen crop, up to 80 m) where the depth is known: an empty scan, one behind the camera, or a wrong calibration"
                    .to_owned(),
            )
        })?;
        let factor = measured / predicted;
        if factor.is_finite() && factor > 0.0 {
            return Ok(factor);
        }
        Err(Error::Data(format!("a scale of {measured} m over {predicted} is no positive number")))
    }
}

/// Mean distance from the camera's centre: of the returns, and predicted at their pixels.
fn mean_radial_distances(predicted: &DepthMap, returns: &DepthMap, camera: &Pinhole) -> Option<(f64, f64)> {
    let (mut count, mut measured, mut expected) = (0, 0.0, 0.0);
    for (u, v, depth) in returns.known() {
        let there = predicted.seen_from(returns, u, v);
        if there == 0.0 {
            continue;
        }
        let (x, y) = ((u as f64 - camera.cx) / camera.fx, (v as f64 - camera.cy) / camera.fy);
        let distance_of_unit_depth = (x * x + y * y + 1.0).sqrt();
        count += 1;
        measured += f64::from(depth) * distance_of_unit_depth;
        expected += there * distance_of_unit_depth;
    }
    (count > 0).then(|| (measured / f64::from(count), expected / f64::from(count)))
}

fn median_depths(predicted: &DepthMap, returns: &DepthMap) -> Option<(f64, f64)> {
    let crop = EigenCrop::of(returns);
    let judged = returns.known().filter(|&(u, v, depth)| crop.contains(u, v, depth));
    let (mut measured, mut expected): (Vec<f64>, Vec<f64>) = judged
        .map(|(u, v, depth)| (f64::from(depth), predicted.seen_from(returns, u, v)))
        .filter(|(_, there)| *there > 0.0)
        .unzip();
    Some((median(&mut measured)?, median(&mut expected)?))
}

/// The middle value, or the mean of the two middle ones.
fn median(values: &mut [f64]) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    values.sort_by(f64::total_cmp);
    Some(0.5 * (values[last / 2] + values[last.div_ceil(2)]))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    const CAMERA: Pinhole = Pinhole { fx: 40.0, fy: 40.0, cx: 20.0, cy: 10.0, width: 40, height: 20 };

    fn map(depth: impl Fn(usize, usize) -> f32) -> DepthMap {
        let depth_m = (0..20).flat_map(|v| (0..40).map(move |u| (u, v))).map(|(u, v)| depth(u, v)).collect();
        DepthMap { width: 40, height: 20, depth_m }
    }

    #[test]
    fn the_factor_of_a_scaled_map_is_found() {
        let predicted = map(|u, v| 1.0 + 0.05 * u as f32 + 0.02 * v as f32);
        let returns = DepthMap { depth_m: map(|u, _| f32::from(u % 3 == 0)).depth_m, ..predicted.clone() };
        let returns = DepthMap {
            depth_m: returns.depth_m.iter().zip(&predicted.depth_m).map(|(seen, depth)| 7.5 * seen * depth).collect(),
            ..returns
        };
        for rule in [ScaleRule::Mean, ScaleRule::Median] {
            let factor = rule.factor(&predicted, &returns, &CAMERA).unwrap();
            assert_relative_eq!(factor, 7.5, epsilon = 1e-5);
            // Pixels that the map does not know say nothing about its scale.
            let holes = DepthMap {
                depth_m: predicted
                    .depth_m
                    .iter()
                    .enumerate()
                    .map(|(pixel, &d)| if pixel % 40 < 20 { 0.0 } else { d })
                    .collect(),
                ..predicted.clone()
            };
            assert_relative_eq!(rule.factor(&holes, &returns, &CAMERA).unwrap(), 7.5, epsilon = 1e-5);
        }
        assert_eq!(ScaleRule::Fixed(5.4).factor(&predicted, &returns, &CAMERA).unwrap(), 5.4);
    }

    #[test]
    fn a_scan_beside_the_image_gives_no_factor() {
        let (predicted, nothing) = (map(|_, _| 1.0), map(|_, _| 0.0));
        for rule in [ScaleRule::Mean, ScaleRule::Median] {
            let message = rule.factor(&predicted, &nothing, &CAMERA).unwrap_err().to_string();
            assert!(message.contains("no LiDAR return"), "{message}");
        }
    }
}
