//! Choices of an export.

use clap::ValueEnum;

use super::perturbation::Perturbation;

/// Which covariance stands beside the poses of a trajectory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum TrajectoryCovariance {
    /// That of the motion from the row before
    #[default]
    Relative,
    /// That of the pose in the first frame, by all motions since
    Accumulated,
    /// None: the plain format
    None,
}

/// How g2o files state the information of rotations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum G2oRotation {
    /// Of the quaternion's vector part, half the angle, as g2o itself takes it
    #[default]
    HalfAngle,
    /// Of the angle, as the g2o readers of GTSAM and factrs take it
    Angle,
}

/// Which poses are written, each with the covariance of its own error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Poses {
    /// T̂ as it was measured, with R
    #[default]
    Measured,
    /// `exp(−μ) T̂`, without the error that the images show, with C
    Corrected,
}

/// Choices of an export.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ExportOptions {
    /// Measured or corrected poses; corrected ones need motions that know their
    /// [posterior](super::MeasuredMotion::posterior).
    pub poses: Poses,
    /// Side of the covariance; `None`: that of the format, left where it takes both.
    pub perturbation: Option<Perturbation>,
    /// Least variance on the diagonal, m² and rad²; `None`: [`ROS_FLOOR`] for `ros`, nothing for the others.
    pub floor: Option<[f64; 2]>,
    /// For `tum` and `kitti`.
    pub trajectory: TrajectoryCovariance,
    /// For `g2o`.
    pub g2o_rotation: G2oRotation,
}

/// Least variance in ROS messages, whose consumers choke on zeros, m² and rad²: far below what any system attains.
pub const ROS_FLOOR: [f64; 2] = [1e-9, 1e-9];

impl ExportOptions {
    /// The side of covariances in formats that take both.
    pub(super) fn side(&self) -> Perturbation {
        self.perturbation.unwrap_or(Perturbation::Left)
    }

    /// What the remarks of a file say of poses that are not the measured ones.
    pub(super) fn remark(&self) -> &'static str {
        match self.poses {
            Poses::Measured => "",
            Poses::Corrected => ", corrected by the error that the images show",
        }
    }
}
