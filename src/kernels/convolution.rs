//! Two-dimensional convolution and its two gradients as matrix products over padded images.
//!
//! Images are `[batch, channels, height, width]`, weights `[outputs, inputs, kernel rows, kernel
//! columns]`, both contiguous. Any kernel size, stride and padding; no dilation, no groups.

use rayon::prelude::*;

use super::buffer::{Shared, filled};
use super::instructions::Instructions;
use super::product::{Left, Right, SLACK, Tile, parts, product};

/// Channels that lie side by side in the columns of the weight gradient.
const CHANNEL_GROUP: usize = 16;

/// Shape of a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ConvolutionShape {
    /// Images.
    pub batch: usize,
    /// Channels of the input.
    pub inputs: usize,
    /// Channels of the output.
    pub outputs: usize,
    /// Rows and columns of the input.
    pub size: [usize; 2],
    /// Rows and columns of the kernel.
    pub kernel: [usize; 2],
    /// Step between two outputs, rows and columns.
    pub stride: [usize; 2],
    /// Zeros added on each side, rows and columns.
    pub padding: [usize; 2],
}

impl ConvolutionShape {
    /// Rows and columns of the output.
    pub fn output_size(&self) -> [usize; 2] {
        [0, 1].map(|axis| (self.size[axis] + 2 * self.padding[axis] - self.kernel[axis]) / self.stride[axis] + 1)
    }

    fn taps(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    fn input_plane(&self) -> usize {
        self.size[0] * self.size[1]
    }

    fn output_plane(&self) -> usize {
        let [rows, columns] = self.output_size();
        rows * columns
    }

    /// Values of an input.
    pub fn input_len(&self) -> usize {
        self.batch * self.inputs * self.input_plane()
    }

    /// Values of an output.
    pub fn output_len(&self) -> usize {
        self.batch * self.outputs * self.output_plane()
    }

    /// Values of the weights.
    pub fn weight_len(&self) -> usize {
        self.outputs * self.inputs * self.taps()
    }

    fn check(&self, input: Option<&[f32]>, weight: Option<&[f32]>, output: Option<&[f32]>) {
        assert!(
            (0..2).all(|axis| self.kernel[axis] > 0
                && self.stride[axis] > 0
                && self.kernel[axis] <= self.size[axis] + 2 * self.padding[axis]),
            "convolution: the kernel must fit the padded image ({self:?})"
        );
        assert!(input.is_none_or(|values| values.len() == self.input_len()), "convolution: input and {self:?}");
        assert!(weight.is_none_or(|values| values.len() == self.weight_len()), "convolution: weight and {self:?}");
        assert!(output.is_none_or(|values| values.len() == self.output_len()), "convolution: output and {self:?}");
    }
}

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
    assert!(bias.is_none_or(|bias| bias.len() == shape.outputs), "convolution: one bias for each output channel");
    let [rows, columns] = shape.output_size();
    let plane = rows * columns;
    let phases = Phases::of(input, &shape);
    let terms = shape.inputs * shape.taps();
    let weights: Vec<u32> = (0..terms as u32).collect();
    let left = Left::new(weight, shape.outputs, terms, &weights);
    let stretches = (0..shape.batch * rows).map(|row| (phases.row(row / rows, row % rows), columns));
    let right = Right::new(&phases.values, &phases.offsets, stretches);
    // SAFETY: the tiles cover every output channel and, in their columns, every pixel of every image.
    unsafe {
        filled(shape.output_len(), |output| {
            product(instructions, left, &right, 1, |tile| {
                for channel in tile.rows.clone() {
                    let bias = bias.map_or(0.0, |bias| bias[channel]);
                    for (column, len) in pieces(&tile, plane) {
                        let (image, pixel) = (column / plane, column % plane);
                        let values = &tile.row(channel)[column - tile.columns.start..][..len];
                        // SAFETY: channel and pixels belong to this tile alone.
                        let output = output.part((image * shape.outputs + channel) * plane + pixel, len);
                        for (output, value) in output.iter_mut().zip(values) {
                            *output = value + bias;
                        }
                    }
                }
            });
        })
    }
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
            unsafe { input.part(0, shape.input_len()) }.fill(0.0);
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
                    weights.push((output * shape.inputs * shape.taps() + tap) as u32);
                    offsets.push(
                        (output * padded.plane + padded.pixel(v.first_output, tap_v, u.first_output, tap_u)) as u32,
                    );
                }
            }
            let left = Left::new(weight, shape.inputs, shape.taps(), &weights);
            let stretches = (0..shape.batch * v.count).map(|row| (padded.row(row / v.count, row % v.count), u.count));
            let right = Right::new(&padded.values, &offsets, stretches);
            product(instructions, left, &right, 1, |tile| {
                for channel in tile.rows.clone() {
                    for (column, len) in pieces(&tile, u.count) {
                        let (row, first) = (column / u.count, column % u.count);
                        let (image, row) = (row / v.count, row % v.count);
                        let line = ((image * shape.inputs + channel) * height + v.first_input + row * stride_v) * width;
                        let values = &tile.row(channel)[column - tile.columns.start..][..len];
                        for (index, &value) in values.iter().enumerate() {
                            // SAFETY: channel and pixel belong to this tile and this set alone.
                            unsafe { input.write(line + u.first_input + (first + index) * stride_u, value) };
                        }
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
            gradients.push((image * shape.outputs * plane + row * columns + column) as u32);
            offsets.push(pixels.pixel(image, row * shape.stride[0], column * shape.stride[1]) as u32);
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
    // SAFETY: the tiles of each part cover all rows and columns, and `places` names every weight of a row.
    let mut weight = unsafe {
        filled(parts * shape.weight_len(), |weight| {
            product(instructions, left, &right, parts, |tile| {
                for output in tile.rows.clone() {
                    let row = tile.part * shape.weight_len() + output * shape.inputs * taps;
                    for (&place, &value) in places[tile.columns.clone()].iter().zip(tile.row(output)) {
                        // SAFETY: this weight belongs to this tile alone.
                        weight.write(row + place, value);
                    }
                }
            });
        })
    };
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

/// Columns of a tile, cut where a new image or row of `len` begins: first column and length of each.
fn pieces(tile: &Tile, len: usize) -> impl Iterator<Item = (usize, usize)> {
    let end = tile.columns.end;
    let mut column = tile.columns.start;
    std::iter::from_fn(move || {
        let piece = (column, (len - column % len).min(end - column));
        column += piece.1;
        (piece.1 > 0).then_some(piece)
    })
}

/// The padded input, cut into one image for each position within a stride, so that the inputs of
/// neighbouring outputs lie side by side whatever the stride.
struct Phases {
    values: Vec<f32>,
    /// Place of each term (channel, tap) relative to an output's place.
    offsets: Vec<u32>,
    image: usize,
    columns: usize,
}

impl Phases {
    fn of(input: &[f32], shape: &ConvolutionShape) -> Self {
        let [stride_v, stride_u] = shape.stride;
        let [rows, columns] = {
            let output = shape.output_size();
            [0, 1].map(|axis| output[axis] + (shape.kernel[axis] - 1) / shape.stride[axis])
        };
        let phases = [0, 1].map(|axis| shape.stride[axis].min(shape.kernel[axis]));
        let plane = rows * columns;
        let channel = phases[0] * phases[1] * plane;
        let image = shape.inputs * channel;
        let len = shape.batch * image;
        let fill = |values: Shared| {
            // SAFETY: the slack belongs to no channel.
            unsafe { values.part(len, SLACK) }.fill(0.0);
            input.par_chunks(shape.input_plane()).enumerate().for_each(|(index, pixels)| {
                // SAFETY: each channel of each image is one task's.
                let phase_rows = unsafe { values.part(index * channel, channel) }.chunks_exact_mut(columns);
                for (index, row) in phase_rows.enumerate() {
                    let (phase, row_index) = (index / rows, index % rows);
                    let (phase_v, phase_u) = (phase / phases[1], phase % phases[1]);
                    let v = (row_index * stride_v + phase_v).checked_sub(shape.padding[0]);
                    match v.filter(|&v| v < shape.size[0]) {
                        None => row.fill(0.0),
                        Some(v) => {
                            let pixels = &pixels[v * shape.size[1]..][..shape.size[1]];
                            copy_phase(pixels, shape.padding[1], phase_u, stride_u, row);
                        }
                    }
                }
            });
        };
        // SAFETY: the tasks write every row of every phase of every channel, and the slack is filled.
        let values = unsafe { filled(len + SLACK, fill) };
        let mut offsets = Vec::with_capacity(shape.inputs * shape.taps());
        for index in 0..shape.inputs * shape.taps() {
            let (input, tap) = (index / shape.taps(), index % shape.taps());
            let (v, u) = (tap / shape.kernel[1], tap % shape.kernel[1]);
            let phase = (v % stride_v) * phases[1] + u % stride_u;
            offsets.push((input * channel + phase * plane + v / stride_v * columns + u / stride_u) as u32);
        }
        Self { values, offsets, image, columns }
    }

    /// Place of the first output of a row.
    fn row(&self, image: usize, row: usize) -> usize {
        image * self.image + row * self.columns
    }
}

/// Every `stride`-th value of a padded row, from `phase` on.
#[inline]
fn copy_phase(pixels: &[f32], padding: usize, phase: usize, stride: usize, row: &mut [f32]) {
    let before = padding.saturating_sub(phase).div_ceil(stride).min(row.len());
    let end = (pixels.len() + padding).saturating_sub(phase).div_ceil(stride).clamp(before, row.len());
    row[..before].fill(0.0);
    row[end..].fill(0.0);
    if before == end {
        return;
    }
    let pixels = &pixels[before * stride + phase - padding..];
    let row = &mut row[before..end];
    match stride {
        1 => row.copy_from_slice(&pixels[..row.len()]),
        // Spelled out, so that the compiler vectorises the stride of most networks.
        2 => {
            let (pairs, rest) = pixels.as_chunks::<2>();
            let (last, row) = if row.len() > pairs.len() { row.split_last_mut().unzip() } else { (None, Some(row)) };
            row.into_iter().flatten().zip(pairs).for_each(|(value, pair)| *value = pair[0]);
            last.into_iter().zip(rest).for_each(|(value, pixel)| *value = *pixel);
        }
        _ => row.iter_mut().zip(pixels.iter().step_by(stride)).for_each(|(value, pixel)| *value = *pixel),
    }
}

/// How input pixels along an axis, sorted by their residue modulo the stride, meet kernel and output.
struct Residues {
    sets: Vec<ResidueSet>,
    before: usize,
    after: usize,
}

/// The input pixels with one residue.
struct ResidueSet {
    /// First kernel tap they meet; the others follow by strides.
    residue: usize,
    /// Kernel taps they meet.
    taps: usize,
    /// First such pixel.
    first_input: usize,
    /// Number of such pixels.
    count: usize,
    /// Output that the first pixel meets with the first tap.
    first_output: usize,
}

impl Residues {
    fn of(shape: &ConvolutionShape, axis: usize) -> Self {
        let (size, kernel, stride, padding) =
            (shape.size[axis], shape.kernel[axis], shape.stride[axis], shape.padding[axis]);
        let sets: Vec<ResidueSet> = (0..stride.min(size))
            .map(|first_input| {
                let residue = (first_input + padding) % stride;
                ResidueSet {
                    residue,
                    taps: kernel.saturating_sub(residue).div_ceil(stride),
                    first_input,
                    count: (size - first_input).div_ceil(stride),
                    first_output: (first_input + padding) / stride,
                }
            })
            .collect();
        let output = shape.output_size()[axis];
        let before = sets.iter().map(|set| set.taps.saturating_sub(set.first_output + 1)).max().unwrap_or(0);
        let after = sets.iter().map(|set| (set.first_output + set.count).saturating_sub(output)).max().unwrap_or(0);
        Self { sets, before, after }
    }
}

/// The output's gradient with zeros around it, wide enough for every tap of every input pixel.
struct PaddedGradient {
    values: Vec<f32>,
    image: usize,
    plane: usize,
    columns: usize,
    before: [usize; 2],
}

impl PaddedGradient {
    fn of(gradient: &[f32], shape: &ConvolutionShape, rows: &Residues, columns: &Residues) -> Self {
        let [output_rows, output_columns] = shape.output_size();
        let padded_columns = output_columns + columns.before + columns.after;
        let plane = (output_rows + rows.before + rows.after) * padded_columns;
        let len = shape.batch * shape.outputs * plane;
        let fill = |values: Shared| {
            // SAFETY: the slack belongs to no channel.
            unsafe { values.part(len, SLACK) }.fill(0.0);
            gradient.par_chunks(output_rows * output_columns).enumerate().for_each(|(index, pixels)| {
                // SAFETY: each channel of each image is one task's.
                let padded = unsafe { values.part(index * plane, plane) };
                padded.fill(0.0);
                let lines = padded[rows.before * padded_columns..].chunks_exact_mut(padded_columns);
                for (line, pixels) in lines.zip(pixels.chunks_exact(output_columns)) {
                    line[columns.before..][..output_columns].copy_from_slice(pixels);
                }
            });
        };
        // SAFETY: the tasks fill every channel, and the slack is filled.
        let values = unsafe { filled(len + SLACK, fill) };
        let before = [rows.before, columns.before];
        Self { values, image: shape.outputs * plane, plane, columns: padded_columns, before }
    }

    /// Place, in a channel, of the output that a set's first pixel meets with a tap.
    fn pixel(&self, first_row: usize, tap_v: usize, first_column: usize, tap_u: usize) -> usize {
        (first_row + self.before[0] - tap_v) * self.columns + first_column + self.before[1] - tap_u
    }

    /// Place of a set's `row`-th row relative to its first.
    fn row(&self, image: usize, row: usize) -> usize {
        image * self.image + row * self.columns
    }
}

/// The padded input with the channels of each pixel side by side.
struct ChannelsLast {
    values: Vec<f32>,
    size: [usize; 2],
    channels: usize,
}

impl ChannelsLast {
    fn of(input: &[f32], shape: &ConvolutionShape) -> Self {
        let output = shape.output_size();
        let size = [0, 1].map(|axis| (output[axis] - 1) * shape.stride[axis] + shape.kernel[axis]);
        let (channels, plane) = (shape.inputs, shape.input_plane());
        let line_len = size[1] * channels;
        let len = shape.batch * size[0] * line_len;
        let fill = |values: Shared| {
            // SAFETY: the slack belongs to no line.
            unsafe { values.part(len, SLACK) }.fill(0.0);
            (0..shape.batch * size[0]).into_par_iter().for_each(|index| {
                // SAFETY: each line of each image is one task's.
                let line = unsafe { values.part(index * line_len, line_len) };
                let (image, row) = (index / size[0], index % size[0]);
                let before = shape.padding[1].min(size[1]);
                let seen = shape.size[1].min(size[1] - before);
                match row.checked_sub(shape.padding[0]).filter(|&row| row < shape.size[0]) {
                    None => line.fill(0.0),
                    Some(row) => {
                        line[..before * channels].fill(0.0);
                        line[(before + seen) * channels..].fill(0.0);
                        let first = image * channels * plane + row * shape.size[1];
                        let pixels = &mut line[before * channels..][..seen * channels];
                        transpose(&input[first..], plane, pixels, channels);
                    }
                }
            });
        };
        // SAFETY: the tasks write every line, and the slack is filled.
        let values = unsafe { filled(len + SLACK, fill) };
        Self { values, size, channels }
    }

    fn pixel(&self, image: usize, row: usize, column: usize) -> usize {
        ((image * self.size[0] + row) * self.size[1] + column) * self.channels
    }
}

/// `pixels[u · channels + c] = planes[c · plane + u]`, in blocks that stay in the first-level cache.
fn transpose(planes: &[f32], plane: usize, pixels: &mut [f32], channels: usize) {
    const BLOCK: usize = 16;
    for (block, pixels) in pixels.chunks_mut(BLOCK * channels).enumerate() {
        for first in (0..channels).step_by(BLOCK) {
            for (u, pixel) in pixels.chunks_exact_mut(channels).enumerate() {
                let last = (first + BLOCK).min(channels);
                for (c, value) in pixel[first..last].iter_mut().enumerate() {
                    *value = planes[(first + c) * plane + block * BLOCK + u];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::reference::reference;
    use super::*;

    /// Values in -.5…5 that differ from place to place.
    fn noise(len: usize, seed: u32) -> Vec<f32> {
        let value = |index: u32| index.wrapping_add(seed).wrapping_mul(0x9E37_79B9);
        (0..len as u32).map(|index| (value(value(index)) >> 8) as f32 / 16_777_216.0 - 0.5).collect()
    }

    fn assert_close(name: &str, found: &[f32], expected: &[[f64; 2]]) {
        assert_eq!(found.len(), expected.len(), "{name}");
        for (index, (&found, &[sum, size])) in found.iter().zip(expected).enumerate() {
            let difference = (f64::from(found) - sum).abs();
            assert!(difference <= 1e-6 * size + 1e-12, "{name}[{index}]: {found}, expected {sum}");
        }
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
