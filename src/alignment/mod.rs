//! The evidence of a pair: what its two images say of the error of the measured pose, by direct alignment.
//!
//! In: grey images, depth of the target, camera, measured `source_from_target`. The residual of the warped image is, to
//! first order, linear in the error e of the measurement, so the photometric normal equations at the measured pose, and
//! a few Gauss-Newton steps from there, give an estimate ê of the error and its information Λ ([`Evidence`]). Where the
//! images say nothing there is no number but a reason ([`NoVerdict`]). On the CPU, no tensors.
//!
//! Leaves to others: how far the estimate may be trusted (`network` learns it), and the warp that the network sees.

mod evidence;
mod features;
mod gauss_newton;
mod image;
mod input;
#[cfg(test)]
mod laws;
mod normal_equations;
mod scale;

pub use evidence::{Evidence, LEVELS, LevelEvidence, NoVerdict};
pub use features::{FEATURES, features};
pub use gauss_newton::{AlignmentInput, align};
pub use image::GreyImage;
pub use input::EvidenceInput;
