//! A vector times a matrix: a fully connected layer for one image.

use pulp::Simd;
use rayon::prelude::*;

use super::instructions::{Instructions, Kernel};

/// Rows of a task. Its partial sums are added in order, so that results do not depend on threads.
const TASK_ROWS: usize = 1024;
/// Vectors of columns summed in registers at once.
const VECTORS: usize = 8;

/// `output = input · weight`; rows of `weight` whose input is 0 are not read, which after a ReLU is
/// about half of a matrix that comes from memory.
///
/// # Shapes
/// - `input`: `[rows]`; `weight`: `[rows, columns]`, row-major
/// - returns: `[columns]`
pub(super) fn vector_matrix(instructions: Instructions, input: &[f32], weight: &[f32], columns: usize) -> Vec<f32> {
    assert_eq!(input.len() * columns, weight.len(), "vector-matrix product: rows times columns");
    let partial: Vec<Vec<f32>> = input
        .par_chunks(TASK_ROWS)
        .zip(weight.par_chunks(TASK_ROWS * columns.max(1)))
        .map(|(input, weight)| {
            let mut sums = vec![0.0; columns];
            instructions.run(WeightedRows { input, weight, sums: &mut sums });
            sums
        })
        .collect();
    let mut output = vec![0.0; columns];
    for sums in partial {
        output.iter_mut().zip(sums).for_each(|(output, sum)| *output += sum);
    }
    output
}

struct WeightedRows<'a> {
    input: &'a [f32],
    weight: &'a [f32],
    sums: &'a mut [f32],
}

impl Kernel for WeightedRows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { input, weight, sums } = self;
        let columns = sums.len();
        let block = VECTORS * S::F32_LANES;
        for (index, sums) in sums.chunks_mut(block).enumerate() {
            let rows = input.iter().zip(weight.chunks_exact(columns)).filter(|&(&factor, _)| factor != 0.0);
            let width = sums.len();
            let rows = rows.map(|(&factor, row)| (factor, &row[index * block..][..width]));
            if width == block {
                let mut vectors = [simd.splat_f32s(0.0); VECTORS];
                for (factor, row) in rows {
                    let factor = simd.splat_f32s(factor);
                    let (row, _) = S::as_simd_f32s(row);
                    for (sum, &value) in vectors.iter_mut().zip(row) {
                        // The weights come from memory: a fused operation would gain nothing here.
                        *sum = simd.add_f32s(simd.mul_f32s(factor, value), *sum);
                    }
                }
                S::as_mut_simd_f32s(sums).0.copy_from_slice(&vectors);
            } else {
                for (factor, row) in rows {
                    sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += factor * value);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn agrees_with_sums_in_f64(rows in 1usize..3000, columns in 1usize..200, seed in any::<u32>()) {
            let value = |index: usize| ((index as u32).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 8) as f32 / 16_777_216.0 - 0.5;
            let input: Vec<f32> = (0..rows).map(|row| value(row).max(0.0)).collect();
            let weight: Vec<f32> = (0..rows * columns).map(|index| value(index + rows)).collect();
            for instructions in Instructions::available() {
                let output = vector_matrix(instructions, &input, &weight, columns);
                for (column, &output) in output.iter().enumerate() {
                    let terms = (0..rows).map(|row| f64::from(input[row]) * f64::from(weight[row * columns + column]));
                    let (sum, size) = terms.fold((0.0, 0.0), |(sum, size), term| (sum + term, size + term.abs()));
                    prop_assert!((f64::from(output) - sum).abs() <= 1e-6 * size + 1e-12, "{}: {output} for {sum}", instructions.name());
                }
            }
        }
    }
}
