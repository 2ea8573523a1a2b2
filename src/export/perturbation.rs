//! The side on which an error stands, and a covariance on that side.

use clap::ValueEnum;

use crate::geometry::{Covariance6, Pose};

/// The side on which an error stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Perturbation {
    /// `T̂ = exp(e) T`, axes of the source frame: the paper's, and relcov's own
    Left,
    /// `T̂ = T exp(e)`, axes of the target frame
    Right,
}

impl Perturbation {
    /// Name in options and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Left => "left",
            Self::Right => "right",
        }
    }
}

/// The covariance of a pose's left perturbation on the asked side, its diagonal lifted to the floor.
pub(super) fn on_side(left: &Covariance6, pose: &Pose, side: Perturbation, floor: Option<[f64; 2]>) -> Covariance6 {
    let covariance = match side {
        Perturbation::Left => *left,
        Perturbation::Right => left.right_of(pose),
    };
    floor.map_or(covariance, |floor| covariance.with_floor(floor))
}
