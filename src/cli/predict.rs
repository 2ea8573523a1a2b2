//! `relcov predict`: covariances of new measurements.

mod inputs;
mod sink;
mod stream;
mod verdicts;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::{ArgGroup, Args, ValueEnum};

use super::progress::{Progress, note};
use super::{FrameArgument, Overrides, SplitArgument, Terminal, synth};
use crate::config::Config;
use crate::depth::{DepthCache, DepthConfig, DepthEstimator, Present, precompute};
use crate::device::{device_name, open_device};
use crate::error::{Error, Result};
use crate::export::{ExportOptions, Format, G2oRotation, MeasuredMotions, Perturbation, Poses, TrajectoryCovariance};
use crate::network::Head;
use crate::pairs::{Dataset, PairScope, Split, SplitName};
use crate::predict::Model;
use crate::recordings::MeasurementFrame;
use crate::systems::measurement_file;
use crate::training::{Manifest, RunFolder};
use inputs::{lenient, of_drive, of_manifest, with_system};
use sink::Sink;
use stream::stream;
use verdicts::describe_verdicts;

/// Arguments of `relcov predict`.
#[derive(Args)]
#[command(group(ArgGroup::new("input").args(["drive", "manifest", "config", "stream"])))]
#[command(after_help = "Examples:
  relcov predict --run checkpoints/kitti --drive kitti/2011_09_30/2011_09_30_drive_0034_sync --measurements vo.txt
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
    run: PathBuf,
    /// A drive in the KITTI raw layout: DATE/DRIVE
    #[arg(long, value_name = "FOLDER", requires = "measurements")]
    drive: Option<PathBuf>,
    /// With --drive: its measured poses
    #[arg(long, value_name = "FILE", requires = "drive", conflicts_with_all = ["manifest", "config", "stream"])]
    measurements: Option<PathBuf>,
    /// With --drive: form of that file [default: relative for .csv, tum for .tum, else kitti]
    #[arg(long, value_enum, requires = "drive", value_name = "FORM", conflicts_with_all = ["manifest", "config", "stream"])]
    measurement_format: Option<MeasurementFormat>,
    /// Whose motion the measurements describe [default: camera0 of a drive, camera2 of a manifest]
    #[arg(long, value_enum, value_name = "BODY", conflicts_with_all = ["config", "stream"])]
    measurement_frame: Option<BodyArgument>,
    /// A pairs manifest (docs/own_data.md)
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// With --manifest: vehicle axes into those of the camera [default: the run's, else the vehicle is where the camera is]
    #[arg(long, value_name = "X,Y,Z,QX,QY,QZ,QW", value_parser = parse_pose, requires = "manifest", allow_hyphen_values = true, conflicts_with_all = ["drive", "config", "stream"])]
    camera_from_vehicle: Option<PoseNumbers>,
    /// The data of another configuration
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Answer JSON lines from stdin on stdout, one by one
    #[arg(long)]
    stream: bool,
    /// Which pairs of a configuration
    #[arg(long, value_enum, default_value = "test", conflicts_with_all = ["drive", "manifest", "stream"])]
    split: SplitArgument,
    /// Only this system's measurements
    #[arg(long, value_name = "NAME", conflicts_with_all = ["drive", "stream"])]
    system: Option<String>,
    /// Form of the output
    #[arg(long, value_enum, default_value = "jsonl", value_name = "FORM")]
    format: Format,
    /// Write to a file instead of stdout; {system} and {drive} stand for their names
    #[arg(long, value_name = "FILE", conflicts_with = "stream")]
    out: Option<PathBuf>,
    /// Write corrected measurements, without the error that the images show and with the covariance of what is left; those
    /// without a verdict as they are. For models with model.head = "posterior"
    #[arg(long)]
    corrected: bool,
    /// Axes of poses and covariances [default: camera for kitti, else the model's]
    #[arg(long, value_enum, value_name = "AXES")]
    frame: Option<FrameArgument>,
    /// Side of the covariances, where the format takes both [default: left]
    #[arg(long, value_enum, value_name = "SIDE")]
    perturbation: Option<Perturbation>,
    /// Least variance, m² and rad²: one number, or two: 1e-6,1e-8 [default: 1e-9 for ros, else none]
    #[arg(long, value_name = "VARIANCE", value_parser = parse_floor)]
    floor: Option<[f64; 2]>,
    /// For tum and kitti: which covariance stands beside the poses
    #[arg(long, value_enum, default_value = "relative", value_name = "WHICH", conflicts_with = "stream")]
    covariance: TrajectoryCovariance,
    /// For g2o: information of half angles, as g2o takes it, or of angles, as the g2o readers of GTSAM and factrs do
    #[arg(long, value_enum, default_value = "half-angle", value_name = "RULE", conflicts_with = "stream")]
    g2o_rotation: G2oRotation,
    #[command(flatten)]
    overrides: Overrides,
}

#[derive(Clone, Copy, ValueEnum)]
enum MeasurementFormat {
    /// Rows of 12 numbers, or 13 with a frame index
    Kitti,
    /// `t x y z qx qy qz qw`
    Tum,
    /// CSV of relative poses
    Relative,
}

#[derive(Clone, Copy, ValueEnum)]
enum BodyArgument {
    Camera0,
    Camera2,
    Vehicle,
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
type PoseNumbers = [f64; 7];

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
    fn options(&self) -> ExportOptions {
        ExportOptions {
            poses: self.poses(),
            perturbation: self.perturbation,
            floor: self.floor,
            trajectory: self.covariance,
            g2o_rotation: self.g2o_rotation,
        }
    }

    fn poses(&self) -> Poses {
        if self.corrected { Poses::Corrected } else { Poses::Measured }
    }

    /// Whether the model can do what is asked for, before any work.
    fn check_model(&self, manifest: &Manifest) -> Result<()> {
        if self.corrected && manifest.architecture.head != Head::Posterior {
            return Err(Error::Data(format!(
                "--corrected: the model of {} does not predict the error itself; train one with model.evidence = \"alignment\" and model.head = \"posterior\", or leave --corrected out",
                self.run.display()
            )));
        }
        Ok(())
    }

    fn changes(&self, key: &str) -> bool {
        self.overrides.set.iter().any(|text| text.trim_start().starts_with(key))
    }
}

pub fn run(arguments: &PredictArguments, terminal: &Terminal) -> anyhow::Result<()> {
    arguments.format.check(&arguments.options())?;
    if arguments.measurement_frame.is_some() && arguments.drive.is_none() && arguments.manifest.is_none() {
        let problem =
            "--measurement-frame is for --drive and --manifest; a configuration says the frame of each system";
        return Err(Error::Data(problem.to_owned()).into());
    }
    arguments.overrides.refuse_model_keys()?;
    let run = RunFolder::open(&arguments.run)?;
    let manifest = run.manifest()?;
    arguments.check_model(&manifest)?;
    let other_data = arguments.stream || arguments.drive.is_some() || arguments.manifest.is_some();
    let config = match other_data {
        true => arguments.overrides.load_for_other_data(&run, &manifest)?,
        false => arguments.overrides.load_for_run(arguments.config.as_deref(), &run, &manifest)?,
    };
    let device = open_device(&config.device)?;
    let model = Model::load(&arguments.run, &device)?;
    if arguments.stream {
        return stream(arguments, &config, &model);
    }
    note(terminal.quiet, &format!("device: {}", device_name(&device)));
    let config = lenient(arguments, config);
    let (config, split) = match (&arguments.drive, &arguments.manifest) {
        (Some(drive), _) => (of_drive(arguments, config, drive)?, SplitName::Test),
        (_, Some(manifest)) => (of_manifest(arguments, config, manifest)?, SplitName::Test),
        (None, None) => {
            synth::make_if_asked(&config, terminal)?;
            (config, arguments.split.name())
        }
    };
    let config = with_system(arguments, config)?;
    make_depth_maps(&config, split, &device, terminal)?;
    let dataset = Dataset::load(&config.pairs(), PairScope::Measured)?;
    let pairs = dataset.require(split)?;
    let owners: BTreeSet<(usize, usize)> = pairs.pairs.iter().map(|pair| (pair.system, pair.id.drive)).collect();
    let names = |&(system, drive): &(usize, usize)| (&*dataset.systems[system], &*dataset.drives[drive].name);
    let sink = Sink::new(arguments, &files_read(arguments, &config, &dataset), owners.iter().map(names))?;
    let frame = arguments.frame.map(FrameArgument::frame).or(arguments.format.usual_frame());
    let frame = frame.unwrap_or(model.error_frame());
    arguments.format.check_frame(frame)?;
    let mut progress = Progress::new(terminal.quiet, "predicting", 0, pairs.pairs.len());
    let begin = std::time::Instant::now();
    let predicted = model.predict_measurements(&config, &dataset, pairs, frame, &mut |done| {
        progress.set(done, &format!("pairs, {:.1} pairs/s", done as f64 / begin.elapsed().as_secs_f64()));
        Ok(())
    })?;
    drop(progress);
    let count: usize = predicted.iter().map(|measured| measured.motions.len()).sum();
    if count == 0 {
        return Err(Error::Data("not one pair could be read; the warnings above say why".to_owned()).into());
    }
    warn_of_missing_times(arguments.format, &predicted, &dataset);
    sink.write(&predicted, terminal)?;
    let rate = count as f64 / begin.elapsed().as_secs_f64();
    let (gaps, verdicts) = (describe_gaps(&dataset, pairs, count), describe_verdicts(&predicted, arguments.poses()));
    note(terminal.quiet, &format!("{count} covariances, {rate:.1} a second{gaps}{verdicts}"));
    Ok(())
}

/// All that predictions are made of.
fn files_read(arguments: &PredictArguments, config: &Config, dataset: &Dataset) -> Vec<PathBuf> {
    let named = [&arguments.measurements, &arguments.manifest, &arguments.config].into_iter().flatten().cloned();
    let measured = dataset.drives.iter().flat_map(|drive| {
        config.systems.iter().filter_map(|system| measurement_file(system, drive, &config.data.root))
    });
    let recorded = dataset.drives.iter().flat_map(|drive| drive.files().map(Path::to_owned));
    named.chain(RunFolder::at(&arguments.run).files()).chain(measured).chain(recorded).collect()
}

/// Says what stands in place of times that are not known, in formats that have them.
fn warn_of_missing_times(format: Format, predicted: &[MeasuredMotions], dataset: &Dataset) {
    let instead = match format {
        Format::Ros => "their stamps are 0",
        Format::Tum => "t is the frame",
        _ => return,
    };
    for MeasuredMotions { drive, motions, .. } in predicted {
        let untimed = motions.iter().filter(|motion| motion.times.is_none()).count();
        let missing = dataset.drives.iter().find(|known| known.name == *drive).map_or("", |drive| drive.layout.times());
        if untimed > 0 {
            let count = motions.len();
            let text = format!("warning: {drive}: {untimed} of {count} motions have no times ({missing}); {instead}");
            note(false, &text);
        }
    }
}

/// Which measurements got no covariance, and why.
fn describe_gaps(dataset: &Dataset, split: &Split, predicted: usize) -> String {
    let of_split = || dataset.coverage.iter().filter(|coverage| coverage.split == split.name);
    let measured: usize = of_split().flat_map(|coverage| &coverage.measured_pairs).sum();
    // Of training drives some pairs may be held out, which lack nothing.
    let lacking = if split.name == SplitName::Test { measured.saturating_sub(split.pairs.len()) } else { 0 };
    let missing = of_split().find_map(|coverage| coverage.missing_depth.as_ref());
    let missing = missing.map_or(String::new(), |path| format!(" (not found: {}, …)", path.display()));
    let unusable = (split.pairs.len() - predicted, "could not be used, as said above".to_owned());
    let gaps = [unusable, (lacking, format!("have no images or no depth{missing}"))];
    gaps.iter().filter(|(pairs, _)| *pairs > 0).map(|(pairs, why)| format!("; {pairs} {why}")).collect()
}

/// Makes the maps that a depth network owes to the pairs, where depth comes from one.
fn make_depth_maps(
    config: &Config,
    split: SplitName,
    device: &burn::tensor::Device,
    terminal: &Terminal,
) -> anyhow::Result<()> {
    let DepthConfig::Monodepth2(network) = &config.depth else { return Ok(()) };
    let without = Config { depth: DepthConfig::default(), ..config.clone() };
    let dataset = Dataset::load(&without.pairs(), PairScope::Measured)?;
    let targets = dataset.require(split)?.pairs.iter().map(|pair| (pair.id.drive, pair.id.target));
    let frames: Vec<_> = targets.collect::<BTreeSet<_>>().into_iter().collect();
    let estimator = DepthEstimator::load(&network.weights, device)?;
    let mut progress: Option<Progress> = None;
    let bad = config.data.max_bad_fraction;
    let summary = precompute(&estimator, network, &dataset.drives, &frames, bad, Present::Keep, &mut |done, total| {
        progress.get_or_insert_with(|| Progress::new(terminal.quiet, "depth", 0, total)).set(done, "frames");
        Ok(())
    })?;
    if summary.made > 0 {
        let folder = DepthCache::of(network).folder().display().to_string();
        note(terminal.quiet, &format!("made {} depth maps in {folder}", summary.made));
    }
    Ok(())
}

impl BodyArgument {
    fn frame(self) -> MeasurementFrame {
        match self {
            Self::Camera0 => MeasurementFrame::Camera0,
            Self::Camera2 => MeasurementFrame::Camera,
            Self::Vehicle => MeasurementFrame::Vehicle,
        }
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
