//! A pair: two frames, what was measured between them and how wrong it is.

use std::sync::Arc;

use crate::geometry::{Covariance6, Pose, Tangent};
use crate::systems::Perturbation;

/// One measurement: two frames, the measured pose and its error.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// Which frames.
    pub id: PairId,
    /// Index of the system that measured it.
    pub system: usize,
    /// Measured `ⁱT̂ᵢ₊₁` in axes of the camera, m: what the warp uses.
    pub source_from_target: Pose,
    /// `e = log(T̂ T⁻¹)` (paper Eq. 2) in the configured error frame, m and rad; zero where the truth is not known.
    pub error: Tangent,
    /// Whether the truth is known.
    pub is_judged: bool,
    /// `log ⁱT̂ᵢ₊₁` in vehicle axes, m and rad: what baselines know of a measurement.
    pub motion: Tangent,
    /// Axes of the errors from those of the camera, where and when the measurement was made.
    pub errors_from_camera: Pose,
    /// What generates the measurement, where it is no system's.
    pub generated: Option<Arc<Perturbation>>,
    /// Covariance of the error that the measurement states, in the error frame: the true one in simulated data.
    pub stated_covariance: Option<Covariance6>,
}

impl Pair {
    /// Measured `ⁱT̂ᵢ₊₁` (axes of the camera, m) and its error; of a generated measurement those of a draw, where one is
    /// asked for.
    pub fn measured(&self, draw: Option<usize>) -> (Pose, Tangent) {
        match (&self.generated, draw) {
            (Some(perturbation), Some(draw)) => {
                let error = perturbation.draw(self.id.drive, [self.id.source, self.id.target], draw);
                (self.wrong_by(&error), error)
            }
            _ => (self.source_from_target, self.error),
        }
    }

    /// True `ⁱTᵢ₊₁`, axes of the camera, m, where it is known.
    pub fn true_source_from_target(&self) -> Option<Pose> {
        self.is_judged.then(|| self.wrong_by(&Tangent::zeros()))
    }

    /// The pose that a measurement with this error would have: `exp(e) exp(−e₀) T̂₀`.
    pub(super) fn wrong_by(&self, error: &Tangent) -> Pose {
        let change = Pose::exp(error) * Pose::exp(&-self.error);
        change.conjugated_by(&self.errors_from_camera.inverse()) * self.source_from_target
    }
}

/// Two frames of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PairId {
    /// Index into [`Dataset::drives`](super::Dataset::drives).
    pub drive: usize,
    /// Frame i.
    pub source: usize,
    /// Frame i + 1.
    pub target: usize,
}

/// Which measured pairs a data set keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PairScope {
    /// Those with images and depth: what a network needs.
    Images,
    /// All with a measured and a true pose: what statistics of errors need.
    Poses,
    /// Those with images and depth, whether or not the truth is known: what a prediction needs. The error of a pair
    /// whose truth is not known is zero and means nothing.
    Measured,
}
