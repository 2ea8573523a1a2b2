//! The training loss (paper Eq. 7), its like for posteriors, and the floor under predicted variances.

use burn::tensor::Tensor;
use burn::tensor::activation::softplus;

/// Log-variances count in the loss within ± this: `exp` of them is a normal f32 number.
const LOG_VARIANCE_LIMIT: f32 = 87.0;
/// Standardised errors count in the loss up to this: the sum of six squares is a finite f32 number.
const STANDARDISED_ERROR_LIMIT: f32 = 1e18;

/// Added to the squared length of a mean, whose root has no slope at zero.
const SHORTEST_MEAN: f32 = 1e-12;

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

/// Negative log-likelihood of errors under posteriors, two ways at once: of what is left after the correction,
/// `e ~ N(μ, C)`, and of the error itself under its second moment, `e ~ N(0, R)` with `R = C + μ μᵀ`.
///
/// Both are `ln det + Mahalanobis²`, twice the negative log-likelihood without its constant; the loss is
/// `corrected_share` of the first and the rest of the second. With `C⁻¹ = L Lᵀ`, `m = Lᵀμ`, `r = Lᵀ(e − μ)`: the
/// first is `ln det C + |r|²`, and by Sherman and Morrison's formula the second
/// `ln det C + ln(1 + |m|²) + |r₋|² + (|m| + r₊)² / (1 + |m|²)`, where r₊ is r's part along m and r₋ the rest of it:
/// no difference of large numbers is taken.
///
/// # Shapes
/// - `log_determinant`: `[batch, 1]`, ln det C
/// - `whitened_mean`, `whitened_rest`: `[batch, 6]`, m and r
/// - returns: `[batch]`
pub fn posterior_loss(
    log_determinant: Tensor<2>,
    whitened_mean: Tensor<2>,
    whitened_rest: Tensor<2>,
    corrected_share: f64,
) -> Tensor<1> {
    let rest = whitened_rest.clamp(-STANDARDISED_ERROR_LIMIT, STANDARDISED_ERROR_LIMIT);
    let mean = whitened_mean.clamp(-STANDARDISED_ERROR_LIMIT, STANDARDISED_ERROR_LIMIT);
    let squared_mean = mean.clone().square().sum_dim(1);
    let length = (squared_mean.clone() + SHORTEST_MEAN).sqrt();
    let along = (rest.clone() * mean.clone()).sum_dim(1) / length.clone();
    let across = rest.clone() - mean * (along.clone() / length.clone());
    let growth = squared_mean + 1.0;
    let corrected = rest.square().sum_dim(1);
    let whole = growth.clone().log() + across.square().sum_dim(1) + (length + along).square() / growth;
    (log_determinant + corrected * corrected_share + whole * (1.0 - corrected_share)).squeeze_dim(1)
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
