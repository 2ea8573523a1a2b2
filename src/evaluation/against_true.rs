//! Predicted beside true standard deviations, which only simulated data can state.

use serde::{Deserialize, Serialize};

use super::ranks::{correlation, median};
use crate::geometry::Covariance6;

/// Predicted beside true standard deviations, component by component.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgainstTrue {
    /// Median of predicted over true σ.
    pub median_sigma_ratio: [f64; 6],
    /// Correlation of ln σ with ln true σ; `None` where one of them is constant.
    pub log_sigma_correlation: [Option<f64>; 6],
}

impl AgainstTrue {
    /// Compares diagonals row by row; `None` without rows or with a variance that is not positive.
    pub fn compare(predicted: &[Covariance6], truth: &[Covariance6]) -> Option<Self> {
        let log_sigmas = |rows: &[Covariance6], c: usize| -> Option<Vec<f64>> {
            let variances = || rows.iter().map(|row| row.matrix()[(c, c)]);
            variances()
                .all(|variance| variance > 0.0)
                .then(|| variances().map(|variance| 0.5 * variance.ln()).collect())
        };
        let (mut ratios, mut correlations) = ([0.0; 6], [None; 6]);
        for c in 0..6 {
            let (predicted, truth) = (log_sigmas(predicted, c)?, log_sigmas(truth, c)?);
            let differences = predicted.iter().zip(&truth).map(|(predicted, truth)| predicted - truth);
            ratios[c] = median(differences.collect())?.exp();
            correlations[c] = correlation(&predicted, &truth);
        }
        Some(Self { median_sigma_ratio: ratios, log_sigma_correlation: correlations })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Tangent;

    fn rows(variances: [f64; 3]) -> [Covariance6; 3] {
        variances.map(|variance| Covariance6::from_variances(&Tangent::repeat(variance)))
    }

    #[test]
    fn predictions_are_compared_with_true_variances() {
        let truth = rows([1.0, 4.0, 9.0]);
        let comparison = AgainstTrue::compare(&rows([0.25, 1.0, 2.25]), &truth).unwrap();
        assert_relative_eq!(comparison.median_sigma_ratio[3], 0.5, epsilon = 1e-12);
        assert_relative_eq!(comparison.log_sigma_correlation[3].unwrap(), 1.0, epsilon = 1e-12);
        assert_eq!(AgainstTrue::compare(&rows([1.0; 3]), &truth).unwrap().log_sigma_correlation, [None; 6]);
        assert_eq!(AgainstTrue::compare(&rows([0.0; 3]), &truth), None);
        assert_eq!(AgainstTrue::compare(&[], &[]), None);
    }
}
