//! The formats: what each can hold, and which file of this room writes it.

use clap::ValueEnum;

use super::motion::MeasuredMotions;
use super::options::{ExportOptions, G2oRotation, Poses, ROS_FLOOR, TrajectoryCovariance};
use super::perturbation::Perturbation;
use super::{csv, g2o, gtsam, jsonl, ros, trajectory};
use crate::error::{Error, Result};
use crate::geometry::ErrorFrame;

/// Form of the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Relative poses, as relcov itself reads them
    Csv,
    /// The same as JSON lines, with its names
    Jsonl,
    /// TUM trajectory with covariances
    Tum,
    /// KITTI trajectory with covariances
    Kitti,
    /// A pose graph for g2o
    G2o,
    /// Factors for GTSAM
    Gtsam,
    /// ROS messages
    Ros,
}

impl Format {
    /// Name in options.
    pub fn name(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Jsonl => "jsonl",
            Self::Tum => "tum",
            Self::Kitti => "kitti",
            Self::G2o => "g2o",
            Self::Gtsam => "gtsam",
            Self::Ros => "ros",
        }
    }

    /// Whether one file can hold several systems and drives, each line saying which it belongs to.
    pub fn is_labelled(self) -> bool {
        self == Self::Jsonl
    }

    /// The axes that readers of the format expect where none were asked for; `None`: those of the covariances.
    pub fn usual_frame(self) -> Option<ErrorFrame> {
        (self == Self::Kitti).then_some(ErrorFrame::Camera)
    }

    /// That motions in these axes can be told in this format.
    ///
    /// # Errors
    /// It joins motions one to the next, and the axes turn between them.
    pub fn check_frame(self, frame: ErrorFrame) -> Result<()> {
        let joins = matches!(self, Self::Tum | Self::Kitti | Self::G2o | Self::Gtsam);
        if !(joins && frame == ErrorFrame::World) {
            return Ok(());
        }
        Err(Error::Data(format!(
            "{} joins motions one to the next, and axes of the world turn with respect to the vehicle between them; take --frame vehicle or camera, or csv, jsonl or ros",
            self.name()
        )))
    }

    /// That the options mean something to this format.
    ///
    /// # Errors
    /// The format fixes what an option asks for otherwise, or the floor is no variance.
    pub fn check(self, options: &ExportOptions) -> Result<()> {
        let name = self.name();
        let fixed = match self {
            Self::G2o | Self::Gtsam => Some("the right perturbation"),
            Self::Ros => Some("errors of position and about fixed axes"),
            Self::Csv | Self::Jsonl | Self::Tum | Self::Kitti => None,
        };
        if let (Some(fixed), Some(asked)) = (fixed, options.perturbation)
            && !(asked == Perturbation::Right && self != Self::Ros)
        {
            return Err(Error::Data(format!(
                "--perturbation {}: the format {name} is defined with {fixed}; leave the option out, or take csv or jsonl",
                asked.name()
            )));
        }
        if options.trajectory != TrajectoryCovariance::Relative && !matches!(self, Self::Tum | Self::Kitti) {
            return Err(Error::Data(format!("--covariance is for tum and kitti; {name} holds relative poses")));
        }
        if options.g2o_rotation != G2oRotation::HalfAngle && self != Self::G2o {
            return Err(Error::Data(format!("--g2o-rotation is for g2o, not {name}")));
        }
        let floor = options.floor.unwrap_or_default();
        if floor.iter().any(|variance| !(0.0..=1e12).contains(variance)) {
            return Err(Error::Data(format!("--floor {floor:?}: expected variances from 0 to 1e12, m² and rad²")));
        }
        Ok(())
    }

    /// The measurements in this format.
    ///
    /// # Errors
    /// The options do not fit the format ([`Format::check`]); corrected poses are asked for and nothing is known of an
    /// error itself; a trajectory is asked for and frames are missing; or a covariance has no inverse where the format
    /// needs one.
    pub fn render(self, measured: &MeasuredMotions, options: &ExportOptions) -> Result<String> {
        self.check(options)?;
        self.check_frame(measured.frame)?;
        let corrected;
        let measured = match options.poses {
            Poses::Measured => measured,
            Poses::Corrected => {
                corrected = measured.corrected()?;
                &corrected
            }
        };
        let options = &ExportOptions { floor: options.floor.or((self == Self::Ros).then_some(ROS_FLOOR)), ..*options };
        match self {
            Self::Csv => Ok(csv::render(measured, options)),
            Self::Jsonl => Ok(jsonl::render(measured, options)),
            Self::Tum => trajectory::render_tum(measured, options),
            Self::Kitti => trajectory::render_kitti(measured, options),
            Self::G2o => g2o::render(measured, options.g2o_rotation, options.floor),
            Self::Gtsam => Ok(gtsam::render(measured, options.floor)),
            Self::Ros => Ok(ros::render(measured, options.floor)),
        }
    }
}
