//! The ways to give measurements their covariances that an evaluation sets side by side.

use nalgebra::{Matrix6, Vector6};

use super::baselines::Baselines;
use super::pair_table::{PairRow, SystemPairs};
use super::recalibration::scale;
use crate::geometry::Covariance6;

/// A way to give a measurement its covariance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// The predictions under judgement: those of a trained model, recalibrated if the run says so.
    Predicted,
    /// The same as the network puts them out, where they were recalibrated.
    Uncalibrated,
    /// Measurements corrected by the part of their error that was predicted, `exp(−μ) T̂`, with the covariance C of what is
    /// left. Judged on errors of its own ([`Method::errors`]).
    Corrected,
    /// No error at all: what MDE alone may reward.
    Zero,
    /// The system's mean e² over the training set.
    Constant,
    /// The same with its correlations: mean e eᵀ over the training set. For fusion, where they count; not among [`Method::ALL`].
    ConstantFull,
    /// The square of 1.4826 times its median |e| over the training set.
    ConstantMad,
    /// [`LogLinear`](super::LogLinear) in the measured motion, fitted to the training set.
    LogLinear,
    /// The system's true covariance, known in rendered data. It knows the scene and not the realised
    /// error, so a model that sees misalignment may beat it.
    Oracle,
    /// The diagonal of the same: the best that a diagonal covariance can say without seeing the error.
    OracleDiagonal,
    /// What the system itself says of its covariance, in recorded data.
    Stated,
}

impl Method {
    /// Those of the tables of an evaluation, in their order.
    pub const ALL: [Self; 10] = [
        Self::Predicted,
        Self::Uncalibrated,
        Self::Corrected,
        Self::Zero,
        Self::Constant,
        Self::ConstantMad,
        Self::LogLinear,
        Self::Stated,
        Self::Oracle,
        Self::OracleDiagonal,
    ];

    /// Whether it is what a model predicts, in whichever form.
    pub fn is_predicted(self) -> bool {
        matches!(self, Self::Predicted | Self::Uncalibrated | Self::Corrected)
    }

    /// Whether predictions of that name would be taken for a baseline.
    pub fn is_taken(name: &str) -> bool {
        Self::ALL[1..].iter().any(|method| method.name("") == name)
    }

    /// Name in tables and files; `predicted` is what the predictions are called.
    pub fn name(self, predicted: &str) -> String {
        match self {
            Self::Predicted => predicted.to_owned(),
            Self::Uncalibrated => format!("{predicted}_uncalibrated"),
            Self::Corrected => format!("{predicted}_corrected"),
            Self::Zero => "zero".to_owned(),
            Self::Constant => "constant".to_owned(),
            Self::ConstantFull => "constant_full".to_owned(),
            Self::ConstantMad => "constant_mad".to_owned(),
            Self::LogLinear => "log_linear".to_owned(),
            Self::Oracle => "oracle".to_owned(),
            Self::OracleDiagonal => "oracle_diagonal".to_owned(),
            Self::Stated => "stated".to_owned(),
        }
    }

    /// The covariance of every pair of a system; `None` where the method does not exist for it.
    ///
    /// `recalibration` holds the factors on variances that the predictions were scaled by.
    pub fn covariances(
        self,
        system: &SystemPairs,
        baselines: Option<&Baselines>,
        recalibration: Option<&[f64; 6]>,
    ) -> Option<Vec<Covariance6>> {
        let repeated =
            |variance: &[f64; 6]| vec![Covariance6::from_variances(&Vector6::from(*variance)); system.rows.len()];
        let stated = || system.rows.iter().map(|row| row.stated).collect::<Option<Vec<_>>>();
        match self {
            Self::Predicted => system.rows.iter().map(|row| row.covariance).collect(),
            Self::Uncalibrated => {
                let undone = recalibration?.map(f64::recip);
                let before = |row: &PairRow| {
                    let (mut covariance, mut posterior) = (row.covariance?, row.posterior);
                    scale(&undone, &mut covariance, &mut posterior);
                    Some(covariance)
                };
                system.rows.iter().map(before).collect()
            }
            // The truth has nothing that a correction could take away.
            Self::Corrected if system.is_truth() || system.rows.iter().all(|row| row.posterior.is_none()) => None,
            Self::Corrected => system.rows.iter().map(PairRow::corrected_covariance).collect(),
            Self::Zero => Some(repeated(&[0.0; 6])),
            Self::Constant => Some(repeated(&baselines?.mean_squared_error)),
            Self::ConstantFull => {
                let rows = baselines?.mean_outer_product?;
                let matrix = Matrix6::from_fn(|row, column| rows[row][column]);
                Some(vec![Covariance6::from_matrix(matrix).ok()?; system.rows.len()])
            }
            Self::ConstantMad => Some(repeated(&baselines?.median_variance?)),
            Self::LogLinear => {
                let law = baselines?.log_linear?;
                let variance = |motion: [f64; 6]| Covariance6::from_variances(&law.variance(&motion.into()).into());
                system.rows.iter().map(|row| row.motion.map(variance)).collect()
            }
            Self::Oracle => stated().filter(|_| system.simulated),
            Self::OracleDiagonal => {
                let truth = stated().filter(|_| system.simulated)?;
                Some(truth.iter().map(|truth| Covariance6::from_variances(&truth.variance())).collect())
            }
            Self::Stated => stated().filter(|_| !system.simulated),
        }
    }

    /// The errors that its covariances should cover, row by row, m and rad: those of the measurements, and of
    /// corrected measurements what is left of them.
    pub fn errors(self, system: &SystemPairs) -> Vec<[f64; 6]> {
        match self {
            Self::Corrected => system.rows.iter().map(PairRow::corrected_error).collect(),
            _ => system.errors(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::Recalibration;
    use crate::evaluation::pair_table::made_row as row;
    use crate::geometry::{Posterior, Tangent};

    #[test]
    fn what_was_recalibrated_is_given_back() {
        let posterior = Posterior {
            mean: Tangent::new(0.1, -0.2, 0.3, 0.01, -0.02, 0.03),
            covariance: Covariance6::from_std_devs(&Tangent::repeat(0.02)),
        };
        let seen =
            PairRow { covariance: Some(posterior.second_moment()), posterior: Some(posterior), ..row(0, 0.1, 1.0) };
        let mut rows = vec![seen, row(1, -0.3, 0.04)];
        let before: Vec<Covariance6> = rows.iter().filter_map(|row| row.covariance).collect();
        let recalibration = Recalibration {
            factors: [0.5, 2.0, 1.0, 4.0, 0.25, 1.5],
            split: "validation".to_owned(),
            systems: vec!["vo".to_owned()],
            pairs: 2,
        };
        for row in &mut rows {
            recalibration.apply_to(row.covariance.as_mut().unwrap(), &mut row.posterior);
        }
        let system = SystemPairs { name: "vo".to_owned(), simulated: false, rows };
        let found = Method::Uncalibrated.covariances(&system, None, Some(&recalibration.factors)).unwrap();
        for (found, before) in found.iter().zip(&before) {
            approx::assert_relative_eq!(found.matrix(), before.matrix(), epsilon = 1e-12);
        }
        // What was seen of the error does not depend on factors; what is left does.
        let corrected = Method::Corrected.covariances(&system, None, Some(&recalibration.factors)).unwrap();
        assert_eq!(corrected[0], posterior.covariance.scaled(&recalibration.factors));
        assert_eq!(Method::Corrected.errors(&system)[1], system.rows[1].error);
    }
}
