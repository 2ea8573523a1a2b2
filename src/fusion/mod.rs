//! What covariances are for: several systems' relative poses and a few absolute fixes joined to one trajectory, each
//! weighted by its covariance.
//!
//! In: [`Odometry`] of each system, [`Fix`]es. Out: the most likely trajectory with its marginal covariances
//! ([`FusedTrajectory`]), and how good both are where the truth is known ([`TrajectoryScores`]). The pose graph is solved by
//! [factrs](https://docs.rs/factrs), by Levenberg and Marquardt's method on sparse Cholesky factors.
//!
//! Poses are `world_from_body`; covariances of odometry are those of relcov (left, ρ then φ), those of the result are of
//! the right perturbation `T̂ = T exp(e)`, in axes of the body, so that their numbers do not depend on how far away the
//! world's origin is.

mod fixes;
mod graph;
mod scores;
mod solver;
mod variables;

pub use fixes::{DEVIATIONS, Fix, SimulatedFixes, parse_fixes};
pub use graph::{FusedTrajectory, Odometry, fuse};
pub use scores::TrajectoryScores;
