//! The baseline that knows the measured motion and no image.

use nalgebra::{Matrix4, Vector4};
use serde::{Deserialize, Serialize};

use crate::geometry::Tangent;

/// Newton steps before a fit counts as failed; 10 are usual.
const MOST_STEPS: usize = 100;

/// Log-variances linear in functions of the measured motion:
/// `ln R = θ · [1, ln(|ρ| + 0.05 m), min(50 |yaw|, 3), min(50 |pitch|, 3)]`, four numbers a component.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogLinear {
    /// θ of each component, order ρ then φ.
    pub coefficients: [[f64; 4]; 6],
}

impl LogLinear {
    /// The most likely coefficients for errors under zero-mean Gaussians; motions are `log T̂` in
    /// vehicle axes (x forward, y left, z up), m and rad.
    ///
    /// `None` without errors to learn from.
    pub fn fit(motions: &[Tangent], errors: &[Tangent]) -> Option<Self> {
        assert_eq!(motions.len(), errors.len(), "one motion for each error");
        let features: Vec<Vector4<f64>> = motions.iter().map(features).collect();
        let mut coefficients = [[0.0; 4]; 6];
        for (component, theta) in coefficients.iter_mut().enumerate() {
            let squares: Vec<f64> = errors.iter().map(|error| error[component] * error[component]).collect();
            *theta = fit_component(&features, &squares)?.into();
        }
        Some(Self { coefficients })
    }

    /// Predicted variances of a measurement, m² and rad².
    pub fn variance(&self, motion: &Tangent) -> [f64; 6] {
        let features = features(motion);
        self.coefficients.map(|theta| Vector4::from(theta).dot(&features).exp())
    }
}

fn features(motion: &Tangent) -> Vector4<f64> {
    let [pitch, yaw] = [motion[4], motion[5]].map(|angle| (50.0 * angle.abs()).min(3.0));
    Vector4::new(1.0, (motion.fixed_rows::<3>(0).norm() + 0.05).ln(), yaw, pitch)
}

/// Minimises `Σ θᵀf + e² exp(−θᵀf)`, which is convex, by Newton's method with step halving.
fn fit_component(features: &[Vector4<f64>], squares: &[f64]) -> Option<Vector4<f64>> {
    let rows = squares.len() as f64;
    let mean = squares.iter().sum::<f64>() / rows;
    if mean.is_nan() || mean <= 0.0 {
        return None;
    }
    let loss = |theta: &Vector4<f64>| -> f64 {
        features.iter().zip(squares).map(|(f, square)| theta.dot(f) + square * (-theta.dot(f)).exp()).sum()
    };
    let mut theta = Vector4::new(mean.ln(), 0.0, 0.0, 0.0);
    let mut current = loss(&theta);
    for _ in 0..MOST_STEPS {
        let mut gradient = Vector4::zeros();
        // A feature that never changes leaves its coefficient where it is.
        let mut hessian = Matrix4::from_diagonal_element(1e-9 * rows);
        for (f, square) in features.iter().zip(squares) {
            let weight = square * (-theta.dot(f)).exp();
            gradient += f * (1.0 - weight);
            hessian += f * f.transpose() * weight;
        }
        let step = hessian.cholesky()?.solve(&gradient);
        let candidates = (0..40).map(|halvings| theta - step * 0.5_f64.powi(halvings));
        let Some((next, lower)) = candidates.map(|next| (next, loss(&next))).find(|(_, lower)| *lower < current) else {
            return Some(theta);
        };
        let gain = current - lower;
        (theta, current) = (next, lower);
        if gain < 1e-12 * rows {
            return Some(theta);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;

    #[test]
    fn the_fit_finds_the_law_that_made_the_errors() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let law = LogLinear { coefficients: [[-8.0, 1.5, 0.3, -0.2]; 6] };
        let (mut motions, mut errors) = (Vec::new(), Vec::new());
        for _ in 0..20_000 {
            let motion = Tangent::new(
                random.random_range(0.0..2.0),
                0.0,
                0.0,
                0.0,
                random.random_range(-0.04..0.04),
                random.random_range(-0.04..0.04),
            );
            // A uniform variable on ±√3 σ has variance σ².
            let error = law.variance(&motion).map(|variance| (3.0 * variance).sqrt() * random.random_range(-1.0..1.0));
            motions.push(motion);
            errors.push(Tangent::from(error));
        }
        let fitted = LogLinear::fit(&motions, &errors).unwrap();
        for (found, expected) in fitted.coefficients.iter().flatten().zip(law.coefficients.iter().flatten()) {
            assert!((found - expected).abs() < 0.06, "{found} against {expected}");
        }
    }

    #[test]
    fn errors_that_are_all_zero_have_no_fit() {
        assert_eq!(LogLinear::fit(&[Tangent::zeros()], &[Tangent::zeros()]), None);
        assert_eq!(LogLinear::fit(&[], &[]), None);
    }
}
