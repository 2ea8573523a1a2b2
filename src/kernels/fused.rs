//! A convolution with all that surrounds it in a network that is only used: inputs that are doubled and joined while
//! they are laid out, and sums that get bias, shortcut and activation while they are in the cache.

use pulp::Simd;

use super::activation::relu;
use super::border::Border;
use super::buffer::{Shared, filled};
use super::instructions::{Instructions, Kernel};
use super::layouts::{Part, Phases, offset};
use super::product::{Left, Right, product};
use super::shape::ConvolutionShape;

/// What follows a convolution.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Activation {
    /// Nothing.
    #[default]
    None,
    /// `max(x, 0)`.
    Relu,
    /// `x` above 0, `eˣ − 1` below.
    Elu,
}

/// A convolution and what surrounds it.
pub(super) struct FusedConvolution<'a> {
    pub shape: ConvolutionShape,
    /// The input, channels one part after the other.
    pub parts: &'a [Part<'a>],
    pub border: Border,
    pub weight: &'a [f32],
    pub bias: Option<&'a [f32]>,
    /// Added before the activation; as the output.
    pub shortcut: Option<&'a [f32]>,
    pub activation: Activation,
}

impl FusedConvolution<'_> {
    /// # Shapes
    /// - returns: `[batch, outputs, output height, output width]`
    pub fn run(self, instructions: Instructions) -> Vec<f32> {
        let Self { shape, parts, border, weight, bias, shortcut, activation } = self;
        shape.check(None, Some(weight), None);
        assert!(bias.is_none_or(|bias| bias.len() == shape.outputs), "convolution: one bias for each output channel");
        assert!(
            shortcut.is_none_or(|values| values.len() == shape.output_len()),
            "convolution: shortcut and {shape:?}"
        );
        let [rows, columns] = shape.output_size();
        let plane = rows * columns;
        let phases = Phases::of(parts, &shape, border);
        let terms = shape.inputs * shape.taps();
        let weights: Vec<u32> = (0..terms).map(offset).collect();
        let left = Left::new(weight, shape.outputs, terms, &weights);
        let stretches = (0..shape.batch * rows).map(|row| (phases.row(row / rows, row % rows), columns));
        let right = Right::new(&phases.values, &phases.offsets, stretches);
        let fill = |output: Shared| {
            product(instructions, left, &right, 1, |tile| {
                for channel in tile.rows.clone() {
                    let bias = bias.map_or(0.0, |bias| bias[channel]);
                    for (column, len) in tile.pieces(plane) {
                        let (image, pixel) = (column / plane, column % plane);
                        let sums = &tile.row(channel)[column - tile.columns.start..][..len];
                        let start = (image * shape.outputs + channel) * plane + pixel;
                        // SAFETY: channel and pixels belong to this tile alone.
                        let output = unsafe { output.written_sum(start, sums, bias) };
                        let shortcut = shortcut.map(|values| &values[start..start + len]);
                        if shortcut.is_some() || activation != Activation::None {
                            instructions.run(Finish { output, shortcut, activation });
                        }
                    }
                }
            });
        };
        // SAFETY: the tiles cover every output channel and, in their columns, every pixel of every image.
        unsafe { filled(shape.output_len(), fill) }
    }
}

/// Shortcut and activation, in place.
struct Finish<'a> {
    output: &'a mut [f32],
    shortcut: Option<&'a [f32]>,
    activation: Activation,
}

impl Kernel for Finish<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { output, shortcut, activation } = self;
        if let Some(shortcut) = shortcut {
            output.iter_mut().zip(shortcut).for_each(|(value, shortcut)| *value += shortcut);
        }
        match activation {
            Activation::None => {}
            Activation::Relu => output.iter_mut().for_each(|value| *value = relu(*value)),
            Activation::Elu => output.iter_mut().for_each(|value| *value = elu(*value)),
        }
    }
}

/// Without branches, so that the compiler vectorises it. NaN stays NaN.
#[inline(always)]
fn elu(x: f32) -> f32 {
    if x > 0.0 { x } else { exp_less_one(x) }
}

/// `eˣ − 1` for x ≤ 0, to 1e-7: `2ⁿ (eʳ − 1) + (2ⁿ − 1)` with |r| ≤ ½ ln 2 and the series of `eʳ − 1`.
#[inline(always)]
#[allow(clippy::excessive_precision, reason = "ln 2 in two parts of f32")]
fn exp_less_one(x: f32) -> f32 {
    const LN_2: [f32; 2] = [0.693_359_375, -2.121_944_4e-4];
    /// Adding it rounds to a whole number, which is then in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    // e^−30 is nothing beside 1. `max` would turn NaN into a number.
    let x = if x < -30.0 { -30.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN_2[0] - n * LN_2[1];
    let power = f32::from_bits(((shifted.to_bits().wrapping_sub(ROUND.to_bits())).wrapping_add(127)) << 23);
    let series = 1.0 / 720.0 * r + 1.0 / 120.0;
    let series = series * r + 1.0 / 24.0;
    let series = series * r + 1.0 / 6.0;
    let series = series * r + 0.5;
    let series = series * r + 1.0;
    power * (series * r) + (power - 1.0)
}

#[cfg(test)]
mod tests {
    use super::super::reference::{noise, reference};
    use super::*;

    #[test]
    fn elu_agrees_with_its_definition() {
        for step in 0..40_000 {
            let x = step as f32 * -1e-3;
            let expected = f64::from(x).exp_m1();
            assert!((f64::from(elu(x)) - expected).abs() < 1.5e-7, "{x}: {} and {expected}", elu(x));
        }
        assert_eq!((elu(3.5), elu(0.0), elu(f32::NEG_INFINITY)), (3.5, 0.0, -1.0));
        assert!(elu(f32::NAN).is_nan());
    }

    /// Joined, doubled, mirrored, with shortcut and activation, against the definition in f64 on the same image laid
    /// out in full.
    #[test]
    fn surroundings_are_those_of_separate_steps() {
        let (batch, height, width) = (2, 6, 10);
        let (first, second) = (3, 2);
        let small = noise(batch * first * height * width / 4, 1);
        let skip = noise(batch * second * height * width, 2);
        let pixel = |image: usize, channel: usize, v: usize, u: usize| {
            if channel < first {
                small[((image * first + channel) * (height / 2) + v / 2) * (width / 2) + u / 2]
            } else {
                skip[((image * second + channel - first) * height + v) * width + u]
            }
        };
        let mirrored = |place: usize, size: usize| match place {
            0 => 1,
            place if place > size => size - 2,
            place => place - 1,
        };
        let (mut padded, inputs) = (Vec::new(), first + second);
        for plane in 0..batch * inputs {
            for v in 0..height + 2 {
                let row = (0..width + 2)
                    .map(|u| pixel(plane / inputs, plane % inputs, mirrored(v, height), mirrored(u, width)));
                padded.extend(row);
            }
        }
        let shape = |size, padding| ConvolutionShape {
            batch,
            inputs,
            outputs: 7,
            size,
            kernel: [3, 3],
            stride: [1, 1],
            padding,
        };
        let whole = shape([height + 2, width + 2], [0, 0]);
        let (weight, bias) = (noise(whole.weight_len(), 3), noise(7, 4));
        let shortcut = noise(whole.output_len(), 5);
        let expected = reference(whole, &padded, &weight, &shortcut).output;
        for instructions in Instructions::available() {
            let found = FusedConvolution {
                shape: shape([height, width], [1, 1]),
                parts: &[
                    Part { values: &small, channels: first, doubled: true },
                    Part { values: &skip, channels: second, doubled: false },
                ],
                border: Border::Mirror,
                weight: &weight,
                bias: Some(&bias),
                shortcut: Some(&shortcut),
                activation: Activation::Elu,
            }
            .run(instructions);
            assert_eq!(found.len(), expected.len());
            for (index, (found, [sum, _])) in found.iter().zip(&expected).enumerate() {
                let channel = index / (height * width) % 7;
                let sum = sum + f64::from(bias[channel]) + f64::from(shortcut[index]);
                let expected = if sum > 0.0 { sum } else { sum.exp_m1() };
                assert!((f64::from(*found) - expected).abs() < 2e-6, "{index}: {found}, expected {expected}");
            }
        }
    }
}
