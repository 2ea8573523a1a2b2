//! Scores that a covariance has as a whole: distance, determinant and likelihood of each error.

use crate::geometry::Covariance6;

/// Scores of whole matrices, row by row.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct JointScores {
    /// eᵀR⁻¹e.
    pub(super) nees: Vec<f64>,
    /// ln det R.
    pub(super) log_determinant: Vec<f64>,
    /// ½(6 ln 2π + ln det R + eᵀR⁻¹e), nats.
    pub(super) nll: Vec<f64>,
}

impl JointScores {
    /// `None` when a covariance cannot be inverted or all errors are zero.
    pub(super) fn of(covariances: &[Covariance6], errors: &[[f64; 6]]) -> Option<Self> {
        if errors.iter().flatten().all(|&error| error == 0.0) {
            return None;
        }
        let rows = covariances.iter().zip(errors);
        let (nees, log_determinant): (Vec<f64>, Vec<f64>) = rows
            .map(|(covariance, &error)| covariance.mahalanobis(&error.into()))
            .collect::<Option<Vec<_>>>()?
            .into_iter()
            .unzip();
        let nll = nees.iter().zip(&log_determinant);
        let nll = nll
            .map(|(distance, log_determinant)| 0.5 * (6.0 * std::f64::consts::TAU.ln() + log_determinant + distance));
        Some(Self { nll: nll.collect(), nees, log_determinant })
    }
}
