//! The posterior head in tensors: what the loss needs of `C⁻¹ = D(exp(−p)) + D(exp(−q/2)) Λ D(exp(−q/2))`.

use burn::tensor::Tensor;

/// p and q count within these, relative to the training set's variances: exponentials stay f32 numbers.
const LIMIT: f32 = 40.0;
/// Least pivot of the factorisation, relative to the diagonal: rounding in f32 leaves no less.
const LEAST_PIVOT: f32 = 1e-6;
const COMPONENTS: usize = 6;

/// The evidence of a batch of pairs.
#[derive(Clone, Debug)]
pub(crate) struct EvidenceTensors {
    /// `[batch, 6]`, ê; order ρ then φ, m and rad.
    pub estimate: Tensor<2>,
    /// `[batch, 6, 6]`, Λ; 1/m² and 1/rad². Zero without a verdict.
    pub information: Tensor<3>,
}

/// With `C⁻¹ = L Lᵀ`: the numbers by which errors are scored.
pub(crate) struct PosteriorTensors {
    /// `[batch, 1]`, `ln det C`; of m² and rad².
    pub log_determinant: Tensor<2>,
    /// `[batch, 6]`, `Lᵀ μ`.
    pub whitened_mean: Tensor<2>,
    /// `[batch, 6]`, `Lᵀ (e − μ)`: what is left of the error, of unit covariance when C is right.
    pub whitened_rest: Tensor<2>,
}

impl PosteriorTensors {
    /// Scores of errors under a batch's posteriors, in units of the training set's standard deviations inside.
    ///
    /// # Shapes
    /// - `outputs`: `[batch, 12]`, p and q
    /// - `error`: `[batch, 6]`, m and rad
    /// - `sigma`: of the training set, m and rad
    pub(crate) fn new(outputs: &Tensor<2>, evidence: &EvidenceTensors, error: Tensor<2>, sigma: &[f64; 6]) -> Self {
        let [batch, _] = error.dims();
        let device = error.device();
        let unit = Tensor::<1>::from_floats(sigma.map(|sigma| sigma as f32), &device).unsqueeze::<2>();
        let column = |first: usize| outputs.clone().slice([0..batch, first..first + COMPONENTS]);
        let prior = limited(column(0) - unit.clone().log() * 2.0);
        let trust = (limited(column(COMPONENTS)) * -0.5).exp() * unit.clone();
        let weight = trust.reshape([batch, COMPONENTS, 1]);
        let trusted = evidence.information.clone() * weight.clone() * weight.swap_dims(1, 2);
        let estimate = (evidence.estimate.clone() / unit.clone()).reshape([batch, COMPONENTS, 1]);
        let mut right = trusted.clone().matmul(estimate);
        let error = (error / unit.clone()).reshape([batch, COMPONENTS, 1]);

        let diagonal = Tensor::<2>::eye(COMPONENTS, &device).unsqueeze::<3>();
        let mut rest = trusted + diagonal * prior.neg().exp().reshape([batch, COMPONENTS, 1]);
        let (mut log_pivots, mut mean, mut whitened) = (Vec::new(), Vec::new(), Vec::new());
        // Cholesky's factorisation, right-looking: column after column of L, and with each a row of L⁻¹ b and Lᵀ e.
        for done in 0..COMPONENTS {
            let left = COMPONENTS - done;
            let corner = rest.clone().slice([0..batch, 0..1, 0..1]);
            let largest = rest.clone().slice([0..batch, 0..1, 0..1]).detach() * LEAST_PIVOT;
            let pivot = corner.max_pair(largest.clamp_min(f32::MIN_POSITIVE)).sqrt();
            let factor = rest.clone().slice([0..batch, 0..left, 0..1]) / pivot.clone();
            let solved = right.clone().slice([0..batch, 0..1, 0..1]) / pivot.clone();
            let errors = error.clone().slice([0..batch, done..COMPONENTS, 0..1]);
            whitened.push((factor.clone() * errors).sum_dim(1).reshape([batch, 1]));
            mean.push(solved.clone().reshape([batch, 1]));
            log_pivots.push(pivot.log().reshape([batch, 1]));
            if left > 1 {
                let below = factor.slice([0..batch, 1..left, 0..1]);
                right = right.slice([0..batch, 1..left, 0..1]) - below.clone() * solved;
                rest = rest.slice([0..batch, 1..left, 1..left]) - below.clone() * below.swap_dims(1, 2);
            }
        }
        let whitened_mean = Tensor::cat(mean, 1);
        Self {
            log_determinant: unit.log().sum_dim(1) * 2.0 - Tensor::cat(log_pivots, 1).sum_dim(1) * 2.0,
            whitened_rest: Tensor::cat(whitened, 1) - whitened_mean.clone(),
            whitened_mean,
        }
    }
}

/// Within ± the limit in value; beyond it the gradient stays what it is there.
fn limited(values: Tensor<2>) -> Tensor<2> {
    let excess = (values.clone() - values.clone().clamp(-LIMIT, LIMIT)).detach();
    values - excess
}
