//! Calibration where σ is small and where it is large: pairs in ten bins of equal count.

use serde::{Deserialize, Serialize};

use super::joint_scores::JointScores;

/// Bins of σ.
const BINS: usize = 10;

/// Calibration bin by bin. Right on average says little: a covariance can be too small where it is small and too large
/// where it is large.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConditionalCalibration {
    /// Of whole covariances, pairs ordered by ln det R.
    pub joint: BinnedCalibration,
    /// Of each component, pairs ordered by its σ.
    pub by_component: [BinnedCalibration; 6],
}

/// Ten bins of equal count, from small σ to large; fewer where pairs of equal σ share one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BinnedCalibration {
    /// Geometric mean of σ in each bin, m or rad; of all six components together for whole covariances.
    pub sigma: Vec<f64>,
    /// Mean of z² in each bin, for whole covariances of `eᵀR⁻¹e / 6`: 1 where calibrated.
    pub anees: Vec<f64>,
}

impl ConditionalCalibration {
    pub(super) fn of(joint: &JointScores, sigma: &[Vec<f64>; 6], z_squared: &[Vec<f64>; 6]) -> Self {
        let log_sigma = joint.log_determinant.iter().map(|log_determinant| log_determinant / 12.0).collect();
        let normalised: Vec<f64> = joint.nees.iter().map(|nees| nees / 6.0).collect();
        let component = |c: usize| {
            let log_sigma = sigma[c].iter().map(|sigma| sigma.ln()).collect();
            BinnedCalibration::of(log_sigma, &z_squared[c])
        };
        Self { joint: BinnedCalibration::of(log_sigma, &normalised), by_component: std::array::from_fn(component) }
    }
}

impl BinnedCalibration {
    fn of(log_sigma: Vec<f64>, normalised: &[f64]) -> Self {
        let bins = equal_count_bins(&log_sigma);
        let means = |values: &[f64]| -> Vec<f64> { bins.iter().map(|bin| mean_over(bin, values)).collect() };
        Self { sigma: means(&log_sigma).into_iter().map(f64::exp).collect(), anees: means(normalised) }
    }

    /// Smallest and largest mean.
    pub fn extremes(&self) -> [f64; 2] {
        [self.anees.iter().copied().fold(f64::INFINITY, f64::min), self.anees.iter().copied().fold(0.0, f64::max)]
    }

    /// The mean that is farthest from 1, as a factor.
    pub fn worst(&self) -> f64 {
        let [low, high] = self.extremes();
        if low * high < 1.0 { low } else { high }
    }
}

/// Root mean squares over the pairs of a bin of σ, m or rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationBin {
    /// Of σ (root mean variance, RMV).
    pub sigma: f64,
    /// Of the error (RMSE).
    pub error: f64,
}

/// Pairs sorted by σ in ten bins of equal count; equal σ share a bin, so a constant has one.
pub fn calibration_bins(errors: &[f64], sigma: &[f64]) -> Vec<CalibrationBin> {
    let squares = |values: &[f64]| values.iter().map(|value| value * value).collect::<Vec<f64>>();
    let (variances, squares) = (squares(sigma), squares(errors));
    let root_means = |bin: &Vec<u32>| CalibrationBin {
        sigma: mean_over(bin, &variances).sqrt(),
        error: mean_over(bin, &squares).sqrt(),
    };
    equal_count_bins(sigma).iter().map(root_means).collect()
}

/// Expected normalised calibration error, mean over bins of `|RMV − RMSE| / RMV`.
pub(super) fn ence(errors: &[f64], sigma: &[f64]) -> f64 {
    let bins = calibration_bins(errors, sigma);
    bins.iter().map(|bin| (bin.sigma - bin.error).abs() / bin.sigma).sum::<f64>() / bins.len() as f64
}

fn mean_over(bin: &[u32], values: &[f64]) -> f64 {
    bin.iter().map(|&index| values[index as usize]).sum::<f64>() / bin.len() as f64
}

/// Indices of values from small to large, in bins of equal count; equal values share a bin.
fn equal_count_bins(values: &[f64]) -> Vec<Vec<u32>> {
    let mut order: Vec<u32> = (0..values.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| values[a as usize].total_cmp(&values[b as usize]));
    let value_at = |place: usize| values[order[place] as usize];
    let mut edges = vec![0];
    for bin in 1..=BINS {
        let mut edge = bin * order.len() / BINS;
        while edge > 0 && edge < order.len() && value_at(edge) == value_at(edge - 1) {
            edge += 1;
        }
        if edge > *edges.last().expect("begins with one") {
            edges.push(edge);
        }
    }
    edges.windows(2).map(|edges| order[edges[0]..edges[1]].to_vec()).collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::evaluation::evaluate;
    use crate::geometry::{Covariance6, Tangent};

    #[test]
    fn bins_hold_equal_counts_and_never_part_equal_sigmas() {
        let sigma: Vec<f64> = (1..=20).map(f64::from).collect();
        let bins = calibration_bins(&[2.0; 20], &sigma);
        assert_eq!((bins.len(), bins[0]), (10, CalibrationBin { sigma: 2.5_f64.sqrt(), error: 2.0 }));
        assert_eq!(calibration_bins(&[3.0; 20], &[1.0; 20]), [CalibrationBin { sigma: 1.0, error: 3.0 }]);
        assert_eq!(calibration_bins(&[3.0; 4], &[1.0, 1.0, 1.0, 2.0]).len(), 2);
    }

    #[test]
    fn what_is_right_on_average_can_be_wrong_in_every_bin() {
        // Errors of one size under a σ that is too small for half of them and too large for the rest.
        let covariances: Vec<Covariance6> = [0.5, 2.0]
            .into_iter()
            .flat_map(|sigma| vec![Covariance6::from_std_devs(&Tangent::repeat(sigma)); 10])
            .collect();
        let errors = [[1.0; 6]; 20];
        let found = evaluate(&covariances, &errors, None).unwrap().conditional.unwrap();
        for binned in found.by_component.iter().chain([&found.joint]) {
            assert_eq!(binned.anees.len(), 2);
            for (found, expected) in binned.sigma.iter().chain(&binned.anees).zip([0.5, 2.0, 4.0, 0.25]) {
                assert_relative_eq!(*found, expected, epsilon = 1e-12);
            }
        }
        assert_relative_eq!(found.joint.extremes()[0], 0.25, epsilon = 1e-12);
        assert_relative_eq!(BinnedCalibration { sigma: vec![1.0; 2], anees: vec![0.2, 4.0] }.worst(), 0.2);
        // A constant has no bins.
        assert_eq!(evaluate(&covariances[..10], &errors[..10], None).unwrap().conditional, None);
    }
}
