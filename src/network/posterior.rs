//! The posterior head in tensors: what the loss needs of `C⁻¹ = D(exp(−p)) + D(exp(−q/2)) Λ D(exp(−q/2))`.

use burn::tensor::Tensor;

/// p and q count within these, relative to the training set's variances: exponentials stay f32 numbers.
const LIMIT: f32 = 40.0;
/// Least pivot of the factorisation, relative to the diagonal: rounding in f32 leaves no less.
const LEAST_PIVOT: f32 = 1e-6;
/// Evidence counts up to this information and this size, in units of the training set's standard deviations: products
/// of both stay f32 numbers.
const LARGEST_INFORMATION: f32 = 1e10;
const LARGEST_ESTIMATE: f32 = 1e6;
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
    /// - `outputs`: `[batch, 18]`, p, q and b
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
        let diagonal = Tensor::<2>::eye(COMPONENTS, &device).unsqueeze::<3>();
        let trusted = evidence.information.clone() * weight.clone() * weight.swap_dims(1, 2);
        let largest = (trusted.clone().detach() * diagonal.clone()).max_dim(1).max_dim(2);
        let trusted = trusted * (largest.clamp_min(LARGEST_INFORMATION).recip() * LARGEST_INFORMATION);
        let estimate = (evidence.estimate.clone() - column(2 * COMPONENTS)) / unit.clone();
        let estimate = estimate.clamp(-LARGEST_ESTIMATE, LARGEST_ESTIMATE);
        let estimate = estimate.reshape([batch, COMPONENTS, 1]);
        let mut right = trusted.clone().matmul(estimate);
        let error = (error / unit.clone()).reshape([batch, COMPONENTS, 1]);

        let mut rest = trusted + diagonal.clone() * prior.neg().exp().reshape([batch, COMPONENTS, 1]);
        let least = (rest.clone().detach() * diagonal).sum_dim(2) * LEAST_PIVOT;
        let (mut log_pivots, mut mean, mut whitened) = (Vec::new(), Vec::new(), Vec::new());
        // Cholesky's factorisation, right-looking: column after column of L, and with each a row of L⁻¹ b and Lᵀ e.
        for done in 0..COMPONENTS {
            let left = COMPONENTS - done;
            let corner = rest.clone().slice([0..batch, 0..1, 0..1]);
            let pivot = corner.max_pair(least.clone().slice([0..batch, done..done + 1, 0..1])).sqrt();
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

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use burn::tensor::{Device, TensorData};
    use nalgebra::{Matrix6, Vector6};

    use super::*;
    use crate::geometry::Tangent;
    use crate::loss::posterior_loss;
    use crate::network::posterior;

    const SIGMA: [f64; 6] = [0.08, 0.07, 0.09, 7e-3, 6e-3, 4e-3];

    /// p, q and b, evidence and error of a pair.
    struct Pair {
        outputs: [f64; 18],
        estimate: Tangent,
        information: Matrix6<f64>,
        error: Tangent,
    }

    /// Evidence much sharper than the prior, as correlated as that of a road, about an error of `size` standard
    /// deviations.
    fn pair(size: f64) -> Pair {
        let unit = Matrix6::from_diagonal(&Vector6::from(SIGMA).map(f64::recip));
        let mixed =
            Matrix6::from_fn(|row, column| if row == column { 1.0 } else { 0.9 * ((3 * row + column) as f64).sin() });
        let error = size * Vector6::from(SIGMA).component_mul(&Vector6::new(1.0, -0.6, 0.3, 0.8, -1.2, 0.5));
        let outputs = std::array::from_fn(|k| match k {
            0..6 => 2.0 * SIGMA[k].ln() + 0.3 * k as f64,
            6..12 => 1.0 + 0.4 * (k as f64).cos(),
            _ => 0.01 * SIGMA[k - 12] * (k as f64).sin(),
        });
        Pair {
            outputs,
            estimate: error + 0.02 * Vector6::from(SIGMA),
            information: unit * (mixed * mixed.transpose() + Matrix6::identity()) * unit * 2e3,
            error,
        }
    }

    fn tensor<const D: usize>(values: impl IntoIterator<Item = f64>, shape: [usize; D], device: &Device) -> Tensor<D> {
        let values: Vec<f32> = values.into_iter().map(|value| value as f32).collect();
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    fn loss(outputs: Tensor<2>, pair: &Pair, share: f64) -> Tensor<1> {
        let device = outputs.device();
        let evidence = EvidenceTensors {
            estimate: tensor(pair.estimate.iter().copied(), [1, 6], &device),
            information: tensor(pair.information.iter().copied(), [1, 6, 6], &device),
        };
        let error = tensor(pair.error.iter().copied(), [1, 6], &device);
        let scored = PosteriorTensors::new(&outputs, &evidence, error, &SIGMA);
        posterior_loss(scored.log_determinant, scored.whitened_mean, scored.whitened_rest, share)
    }

    fn value(pair: &Pair, share: f64) -> f64 {
        let outputs = tensor(pair.outputs, [1, 18], &Device::flex());
        f64::from(loss(outputs, pair, share).into_scalar::<f32>())
    }

    /// The same in f64, with matrices.
    fn expected(pair: &Pair, share: f64) -> f64 {
        let known = posterior(&pair.outputs, &pair.estimate, &pair.information).unwrap();
        let (corrected, log_determinant) = known.covariance.mahalanobis(&(pair.error - known.mean)).unwrap();
        let (whole, whole_log_determinant) = known.second_moment().mahalanobis(&pair.error).unwrap();
        share * (log_determinant + corrected) + (1.0 - share) * (whole_log_determinant + whole)
    }

    #[test]
    fn the_loss_is_the_likelihood_of_the_posterior() {
        for size in [0.0, 0.1, 1.0, 10.0] {
            for share in [0.0, 0.5, 1.0] {
                let pair = pair(size);
                assert_relative_eq!(value(&pair, share), expected(&pair, share), epsilon = 0.02, max_relative = 1e-3);
            }
        }
    }

    #[test]
    fn evidence_without_information_leaves_the_prior() {
        let pair = Pair { information: Matrix6::zeros(), estimate: Tangent::zeros(), ..pair(1.0) };
        let known = posterior(&pair.outputs, &pair.estimate, &pair.information).unwrap();
        assert_eq!(known.mean, Tangent::zeros());
        for c in 0..6 {
            assert_relative_eq!(known.covariance.matrix()[(c, c)], pair.outputs[c].exp(), max_relative = 1e-12);
        }
        assert_relative_eq!(value(&pair, 0.5), expected(&pair, 0.5), max_relative = 1e-4);
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        let device = Device::flex().autodiff();
        for share in [0.0, 0.3, 1.0] {
            let pair = pair(1.0);
            let outputs = tensor(pair.outputs, [1, 18], &device).require_grad();
            let gradients = loss(outputs.clone(), &pair, share).sum().backward();
            let gradient: Vec<f32> = outputs.grad(&gradients).unwrap().into_data().iter().collect();
            for k in 0..18 {
                // The drift is in metres and radians.
                let unit = if k < 12 { 1.0 } else { SIGMA[k - 12] };
                let shifted = |by: f64| {
                    let mut outputs = pair.outputs;
                    outputs[k] += by * unit;
                    expected(&Pair { outputs, ..self::pair(1.0) }, share)
                };
                let difference = (shifted(1e-4) - shifted(-1e-4)) / 2e-4;
                let gradient = f64::from(gradient[k]) * unit;
                assert_relative_eq!(gradient, difference, epsilon = 0.02, max_relative = 0.01);
            }
        }
    }

    #[test]
    fn the_loss_and_its_gradients_are_finite_whatever_the_numbers() {
        let device = Device::flex().autodiff();
        for wild in [0.0, 50.0, -50.0, 1e4, -1e4] {
            for (size, information) in [(0.0, 0.0), (1e3, 1.0), (1e3, 1e20), (1.0, 1e-20)] {
                // A rank of one: what a single direction shows.
                let pair = Pair { information: Matrix6::from_element(information), ..pair(size) };
                let outputs = tensor([wild; 18], [1, 18], &device).require_grad();
                let loss = loss(outputs.clone(), &pair, 0.5);
                let gradients = loss.clone().sum().backward();
                let gradient: Vec<f32> = outputs.grad(&gradients).unwrap().into_data().iter().collect();
                let loss = loss.into_scalar::<f32>();
                assert!(loss.is_finite(), "{wild}, {size}, {information}: {loss}");
                assert!(gradient.iter().all(|value| value.is_finite()), "{wild}, {size}, {information}: {gradient:?}");
            }
        }
    }
}
