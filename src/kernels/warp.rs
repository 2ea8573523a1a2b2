//! The warp in one pass: reprojection, bilinear sample and validity of each pixel, with nothing of
//! image size in between.

use pulp::Simd;
use rayon::prelude::*;

use super::buffer::{Shared, filled};
use super::instructions::{Instructions, Kernel};

/// What the projection of a pixel needs to count as valid.
#[derive(Clone, Copy, Debug)]
pub struct Validity {
    /// Least depth in the source camera, m.
    pub min_depth_m: f32,
    /// How far outside the border pixels' centres still counts as inside, px.
    pub border_tolerance_px: f32,
}

/// Images of a warp, all contiguous.
#[derive(Clone, Copy, Debug)]
pub(super) struct WarpInput<'a> {
    /// `[batch, channels, height, width]`.
    pub source_image: &'a [f32],
    /// `[batch, 1, height, width]`, m; 0 = unknown.
    pub target_depth: &'a [f32],
    /// `[batch, 4]`, fx, fy, cx, cy, px.
    pub intrinsics: &'a [f32],
    /// `[batch, 4, 4]`, row-major, m.
    pub source_from_target: &'a [f32],
    /// Batch, channels, height, width of the source image.
    pub shape: [usize; 4],
    /// When a pixel is valid.
    pub validity: Validity,
}

/// `I_i(K ⁱT̂ᵢ₊₁ D K⁻¹ p)` for every target pixel p (paper Eq. 5): image `[batch, channels, height,
/// width]` and mask `[batch, 1, height, width]`, both 0 where not valid.
pub(super) fn warp(instructions: Instructions, input: WarpInput) -> (Vec<f32>, Vec<f32>) {
    let [batch, channels, height, width] = input.shape;
    let plane = height * width;
    assert!(height > 1 && width > 1 && u32::try_from(plane).is_ok(), "warp: 2x2 to 2^32 pixels");
    assert_eq!(input.source_image.len(), batch * channels * plane, "warp: source image");
    assert_eq!(input.target_depth.len(), batch * plane, "warp: target depth");
    assert_eq!((input.intrinsics.len(), input.source_from_target.len()), (4 * batch, 16 * batch), "warp: cameras");
    let mut mask = Vec::new();
    let fill = |image: Shared| {
        let fill = |mask: Shared| {
            (0..batch * height).into_par_iter().for_each_init(
                || RowTaps::new(width),
                |taps, line| {
                    let (index, row) = (line / height, line % height);
                    // SAFETY: each line of the mask is one task's.
                    let valid = unsafe { mask.zeroed(line * width, width) };
                    let depth = &input.target_depth[line * width..][..width];
                    instructions.run(ProjectRow { input, index, row, depth, taps, valid });
                    for channel in index * channels..(index + 1) * channels {
                        let source = &input.source_image[channel * plane..][..plane];
                        // SAFETY: each line of each channel is one task's.
                        let output = unsafe { image.zeroed(channel * plane + row * width, width) };
                        instructions.run(SampleRow { source, width, taps, valid, output });
                    }
                },
            );
        };
        // SAFETY: the tasks write every line.
        mask = unsafe { filled(batch * plane, fill) };
    };
    // SAFETY: the tasks write every line of every channel.
    let image = unsafe { filled(batch * channels * plane, fill) };
    (image, mask)
}

/// Where the pixels of a row are sampled.
struct RowTaps {
    /// Upper left of the four source pixels; always one that has a right and a lower neighbour.
    first: Vec<u32>,
    /// Weights of the right and of the lower neighbours.
    right: Vec<f32>,
    lower: Vec<f32>,
}

impl RowTaps {
    fn new(width: usize) -> Self {
        Self { first: vec![0; width], right: vec![0.0; width], lower: vec![0.0; width] }
    }
}

struct ProjectRow<'a> {
    input: WarpInput<'a>,
    index: usize,
    row: usize,
    depth: &'a [f32],
    taps: &'a mut RowTaps,
    valid: &'a mut [f32],
}

impl Kernel for ProjectRow<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { input, index, row, depth, taps, valid } = self;
        let [_, _, height, width] = input.shape;
        let Validity { min_depth_m, border_tolerance_px } = input.validity;
        let [fx, fy, cx, cy] = input.intrinsics[4 * index..].first_chunk().copied().expect("four intrinsics");
        let pose: &[f32; 16] = input.source_from_target[16 * index..].first_chunk().expect("a 4x4 matrix");
        let (last_u, last_v) = ((width - 1) as f32, (height - 1) as f32);
        let ray_y = (row as f32 - cy) / fy;
        let taps = taps.first.iter_mut().zip(&mut taps.right).zip(&mut taps.lower);
        for (column, (((first, right), lower), (valid, &depth))) in taps.zip(valid.iter_mut().zip(depth)).enumerate() {
            let ray_x = (column as f32 - cx) / fx;
            let (x, y) = (ray_x * depth, ray_y * depth);
            let point = |axis: usize| {
                pose[4 * axis] * x + pose[4 * axis + 1] * y + pose[4 * axis + 2] * depth + pose[4 * axis + 3]
            };
            let z = point(2);
            let in_front = z > min_depth_m && depth > 0.0;
            let z = if in_front { z } else { 1.0 };
            let (u, v) = (point(0) / z * fx + cx, point(1) / z * fy + cy);
            let inside = u >= -border_tolerance_px
                && u <= last_u + border_tolerance_px
                && v >= -border_tolerance_px
                && v <= last_v + border_tolerance_px;
            *valid = if in_front && inside { 1.0 } else { 0.0 };
            // Clamped, so that a pixel that is not valid reads some pixel too. `max` turns NaN into 0.
            let (u, v) = (u.max(0.0).min(last_u), v.max(0.0).min(last_v));
            let (left, upper) = (u.min(last_u - 1.0) as u32, v.min(last_v - 1.0) as u32);
            *first = upper * width as u32 + left;
            (*right, *lower) = (u - left as f32, v - upper as f32);
        }
    }
}

struct SampleRow<'a> {
    source: &'a [f32],
    width: usize,
    taps: &'a RowTaps,
    valid: &'a [f32],
    output: &'a mut [f32],
}

impl Kernel for SampleRow<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { source, width, taps, valid, output } = self;
        // The furthest tap of any row lies one line and one pixel after `first`.
        let furthest = taps.first.iter().max().map_or(0, |&first| first as usize) + width + 1;
        assert!(furthest < source.len(), "warp: a tap outside the image");
        // SAFETY: asserted above for all four.
        let pixel = |index: usize| unsafe { *source.get_unchecked(index) };
        let weights = taps.right.iter().zip(&taps.lower).zip(valid);
        for ((output, &first), ((right, lower), valid)) in output.iter_mut().zip(&taps.first).zip(weights) {
            let first = first as usize;
            let (a, b, c, d) = (pixel(first), pixel(first + 1), pixel(first + width), pixel(first + width + 1));
            let (upper, below) = (a + (b - a) * right, c + (d - c) * right);
            let value = upper + (below - upper) * lower;
            *output = if *valid > 0.0 { value } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: [usize; 4] = [2, 3, 9, 37];

    fn source_image() -> Vec<f32> {
        (0..SHAPE.iter().product::<usize>()).map(|index| (index as f32).sin()).collect()
    }

    fn warped(instructions: Instructions, depth: f32, pose: [f32; 16]) -> (Vec<f32>, Vec<f32>) {
        let [batch, _, height, width] = SHAPE;
        let input = WarpInput {
            source_image: &source_image(),
            target_depth: &vec![depth; batch * height * width],
            intrinsics: &[30.0, 32.0, 18.0, 4.0].repeat(batch),
            source_from_target: &pose.repeat(batch),
            shape: SHAPE,
            validity: Validity { min_depth_m: 1e-3, border_tolerance_px: 1e-3 },
        };
        warp(instructions, input)
    }

    const IDENTITY: [f32; 16] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];

    #[test]
    fn the_identity_returns_the_image() {
        for instructions in Instructions::available() {
            let (image, mask) = warped(instructions, 7.0, IDENTITY);
            assert!(image.iter().zip(source_image()).all(|(a, b)| (a - b).abs() < 1e-4));
            assert!(mask.iter().all(|&valid| valid == 1.0));
        }
    }

    /// Whatever the numbers, nothing outside the image is read, and what is not valid is 0.
    #[test]
    fn wild_poses_and_depths_stay_inside_the_image() {
        let wild = [0.0, -1.0, 1e-30, 1e30, -1e30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 7.0];
        for instructions in Instructions::available() {
            for (index, &value) in wild.iter().enumerate() {
                warped(instructions, value, IDENTITY);
                for &other in &wild[index..] {
                    let mut pose = IDENTITY;
                    (pose[0], pose[3], pose[7], pose[11]) = (other, value, other, value);
                    let (image, mask) = warped(instructions, 5.0, pose);
                    let plane = SHAPE[2] * SHAPE[3];
                    for (index, &value) in image.iter().enumerate() {
                        let pixel = index / (3 * plane) * plane + index % plane;
                        assert!(mask[pixel] == 1.0 || value == 0.0);
                        assert!(value.is_finite());
                    }
                }
            }
        }
    }
}
