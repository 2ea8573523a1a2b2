//! What is exported: measured motions, each with what a model says of its error, and the same motions corrected.

use super::perturbation::{Perturbation, on_side};
use crate::alignment::NoVerdict;
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, ErrorFrame, Pose, Posterior};
use crate::time::Time;

/// One system's measurements on one drive.
#[derive(Clone, Debug, PartialEq)]
pub struct MeasuredMotions {
    /// Name of the system.
    pub system: String,
    /// Name of the drive.
    pub drive: String,
    /// Axes of poses and covariances. Those of the world turn with the vehicle, from motion to motion.
    pub frame: ErrorFrame,
    /// The measurements, in the order of their frames.
    pub motions: Vec<MeasuredMotion>,
}

/// A relative pose with its covariance.
#[derive(Clone, Debug, PartialEq)]
pub struct MeasuredMotion {
    /// Frame i.
    pub source: usize,
    /// Frame i + 1.
    pub target: usize,
    /// Their times, where they are known.
    pub times: Option<[Time; 2]>,
    /// Measured `ⁱT̂ᵢ₊₁`, m.
    pub source_from_target: Pose,
    /// Covariance of `log(T̂ T⁻¹)`, left, order ρ then φ, m² and rad², the same axes.
    pub covariance: Covariance6,
    /// What is known of that error itself, the same axes; `None` of a model that does not say, and of a motion that was
    /// corrected.
    pub posterior: Option<Posterior>,
    /// Whether the images say something of this error; `None` of a model that does not ask them.
    pub verdict: Option<Verdict>,
}

/// Whether the images of a pair say something of the error of its measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// They do.
    Given,
    /// They do not, and why: the covariance is the prior's, and nothing is corrected.
    Withheld(NoVerdict),
}

impl Verdict {
    /// What direct alignment came to, where it says why it came to nothing.
    pub fn of(no_verdict: Option<NoVerdict>) -> Self {
        no_verdict.map_or(Self::Given, Self::Withheld)
    }

    /// Name in files: `ok`, or the reason's.
    pub fn name(self) -> &'static str {
        match self {
            Self::Given => "ok",
            Self::Withheld(reason) => reason.name(),
        }
    }

    /// The reason in words, where it is withheld.
    pub fn reason(self) -> Option<&'static str> {
        match self {
            Self::Given => None,
            Self::Withheld(reason) => Some(reason.reason()),
        }
    }
}

impl MeasuredMotions {
    /// The measurements without the errors that the images show.
    ///
    /// # Errors
    /// Nothing is known of the error of one of them.
    pub fn corrected(&self) -> Result<Self> {
        let motions = self.motions.iter().map(MeasuredMotion::corrected).collect::<Option<_>>().ok_or_else(|| {
            Error::Data(format!(
                "{}, {}: the model does not predict the error itself, so there is nothing to correct by; train one with model.head = \"posterior\"",
                self.drive, self.system
            ))
        })?;
        Ok(Self { motions, ..self.clone() })
    }
}

impl MeasuredMotion {
    /// The measurement without the error that the images show, `exp(−μ) T̂` with the covariance C; one without a verdict
    /// stays as it is, for its μ is zero and its C the prior's. `None` where nothing is known of the error itself.
    pub fn corrected(&self) -> Option<Self> {
        let posterior = self.posterior?;
        Some(Self {
            source_from_target: posterior.correct(&self.source_from_target),
            covariance: posterior.covariance,
            posterior: None,
            ..self.clone()
        })
    }

    /// The covariance on the asked side, its diagonal lifted to the floor.
    pub(super) fn covariance_on(&self, side: Perturbation, floor: Option<[f64; 2]>) -> Covariance6 {
        on_side(&self.covariance, &self.source_from_target, side, floor)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::tests::seen;
    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn a_motion_in_other_axes_is_corrected_by_the_same_motion() {
        let other_from_these = Pose::exp(&Tangent::new(1.0, -2.0, 3.0, 0.3, -0.2, 0.9));
        for motion in &seen().motions {
            let moved = MeasuredMotion {
                source_from_target: motion.source_from_target.conjugated_by(&other_from_these),
                covariance: motion.covariance.transported(&other_from_these),
                posterior: motion.posterior.map(|posterior| posterior.transported(&other_from_these)),
                ..motion.clone()
            };
            let (here, there) = (motion.corrected().unwrap(), moved.corrected().unwrap());
            let expected = here.source_from_target.conjugated_by(&other_from_these);
            assert_relative_eq!(there.source_from_target.matrix(), expected.matrix(), epsilon = 1e-12);
            let expected = here.covariance.transported(&other_from_these);
            assert_relative_eq!(there.covariance.matrix(), expected.matrix(), epsilon = 1e-15);
        }
    }

    #[test]
    fn what_got_no_verdict_stays_as_it_is() {
        let mut motion = seen().motions[0].clone();
        let prior = motion.covariance;
        motion.posterior = Some(Posterior { mean: Tangent::zeros(), covariance: prior });
        motion.verdict = Some(Verdict::of(Some(NoVerdict::NoTexture)));
        let corrected = motion.corrected().unwrap();
        assert_eq!((corrected.source_from_target, corrected.covariance), (motion.source_from_target, prior));
        assert_eq!(corrected.verdict.map(Verdict::name), Some("no_texture"));
        // What was corrected is not corrected again.
        assert_eq!(corrected.corrected(), None);
    }
}
