//! Relative poses chained to a trajectory, with the covariance that adds up along it.

use super::motion::MeasuredMotions;
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, Pose};

/// Poses of a drive in the axes of its first frame.
#[derive(Clone, Debug)]
pub struct Chain {
    /// Frames, in order.
    pub frames: Vec<usize>,
    /// `first_from_frame`; the first is the identity.
    pub poses: Vec<Pose>,
    /// Covariance of `log(T̂ T⁻¹)` of each pose, left, axes of the first frame; the first is zero.
    pub covariances: Vec<Covariance6>,
}

impl Chain {
    /// Chains motions: `T̂ₖ₊₁ = T̂ₖ ᵏT̂ₖ₊₁`, `Σₖ₊₁ = Σₖ + Ad Σ Adᵀ` with the adjoint of `T̂ₖ`.
    ///
    /// # Errors
    /// There is no motion, or one does not begin where the one before it ends.
    pub fn of(measured: &MeasuredMotions) -> Result<Self> {
        let MeasuredMotions { system, drive, motions, .. } = measured;
        let Some(first) = motions.first() else {
            return Err(Error::Data(format!("{drive}, {system}: no motion to chain")));
        };
        let (mut pose, mut covariance) = (Pose::identity(), Covariance6::zero());
        let mut chain = Self { frames: vec![first.source], poses: vec![pose], covariances: vec![covariance] };
        let mut end = first.source;
        for motion in motions {
            if motion.source != end {
                return Err(Error::Data(format!(
                    "{drive}, {system}: no motion from frame {end} to {}; a trajectory needs an unbroken chain of neighbours: write csv, jsonl or g2o, fewer frames, or set data.gap to one number",
                    motion.source
                )));
            }
            covariance = covariance.plus(&motion.covariance.transported(&pose));
            pose = pose * motion.source_from_target;
            end = motion.target;
            chain.frames.push(end);
            chain.poses.push(pose);
            chain.covariances.push(covariance);
        }
        Ok(chain)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::measured;
    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn covariances_add_up_as_the_errors_do() {
        let measured = measured();
        let chain = Chain::of(&measured).unwrap();
        assert_eq!(chain.frames, [4, 5, 6]);
        // Small errors of both motions against the error of the end pose.
        let small = [Tangent::new(1.0, 2.0, -1.0, 0.5, -0.3, 0.2), Tangent::new(-2.0, 0.3, 1.0, 0.2, 0.6, -0.4)]
            .map(|e| e * 1e-7);
        let wrong = measured.motions.iter().zip(&small).map(|(motion, e)| Pose::exp(e) * motion.source_from_target);
        let end = wrong.fold(Pose::identity(), |pose, motion| pose * motion);
        let error = Pose::error(&end, &chain.poses[2]);
        let expected = small[0] + chain.poses[1].adjoint() * small[1];
        assert!((error - expected).norm() < 1e-12);
        let sum = measured.motions[0].covariance.plus(&measured.motions[1].covariance.transported(&chain.poses[1]));
        assert!((sum.matrix() - chain.covariances[2].matrix()).norm() < 1e-15);
    }

    #[test]
    fn a_gap_is_named() {
        let mut measured = measured();
        measured.motions[1].source = 7;
        measured.motions[1].target = 8;
        assert!(Chain::of(&measured).unwrap_err().to_string().contains("from frame 5 to 7"));
    }
}
