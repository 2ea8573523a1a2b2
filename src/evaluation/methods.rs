//! The ways to give measurements their covariances that an evaluation sets side by side.

use nalgebra::{Matrix6, Vector6};

use super::baselines::Baselines;
use super::pair_table::SystemPairs;
use crate::geometry::Covariance6;

/// A way to give a measurement its covariance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// The predictions under judgement: those of a trained model, recalibrated if the run says so.
    Predicted,
    /// The same as the network puts them out, where they were recalibrated.
    Uncalibrated,
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
    pub const ALL: [Self; 9] = [
        Self::Predicted,
        Self::Uncalibrated,
        Self::Zero,
        Self::Constant,
        Self::ConstantMad,
        Self::LogLinear,
        Self::Stated,
        Self::Oracle,
        Self::OracleDiagonal,
    ];

    /// Whether predictions of that name would be taken for a baseline.
    pub fn is_taken(name: &str) -> bool {
        Self::ALL[1..].iter().any(|method| method.name("") == name)
    }

    /// Name in tables and files; `predicted` is what the predictions are called.
    pub fn name(self, predicted: &str) -> String {
        match self {
            Self::Predicted => predicted.to_owned(),
            Self::Uncalibrated => format!("{predicted}_uncalibrated"),
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
                system.rows.iter().map(|row| Some(row.covariance?.scaled(&undone))).collect()
            }
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
}
