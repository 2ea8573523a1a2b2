//! Images laid out so that a convolution's operands can be read where they lie.

use rayon::prelude::*;

use super::border::Border;
use super::buffer::{Shared, filled};
use super::product::SLACK;
use super::shape::ConvolutionShape;

/// A place in an operand. Tables of places hold 32-bit numbers, half the memory of 64-bit ones.
pub(super) fn offset(place: usize) -> u32 {
    u32::try_from(place).expect("a convolution of at most 2^32 values")
}

/// Some channels of a convolution's input.
#[derive(Clone, Copy)]
pub(super) struct Part<'a> {
    /// `[batch, channels, height, width]`, half of both if doubled.
    pub values: &'a [f32],
    pub channels: usize,
    /// Whether each pixel stands for four; for stride 1.
    pub doubled: bool,
}

/// The padded input, cut into one image for each position within a stride, so that the inputs of
/// neighbouring outputs lie side by side whatever the stride.
pub(super) struct Phases {
    pub values: Vec<f32>,
    /// Place of each term (channel, tap) relative to an output's place.
    pub offsets: Vec<u32>,
    image: usize,
    columns: usize,
}

impl Phases {
    /// Lays the parts of an input out, one behind the other.
    pub fn of(parts: &[Part], shape: &ConvolutionShape, border: Border) -> Self {
        let [stride_v, stride_u] = shape.stride;
        check_parts(parts, shape, border);
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
            unsafe { values.zeroed(len, SLACK) };
            (0..shape.batch * shape.inputs).into_par_iter().for_each(|index| {
                let plane = ChannelPlane::of(parts, shape, index);
                for line in 0..channel / columns {
                    // SAFETY: each channel of each image is one task's.
                    let row = unsafe { values.zeroed(index * channel + line * columns, columns) };
                    let (phase, row_index) = (line / rows, line % rows);
                    let (phase_v, phase_u) = (phase / phases[1], phase % phases[1]);
                    let Some(v) = border.inside(row_index * stride_v + phase_v, shape.padding[0], shape.size[0]) else {
                        continue;
                    };
                    if plane.doubled || border == Border::Mirror {
                        plane.copy_row(v, shape.padding[1], border, row);
                    } else {
                        copy_phase(plane.row(v), shape.padding[1], phase_u, stride_u, row);
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
            offsets.push(offset(input * channel + phase * plane + v / stride_v * columns + u / stride_u));
        }
        Self { values, offsets, image, columns }
    }

    /// Place of the first output of a row.
    pub fn row(&self, image: usize, row: usize) -> usize {
        image * self.image + row * self.columns
    }
}

fn check_parts(parts: &[Part], shape: &ConvolutionShape, border: Border) {
    assert_eq!(
        parts.iter().map(|part| part.channels).sum::<usize>(),
        shape.inputs,
        "convolution: channels of all parts"
    );
    for part in parts {
        let fraction = if part.doubled { 4 } else { 1 };
        let len = shape.batch * part.channels * shape.input_plane() / fraction;
        assert_eq!(part.values.len(), len, "convolution: a part of the input of {shape:?}");
    }
    let doubled = parts.iter().any(|part| part.doubled);
    assert!(!doubled || shape.size.iter().all(|size| size % 2 == 0), "convolution: a doubled image has an even size");
    let plain = !doubled && border == Border::Zeros;
    assert!(plain || shape.stride == [1, 1], "convolution: doubled and mirrored images go with stride 1");
    let mirrored = (0..2).all(|axis| shape.padding[axis] < shape.size[axis]);
    assert!(border == Border::Zeros || mirrored, "convolution: a mirror image no larger than the image");
}

/// One channel of one image.
struct ChannelPlane<'a> {
    pixels: &'a [f32],
    columns: usize,
    doubled: bool,
}

impl<'a> ChannelPlane<'a> {
    fn of(parts: &[Part<'a>], shape: &ConvolutionShape, index: usize) -> Self {
        let (image, mut channel) = (index / shape.inputs, index % shape.inputs);
        let mut parts = parts.iter();
        let part = parts.by_ref().find(|part| {
            let here = channel < part.channels;
            channel -= if here { 0 } else { part.channels };
            here
        });
        let Part { values, channels, doubled } = *part.expect("checked: the parts have all channels");
        let columns = if doubled { shape.size[1] / 2 } else { shape.size[1] };
        let plane = if doubled { shape.input_plane() / 4 } else { shape.input_plane() };
        Self { pixels: &values[(image * channels + channel) * plane..][..plane], columns, doubled }
    }

    fn row(&self, v: usize) -> &'a [f32] {
        &self.pixels[v * self.columns..][..self.columns]
    }

    /// A row at full size with its border, stride 1.
    fn copy_row(&self, v: usize, padding: usize, border: Border, row: &mut [f32]) {
        let pixels = self.row(if self.doubled { v / 2 } else { v });
        let width = if self.doubled { 2 * self.columns } else { self.columns };
        let inner = &mut row[padding..padding + width];
        if self.doubled {
            let (pairs, _) = inner.as_chunks_mut::<2>();
            pairs.iter_mut().zip(pixels).for_each(|(pair, &pixel)| *pair = [pixel; 2]);
        } else {
            inner.copy_from_slice(pixels);
        }
        if border == Border::Mirror {
            for distance in 1..=padding {
                row[padding - distance] = row[padding + distance];
                row[padding + width - 1 + distance] = row[padding + width - 1 - distance];
            }
        }
    }
}

/// Every `stride`-th value of a padded row, from `phase` on, into a row of zeros.
#[inline]
fn copy_phase(pixels: &[f32], padding: usize, phase: usize, stride: usize, row: &mut [f32]) {
    let before = padding.saturating_sub(phase).div_ceil(stride).min(row.len());
    let end = (pixels.len() + padding).saturating_sub(phase).div_ceil(stride).clamp(before, row.len());
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
pub(super) struct Residues {
    pub sets: Vec<ResidueSet>,
    before: usize,
    after: usize,
}

/// The input pixels with one residue.
pub(super) struct ResidueSet {
    /// First kernel tap they meet; the others follow by strides.
    pub residue: usize,
    /// Kernel taps they meet.
    pub taps: usize,
    /// First such pixel.
    pub first_input: usize,
    /// Number of such pixels.
    pub count: usize,
    /// Output that the first pixel meets with the first tap.
    pub first_output: usize,
}

impl Residues {
    pub fn of(shape: &ConvolutionShape, axis: usize) -> Self {
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
pub(super) struct PaddedGradient {
    pub values: Vec<f32>,
    image: usize,
    pub plane: usize,
    columns: usize,
    before: [usize; 2],
}

impl PaddedGradient {
    pub fn of(gradient: &[f32], shape: &ConvolutionShape, rows: &Residues, columns: &Residues) -> Self {
        let [output_rows, output_columns] = shape.output_size();
        let padded_columns = output_columns + columns.before + columns.after;
        let plane = (output_rows + rows.before + rows.after) * padded_columns;
        let len = shape.batch * shape.outputs * plane;
        let fill = |values: Shared| {
            // SAFETY: the slack belongs to no channel.
            unsafe { values.zeroed(len, SLACK) };
            gradient.par_chunks(output_rows * output_columns).enumerate().for_each(|(index, pixels)| {
                // SAFETY: each channel of each image is one task's.
                let padded = unsafe { values.zeroed(index * plane, plane) };
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
    pub fn pixel(&self, first_row: usize, tap_v: usize, first_column: usize, tap_u: usize) -> usize {
        (first_row + self.before[0] - tap_v) * self.columns + first_column + self.before[1] - tap_u
    }

    /// Place of a set's `row`-th row relative to its first.
    pub fn row(&self, image: usize, row: usize) -> usize {
        image * self.image + row * self.columns
    }
}

/// The padded input with the channels of each pixel side by side.
pub(super) struct ChannelsLast {
    pub values: Vec<f32>,
    size: [usize; 2],
    channels: usize,
}

impl ChannelsLast {
    pub fn of(input: &[f32], shape: &ConvolutionShape) -> Self {
        let output = shape.output_size();
        let size = [0, 1].map(|axis| (output[axis] - 1) * shape.stride[axis] + shape.kernel[axis]);
        let (channels, plane) = (shape.inputs, shape.input_plane());
        let line_len = size[1] * channels;
        let len = shape.batch * size[0] * line_len;
        let fill = |values: Shared| {
            // SAFETY: the slack belongs to no line.
            unsafe { values.zeroed(len, SLACK) };
            (0..shape.batch * size[0]).into_par_iter().for_each(|index| {
                // SAFETY: each line of each image is one task's.
                let line = unsafe { values.zeroed(index * line_len, line_len) };
                let (image, row) = (index / size[0], index % size[0]);
                let before = shape.padding[1].min(size[1]);
                let seen = shape.size[1].min(size[1] - before);
                if let Some(row) = row.checked_sub(shape.padding[0]).filter(|&row| row < shape.size[0]) {
                    let first = image * channels * plane + row * shape.size[1];
                    let pixels = &mut line[before * channels..][..seen * channels];
                    transpose(&input[first..], plane, pixels, channels);
                }
            });
        };
        // SAFETY: the tasks write every line, and the slack is filled.
        let values = unsafe { filled(len + SLACK, fill) };
        Self { values, size, channels }
    }

    pub fn pixel(&self, image: usize, row: usize, column: usize) -> usize {
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
