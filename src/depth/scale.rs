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
    /// (Monodepth2's own evaluation).
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
    /// Those of the whole sequence: one factor for all its frames.
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
                "no LiDAR return falls on the image: an empty scan, one behind the camera, or a wrong calibration"
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
        let (x, y) = ((u as f64 - camera.cx) / camera.fx, (v as f64 - camera.cy) / camera.fy);
        let distance_of_unit_depth = (x * x + y * y + 1.0).sqrt();
        count += 1;
        measured += f64::from(depth) * distance_of_unit_depth;
        expected += predicted.seen_from(returns, u, v) * distance_of_unit_depth;
    }
    (count > 0).then(|| (measured / f64::from(count), expected / f64::from(count)))
}

fn median_depths(predicted: &DepthMap, returns: &DepthMap) -> Option<(f64, f64)> {
    let crop = EigenCrop::of(returns);
    let judged = returns.known().filter(|&(u, v, depth)| crop.contains(u, v, depth));
    let (mut measured, mut expected): (Vec<f64>, Vec<f64>) =
        judged.map(|(u, v, depth)| (f64::from(depth), predicted.seen_from(returns, u, v))).unzip();
    Some((median(&mut measured)?, median(&mut expected)?))
}

/// The middle value, or the mean of the two middle ones.
pub(super) fn median(values: &mut [f64]) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    values.sort_by(f64::total_cmp);
    Some(0.5 * (values[last / 2] + values[last.div_ceil(2)]))
}
