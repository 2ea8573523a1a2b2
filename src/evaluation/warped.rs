//! What the network gets to see of a pair, back on the CPU for people to look at.

use burn::tensor::Device;

use super::prediction::read_values;
use crate::error::Result;
use crate::pairs::{PairBatch, PairSample};
use crate::recordings::RgbImage;
use crate::warp::Warp;

/// The source image seen from the target by the measured pose.
#[derive(Clone, Debug, PartialEq)]
pub struct WarpedPair {
    /// `I^w_{i+1}`, black where not valid.
    pub warped_image: RgbImage,
    /// Whether a pixel has a source, row by row.
    pub valid: Vec<bool>,
    /// Mean of `|I^w − I_{i+1}|` over valid pixels and channels, grey levels; `None` without any.
    pub mean_difference: Option<f64>,
}

/// Warps a pair.
///
/// # Errors
/// The device failed.
pub fn warp_pair(sample: &PairSample, device: &Device) -> Result<WarpedPair> {
    let batch = PairBatch::new(std::slice::from_ref(sample), device).images.expect("included");
    let warped = Warp.forward(batch.source_image, batch.target_depth, batch.intrinsics, batch.source_from_target);
    let planes = read_values(warped.image)?;
    let valid: Vec<bool> = read_values(warped.valid_mask)?.into_iter().map(|value| value > 0.0).collect();
    let RgbImage { width, height, bytes: target } = &*sample.target_image;
    let pixels = width * height;
    let level = |index: usize| (255.0 * planes[index % 3 * pixels + index / 3]).round().clamp(0.0, 255.0) as u8;
    let bytes: Vec<u8> = (0..3 * pixels).map(level).collect();
    let mean_difference = mean_difference(&bytes, target, &valid);
    Ok(WarpedPair { warped_image: RgbImage { width: *width, height: *height, bytes }, valid, mean_difference })
}

/// Mean of `|a − b|` over channels and the pixels of a mask, grey levels; `None` without one.
pub(super) fn mean_difference(a: &[u8], b: &[u8], mask: &[bool]) -> Option<f64> {
    let inside = a.iter().zip(b).enumerate().filter(|(index, _)| mask[index / 3]);
    let (sum, count) =
        inside.fold((0_u64, 0_u64), |(sum, count), (_, (a, b))| (sum + u64::from(a.abs_diff(*b)), count + 1));
    (count > 0).then(|| sum as f64 / count as f64)
}
