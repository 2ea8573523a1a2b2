//! Two-dimensional convolution and its two gradients as matrix products over padded images.
//!
//! Images are `[batch, channels, height, width]`, weights `[outputs, inputs, kernel rows, kernel
//! columns]`, both contiguous. Any kernel size, stride and padding; no dilation, no groups.

use rayon::prelude::*;

use super::border::Border;
use super::buffer::{Shared, filled};
use super::fused::{Activation, FusedConvolution};
use super::instructions::Instructions;
use super::layouts::{ChannelsLast, PaddedGradient, Part, Residues, offset};
use super::product::{Left, Right, parts, product};
use super::shape::ConvolutionShape;

/// Channels that lie side by side in the columns of the weight gradient.
const CHANNEL_GROUP: usize = 16;

/// `output[b, o] = bias[o] + Σ_c weight[o, c] ∗ input[b, c]`.
///
/// # Shapes
/// - `input`: `[batch, inputs, height, width]`
/// - `weight`: `[outputs, inputs, kernel rows, kernel columns]`
/// - `bias`: `[outputs]`
/// - returns: `[batch, outputs, output height, output width]`
pub(super) fn convolution(
    instructions: Instructions,
    shape: ConvolutionShape,
    input: &[f32],
    weight: &[f32],
    bias: Option<&[f32]>,
) -> Vec<f32> {
    shape.check(Some(input), Some(weight), None);
    let parts = &[Part { values: input, channels: shape.inputs, doubled: false }];
    let (border, activation) = (Border::Zeros, Activation::None);
    FusedConvolution { shape, parts, border, weight, bias, shortcut: None, activation }.run(instructions)
}

/// Gradient of [`convolution`] with respect to its input.
///
/// # Shapes
/// - `gradient`: as the output; `weight`: as above
/// - returns: as the input
pub(super) fn input_gradient(
    instructions: Instructions,
    shape: ConvolutionShape,
    weight: &[f32],
    gradient: &[f32],
) -> Vec<f32> {
    shape.check(None, Some(weight), Some(gradient));
    let [rows, columns] = [0, 1].map(|axis| Residues::of(&shape, axis));
    let padded = PaddedGradient::of(gradient, &shape, &rows, &columns);
    let [height, width] = shape.size;
    let [stride_v, stride_u] = shape.stride;
    // Input pixels that no kernel tap reaches have no gradient.
    let untouched = shape.stride[0] > shape.kernel[0] || shape.stride[1] > shape.kernel[1];
    let fill = |input: Shared| {
        if untouched {
            // SAFETY: nothing else has begun yet.
            unsafe { input.zeroed(0, shape.input_len()) };
        }
        // Input pixels with the same residue of position by stride meet the same kernel taps: each such
        // set is a convolution of its own, with stride 1.
        for (v, u) in rows.sets.iter().flat_map(|v| columns.sets.iter().map(move |u| (v, u))) {
            if v.taps * u.taps == 0 || v.count * u.count == 0 {
                continue;
            }
            let (mut weights, mut offsets) = (Vec::new(), Vec::new());
            for output in 0..shape.outputs {
                for (tap_v, tap_u) in (0..v.taps).flat_map(|tap_v| (0..u.taps).map(move |tap_u| (tap_v, tap_u))) {
                    let tap = (v.residue + stride_v * tap_v) * shape.kernel[1] + u.residue + stride_u * tap_u;
                    weights.push(offset(output * shape.inputs * shape.taps() + tap));
                    let pixel = padded.pixel(v.first_output, tap_v, u.first_output, tap_u);
                    offsets.push(offset(output * padded.plane + pixel));
                }
            }
            let left = Left::new(weight, shape.inputs, shape.taps(), &weights);
            let stretches = (0..shape.batch * v.count).map(|row| (padded.row(row / v.count, row % v.count), u.count));
            let right = Right::new(&padded.values, &offsets, stretches);
            product(instructions, left, &right, 1, |tile| {
                for channel in tile.rows.clone() {
                    for (column, len) in tile.pieces(u.count) {
                        let (row, first) = (column / u.count, column % u.count);
                        let (image, row) = (row / v.count, row % v.count);
                        let line = ((image * shape.inputs + channel) * height + v.first_input + row * stride_v) * width;
                        let values = &tile.row(channel)[column - tile.columns.start..][..len];
                        // SAFETY: channel and pixels belong to this tile and this set alone.
                        unsafe { input.write_every(stride_u, line + u.first_input + first * stride_u, values) };
                    }
                }
            });
        }
    };
    // SAFETY: every pixel belongs to one set; sets without taps exist only where `untouched` filled them.
    unsafe { filled(shape.input_len(), fill) }
}

/// Gradient of [`convolution`] with respect to its weights.
///
/// # Shapes
/// - `input`, `gradient`: as the input and the output
/// - returns: as the weights
pub(super) fn weight_gradient(
    instructions: Instructions,
    shape: ConvolutionShape,
    input: &[f32],
    gradient: &[f32],
) -> Vec<f32> {
    shape.check(Some(input), None, Some(gradient));
    let [rows, columns] = shape.output_size();
    let (taps, plane) = (shape.taps(), rows * columns);
    let pixels = ChannelsLast::of(input, &shape);
    let (mut gradients, mut offsets) = (Vec::new(), Vec::new());
    for image in 0..shape.batch {
        for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
            gradients.push(offset(image * shape.outputs * plane + row * columns + column));
            offsets.push(offset(pixels.pixel(image, row * shape.stride[0], column * shape.stride[1])));
        }
    }
    // Columns: groups of channels, in each the taps, in each the channels. So a tile's columns are few
    // whole stretches of the weights.
    let (mut stretches, mut places) = (Vec::new(), Vec::new());
    for first in (0..shape.inputs).step_by(CHANNEL_GROUP) {
        let channels = first..(first + CHANNEL_GROUP).min(shape.inputs);
        for tap in 0..taps {
            let position = pixels.pixel(0, tap / shape.kernel[1], tap % shape.kernel[1]) + first;
            stretches.push((position, channels.len()));
            places.extend(channels.clone().map(|channel| channel * taps + tap));
        }
    }
    let left = Left::new(gradient, shape.outputs, plane, &gradients);
    let right = Right::new(&pixels.values, &offsets, stretches.into_iter());
    let parts = parts(shape.outputs, right.columns(), offsets.len());
    let row_len = shape.inputs * taps;
    let fill = |weight: Shared| {
        product(instructions, left, &right, parts, |tile| {
            for output in tile.rows.clone() {
                let start = tile.part * shape.weight_len() + output * row_len;
                // SAFETY: these weights belong to this tile alone.
                unsafe { weight.scatter(start, row_len, &places[tile.columns.clone()], tile.row(output)) };
            }
        });
    };
    // SAFETY: the tiles of each part cover all rows and columns, and `places` names every weight of a row.
    let mut weight = unsafe { filled(parts * shape.weight_len(), fill) };
    sum_parts(&mut weight, parts);
    weight
}

/// Gradient of [`convolution`] with respect to its bias: the sum of `gradient` over images and pixels.
pub(super) fn bias_gradient(shape: ConvolutionShape, gradient: &[f32]) -> Vec<f32> {
    shape.check(None, None, Some(gradient));
    let plane = shape.output_plane();
    let sum_of = |output: usize| -> f32 {
        (0..shape.batch).map(|image| sum(&gradient[(image * shape.outputs + output) * plane..][..plane])).sum()
    };
    (0..shape.outputs).into_par_iter().map(sum_of).collect()
}

/// Sum with eight running sums, which vectorises and rounds less than one.
fn sum(values: &[f32]) -> f32 {
    let (chunks, rest) = values.as_chunks::<8>();
    let mut sums = [0.0f32; 8];
    for chunk in chunks {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += value;
        }
    }
    sums.iter().sum::<f32>() + rest.iter().sum::<f32>()
}

/// Adds the parts that follow the first to it, and drops them.
fn sum_parts(values: &mut Vec<f32>, parts: usize) {
    let len = values.len() / parts;
    let (sum, others) = values.split_at_mut(len);
    for other in others.chunks(len.max(1)) {
        for (sum, value) in sum.iter_mut().zip(other) {
            *sum += value;
        }
    }
    values.truncate(len);
    values.shrink_to_fit();
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::reference::{deviation, noise, reference};
    use super::*;

    fn assert_close(name: &str, found: &[f32], expected: &[[f64; 2]]) {
        let deviation = deviation(found, expected);
        assert!(deviation <= 1e-6, "{name}: {deviation:.1e}");
    }

    fn check(shape: ConvolutionShape, seed: u32) {
        let input = noise(shape.input_len(), seed);
        let weight = noise(shape.weight_len(), seed ^ 1);
        let gradient = noise(shape.output_len(), seed ^ 2);
        let bias = noise(shape.outputs, seed ^ 3);
        let mut expected = reference(shape, &input, &weight, &gradient);
        for (index, output) in expected.output.iter_mut().enumerate() {
            let bias = f64::from(bias[index / shape.output_plane() % shape.outputs]);
            *output = [output[0] + bias, output[1] + bias.abs()];
        }
        for instructions in Instructions::available() {
            let name = |part| format!("{part} by {} of {shape:?}", instructions.name());
            let output = convolution(instructions, shape, &input, &weight, Some(&bias));
            assert_close(&name("output"), &output, &expected.output);
            let input_gradient = input_gradient(instructions, shape, &weight, &gradient);
            assert_close(&name("input gradient"), &input_gradient, &expected.input_gradient);
            let weight_gradient = weight_gradient(instructions, shape, &input, &gradient);
            assert_close(&name("weight gradient"), &weight_gradient, &expected.weight_gradient);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(if cfg!(miri) { 2 } else { 200 }))]
        #[test]
        fn agrees_with_the_definition_in_f64(
            batch in 1usize..4,
            inputs in 1usize..20,
            outputs in 1usize..20,
            size in [1usize..24, 1usize..40],
            kernel in [1usize..8, 1usize..8],
            stride in [1usize..5, 1usize..5],
            padding in [0usize..5, 0usize..5],
            seed in any::<u32>(),
        ) {
            let shape = ConvolutionShape { batch, inputs, outputs, size, kernel, stride, padding };
            prop_assume!((0..2).all(|axis| kernel[axis] <= size[axis] + 2 * padding[axis]));
            check(shape, seed);
        }
    }

    /// Larger than one tile of the product in each direction, and sums that are cut into parts.
    #[test]
    fn agrees_beyond_one_tile() {
        for (inputs, outputs, size, kernel, stride) in
            [(37, 270, [9, 37], [3, 3], [1, 1]), (3, 11, [80, 90], [5, 5], [2, 2]), (70, 20, [6, 8], [3, 3], [1, 2])]
        {
            let padding = [kernel[0] / 2, kernel[1] / 2];
            check(ConvolutionShape { batch: 2, inputs, outputs, size, kernel, stride, padding }, 5);
        }
    }

    /// Training must give the same weights on a laptop and on a workstation.
    #[test]
    fn results_do_not_depend_on_the_number_of_threads() {
        let shape = ConvolutionShape {
            batch: 3,
            inputs: 16,
            outputs: 40,
            size: [40, 60],
            kernel: [3, 3],
            stride: [2, 2],
            padding: [1, 1],
        };
        let [input, weight, gradient] =
            [shape.input_len(), shape.weight_len(), shape.output_len()].map(|len| noise(len, 11));
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let instructions = Instructions::current();
            pool.install(|| {
                (
                    convolution(instructions, shape, &input, &weight, None),
                    input_gradient(instructions, shape, &weight, &gradient),
                    weight_gradient(instructions, shape, &input, &gradient),
                )
            })
        };
        assert_eq!(run(1), run(5));
    }
}
