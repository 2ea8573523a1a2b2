//! The evidence as numbers of about one, for a network to read.

use nalgebra::Matrix6;

use super::evidence::{Evidence, LEVELS};
use crate::geometry::Tangent;

/// How many there are.
pub const FEATURES: usize = 87;
/// Errors that count as one where numbers must keep their size: m and rad.
const UNIT: [f64; 6] = [0.05, 0.05, 0.05, 5e-3, 5e-3, 5e-3];
/// Standard deviations that a direction keeps of which the images show nothing, m and rad.
const FAR: [f64; 6] = [100.0, 100.0, 100.0, 3.0, 3.0, 3.0];
/// Half a step of 8-bit images: the noise that residuals are compared with.
const NOISE: f64 = 0.5 / 255.0;
/// Logarithms span some ±10.
const LOG_SCALE: f64 = 0.3;

/// Features of evidence, in axes of the errors, and of the measured motion, in those of the camera; S = Λ⁻¹, levels from
/// coarse to fine; in the order of the array.
///
/// | number | feature | what it tells |
/// |---|---|---|
/// | 6 | `ln(\|motion\|/unit + .1)` | what the measurement says: some systems' errors follow it |
/// | 1 | whether there is a verdict; without one all others but the motion are 0 | |
/// | 18 | `ln(1 + \|ê\|/√S)` of each level | how certainly the measurement is wrong |
/// | 12 | `ln(1 + \|ê_level − ê_finest\|/√S_finest)` of the coarser levels | whether the levels agree |
/// | 12 | `ln(√S_level/√S_finest)` of the same | what resolution adds |
/// | 15 | correlations of S at the finest level | which directions the images cannot tell apart |
/// | 6 | `ln(residual before/after)` and `ln(after/noise)` of each level | what alignment explained; what it left |
/// | 3 | valid share of each level | |
/// | 2 | gain and bias | change of light |
/// | 6 | `ln(√S_finest/unit)` | back to metres: how much the images show here |
/// | 6 | `ln(\|ê\|/unit + .01)` | back to metres: how large the error seems |
pub fn features(evidence: &Evidence, motion: &Tangent) -> [f32; FEATURES] {
    let mut list = Features { values: [0.0; FEATURES], filled: 0 };
    list.logs((0..6).map(|c| motion[c].abs() / UNIT[c] + 0.1));
    if evidence.no_verdict.is_none() {
        list.evidence(evidence);
        assert_eq!(list.filled, FEATURES, "the table above");
    }
    list.values
}

struct Features {
    values: [f32; FEATURES],
    filled: usize,
}

impl Features {
    fn push(&mut self, value: f64) {
        // Numbers of the images are finite; a ratio of extremes may not be.
        self.values[self.filled] = if value.is_nan() { 0.0 } else { value.clamp(-10.0, 10.0) as f32 };
        self.filled += 1;
    }

    fn logs(&mut self, values: impl IntoIterator<Item = f64>) {
        values.into_iter().for_each(|value| self.push(LOG_SCALE * value.ln()));
    }

    fn evidence(&mut self, evidence: &Evidence) {
        self.push(1.0);
        let covariances = evidence.levels.map(|level| bounded_inverse(&level.information));
        let sigmas = covariances.map(|covariance| covariance.diagonal().map(f64::sqrt));
        let (finest, sigma) = (evidence.finest(), sigmas[LEVELS - 1]);
        for (level, sigma) in evidence.levels.iter().zip(&sigmas) {
            self.logs((0..6).map(|c| 1.0 + level.error[c].abs() / sigma[c]));
        }
        for (level, level_sigma) in evidence.levels.iter().zip(&sigmas).take(LEVELS - 1) {
            self.logs((0..6).map(|c| 1.0 + (level.error[c] - finest.error[c]).abs() / sigma[c]));
            self.logs((0..6).map(|c| level_sigma[c] / sigma[c]));
        }
        let covariance = &covariances[LEVELS - 1];
        for row in 0..6 {
            for column in 0..row {
                self.push(covariance[(row, column)] / (sigma[row] * sigma[column]));
            }
        }
        for level in &evidence.levels {
            self.logs([level.residual_before.max(NOISE) / level.residual_after.max(NOISE)]);
            self.logs([level.residual_after.max(NOISE) / NOISE]);
            self.push(level.valid_share);
        }
        self.push(evidence.gain);
        self.push(evidence.bias);
        self.logs((0..6).map(|c| sigma[c] / UNIT[c]));
        self.logs((0..6).map(|c| finest.error[c].abs() / UNIT[c] + 0.01));
    }
}

/// `Λ⁻¹`, no direction less certain than [`FAR`] says.
fn bounded_inverse(information: &Matrix6<f64>) -> Matrix6<f64> {
    let least = Matrix6::from_diagonal(&Tangent::from(FAR).map(|sigma| sigma.powi(-2)));
    let bounded = information + least;
    bounded.cholesky().map_or_else(|| Matrix6::from_diagonal(&Tangent::from(FAR).map(|s| s * s)), |f| f.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alignment::NoVerdict;

    #[test]
    fn features_are_finite_whatever_the_evidence() {
        let motion = Tangent::new(0.0, 1e6, -1e-9, 0.0, 3.0, 0.0);
        let none = features(&Evidence::none(NoVerdict::NoDepth), &motion);
        assert!(none.iter().all(|value| value.is_finite()));
        assert!(none[6..].iter().all(|&value| value == 0.0));
        // Levels without information, as those too small to say anything.
        let nothing = Evidence { no_verdict: None, ..Evidence::none(NoVerdict::NoDepth) };
        assert!(features(&nothing, &motion).iter().all(|value| value.is_finite()));
        let mut wild = nothing;
        wild.levels[0].information = Matrix6::from_element(1e300);
        wild.levels[2].information = Matrix6::from_diagonal_element(1e-300);
        wild.levels[2].error = Tangent::repeat(1e300);
        assert!(features(&wild, &motion).iter().all(|value| value.is_finite()));
    }
}
