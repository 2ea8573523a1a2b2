//! Arguments of `relcov predict`.

use std::path::PathBuf;

use clap::{ArgGroup, Args, ValueEnum};

use crate::cli::choices::{FrameArgument, SplitArgument};
use crate::cli::overrides::Overrides;
use crate::error::{Error, Result};
use crate::export::{ExportOptions, Format, G2oRotation, Perturbation, Poses, TrajectoryCovariance};
use crate::network::Head;
use crate::recordings::MeasurementFrame;
use crate::training::Manifest;

/// Arguments of `relcov predict`.
#[derive(Args)]
#[command(group(ArgGroup::new("input").args(["drive", "manifest", "config", "stream"])))]
#[command(after_help = "Examples:
  relcov predict --run checkpoints/kitti --drive kitti/2011_09_30/2011_09_30_drive_0034_sync --measurements vo.txt
  relcov predict --run checkpoints/redkitchen --drive rgbd/redkitchen --measurements vo.tum
  relcov predict --run checkpoints/robot --manifest pairs.csv --format g2o --out 'graphs/{drive}.g2o'
  relcov predict --run checkpoints/robot --manifest pairs.csv --format ros --floor 1e-6 --frame camera
  relcov predict --run checkpoints/synthetic --out 'predictions/{system}/{drive}.csv'
  relcov predict --run checkpoints/robot --manifest pairs.csv --corrected --format gtsam --out '{drive}.csv'
  robot | relcov predict --run checkpoints/robot --stream | filter

Without --drive, --manifest, --config or --stream: the measurements of the run's own configuration.
Models with model.head = posterior say what the images show of the error itself, mean μ and covariance C of the rest:
jsonl and --stream give both beside the measurement, --corrected writes exp(-μ) T with C in any format.
Formats, their order, side and units, and the fields of a stream: docs/predict.md.")]
pub struct PredictArguments {
    /// Run folder of a trained model
    #[arg(long, value_name = "RUN")]
    pub(super) run: PathBuf,
    /// A recording: the folder DATE/DRIVE of KITTI raw, sequences/NN of KITTI odometry, or that of TUM RGB-D or EuRoC
    #[arg(long, value_name = "FOLDER", requires = "measurements")]
    pub(super) drive: Option<PathBuf>,
    /// With --drive: its measured poses
    #[arg(long, value_name = "FILE", requires = "drive", conflicts_with_all = ["manifest", "config", "stream"])]
    pub(super) measurements: Option<PathBuf>,
    /// With --drive: form of that file [default: relative for .csv, tum for .tum and for recordings of TUM RGB-D and EuRoC, else kitti]
    #[arg(long, value_enum, requires = "drive", value_name = "FORM", conflicts_with_all = ["manifest", "config", "stream"])]
    pub(super) measurement_format: Option<MeasurementFormat>,
    /// Whose motion the measurements describe [default: camera0 of a drive, camera2 of a manifest]
    #[arg(long, value_enum, value_name = "BODY", conflicts_with_all = ["config", "stream"])]
    pub(super) measurement_frame: Option<BodyArgument>,
    /// A pairs manifest (docs/own_data.md)
    #[arg(long, value_name = "FILE")]
    pub(super) manifest: Option<PathBuf>,
    /// With --manifest: vehicle axes into those of the camera [default: the run's, else the vehicle is where the camera is]
    #[arg(long, value_name = "X,Y,Z,QX,QY,QZ,QW", value_parser = parse_pose, requires = "manifest", allow_hyphen_values = true, conflicts_with_all = ["drive", "config", "stream"])]
    pub(super) camera_from_vehicle: Option<PoseNumbers>,
    /// The data of another configuration
    #[arg(long, value_name = "FILE")]
    pub(super) config: Option<PathBuf>,
    /// Answer JSON lines from stdin on stdout, one by one
    #[arg(long)]
    pub(super) stream: bool,
    /// Which pairs of a configuration
    #[arg(long, value_enum, default_value = "test", conflicts_with_all = ["drive", "manifest", "stream"])]
    pub(super) split: SplitArgument,
    /// Only this system's measurements
    #[arg(long, value_name = "NAME", conflicts_with_all = ["drive", "stream"])]
    pub(super) system: Option<String>,
    /// Form of the output
    #[arg(long, value_enum, default_value = "jsonl", value_name = "FORM")]
    pub(super) format: Format,
    /// Write to a file instead of stdout; {system} and {drive} stand for their names
    #[arg(long, value_name = "FILE", conflicts_with = "stream")]
    pub(super) out: Option<PathBuf>,
    /// Write corrected measurements, without the error that the images show and with the covariance of what is left; those
    /// without a verdict as they are. For models with model.head = "posterior"
    #[arg(long)]
    pub(super) corrected: bool,
    /// Axes of poses and covariances [default: camera for kitti, else the model's]
    #[arg(long, value_enum, value_name = "AXES")]
    pub(super) frame: Option<FrameArgument>,
    /// Side of the covariances, where the format takes both [default: left]
    #[arg(long, value_enum, value_name = "SIDE")]
    pub(super) perturbation: Option<Perturbation>,
    /// Least variance, m² and rad²: one number, or two: 1e-6,1e-8 [default: 1e-9 for ros, else none]
    #[arg(long, value_name = "VARIANCE", value_parser = parse_floor)]
    pub(super) floor: Option<[f64; 2]>,
    /// For tum and kitti: which covariance stands beside the poses
    #[arg(long, value_enum, default_value = "relative", value_name = "WHICH", conflicts_with = "stream")]
    pub(super) covariance: TrajectoryCovariance,
    /// For g2o: information of half angles, as g2o takes it, or of angles, as the g2o readers of GTSAM and factrs do
    #[arg(long, value_enum, default_value = "half-angle", value_name = "RULE", conflicts_with = "stream")]
    g2o_rotation: G2oRotation,
    #[command(flatten)]
    pub(super) overrides: Overrides,
}

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum MeasurementFormat {
    /// Rows of 12 numbers, or 13 with a frame index
    Kitti,
    /// `t x y z qx qy qz qw`
    Tum,
    /// CSV of relative poses
    Relative,
}

#[derive(Clone, Copy, ValueEnum)]
pub(super) enum BodyArgument {
    Camera0,
    Camera2,
    Vehicle,
}

impl BodyArgument {
    pub(super) fn frame(self) -> MeasurementFrame {
        match self {
            Self::Camera0 => MeasurementFrame::Camera0,
            Self::Camera2 => MeasurementFrame::Camera,
            Self::Vehicle => MeasurementFrame::Vehicle,
        }
    }
}

fn parse_floor(text: &str) -> Result<[f64; 2], String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|word| word.trim().parse().ok()).collect();
    let problem = || format!("`{text}` is no variance; write one number, or two: 1e-6,1e-8");
    match *numbers.ok_or_else(problem)?.as_slice() {
        [both] => Ok([both; 2]),
        [translation, rotation] => Ok([translation, rotation]),
        _ => Err(problem()),
    }
}

/// `x y z qx qy qz qw`.
pub(super) type PoseNumbers = [f64; 7];

fn parse_pose(text: &str) -> Result<PoseNumbers, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|word| word.trim().parse().ok()).collect();
    let pose: Option<PoseNumbers> = numbers.and_then(|numbers| numbers.try_into().ok());
    let unit = |[_, _, _, quaternion @ ..]: &PoseNumbers| {
        (quaternion.iter().map(|value| value * value).sum::<f64>().sqrt() - 1.0).abs() < 1e-2
    };
    let usable = pose.filter(|pose| pose.iter().all(|value| value.abs() < 1e6) && unit(pose));
    usable
        .ok_or_else(|| format!("`{text}` is no pose; write x,y,z,qx,qy,qz,qw in metres with a quaternion of length 1"))
}

impl PredictArguments {
    pub(super) fn options(&self) -> ExportOptions {
        ExportOptions {
            poses: self.poses(),
            perturbation: self.perturbation,
            floor: self.floor,
            trajectory: self.covariance,
            g2o_rotation: self.g2o_rotation,
        }
    }

    pub(super) fn poses(&self) -> Poses {
        if self.corrected { Poses::Corrected } else { Poses::Measured }
    }

    /// Whether the model can do what is asked for, before any work.
    pub(super) fn check_model(&self, manifest: &Manifest) -> Result<()> {
        if self.corrected && manifest.architecture.head != Head::Posterior {
            return Err(Error::Data(format!(
                "--corrected: the model of {} does not predict the error itself; train one with model.evidence = \"alignment\" and model.head = \"posterior\", or leave --corrected out",
                self.run.display()
            )));
        }
        Ok(())
    }

    /// Whether a key, or one of a table's, is set.
    pub(super) fn changes(&self, key: &str) -> bool {
        let key_of = |text: &String| text.split('=').next().unwrap_or_default().trim().to_owned();
        let of_table = |set: &str| set.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        self.overrides.set.iter().any(|text| of_table(&key_of(text)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_floor_is_one_number_or_two() {
        assert_eq!(parse_floor("1e-6"), Ok([1e-6; 2]));
        assert_eq!(parse_floor("1e-4, 1e-6"), Ok([1e-4, 1e-6]));
        assert!(parse_floor("small").unwrap_err().contains("`small`") && parse_floor("1,2,3").is_err());
    }
}
