//! Rigid motions, their errors and covariances, the pinhole camera and its lens; f64 on the CPU, no tensors.
//!
//! Every other room takes its conventions from here; they are stored in each checkpoint and result
//! ([`Conventions`]) and checked when one is loaded.
//!
//! | what | convention |
//! |---|---|
//! | tangent order | ρ then φ: x, y, z, rx, ry, rz ([`TRANSLATION`], [`ROTATION`]) |
//! | units | metres, radians |
//! | relative pose | `source_from_target`: maps points of view i+1 (target) into view i (source) |
//! | error | `e = log(T̂ T⁻¹)`, a left perturbation in the axes of the source frame (paper Eq. 2) |
//! | axes | vehicle: x forward, y left, z up; camera: x right, y down, z forward |
//! | pixels | centres at integer coordinates |

mod camera;
mod covariance;
mod frame;
mod lens;
mod posterior;
mod se3;

pub(crate) use camera::OWN_INTRINSICS;
pub use camera::Pinhole;
pub use covariance::{Covariance6, CovarianceError};
pub use frame::{Conventions, ErrorFrame};
pub use lens::Lens;
pub use posterior::Posterior;
pub use se3::{Pose, ROTATION, TRANSLATION, Tangent, hat};
