//! What direct alignment found.

use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

use crate::geometry::{Pose, Tangent};

/// Levels of the pyramid.
pub const LEVELS: usize = 3;

/// What the images of a pair say of the error of its measured pose.
///
/// # Frames
/// Errors and information are those of the left perturbation `e = log(T̂ T⁻¹)`, order ρ then φ, m and rad; in axes of the
/// source camera as [`align`](super::align) gives them, in others after [`Evidence::transported`].
#[derive(Clone, Debug, PartialEq)]
pub struct Evidence {
    /// From coarse to fine.
    pub levels: [LevelEvidence; LEVELS],
    /// `I_{i+1} ≈ (1 + gain) I_i + bias` after alignment, intensities in 0…1.
    pub gain: f64,
    /// See `gain`.
    pub bias: f64,
    /// Why the images say nothing, where they do not; numbers are then no evidence.
    pub no_verdict: Option<NoVerdict>,
}

/// The same at one level of the pyramid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LevelEvidence {
    /// ê: the alignment's estimate of the error, from this level and all coarser ones.
    pub error: Tangent,
    /// `Λ = JᵀWJ / σ²`, gain and bias eliminated: information that this level's residuals have of the error if they
    /// were independent, 1/m² and 1/rad². Directions that the images do not show have little or none.
    pub information: Matrix6<f64>,
    /// Robust standard deviation of the residuals at the measured pose, intensities in 0…1.
    pub residual_before: f64,
    /// The same after alignment: σ.
    pub residual_after: f64,
    /// Share of the level's pixels that have a known depth and lie inside the source image after alignment.
    pub valid_share: f64,
}

impl Evidence {
    /// Without any information.
    pub fn none(reason: NoVerdict) -> Self {
        let level = LevelEvidence {
            error: Tangent::zeros(),
            information: Matrix6::zeros(),
            residual_before: 0.0,
            residual_after: 0.0,
            valid_share: 0.0,
        };
        Self { levels: [level; LEVELS], gain: 0.0, bias: 0.0, no_verdict: Some(reason) }
    }

    /// The finest level.
    pub fn finest(&self) -> &LevelEvidence {
        &self.levels[LEVELS - 1]
    }

    /// ê and Λ of the finest level; both zero without a verdict.
    pub fn judged(&self) -> (Tangent, Matrix6<f64>) {
        match self.no_verdict {
            None => (self.finest().error, self.finest().information),
            Some(_) => (Tangent::zeros(), Matrix6::zeros()),
        }
    }

    /// The same in other axes: `ê' = Ad ê`, `Λ' = Ad⁻ᵀ Λ Ad⁻¹`.
    pub fn transported(&self, other_from_self: &Pose) -> Self {
        let adjoint = other_from_self.adjoint();
        let inverse = other_from_self.inverse().adjoint();
        let levels = self.levels.map(|level| LevelEvidence {
            error: adjoint * level.error,
            information: inverse.transpose() * level.information * inverse,
            ..level
        });
        Self { levels, ..self.clone() }
    }
}

/// Why the images of a pair say nothing of its error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoVerdict {
    /// The depth of too few pixels is known.
    NoDepth,
    /// By the measured pose too few pixels of the target lie inside the source image.
    NoOverlap,
    /// Too few pixels have an image gradient: black, constant or overexposed images.
    NoTexture,
    /// The alignment did not come to rest: the pose is too far off, or the images show something else.
    Diverged,
}

impl NoVerdict {
    /// Name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoDepth => "no_depth",
            Self::NoOverlap => "no_overlap",
            Self::NoTexture => "no_texture",
            Self::Diverged => "diverged",
        }
    }

    /// The reason in words.
    pub fn reason(self) -> &'static str {
        match self {
            Self::NoDepth => "the depth of too few pixels is known",
            Self::NoOverlap => "by the measured pose the images share too few pixels",
            Self::NoTexture => "the images have too little texture",
            Self::Diverged => "the alignment of the images did not come to rest",
        }
    }
}
