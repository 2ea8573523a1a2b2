//! Metrics of predicted covariances; z = e/√R throughout, R the diagonal.

use serde::{Deserialize, Serialize};

use super::ranks::{correlation, median};
use crate::geometry::Covariance6;

/// Squared Mahalanobis distance that a 6-dimensional Gaussian error stays below with probability 0.95.
const CHI_SQUARED_6_95: f64 = 12.592;

/// How well variances describe errors. What does not exist for a method (the likelihood of a zero
/// variance, the calibration against errors that are all zero) is `None`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Median dispersion error, `median √|R − e²|` (paper Section V-B.3); m and rad. Improper: a
    /// predictor of zero can win it.
    pub mde: [f64; 6],
    /// Quartiles of the same: 25, 50 and 75 %.
    pub de_quartiles: [[f64; 6]; 3],
    /// Mean of ½(6 ln 2π + Σ ln R + eᵀR⁻¹e), nats. Lower is better; proper.
    pub nll: Option<f64>,
    /// Mean of eᵀR⁻¹e / 6; 1 when calibrated.
    pub anees: Option<f64>,
    /// Share of pairs with eᵀR⁻¹e < 12.592; .95 when calibrated.
    pub nees_below_95: Option<f64>,
    /// Mean of z²; 1 when calibrated.
    pub zms: Option<[f64; 6]>,
    /// Shares with |z| below 1, 2 and 3; .683, .954, .997 when calibrated.
    pub coverage: Option<[[f64; 6]; 3]>,
    /// Mean of √R, m and rad.
    pub sharpness: [f64; 6],
    /// Share of outputs on the variance floor.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_floor: Option<f64>,
    /// Against the system's true covariance, where the data state it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub against_true: Option<AgainstTrue>,
}

/// Predicted beside true standard deviations, component by component.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgainstTrue {
    /// Median of predicted over true σ.
    pub median_sigma_ratio: [f64; 6],
    /// Correlation of ln σ with ln true σ; `None` where one of them is constant.
    pub log_sigma_correlation: [Option<f64>; 6],
}

impl AgainstTrue {
    /// Compares variances row by row; `None` without rows or with a variance that is not positive.
    pub fn compare(predicted: &[[f64; 6]], truth: &[[f64; 6]]) -> Option<Self> {
        let positive = |rows: &[[f64; 6]]| rows.iter().flatten().all(|&variance| variance > 0.0);
        if predicted.is_empty() || !positive(predicted) || !positive(truth) {
            return None;
        }
        let log_sigmas =
            |rows: &[[f64; 6]], c: usize| -> Vec<f64> { rows.iter().map(|row| 0.5 * row[c].ln()).collect() };
        Some(Self {
            median_sigma_ratio: std::array::from_fn(|c| {
                let ratios = predicted.iter().zip(truth).map(|(predicted, truth)| (predicted[c] / truth[c]).sqrt());
                median(ratios.collect()).expect("not empty")
            }),
            log_sigma_correlation: std::array::from_fn(|c| {
                correlation(&log_sigmas(predicted, c), &log_sigmas(truth, c))
            }),
        })
    }
}

/// Evaluates diagonal covariances against errors, row by row (order ρ then φ); `None` without rows.
pub fn evaluate(variances: &[[f64; 6]], errors: &[[f64; 6]]) -> Option<Metrics> {
    assert_eq!(variances.len(), errors.len(), "one variance for each error");
    let rows = variances.iter().zip(errors);
    let nees = rows.map(|(variance, error)| variance.iter().zip(error).map(|(v, e)| e * e / v).sum()).collect();
    let log_determinants: Vec<f64> = variances.iter().map(|variance| variance.iter().map(|v| v.ln()).sum()).collect();
    let possible = variances.iter().flatten().all(|&variance| variance > 0.0);
    evaluate_joint(variances, errors, possible.then_some((nees, log_determinants)))
}

/// Evaluates full covariances: joint scores by the whole matrix, scores of components by its diagonal.
/// `None` without rows.
pub fn evaluate_full(covariances: &[Covariance6], errors: &[[f64; 6]]) -> Option<Metrics> {
    assert_eq!(covariances.len(), errors.len(), "one covariance for each error");
    let variances: Vec<[f64; 6]> = covariances.iter().map(|covariance| covariance.variance().into()).collect();
    let joint: Option<Vec<(f64, f64)>> =
        covariances.iter().zip(errors).map(|(covariance, &error)| covariance.mahalanobis(&error.into())).collect();
    evaluate_joint(&variances, errors, joint.map(|joint| joint.into_iter().unzip()))
}

/// `joint` holds eᵀR⁻¹e and ln det R of each row, if R can be inverted in every row.
fn evaluate_joint(variances: &[[f64; 6]], errors: &[[f64; 6]], joint: Option<(Vec<f64>, Vec<f64>)>) -> Option<Metrics> {
    if errors.is_empty() {
        return None;
    }
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let column = |value: &dyn Fn(f64, f64) -> f64, component: usize| -> Vec<f64> {
        variances.iter().zip(errors).map(|(variance, error)| value(variance[component], error[component])).collect()
    };
    let per_component = |summary: &dyn Fn(usize) -> f64| std::array::from_fn(summary);

    let mut dispersion: [Vec<f64>; 6] =
        std::array::from_fn(|c| column(&|variance, error| (variance - error * error).abs().sqrt(), c));
    dispersion.iter_mut().for_each(|values| values.sort_by(f64::total_cmp));
    let quartile = |share: f64| per_component(&|c| quantile(&dispersion[c], share));

    let erroneous = errors.iter().flatten().any(|&error| error != 0.0);
    let joint = joint.filter(|_| erroneous);
    let z_squared: [Vec<f64>; 6] = std::array::from_fn(|c| column(&|variance, error| error * error / variance, c));
    let calibratable = joint.is_some();

    Some(Metrics {
        mde: quartile(0.5),
        de_quartiles: [quartile(0.25), quartile(0.5), quartile(0.75)],
        nll: joint.as_ref().map(|(nees, log_determinants)| {
            0.5 * (6.0 * std::f64::consts::TAU.ln() + mean(log_determinants) + mean(nees))
        }),
        anees: joint.as_ref().map(|(nees, _)| mean(nees) / 6.0),
        nees_below_95: joint.as_ref().map(|(nees, _)| share(nees, |value| value < CHI_SQUARED_6_95)),
        zms: calibratable.then(|| per_component(&|c| mean(&z_squared[c]))),
        coverage: calibratable
            .then(|| [1.0, 4.0, 9.0].map(|limit| per_component(&|c| share(&z_squared[c], |value| value <= limit)))),
        sharpness: per_component(&|c| mean(&column(&|variance, _| variance.sqrt(), c))),
        at_floor: None,
        against_true: None,
    })
}

fn share(values: &[f64], condition: impl Fn(f64) -> bool) -> f64 {
    values.iter().filter(|&&value| condition(value)).count() as f64 / values.len() as f64
}

/// Quantile of sorted values, linear between neighbours (numpy's default).
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let position = share * (sorted.len() - 1) as f64;
    let below = position.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn a_standard_normal_error_under_its_own_variance_is_calibrated() {
        // Quantiles of the normal distribution would do; a symmetric pair has z² = 1 exactly.
        let metrics = evaluate(&[[4.0; 6], [4.0; 6]], &[[2.0; 6], [-2.0; 6]]).unwrap();
        assert_relative_eq!(metrics.anees.unwrap(), 1.0);
        assert_eq!(metrics.zms, Some([1.0; 6]));
        assert_eq!(metrics.mde, [0.0; 6]);
        let expected = 0.5 * (6.0 * std::f64::consts::TAU.ln() + 6.0 * 4f64.ln() + 6.0);
        assert_relative_eq!(metrics.nll.unwrap(), expected, epsilon = 1e-12);
    }

    #[test]
    fn a_full_covariance_scores_its_correlations() {
        let diagonal = Covariance6::from_std_devs(&Tangent::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03));
        let errors = [[0.05, -0.1, 0.2, 0.01, 0.0, -0.02], [0.0, 0.3, -0.1, 0.02, 0.01, 0.01]];
        let full = evaluate_full(&[diagonal; 2], &errors).unwrap();
        let plain = evaluate(&[diagonal.variance().into(); 2], &errors).unwrap();
        assert_relative_eq!(full.nll.unwrap(), plain.nll.unwrap(), epsilon = 1e-12);
        assert_relative_eq!(full.anees.unwrap(), plain.anees.unwrap(), epsilon = 1e-12);
        // In other axes the matrix is full, and the likelihood of the error carried along is the same.
        let axes = crate::geometry::Pose::exp(&Tangent::new(1.0, 0.4, -0.3, 0.5, 0.2, -0.8));
        let moved = errors.map(|error| (axes.adjoint() * Tangent::from(error)).into());
        let full = evaluate_full(&[diagonal.transported(&axes); 2], &moved).unwrap();
        assert_relative_eq!(full.nll.unwrap(), plain.nll.unwrap(), epsilon = 1e-9);
    }

    #[test]
    fn predictions_are_compared_with_true_variances() {
        let truth = [[1.0; 6], [4.0; 6], [9.0; 6]];
        let halved = truth.map(|row| row.map(|variance| variance / 4.0));
        let comparison = AgainstTrue::compare(&halved, &truth).unwrap();
        assert_relative_eq!(comparison.median_sigma_ratio[3], 0.5);
        assert_relative_eq!(comparison.log_sigma_correlation[3].unwrap(), 1.0, epsilon = 1e-12);
        let constant = AgainstTrue::compare(&[[1.0; 6]; 3], &truth).unwrap();
        assert_eq!(constant.log_sigma_correlation, [None; 6]);
        assert_eq!(AgainstTrue::compare(&[[0.0; 6]; 3], &truth), None);
    }

    #[test]
    fn what_does_not_exist_is_none() {
        let zero = evaluate(&[[0.0; 6]], &[[1.0; 6]]).unwrap();
        assert_eq!((zero.nll, zero.anees, zero.mde), (None, None, [1.0; 6]));
        let truth = evaluate(&[[0.25; 6]], &[[0.0; 6]]).unwrap();
        assert_eq!((truth.nll, truth.coverage, truth.mde), (None, None, [0.5; 6]));
        assert!(evaluate(&[], &[]).is_none());
    }
}
