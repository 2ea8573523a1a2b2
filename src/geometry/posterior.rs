//! What is known of a pose error after a look at the images: its mean and the covariance that remains.

use super::{Covariance6, Pose, Tangent};

/// `e | images ~ N(μ, C)`, e the left error of a measurement in one set of axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Posterior {
    /// μ, order ρ then φ, m and rad: the part of the error that the images show.
    pub mean: Tangent,
    /// C, m² and rad²: what they leave open.
    pub covariance: Covariance6,
}

impl Posterior {
    /// `R = E[e eᵀ] = C + μ μᵀ`: the covariance of a measurement that is left as it is.
    pub fn second_moment(&self) -> Covariance6 {
        self.covariance.plus_outer(&self.mean)
    }

    /// The measurement without its visible error, `exp(−μ) T̂`; axes as those of μ. What is left of its error has
    /// the covariance C, to first order.
    pub fn correct(&self, measured: &Pose) -> Pose {
        Pose::exp(&-self.mean) * *measured
    }

    /// The same in other axes.
    pub fn transported(&self, other_from_self: &Pose) -> Self {
        Self { mean: other_from_self.adjoint() * self.mean, covariance: self.covariance.transported(other_from_self) }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    fn posterior() -> Posterior {
        Posterior {
            mean: Tangent::new(0.1, -0.02, 0.03, 1e-3, -2e-3, 3e-3),
            covariance: Covariance6::from_std_devs(&Tangent::new(0.01, 0.02, 0.03, 1e-3, 2e-3, 3e-3)),
        }
    }

    #[test]
    fn the_second_moment_moves_with_the_axes() {
        let pose = Pose::exp(&Tangent::new(1.0, -2.0, 3.0, 0.3, -0.2, 0.9));
        let moved = posterior().transported(&pose).second_moment();
        assert_relative_eq!(moved.matrix(), posterior().second_moment().transported(&pose).matrix(), epsilon = 1e-12);
    }

    #[test]
    fn a_correction_by_the_error_itself_returns_the_truth() {
        let truth = Pose::exp(&Tangent::new(1.0, 0.1, -0.2, 0.02, -0.05, 0.3));
        let measured = Pose::exp(&posterior().mean) * truth;
        assert_relative_eq!(posterior().correct(&measured).matrix(), truth.matrix(), epsilon = 1e-12);
    }
}
