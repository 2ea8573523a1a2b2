//! Measured motions with their covariances in the forms that other programs read.
//!
//! In: [`MeasuredMotions`], one system's relative poses on one drive with covariances of the left perturbation, order ρ
//! then φ, all in one set of axes. Out: text, each format with its own order, side and units:
//!
//! | [`Format`] | a line is | covariance |
//! |---|---|---|
//! | `csv` | a relative pose: `source,target,x,y,z,qx,qy,qz,qw` and 36 values | ρ, φ; left or right |
//! | `jsonl` | the same with its names, as a JSON object | ρ, φ; left or right |
//! | `tum`, `kitti` | an absolute pose of the chained trajectory, and 36 values | ρ, φ; left or right |
//! | `g2o` | `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT` | 21 information values, t then q, right |
//! | `gtsam` | a `BetweenFactorPose3`: keys, pose and 36 values | **φ, ρ**, right |
//! | `ros` | a `geometry_msgs/PoseWithCovarianceStamped` as JSON (which is YAML) | position, then fixed axes |
//!
//! Each of them writes the measurements as they are, or corrected by what the images show of their errors ([`Poses`]).
//! Leaves the choice of axes to its caller and writing files to `cli`.

mod chain;
mod csv;
mod g2o;
mod gtsam;
mod jsonl;
mod motion;
mod ros;
mod trajectory;

use clap::ValueEnum;
use nalgebra::{Matrix6, UnitQuaternion};

use crate::error::{Error, Result};
use crate::geometry::{Covariance6, ErrorFrame, Pose, ROTATION, TRANSLATION};

pub use chain::Chain;
pub(crate) use jsonl::{JsonJudgement, JsonPose};
pub use motion::{MeasuredMotion, MeasuredMotions, Verdict};
pub use trajectory::fused_trajectory;

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
    /// Measured or corrected poses; corrected ones need motions that know their [`MeasuredMotion::posterior`].
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

impl ExportOptions {
    /// The side of covariances in formats that take both.
    fn side(&self) -> Perturbation {
        self.perturbation.unwrap_or(Perturbation::Left)
    }

    /// What the remarks of a file say of poses that are not the measured ones.
    fn remark(&self) -> &'static str {
        match self.poses {
            Poses::Measured => "",
            Poses::Corrected => ", corrected by the error that the images show",
        }
    }
}

/// The covariance of a pose's left perturbation on the asked side, its diagonal lifted to the floor.
fn on_side(left: &Covariance6, pose: &Pose, side: Perturbation, floor: Option<[f64; 2]>) -> Covariance6 {
    let covariance = match side {
        Perturbation::Left => *left,
        Perturbation::Right => left.right_of(pose),
    };
    floor.map_or(covariance, |floor| covariance.with_floor(floor))
}

/// Position and quaternion `x y z qx qy qz qw`.
fn pose_numbers(pose: &Pose) -> [f64; 7] {
    let quaternion = UnitQuaternion::from_rotation_matrix(&pose.rotation);
    let (t, q) = (pose.translation, quaternion.coords);
    // The same rotation either way; readers expect the short one.
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [t.x, t.y, t.z, sign * q.x, sign * q.y, sign * q.z, sign * q.w]
}

/// Entries of a matrix, row by row.
fn rows(matrix: &Matrix6<f64>) -> impl Iterator<Item = f64> {
    let entries: Vec<f64> = matrix.transpose().iter().copied().collect();
    entries.into_iter()
}

/// The matrix with φ before ρ.
fn rotation_first(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    let order: Vec<usize> = ROTATION.chain(TRANSLATION).collect();
    Matrix6::from_fn(|row, column| matrix[(order[row], order[column])])
}

/// Numbers in a line, shortest text that gives the same number back.
fn join(numbers: impl IntoIterator<Item = f64>, separator: &str) -> String {
    numbers.into_iter().map(|number| format!("{number:?}")).collect::<Vec<_>>().join(separator)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::geometry::{Posterior, Tangent};
    use crate::time::Time;

    /// Two motions with full covariances.
    pub(crate) fn measured() -> MeasuredMotions {
        let motion = |source: usize, tangent: Tangent| {
            let skewed = Pose::exp(&Tangent::new(0.3, -0.2, 0.1, 0.2, 0.1, -0.3));
            let std_devs = Tangent::new(0.05, 0.02, 0.03, 1e-3, 2e-3, 8e-4);
            MeasuredMotion {
                source,
                target: source + 1,
                times: Some([0, 1].map(|step| {
                    Time::from_nanoseconds(1_403_636_579_763_555_584 + 50_000_000 * (source + step) as i64)
                })),
                source_from_target: Pose::exp(&tangent),
                covariance: Covariance6::from_std_devs(&std_devs).transported(&skewed),
                posterior: None,
                verdict: None,
            }
        };
        let motions = vec![
            motion(4, Tangent::new(1.1, 0.05, -0.02, 0.01, -0.02, 0.1)),
            motion(5, Tangent::new(1.0, -0.03, 0.02, -0.01, 0.02, -0.2)),
        ];
        MeasuredMotions { system: "vo".to_owned(), drive: "drive".to_owned(), frame: ErrorFrame::Vehicle, motions }
    }

    /// The same, of which the images show a part of the error.
    pub(crate) fn seen() -> MeasuredMotions {
        let mut seen = measured();
        for (motion, share) in seen.motions.iter_mut().zip([1.0, -0.5]) {
            let mean = share * Tangent::new(0.06, -0.03, 0.02, 2e-3, -1e-3, 3e-3);
            let posterior = Posterior { mean, covariance: motion.covariance };
            (motion.covariance, motion.posterior) = (posterior.second_moment(), Some(posterior));
            motion.verdict = Some(Verdict::Given);
        }
        seen
    }

    #[test]
    fn every_format_writes_the_corrected_motions_as_it_writes_measured_ones() {
        let corrected = ExportOptions { poses: Poses::Corrected, ..ExportOptions::default() };
        let by_hand = seen().corrected().unwrap();
        for format in Format::value_variants() {
            let text = format.render(&seen(), &corrected).unwrap();
            let expected = format.render(&by_hand, &ExportOptions::default()).unwrap();
            // What says that they are corrected is all that differs.
            let plain = text.replace(corrected.remark(), "").replace("\"corrected\":true,", "");
            assert_eq!(plain, expected, "{}", format.name());
            assert_ne!(text, format.render(&seen(), &ExportOptions::default()).unwrap());
            let problem = format.render(&measured(), &corrected).unwrap_err().to_string();
            assert!(problem.contains("does not predict the error itself"), "{problem}");
        }
    }

    #[test]
    fn options_that_a_format_cannot_honour_are_refused() {
        let left = ExportOptions { perturbation: Some(Perturbation::Left), ..ExportOptions::default() };
        let right = ExportOptions { perturbation: Some(Perturbation::Right), ..ExportOptions::default() };
        for format in [Format::G2o, Format::Gtsam] {
            assert!(format.check(&right).is_ok());
            assert!(format.check(&left).unwrap_err().to_string().contains("right perturbation"));
        }
        assert!(Format::Ros.check(&right).unwrap_err().to_string().contains("fixed axes"));
        let angle = ExportOptions { g2o_rotation: G2oRotation::Angle, ..ExportOptions::default() };
        assert!(Format::G2o.check(&angle).is_ok() && Format::Csv.check(&angle).is_err());
        let bad = ExportOptions { floor: Some([f64::NAN, 0.0]), ..ExportOptions::default() };
        assert!(Format::Ros.check(&bad).is_err());
    }

    #[test]
    fn motions_in_axes_that_turn_are_not_joined() {
        let measured = MeasuredMotions { frame: ErrorFrame::World, ..measured() };
        for (format, joins) in [(Format::Tum, true), (Format::G2o, true), (Format::Gtsam, true), (Format::Ros, false)] {
            let rendered = format.render(&measured, &ExportOptions::default());
            assert_eq!(rendered.is_err_and(|error| error.to_string().contains("axes of the world turn")), joins);
        }
    }

    #[test]
    fn a_floor_lifts_what_lies_below_it_and_nothing_else() {
        let mut measured = measured();
        measured.motions[0].covariance = Covariance6::from_variances(&Tangent::new(0.0, 1.0, 1.0, 0.0, 1.0, 1.0));
        let lifted = measured.motions[0].covariance_on(Perturbation::Left, Some([1e-4, 1e-6])).variance();
        assert_eq!(lifted, Tangent::new(1e-4, 1.0, 1.0, 1e-6, 1.0, 1.0));
    }
}
