//! Metrics of predicted diagonal covariances; z = e/√R throughout.

use serde::{Deserialize, Serialize};

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
}

/// Evaluates variances against errors, row by row (order ρ then φ); `None` without rows.
pub fn evaluate(variances: &[[f64; 6]], errors: &[[f64; 6]]) -> Option<Metrics> {
    assert_eq!(variances.len(), errors.len(), "one variance for each error");
    if errors.is_empty() {
        return None;
    }
    let rows = errors.len() as f64;
    let column = |value: &dyn Fn([f64; 6], [f64; 6], usize) -> f64, component: usize| -> Vec<f64> {
        variances.iter().zip(errors).map(|(&variance, &error)| value(variance, error, component)).collect()
    };
    let per_component = |summary: &dyn Fn(usize) -> f64| std::array::from_fn(summary);

    let mut dispersion: [Vec<f64>; 6] =
        std::array::from_fn(|c| column(&|variance, error, c| (variance[c] - error[c] * error[c]).abs().sqrt(), c));
    dispersion.iter_mut().for_each(|values| values.sort_by(f64::total_cmp));
    let quartile = |share: f64| per_component(&|c| quantile(&dispersion[c], share));

    let possible = variances.iter().flatten().all(|&variance| variance > 0.0);
    let erroneous = errors.iter().flatten().any(|&error| error != 0.0);
    let calibratable = possible && erroneous;
    let z_squared: [Vec<f64>; 6] =
        std::array::from_fn(|c| column(&|variance, error, c| error[c] * error[c] / variance[c], c));
    let nees: Vec<f64> = (0..errors.len()).map(|row| z_squared.iter().map(|column| column[row]).sum()).collect();
    let log_determinant = || variances.iter().flatten().map(|variance| variance.ln()).sum::<f64>() / rows;
    let mean_nees = nees.iter().sum::<f64>() / rows;

    Some(Metrics {
        mde: quartile(0.5),
        de_quartiles: [quartile(0.25), quartile(0.5), quartile(0.75)],
        nll: calibratable.then(|| 0.5 * (6.0 * std::f64::consts::TAU.ln() + log_determinant() + mean_nees)),
        anees: calibratable.then_some(mean_nees / 6.0),
        nees_below_95: calibratable.then(|| share(&nees, |value| value < CHI_SQUARED_6_95)),
        zms: calibratable.then(|| per_component(&|c| z_squared[c].iter().sum::<f64>() / rows)),
        coverage: calibratable
            .then(|| [1.0, 4.0, 9.0].map(|limit| per_component(&|c| share(&z_squared[c], |value| value <= limit)))),
        sharpness: per_component(&|c| column(&|variance, _, c| variance[c].sqrt(), c).iter().sum::<f64>() / rows),
        at_floor: None,
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
    fn what_does_not_exist_is_none() {
        let zero = evaluate(&[[0.0; 6]], &[[1.0; 6]]).unwrap();
        assert_eq!((zero.nll, zero.anees, zero.mde), (None, None, [1.0; 6]));
        let truth = evaluate(&[[0.25; 6]], &[[0.0; 6]]).unwrap();
        assert_eq!((truth.nll, truth.coverage, truth.mde), (None, None, [0.5; 6]));
        assert!(evaluate(&[], &[]).is_none());
    }
}
