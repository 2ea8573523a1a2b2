//! One factor a component that makes predicted variances right on average over held-out pairs (temperature
//! scaling; Laves et al. 2020).

use serde::{Deserialize, Serialize};

use super::prediction::Prediction;
use crate::geometry::Covariance6;

/// Factors on variances, fitted to pairs that the weights did not learn from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recalibration {
    /// Factor on the variance of each component: `R' = D(√s) R D(√s)`; ln s is added to the log-variance.
    pub factors: [f64; 6],
    /// The split it was fitted to.
    pub split: String,
    /// Systems whose pairs were used: those that have errors.
    pub systems: Vec<String>,
    /// Their pairs.
    pub pairs: usize,
}

impl Recalibration {
    /// The most likely factors, the mean z² of each component, over all systems with errors; `None` without any.
    pub fn fit(predictions: &[Prediction], systems: &[String], split: &str) -> Option<Self> {
        let wrong = |system: &usize| predictions.iter().any(|row| row.system == *system && row.error != [0.0; 6]);
        let used: Vec<usize> = (0..systems.len()).filter(wrong).collect();
        let rows: Vec<&Prediction> = predictions.iter().filter(|row| used.contains(&row.system)).collect();
        let mean_z_squared =
            |c: usize| rows.iter().map(|row| row.error[c].powi(2) / row.variance()[c]).sum::<f64>() / rows.len() as f64;
        let factors: [f64; 6] = std::array::from_fn(mean_z_squared);
        factors.iter().all(|factor| factor.is_finite() && *factor > 0.0).then(|| Self {
            factors,
            split: split.to_owned(),
            systems: used.into_iter().map(|system| systems[system].clone()).collect(),
            pairs: rows.len(),
        })
    }

    /// The recalibrated covariance.
    pub fn apply(&self, covariance: &Covariance6) -> Covariance6 {
        covariance.scaled(&self.factors)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::PairId;
    use crate::evaluation::evaluate;
    use crate::geometry::Tangent;

    fn prediction(system: usize, frame: usize, error: f64, variance: f64) -> Prediction {
        Prediction {
            pair: PairId { drive: 0, source: frame, target: frame + 1 },
            system,
            error: [error; 6],
            covariance: Covariance6::from_variances(&Tangent::repeat(variance)),
            motion: Tangent::zeros(),
            stated_covariance: None,
        }
    }

    #[test]
    fn recalibrated_predictions_are_calibrated_where_they_were_fitted() {
        let systems = ["vo", "gnss"].map(str::to_owned);
        let rows = [prediction(0, 0, 0.1, 0.02), prediction(0, 1, -0.3, 0.02), prediction(1, 0, 0.0, 1.0)];
        let fitted = Recalibration::fit(&rows, &systems, "validation").unwrap();
        assert_eq!((fitted.systems.as_slice(), fitted.pairs), (&systems[..1], 2));
        let covariances: Vec<Covariance6> = rows[..2].iter().map(|row| fitted.apply(&row.covariance)).collect();
        let metrics = evaluate(&covariances, &[rows[0].error, rows[1].error], None).unwrap();
        assert!((metrics.anees.unwrap() - 1.0).abs() < 1e-12);
        // Nothing can be learned from a system without errors.
        assert_eq!(Recalibration::fit(&rows[2..], &systems, "validation"), None);
    }
}
