//! Metrics of predicted covariances; z = e/√R throughout, R the diagonal.

use libm::erf;
use serde::{Deserialize, Serialize};

use super::against_true::AgainstTrue;
use super::bootstrap::Resamples;
use super::calibration::{ConditionalCalibration, ence};
use super::correction::RmsRatio;
use super::joint_scores::JointScores;
use super::ranks::{quantile, spearman};
use super::sparsification::sparsification_areas;
use crate::geometry::Covariance6;

/// Squared Mahalanobis distance that a 6-dimensional Gaussian error stays below with probability 0.95.
pub const CHI_SQUARED_6_95: f64 = 12.592;

/// How well covariances describe errors. What does not exist for a method (the likelihood of a zero
/// variance, the rank correlation of a constant, the calibration against errors that are all zero) is `None`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Median dispersion error, `median √|R − e²|` (paper Section V-B.3); m and rad. Improper: a
    /// predictor of zero can win it.
    pub mde: [f64; 6],
    /// Block-bootstrap interval of the same: lower and upper bounds.
    pub mde_interval: Option<[[f64; 6]; 2]>,
    /// Quartiles of the same: 25, 50 and 75 %.
    pub de_quartiles: [[f64; 6]; 3],
    /// Mean of ½(6 ln 2π + ln det R + eᵀR⁻¹e), nats. Lower is better; proper.
    pub nll: Option<f64>,
    /// Block-bootstrap interval of the same.
    pub nll_interval: Option<[f64; 2]>,
    /// Mean of the same minus that of the constant baseline, and its interval on the same resamples.
    pub nll_over_constant: Option<Difference>,
    /// Mean of ½(ln 2π + ln R + z²) of each component alone, nats.
    pub nll_by_component: Option<[f64; 6]>,
    /// Continuous ranked probability score, mean of `σ(z(2Φ(z)−1) + 2φ(z) − 1/√π)`; m and rad, lower is
    /// better; proper (Gneiting and Raftery 2007).
    pub crps: Option<[f64; 6]>,
    /// Mean of eᵀR⁻¹e / 6; 1 when calibrated.
    pub anees: Option<f64>,
    /// Block-bootstrap interval of the same.
    pub anees_interval: Option<[f64; 2]>,
    /// Share of pairs with eᵀR⁻¹e < 12.592; .95 when calibrated.
    pub nees_below_95: Option<f64>,
    /// Mean of z²; 1 when calibrated.
    pub zms: Option<[f64; 6]>,
    /// Shares with |z| at most 1, 2 and 3; .683, .954, .997 when calibrated.
    pub coverage: Option<[[f64; 6]; 3]>,
    /// Expected normalised calibration error, mean over bins of σ of |RMV − RMSE| / RMV (Levi et al. 2022):
    /// 0 when calibrated wherever σ is small or large.
    pub ence: Option<[f64; 6]>,
    /// Calibration where the covariance is small and where it is large; `None` for one that never changes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub conditional: Option<ConditionalCalibration>,
    /// Area under the sparsification error: 0 when σ ranks pairs as |e| does.
    pub ause: [Option<f64>; 6],
    /// Area under the random gain: above 0 when σ ranks errors better than chance.
    pub aurg: [Option<f64>; 6],
    /// Rank correlation of |e| and σ.
    pub spearman: [Option<f64>; 6],
    /// Mean of √R, m and rad.
    pub sharpness: [f64; 6],
    /// What a correction leaves of the errors, of corrected measurements.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rms_ratio: Option<RmsRatio>,
    /// Share of outputs on the variance floor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_floor: Option<f64>,
    /// Against the system's true covariance, where the data state it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub against_true: Option<AgainstTrue>,
}

/// A mean difference and the bounds of its interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// Mean.
    pub mean: f64,
    /// Bounds.
    pub interval: [f64; 2],
}

/// Evaluates covariances against errors, row by row (order ρ then φ); `None` without rows.
///
/// Joint scores take the whole matrix, scores of components its diagonal; without resamples there are no
/// intervals.
pub fn evaluate(covariances: &[Covariance6], errors: &[[f64; 6]], resamples: Option<&Resamples>) -> Option<Metrics> {
    evaluate_over(covariances, errors, resamples, None)
}

/// The same, and by how much the NLL differs from that of a reference.
pub(super) fn evaluate_over(
    covariances: &[Covariance6],
    errors: &[[f64; 6]],
    resamples: Option<&Resamples>,
    reference_nll: Option<&[f64]>,
) -> Option<Metrics> {
    assert_eq!(covariances.len(), errors.len(), "one covariance for each error");
    if errors.is_empty() {
        return None;
    }
    let error: [Vec<f64>; 6] = std::array::from_fn(|c| errors.iter().map(|error| error[c]).collect());
    let sigma: [Vec<f64>; 6] =
        std::array::from_fn(|c| covariances.iter().map(|covariance| covariance.matrix()[(c, c)].sqrt()).collect());
    let joint = JointScores::of(covariances, errors);
    let wrong = errors.iter().flatten().any(|&error| error != 0.0);
    // A score of z exists where a likelihood does.
    let z_squared: Option<[Vec<f64>; 6]> = joint.is_some().then(|| {
        std::array::from_fn(|c| error[c].iter().zip(&sigma[c]).map(|(e, sigma)| (e / sigma).powi(2)).collect())
    });
    let dispersion: [Vec<f64>; 6] = std::array::from_fn(|c| {
        let pairs = covariances.iter().zip(&error[c]);
        pairs.map(|(covariance, e)| (covariance.matrix()[(c, c)] - e * e).abs().sqrt()).collect()
    });
    let mde_interval = resamples.map(|resamples| resamples.median_intervals(&dispersion));
    let sorted = dispersion.map(|mut values| {
        values.sort_unstable_by(f64::total_cmp);
        values
    });
    let quartiles = [0.25, 0.5, 0.75].map(|share| per_component(|c| quantile(&sorted[c], share)));
    let areas: [Option<[f64; 2]>; 6] = std::array::from_fn(|c| sparsification_areas(&sigma[c], &error[c]));

    Some(Metrics {
        mde: quartiles[1],
        mde_interval: mde_interval.map(|bounds| [0, 1].map(|side| bounds.map(|bounds| bounds[side]))),
        de_quartiles: quartiles,
        nll: joint.as_ref().map(|joint| mean(&joint.nll)),
        nll_interval: joint.as_ref().zip(resamples).map(|(joint, resamples)| resamples.mean_interval(&joint.nll)),
        nll_over_constant: joint.as_ref().zip(resamples).zip(reference_nll).map(|((joint, resamples), reference)| {
            let differences: Vec<f64> =
                joint.nll.iter().zip(reference).map(|(nll, reference)| nll - reference).collect();
            Difference { mean: mean(&differences), interval: resamples.mean_interval(&differences) }
        }),
        nll_by_component: z_squared.as_ref().map(|z_squared| {
            per_component(|c| {
                let log_sigma = mean_of(sigma[c].iter().map(|sigma| sigma.ln()));
                0.5 * std::f64::consts::TAU.ln() + log_sigma + 0.5 * mean(&z_squared[c])
            })
        }),
        crps: wrong.then(|| per_component(|c| mean_of(error[c].iter().zip(&sigma[c]).map(|(&e, &s)| crps(e, s))))),
        anees: joint.as_ref().map(|joint| mean(&joint.nees) / 6.0),
        anees_interval: joint
            .as_ref()
            .zip(resamples)
            .map(|(joint, resamples)| resamples.mean_interval(&joint.nees).map(|bound| bound / 6.0)),
        nees_below_95: joint.as_ref().map(|joint| share(&joint.nees, |value| value < CHI_SQUARED_6_95)),
        zms: z_squared.as_ref().map(|z_squared| per_component(|c| mean(&z_squared[c]))),
        coverage: z_squared.as_ref().map(|z_squared| {
            [1.0, 4.0, 9.0].map(|limit| per_component(|c| share(&z_squared[c], |value| value <= limit)))
        }),
        ence: joint.is_some().then(|| per_component(|c| ence(&error[c], &sigma[c]))),
        conditional: joint
            .as_ref()
            .zip(z_squared.as_ref())
            .filter(|_| covariances.iter().any(|covariance| *covariance != covariances[0]))
            .map(|(joint, z_squared)| ConditionalCalibration::of(joint, &sigma, z_squared)),
        ause: areas.map(|areas| Some(areas?[0])),
        aurg: areas.map(|areas| Some(areas?[1])),
        spearman: std::array::from_fn(|c| {
            let sizes: Vec<f64> = error[c].iter().map(|error| error.abs()).collect();
            spearman(&sizes, &sigma[c])
        }),
        sharpness: per_component(|c| mean(&sigma[c])),
        rms_ratio: None,
        at_floor: None,
        against_true: None,
    })
}

fn per_component(summary: impl Fn(usize) -> f64) -> [f64; 6] {
    std::array::from_fn(summary)
}

fn mean(values: &[f64]) -> f64 {
    mean_of(values.iter().copied())
}

fn mean_of(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

fn share(values: &[f64], condition: impl Fn(f64) -> bool) -> f64 {
    values.iter().filter(|&&value| condition(value)).count() as f64 / values.len() as f64
}

/// Of a zero-mean Gaussian against an error; |e| for a prediction without spread.
fn crps(error: f64, sigma: f64) -> f64 {
    if sigma == 0.0 {
        return error.abs();
    }
    let z = error / sigma;
    let density = (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt();
    // 2Φ(z) − 1 is erf(z/√2).
    sigma * (z * erf(z * std::f64::consts::FRAC_1_SQRT_2) + 2.0 * density - std::f64::consts::PI.sqrt().recip())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Tangent;

    fn diagonal(variances: &[[f64; 6]]) -> Vec<Covariance6> {
        variances.iter().map(|&variance| Covariance6::from_variances(&variance.into())).collect()
    }

    #[test]
    fn a_standard_normal_error_under_its_own_variance_is_calibrated() {
        // Quantiles of the normal distribution would do; a symmetric pair has z² = 1 exactly.
        let metrics = evaluate(&diagonal(&[[4.0; 6], [4.0; 6]]), &[[2.0; 6], [-2.0; 6]], None).unwrap();
        assert_relative_eq!(metrics.anees.unwrap(), 1.0);
        assert_eq!(metrics.zms, Some([1.0; 6]));
        assert_eq!(metrics.mde, [0.0; 6]);
        assert_eq!((metrics.ence, metrics.spearman), (Some([0.0; 6]), [None; 6]));
        let expected = 0.5 * (6.0 * std::f64::consts::TAU.ln() + 6.0 * 4f64.ln() + 6.0);
        assert_relative_eq!(metrics.nll.unwrap(), expected, epsilon = 1e-12);
        assert_relative_eq!(metrics.nll_by_component.unwrap().iter().sum::<f64>(), expected, epsilon = 1e-12);
    }

    #[test]
    fn a_full_covariance_scores_its_correlations() {
        let independent = Covariance6::from_std_devs(&Tangent::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03));
        let errors = [[0.05, -0.1, 0.2, 0.01, 0.0, -0.02], [0.0, 0.3, -0.1, 0.02, 0.01, 0.01]];
        let plain = evaluate(&[independent; 2], &errors, None).unwrap();
        // In other axes the matrix is full, and the likelihood of the error carried along is the same.
        let axes = crate::geometry::Pose::exp(&Tangent::new(1.0, 0.4, -0.3, 0.5, 0.2, -0.8));
        let moved = errors.map(|error| (axes.adjoint() * Tangent::from(error)).into());
        let full = evaluate(&[independent.transported(&axes); 2], &moved, None).unwrap();
        assert_relative_eq!(full.nll.unwrap(), plain.nll.unwrap(), epsilon = 1e-9);
        assert_relative_eq!(full.anees.unwrap(), plain.anees.unwrap(), epsilon = 1e-9);
    }

    #[test]
    fn what_does_not_exist_is_none() {
        let zero = evaluate(&diagonal(&[[0.0; 6]; 2]), &[[1.0; 6], [-3.0; 6]], None).unwrap();
        assert_eq!((zero.nll, zero.anees, zero.zms, zero.ence), (None, None, None, None));
        // The score of a prediction without spread is its absolute error.
        assert_eq!((zero.mde, zero.crps), ([2.0; 6], Some([2.0; 6])));
        let truth = evaluate(&diagonal(&[[1.0; 6]; 2]), &[[0.0; 6]; 2], None).unwrap();
        assert_eq!((truth.nll, truth.crps, truth.coverage, truth.ause), (None, None, None, [None; 6]));
        assert_eq!(truth.sharpness, [1.0; 6]);
        assert_eq!(evaluate(&[], &[], None), None);
    }
}
