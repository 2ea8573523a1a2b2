//! What the last layer's outputs mean: a diagonal covariance, a full one, or a posterior.

use burn::tensor::Tensor;
use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

use crate::geometry::{Covariance6, Posterior, Tangent};

/// Components of a pose error.
const COMPONENTS: usize = 6;
/// Entries below the diagonal of a 6x6 matrix.
const BELOW_DIAGONAL: usize = COMPONENTS * (COMPONENTS - 1) / 2;

/// Where q of [`Head::Posterior`] starts: residuals of neighbouring pixels are no independent numbers, and the
/// information of evidence is some thirty times too large (docs/method.md).
const INITIAL_DISTRUST: f64 = 3.4;

/// Form of the predicted covariance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Head {
    /// `R = D(exp(d))`, six values (the paper).
    #[default]
    Diagonal,
    /// `R = L D(exp(d)) Lᵀ`, 21 values, positive definite by construction (the paper's reference 5): d,
    /// then the rows of the unit lower triangular L below its diagonal. These are in units of the training
    /// set's standard deviations: `L[i][j] = l[i][j] σᵢ / σⱼ`.
    Full,
    /// Twelve values, p and q: what the system is like, `e ~ N(0, D(exp(p)))`, and how far the evidence may be trusted,
    /// `ê = e + n` with `n ~ N(b, D(exp(q/2)) Λ⁻¹ D(exp(q/2)))`. By Bayes' rule `C⁻¹ = D(exp(−p)) + M`, `μ = C M (ê − b)` with
    /// `M = D(exp(−q/2)) Λ D(exp(−q/2))`, and `R = C + μ μᵀ`: full, positive definite by construction, and fine where
    /// the evidence knows nothing of a direction.
    Posterior,
}

impl Head {
    /// Values that the network puts out.
    pub fn outputs(self) -> usize {
        match self {
            Self::Diagonal => COMPONENTS,
            Self::Full => COMPONENTS + BELOW_DIAGONAL,
            Self::Posterior => 2 * COMPONENTS,
        }
    }

    /// Values that stand for a pair: those of the network, and for a posterior the drift b of its evidence.
    pub fn values(self) -> usize {
        match self {
            Self::Diagonal | Self::Full => self.outputs(),
            Self::Posterior => self.outputs() + COMPONENTS,
        }
    }

    /// Outputs that stand for a covariance of these log-variances (with evidence: for a prior of these).
    pub(super) fn initial_outputs(self, log_variance: [f64; COMPONENTS]) -> Vec<f32> {
        let rest = if self == Self::Posterior { INITIAL_DISTRUST } else { 0.0 };
        let mut outputs = log_variance.map(|d| d as f32).to_vec();
        outputs.resize(self.outputs(), rest as f32);
        outputs
    }

    /// `L⁻¹ e`, by forward substitution; components of it are independent under the prediction, with
    /// variances `exp(d)`. The error itself for a diagonal covariance.
    ///
    /// # Shapes
    /// - `outputs`: `[batch, 6]` or `[batch, 21]`
    /// - `error`: `[batch, 6]`, m and rad
    /// - `sigma`: of the training set, m and rad
    /// - returns: `[batch, 6]`, m and rad
    pub(crate) fn decorrelate(self, outputs: &Tensor<2>, error: Tensor<2>, sigma: &[f64; 6]) -> Tensor<2> {
        match self {
            Self::Diagonal => return error,
            Self::Full => {}
            Self::Posterior => unreachable!("a posterior has evidence beside its outputs"),
        }
        let batch = error.dims()[0];
        let mut residuals: Vec<Tensor<2>> = Vec::with_capacity(COMPONENTS);
        for row in 0..COMPONENTS {
            let mut residual = error.clone().slice([0..batch, row..row + 1]);
            for (column, before) in residuals.iter().enumerate() {
                let entry = COMPONENTS + below_diagonal(row, column);
                let unit = (sigma[row] / sigma[column]) as f32;
                residual = residual - outputs.clone().slice([0..batch, entry..entry + 1]) * before.clone() * unit;
            }
            residuals.push(residual);
        }
        Tensor::cat(residuals, 1)
    }

    /// The covariance that one row of outputs stands for, m² and rad²; `sigma` as in training.
    pub fn covariance(self, outputs: &[f64], sigma: &[f64; 6]) -> Covariance6 {
        assert_eq!(outputs.len(), self.outputs(), "one row of outputs");
        assert!(self != Self::Posterior, "a posterior has evidence beside its outputs");
        let log_variance = Vector6::from_column_slice(&outputs[..COMPONENTS]);
        match self {
            Self::Diagonal | Self::Posterior => Covariance6::from_log_variances(&log_variance),
            Self::Full => {
                let lower = Matrix6::from_fn(|row, column| match row.cmp(&column) {
                    std::cmp::Ordering::Less => 0.0,
                    std::cmp::Ordering::Equal => 1.0,
                    std::cmp::Ordering::Greater => {
                        outputs[COMPONENTS + below_diagonal(row, column)] * sigma[row] / sigma[column]
                    }
                });
                Covariance6::from_factors(&lower, &log_variance)
            }
        }
    }
}

/// What one row of [`Head::Posterior`]'s values (p, q and b) and the evidence of its pair say of the error: order ρ then φ, m and
/// rad. `None` where the numbers have no inverse.
pub fn posterior(outputs: &[f64], estimate: &Tangent, information: &Matrix6<f64>) -> Option<Posterior> {
    assert_eq!(outputs.len(), Head::Posterior.values(), "one row of values");
    let drift = Tangent::from_column_slice(&outputs[2 * COMPONENTS..]);
    let prior = Vector6::from_fn(|c, _| (-outputs[c]).exp());
    let trust = Matrix6::from_diagonal(&Vector6::from_fn(|c, _| (-0.5 * outputs[COMPONENTS + c]).exp()));
    let trusted = trust * information * trust;
    let factor = (Matrix6::from_diagonal(&prior) + 0.5 * (trusted + trusted.transpose())).cholesky()?;
    let covariance = factor.inverse();
    let covariance = Covariance6::from_matrix(0.5 * (covariance + covariance.transpose())).ok()?;
    Some(Posterior { mean: factor.solve(&(trusted * (estimate - drift))), covariance })
}

/// Place of an entry below the diagonal, row by row.
fn below_diagonal(row: usize, column: usize) -> usize {
    row * (row - 1) / 2 + column
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use burn::tensor::{Device, TensorData};

    use super::*;
    use crate::geometry::Tangent;
    use crate::loss::gaussian_loss;

    /// Two roads to one number: tensors in f32, matrices in f64.
    #[test]
    fn the_loss_of_a_full_covariance_is_its_log_likelihood() {
        let device = Device::flex();
        let sigma = [0.05, 0.02, 0.03, 1e-3, 2e-3, 5e-4];
        let outputs: Vec<f32> = (0..21)
            .map(|k| if k < 6 { 2.0 * (sigma[k] as f32).ln() + 0.1 * k as f32 } else { 0.6 * (k as f32).sin() })
            .collect();
        let error = [0.04, -0.03, 0.02, 2e-3, -1e-3, 4e-4];
        let row: Vec<f64> = outputs.iter().map(|&value| f64::from(value)).collect();
        let outputs = Tensor::<2>::from_data(TensorData::new(outputs, [1, 21]), &device);
        let tensor = Tensor::<2>::from_data(TensorData::new(error.map(|e| e as f32).to_vec(), [1, 6]), &device);
        let residual = Head::Full.decorrelate(&outputs, tensor, &sigma);
        let loss: f32 = gaussian_loss(outputs.slice([0..1, 0..6]), residual).into_scalar();

        let covariance = Head::Full.covariance(&row, &sigma);
        let factor = covariance.matrix().cholesky().expect("positive definite");
        let error = Tangent::from(error);
        let log_determinant = 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
        assert_relative_eq!(f64::from(loss), log_determinant + error.dot(&factor.solve(&error)), max_relative = 1e-5);
        let correlated = covariance.matrix()[(1, 0)].abs();
        assert!(correlated > 0.1 * sigma[0] * sigma[1], "{correlated}");
    }

    #[test]
    fn a_full_head_without_off_diagonal_values_is_the_diagonal_one() {
        let d = [-6.0, -7.0, -8.0, -12.0, -13.0, -14.0];
        let outputs: Vec<f64> = d.into_iter().chain([0.0; 15]).collect();
        let full = Head::Full.covariance(&outputs, &[0.1; 6]);
        assert_relative_eq!(full.matrix(), Head::Diagonal.covariance(&d, &[0.1; 6]).matrix(), max_relative = 1e-12);
    }
}
