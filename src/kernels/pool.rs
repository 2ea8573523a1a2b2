//! Maximum pooling as ResNets have it: 3x3 pixels, every second row and column.

use pulp::Simd;
use rayon::prelude::*;

use super::buffer::{Shared, filled};
use super::instructions::{Instructions, Kernel};

/// # Shapes
/// - `input`: `[batch, channels, height, width]` as `shape` says
/// - returns: half of both sizes, rounded up; what lies beyond the border does not count
pub(super) fn max_pool(instructions: Instructions, input: &[f32], shape: [usize; 4]) -> Vec<f32> {
    let [batch, channels, height, width] = shape;
    assert!(shape.iter().all(|&size| size > 0), "max_pool: nothing to do ({shape:?})");
    assert_eq!(input.len(), batch * channels * height * width, "max_pool: input of {shape:?}");
    let (rows, columns) = (height.div_ceil(2), width.div_ceil(2));
    let fill = |output: Shared| {
        input.par_chunks(height * width).enumerate().for_each_init(
            || vec![0.0; width],
            |tallest, (plane, pixels)| {
                for row in 0..rows {
                    // SAFETY: each plane is one task's.
                    let output = unsafe { output.zeroed((plane * rows + row) * columns, columns) };
                    let line = |v: usize| &pixels[v * width..][..width];
                    let lines = [line((2 * row).saturating_sub(1)), line(2 * row), line((2 * row + 1).min(height - 1))];
                    instructions.run(PoolRow { lines, tallest, output });
                }
            },
        );
    };
    // SAFETY: the tasks write every row of every plane.
    unsafe { filled(batch * channels * rows * columns, fill) }
}

struct PoolRow<'a> {
    /// Three lines of the image; at its border one of them twice.
    lines: [&'a [f32]; 3],
    /// As long as a line.
    tallest: &'a mut [f32],
    output: &'a mut [f32],
}

impl Kernel for PoolRow<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { lines: [a, b, c], tallest, output } = self;
        for (((tallest, a), b), c) in tallest.iter_mut().zip(a).zip(b).zip(c) {
            *tallest = larger(larger(*a, *b), *c);
        }
        let (pairs, last) = tallest.as_chunks::<2>();
        let mut before = tallest[0];
        for (output, [even, odd]) in output.iter_mut().zip(pairs) {
            *output = larger(larger(before, *even), *odd);
            before = *odd;
        }
        if let ([last], Some(output)) = (last, output.last_mut()) {
            *output = larger(before, *last);
        }
    }
}

/// NaN stays NaN, so that broken weights are seen.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b || a.is_nan() { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::super::reference::noise;
    use super::*;

    #[test]
    fn each_pixel_is_the_largest_around_it() {
        for (height, width) in [(6, 8), (7, 9), (1, 1), (2, 5), (33, 64)] {
            let input = noise(2 * 3 * height * width, 8);
            for instructions in Instructions::available() {
                let output = max_pool(instructions, &input, [2, 3, height, width]);
                let (rows, columns) = (height.div_ceil(2), width.div_ceil(2));
                assert_eq!(output.len(), 6 * rows * columns);
                for (index, value) in output.iter().enumerate() {
                    let (plane, v, u) = (index / (rows * columns), index / columns % rows, index % columns);
                    let around =
                        |centre: usize, size: usize| (2 * centre).saturating_sub(1)..(2 * centre + 2).min(size);
                    let pixels = around(v, height).flat_map(|v| around(u, width).map(move |u| (v, u)));
                    let largest = pixels.map(|(v, u)| input[(plane * height + v) * width + u]).reduce(f32::max);
                    assert_eq!(Some(*value), largest, "{height}x{width}, {index}");
                }
            }
        }
    }

    #[test]
    fn nan_is_not_lost() {
        let output = max_pool(Instructions::available()[0], &[1.0, f32::NAN, 3.0, 4.0], [1, 1, 2, 2]);
        assert!(output[0].is_nan());
    }
}
