//! The training loss (paper Eq. 7) and the floor under predicted variances.

use burn::tensor::Tensor;
use burn::tensor::activation::softplus;

/// Log-variances count in the loss within ± this: `exp` of them is a normal f32 number.
const LOG_VARIANCE_LIMIT: f32 = 87.0;
/// Standardised errors count in the loss up to this: the sum of six squares is a finite f32 number.
const STANDARDISED_ERROR_LIMIT: f32 = 1e18;

/// Negative log-likelihood of relative-pose errors under a zero-mean Gaussian with diagonal covariance.
///
/// `loss = sum(d) + eᵀ diag(exp(−d)) e` (paper Eq. 7): twice the negative log-likelihood, without
/// its constant `6 ln 2π`.
///
/// Departure: d counts within ±87 and `e exp(−d/2)` within ±1e18, so that value and gradient are
/// finite for every finite input; beyond the limit d keeps the gradient it has at the limit.
///
/// # Shapes
/// - `log_variance`: `[batch, 6]`, d; order ρ then φ, ln m² and ln rad²
/// - `error`: `[batch, 6]`, e of paper Eq. 2; m and rad
/// - returns: `[batch]`
pub fn gaussian_loss(log_variance: Tensor<2>, error: Tensor<2>) -> Tensor<1> {
    let limited = log_variance.clone().clamp(-LOG_VARIANCE_LIMIT, LOG_VARIANCE_LIMIT);
    let excess = (log_variance.clone() - limited.clone()).detach();
    let log_variance = log_variance - excess;
    let standardised =
        (error * (log_variance.clone() * -0.5).exp()).clamp(-STANDARDISED_ERROR_LIMIT, STANDARDISED_ERROR_LIMIT);
    (log_variance + standardised.clone() * standardised).sum_dim(1).squeeze_dim(1)
}

/// Keeps log-variances above a floor: `floor + softplus(d − floor)`.
///
/// Far above the floor this is d itself (4 nats above: 2 % of a nat more). Its slope is positive
/// everywhere, so an output near the floor can rise again when errors appear (5 nats below it: 0.7 %
/// of the slope; a hard clamp would leave none).
///
/// # Shapes
/// - `log_variance`: `[batch, 6]`
/// - `floor`: `[1, 6]`
pub fn floored(log_variance: Tensor<2>, floor: Tensor<2>) -> Tensor<2> {
    floor.clone() + softplus(log_variance - floor, 1.0)
}
