//! What a system's training errors alone say: the baselines that a model must beat.

use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

use super::log_linear::LogLinear;
use super::pair_table::SystemPairs;
use super::ranks::median;
use crate::geometry::{Covariance6, Tangent};
use crate::pairs::Pair;

/// Standard deviation of a Gaussian over the median of its absolute values.
const SIGMA_PER_MEDIAN: f64 = 1.482_602_218_505_602;

/// Predictors fitted to the errors of one system over the training set.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Baselines {
    /// Mean e², m² and rad²: the most likely constant.
    pub mean_squared_error: [f64; 6],
    /// Square of 1.4826 times the median |e|, m² and rad²: a constant that outliers do not move. `None` where
    /// half of a component's errors are zero.
    #[serde(default)]
    pub median_variance: Option<[f64; 6]>,
    /// Mean e eᵀ, m² and rad²: the most likely constant with correlations. `None` where it is not positive definite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_outer_product: Option<[[f64; 6]; 6]>,
    /// Log-linear in the measured motion; `None` for a system without errors.
    #[serde(default)]
    pub log_linear: Option<LogLinear>,
}

impl Baselines {
    /// Fits to the pairs of one system.
    pub fn of_pairs(pairs: &[Pair]) -> Self {
        let (motions, errors): (Vec<_>, Vec<_>) = pairs.iter().map(|pair| (pair.motion, pair.error)).unzip();
        Self::fit(&motions, &errors)
    }

    /// Fits to the measurements of one system; log-linear where their motion is known.
    pub fn of_system(system: &SystemPairs) -> Self {
        let errors: Vec<Tangent> = system.rows.iter().map(|row| row.error.into()).collect();
        let motions: Option<Vec<Tangent>> = system.rows.iter().map(|row| row.motion.map(Tangent::from)).collect();
        match motions {
            Some(motions) => Self::fit(&motions, &errors),
            None => Self { log_linear: None, ..Self::fit(&vec![Tangent::zeros(); errors.len()], &errors) },
        }
    }

    /// Fits to errors (m and rad) and the measured motions they belong to (`log T̂` in vehicle axes).
    pub fn fit(motions: &[Tangent], errors: &[Tangent]) -> Self {
        let sum: Vector6<f64> = errors.iter().map(|error| error.component_mul(error)).sum();
        let outer: Matrix6<f64> = errors.iter().map(|error| error * error.transpose()).sum();
        let outer = Covariance6::from_matrix(outer / errors.len().max(1) as f64).ok().filter(Covariance6::is_positive);
        let median_variance: [f64; 6] = std::array::from_fn(|component| {
            let sizes = errors.iter().map(|error| error[component].abs()).collect();
            (SIGMA_PER_MEDIAN * median(sizes).unwrap_or(0.0)).powi(2)
        });
        Self {
            mean_squared_error: (sum / errors.len().max(1) as f64).into(),
            median_variance: median_variance.iter().all(|&variance| variance > 0.0).then_some(median_variance),
            mean_outer_product: outer
                .map(|outer| std::array::from_fn(|row| std::array::from_fn(|column| outer.matrix()[(row, column)]))),
            log_linear: LogLinear::fit(motions, errors),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outlier_moves_the_mean_and_not_the_median() {
        let errors = [1.0, -1.0, 1.0, -1.0, 100.0].map(Tangent::repeat);
        let baselines = Baselines::fit(&[Tangent::zeros(); 5], &errors);
        assert_eq!(baselines.mean_squared_error, [2000.8; 6]);
        assert!((baselines.median_variance.unwrap()[0] - SIGMA_PER_MEDIAN * SIGMA_PER_MEDIAN).abs() < 1e-12);
        assert_eq!(Baselines::fit(&[], &[]).median_variance, None);
    }
}
