//! One factor a component that makes predicted variances right on average over held-out pairs (temperature
//! scaling; Laves et al. 2020).

use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

use super::correction::{corrected_covariance, corrected_error};
use super::prediction::Prediction;
use crate::geometry::{Covariance6, Posterior};

/// No model is off by more, and its inverse.
const LARGEST_FACTOR: f64 = 1e6;
/// Passes over the components of a fit; some 20 are usual.
const MOST_SWEEPS: usize = 1000;

/// Factors on variances, fitted to pairs that the weights did not learn from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recalibration {
    /// Factor on the variance of each component: `R' = D(√s) R D(√s)`; ln s is added to the log-variance. Where the error
    /// itself was predicted too, on the variances that are left of it: `C' = D(√s) C D(√s)`, `R' = C' + μμᵀ`.
    pub factors: [f64; 6],
    /// The split it was fitted to.
    pub split: String,
    /// Systems whose pairs were used: those that have errors.
    pub systems: Vec<String>,
    /// Their pairs.
    pub pairs: usize,
}

impl Recalibration {
    /// The most likely factors over the systems that were learned from and have errors; `None` without any. For diagonal
    /// covariances the mean z² of each component. With a posterior they are judged by what the correction leaves of the
    /// error, and C.
    ///
    /// `learned` names those that were learned from: the factors are of the model, not of what it is tried on.
    pub fn fit(predictions: &[Prediction], systems: &[String], learned: &[&str], split: &str) -> Option<Self> {
        let wrong = |system: &usize| predictions.iter().any(|row| row.system == *system && row.error != [0.0; 6]);
        let known = |system: &usize| learned.contains(&systems[*system].as_str());
        let used: Vec<usize> = (0..systems.len()).filter(|system| known(system) && wrong(system)).collect();
        let rows: Vec<&Prediction> = predictions.iter().filter(|row| used.contains(&row.system)).collect();
        let factors = most_likely_factors(&rows)?;
        let fitted = Self {
            factors,
            split: split.to_owned(),
            systems: used.into_iter().map(|system| systems[system].clone()).collect(),
            pairs: rows.len(),
        };
        fitted.is_usable().then_some(fitted)
    }

    /// Whether the factors leave a variance a variance.
    pub fn is_usable(&self) -> bool {
        self.factors.iter().all(|factor| (1.0 / LARGEST_FACTOR..=LARGEST_FACTOR).contains(factor))
    }

    /// The recalibrated covariance of an error of which nothing more was predicted.
    pub fn apply(&self, covariance: &Covariance6) -> Covariance6 {
        covariance.scaled(&self.factors)
    }

    /// Recalibrates a covariance R together with the posterior, if there is one, whose second moment it is.
    pub fn apply_to(&self, covariance: &mut Covariance6, posterior: &mut Option<Posterior>) {
        scale(&self.factors, covariance, posterior);
    }
}

/// Scales the variances that a model puts out: those of C where there is a posterior, which R then follows.
pub(super) fn scale(factors: &[f64; 6], covariance: &mut Covariance6, posterior: &mut Option<Posterior>) {
    match posterior {
        None => *covariance = covariance.scaled(factors),
        Some(posterior) => {
            posterior.covariance = posterior.covariance.scaled(factors);
            *covariance = posterior.second_moment();
        }
    }
}

/// Minimises `−2 Σ ln t + tᵀAt` over `t = s^(−½)`, A the mean of `D(e) R⁻¹ D(e)`: the likelihood of the errors
/// under `D(√s) R D(√s)`, or of what is left of them under `D(√s) C D(√s)`. It is convex; each component in turn has a solution in closed form.
fn most_likely_factors(rows: &[&Prediction]) -> Option<[f64; 6]> {
    let mut quadratic = Matrix6::zeros();
    for row in rows {
        let posterior = row.posterior.as_ref();
        let error = Matrix6::from_diagonal(&Vector6::from(corrected_error(&row.error, posterior)));
        let covariance = corrected_covariance(&row.covariance, posterior);
        quadratic += error * covariance.matrix().cholesky()?.inverse() * error / rows.len() as f64;
    }
    if (0..6).any(|c| quadratic[(c, c)].is_nan() || quadratic[(c, c)] <= 0.0) {
        return None;
    }
    let mut t = Vector6::from_fn(|c, _| quadratic[(c, c)].sqrt().recip());
    for _ in 0..MOST_SWEEPS {
        let before = t;
        for c in 0..6 {
            let own = quadratic[(c, c)];
            let beside = quadratic.row(c).transpose().dot(&t) - own * t[c];
            t[c] = 2.0 / (beside + (beside * beside + 4.0 * own).sqrt());
        }
        if (t - before).abs().max() <= 1e-12 * t.max() {
            break;
        }
    }
    Some(t.map(|t| t.powi(-2)).into())
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::evaluation::evaluate;
    use crate::geometry::Tangent;
    use crate::pairs::PairId;

    fn prediction(system: usize, frame: usize, error: f64, variance: f64) -> Prediction {
        Prediction {
            pair: PairId { drive: 0, source: frame, target: frame + 1 },
            system,
            error: [error; 6],
            covariance: Covariance6::from_variances(&Tangent::repeat(variance)),
            posterior: None,
            no_verdict: None,
            motion: Tangent::zeros(),
            stated_covariance: None,
        }
    }

    #[test]
    fn correlated_components_are_scaled_together() {
        // Errors drawn with a covariance that is scaled component by component away from the predicted one.
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        let lower = Matrix6::from_fn(|row, column| match row.cmp(&column) {
            std::cmp::Ordering::Less => 0.0,
            std::cmp::Ordering::Equal => 1.0,
            std::cmp::Ordering::Greater => 0.8,
        });
        let covariance = Covariance6::from_factors(&lower, &Vector6::zeros());
        let factors = [0.5, 2.0, 1.0, 4.0, 0.25, 1.5];
        let rows: Vec<Prediction> = (0..20_000)
            .map(|frame| {
                // A uniform variable on ±√3 has variance 1.
                let normal = Vector6::from_fn(|_, _| 3f64.sqrt() * random.random_range(-1.0..1.0));
                let error = (lower * normal).component_mul(&Vector6::from(factors.map(f64::sqrt)));
                Prediction { error: error.into(), covariance, ..prediction(0, frame, 0.0, 1.0) }
            })
            .collect();
        let fitted = Recalibration::fit(&rows, &["vo".to_owned()], &["vo"], "validation").unwrap();
        for (found, expected) in fitted.factors.iter().zip(factors) {
            assert!((found / expected - 1.0).abs() < 0.03, "{:?} against {factors:?}", fitted.factors);
        }
    }

    #[test]
    fn recalibrated_predictions_are_calibrated_where_they_were_fitted() {
        let systems = ["vo", "gnss"].map(str::to_owned);
        let rows = [prediction(0, 0, 0.1, 0.02), prediction(0, 1, -0.3, 0.02), prediction(1, 0, 0.0, 1.0)];
        let fitted = Recalibration::fit(&rows, &systems, &["vo", "gnss"], "validation").unwrap();
        assert_eq!((fitted.systems.as_slice(), fitted.pairs), (&systems[..1], 2));
        let covariances: Vec<Covariance6> = rows[..2].iter().map(|row| fitted.apply(&row.covariance)).collect();
        let metrics = evaluate(&covariances, &[rows[0].error, rows[1].error], None).unwrap();
        assert!((metrics.anees.unwrap() - 1.0).abs() < 1e-12);
        // Nothing can be learned from a system without errors.
        assert_eq!(Recalibration::fit(&rows[2..], &systems, &["vo", "gnss"], "validation"), None);
        assert_eq!(Recalibration::fit(&rows, &systems, &["gnss"], "validation"), None);
    }

    /// Measurements of which a model sees most of the error, overconfident in what is left; one without a verdict.
    fn seen_errors() -> Vec<Prediction> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let mut draw = |sigma: f64| Tangent::from_fn(|_, _| sigma * random.random_range(-1.0..1.0));
        let mut rows: Vec<Prediction> = (0..500)
            .map(|frame| {
                let (mean, left) = (draw(0.1), draw(0.01));
                let posterior = Posterior { mean, covariance: Covariance6::from_std_devs(&Tangent::repeat(0.003)) };
                let error = (crate::geometry::Pose::exp(&mean) * crate::geometry::Pose::exp(&left)).log();
                Prediction {
                    error: error.into(),
                    covariance: posterior.second_moment(),
                    posterior: Some(posterior),
                    ..prediction(0, frame, 0.0, 1.0)
                }
            })
            .collect();
        rows.push(prediction(0, 500, 0.02, 1e-3));
        rows
    }

    #[test]
    fn factors_belong_to_what_a_correction_leaves() {
        let mut rows = seen_errors();
        let fitted = Recalibration::fit(&rows, &["vo".to_owned()], &["vo"], "validation").unwrap();
        let before = rows.clone();
        for row in &mut rows {
            fitted.apply_to(&mut row.covariance, &mut row.posterior);
        }
        let judged = |rows: &[Prediction]| {
            let errors: Vec<_> = rows.iter().map(|row| corrected_error(&row.error, row.posterior.as_ref())).collect();
            let covariances: Vec<_> =
                rows.iter().map(|row| corrected_covariance(&row.covariance, row.posterior.as_ref())).collect();
            evaluate(&covariances, &errors, None).unwrap()
        };
        assert!(judged(&before).anees.unwrap() > 3.0);
        for zms in judged(&rows).zms.unwrap() {
            assert!((zms - 1.0).abs() < 1e-9, "{zms}");
        }
        for row in &rows[..500] {
            assert_eq!(row.covariance, row.posterior.unwrap().second_moment());
        }
        // And back.
        for (row, before) in rows.iter_mut().zip(&before) {
            scale(&fitted.factors.map(f64::recip), &mut row.covariance, &mut row.posterior);
            approx::assert_relative_eq!(row.covariance.matrix(), before.covariance.matrix(), epsilon = 1e-12);
            assert_eq!(row.posterior.map(|posterior| posterior.mean), before.posterior.map(|posterior| posterior.mean));
        }
    }
}
