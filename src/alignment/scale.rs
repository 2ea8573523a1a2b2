//! The robust scale of residuals.

use pulp::Simd;

use super::normal_equations::DEGREES_OF_FREEDOM;
use crate::kernels::{Instructions, Kernel};

/// Most steps towards the fixed point.
const STEPS: usize = 12;
/// Values that are summed side by side.
const LANES: usize = 16;
/// Values that are summed in f32 before they join the f64 sum.
const BLOCK: usize = 2048;

/// The scale of residuals under Student's t: the fixed point of `σ² = mean (ν+1) r² / (ν + r²/σ²)` (Kerl et al. 2013,
/// Eq. 14), from a first guess; NaN are left out.
pub(super) fn scale(residuals: &[f32], guess: f32, least: f32) -> f32 {
    let mut scale = guess.max(least);
    for _ in 0..STEPS {
        let (sum, count) = Instructions::current().run(ScaleSums { residuals, scale });
        if count == 0.0 {
            return least;
        }
        let next = ((sum / count).sqrt() as f32).max(least);
        let settled = (next - scale).abs() < 0.02 * scale;
        scale = next;
        if settled {
            break;
        }
    }
    scale
}

struct ScaleSums<'a> {
    residuals: &'a [f32],
    scale: f32,
}

impl Kernel for ScaleSums<'_> {
    type Output = (f64, f64);

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> (f64, f64) {
        let precision = 1.0 / (self.scale * self.scale);
        let (mut sum, mut counts) = (0.0, [0u32; LANES]);
        for block in self.residuals.chunks(BLOCK) {
            let mut sums = [0.0f32; LANES];
            // Residuals are padded to whole chunks.
            for residuals in block.as_chunks::<LANES>().0 {
                for lane in 0..LANES {
                    let r = residuals[lane];
                    // `max` turns NaN into 0; a condition would leave the compiler one value at a time.
                    let square = (r * r).max(0.0);
                    sums[lane] += square * (DEGREES_OF_FREEDOM + 1.0) / (DEGREES_OF_FREEDOM + square * precision);
                    counts[lane] += u32::from(!r.is_nan());
                }
            }
            sum += sums.iter().map(|&value| f64::from(value)).sum::<f64>();
        }
        (sum, f64::from(counts.iter().sum::<u32>()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_a_fixed_point_and_leaves_nan_out() {
        let residual = |k: usize| if k.is_multiple_of(3) { f32::NAN } else { 0.01 * (k as f32).sin() };
        let residuals: Vec<f32> = (0..4096).map(residual).collect();
        let found = f64::from(scale(&residuals, 0.02, 1e-6));
        let valid = residuals.iter().filter(|r| !r.is_nan()).map(|&r| f64::from(r).powi(2));
        let nu = f64::from(DEGREES_OF_FREEDOM);
        let sum: f64 = valid.clone().map(|square| (nu + 1.0) * square / (nu + square / found.powi(2))).sum();
        let next = (sum / valid.count() as f64).sqrt();
        assert!((found - next).abs() < 0.02 * next, "{found} {next}");
        assert_eq!(scale(&[f32::NAN; 64], 0.02, 1e-6), 1e-6);
    }
}
