//! What the systems' least squares share: the prior that their sums start from, and the inverse of what these come to.

use nalgebra::{Matrix6, Vector6};

/// What a smooth motion would be taken for without any landmark or point, m and rad.
const MOTION_PRIOR: [f64; 6] = [0.25, 0.25, 0.25, 0.02, 0.02, 0.02];

/// The information of that prior alone: what the sums start from.
pub(super) fn prior_information() -> Matrix6<f64> {
    Matrix6::from_diagonal(&Vector6::from(MOTION_PRIOR).map(|std_dev| 1.0 / (std_dev * std_dev)))
}

/// The inverse of a symmetric positive definite matrix, symmetric to the last bit.
pub(super) fn inverse(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    let inverse = matrix.cholesky().expect("a prior keeps it positive definite").inverse();
    0.5 * (inverse + inverse.transpose())
}
