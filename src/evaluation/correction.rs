//! Errors of corrected measurements: what is left of an error once the part that was predicted is taken away.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::geometry::{Covariance6, Pose, Posterior, ROTATION, TRANSLATION};

/// The error of the corrected measurement `exp(−μ) T̂`: `log(exp(−μ) exp(e))`, to first order e − μ; m and rad. Without
/// a posterior the measurement stays as it is, and e its error.
pub(super) fn corrected_error(error: &[f64; 6], posterior: Option<&Posterior>) -> [f64; 6] {
    posterior.map_or(*error, |posterior| posterior.correct(&Pose::exp(&(*error).into())).log().into())
}

/// The covariance of that error: C, and R without a posterior.
pub(super) fn corrected_covariance(covariance: &Covariance6, posterior: Option<&Posterior>) -> Covariance6 {
    posterior.map_or(*covariance, |posterior| posterior.covariance)
}

/// Root mean square of the errors of corrected measurements over that of the measurements as they are: below 1 where a
/// correction helps. `None` where there is no error to take away.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RmsRatio {
    /// Component by component.
    pub components: [Option<f64>; 6],
    /// Of |ρ|.
    pub translation: Option<f64>,
    /// Of |φ|.
    pub rotation: Option<f64>,
}

impl RmsRatio {
    /// Compares errors of the same measurements, m and rad.
    pub(super) fn compare(corrected: &[[f64; 6]], errors: &[[f64; 6]]) -> Self {
        let sum = |errors: &[[f64; 6]], components: &Range<usize>| -> f64 {
            errors.iter().flat_map(|error| &error[components.clone()]).map(|value| value * value).sum()
        };
        let ratio = |components: Range<usize>| {
            let before = sum(errors, &components);
            (before > 0.0).then(|| (sum(corrected, &components) / before).sqrt())
        };
        Self {
            components: std::array::from_fn(|c| ratio(c..c + 1)),
            translation: ratio(TRANSLATION),
            rotation: ratio(ROTATION),
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Tangent;

    const ERROR: [f64; 6] = [0.3, -0.1, 0.2, 0.02, -0.01, 0.04];

    fn posterior(share: f64) -> Posterior {
        Posterior { mean: share * Tangent::from(ERROR), covariance: Covariance6::from_std_devs(&Tangent::repeat(0.01)) }
    }

    #[test]
    fn a_correction_takes_its_part_of_the_error_away() {
        // Along one axis of motion errors add up exactly.
        for share in [0.0, 1e-8, 0.5, 1.0] {
            let left = corrected_error(&ERROR, Some(&posterior(share)));
            for c in 0..6 {
                assert_relative_eq!(left[c], (1.0 - share) * ERROR[c], epsilon = 1e-12);
            }
        }
        assert_eq!(corrected_error(&ERROR, None), ERROR);
    }

    #[test]
    fn a_correction_across_the_error_subtracts_to_first_order() {
        let mean = Tangent::new(-0.01, 0.02, 0.01, 2e-3, 1e-3, -3e-3);
        let left = corrected_error(&ERROR.map(|error| 0.1 * error), Some(&Posterior { mean, ..posterior(0.0) }));
        for c in 0..6 {
            assert!((left[c] - (0.1 * ERROR[c] - mean[c])).abs() < 1e-4, "{left:?}");
        }
    }

    #[test]
    fn what_is_left_is_a_share_of_what_was_there() {
        let mut errors = [ERROR, ERROR.map(|error| -2.0 * error)];
        errors.iter_mut().for_each(|error| error[2] = 0.0);
        let half = errors.map(|error| error.map(|error| 0.5 * error));
        let ratio = RmsRatio::compare(&half, &errors);
        assert_eq!(ratio.components, [Some(0.5), Some(0.5), None, Some(0.5), Some(0.5), Some(0.5)]);
        assert_eq!((ratio.translation, ratio.rotation), (Some(0.5), Some(0.5)));
        assert_eq!(RmsRatio::compare(&half, &[[0.0; 6]; 2]).rotation, None);
    }
}
