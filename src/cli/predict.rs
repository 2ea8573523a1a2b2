//! `relcov predict`: covariances of new measurements.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufRead, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{ArgGroup, Args, ValueEnum};

use super::output::make_folder;
use super::progress::{Progress, note};
use super::{FrameArgument, Overrides, SplitArgument, Terminal, print_result, synth};
use crate::config::{
    Config, DataConfig, DepthConfig, DriveConfig, MeasurementFrame, RelativeConfig, SystemConfig, SystemSource,
    TrajectoryConfig, TrajectoryFormat, TruthConfig,
};
use crate::data::{Dataset, Manifest, PairScope, SplitName};
use crate::depth::{DepthCache, DepthEstimator, Present, precompute};
use crate::device::{device_name, open_device};
use crate::error::{Error, Result};
use crate::export::{ExportOptions, Format, G2oRotation, MeasuredMotions, Perturbation, TrajectoryCovariance};
use crate::files::{require_no_folder, write_atomically};
use crate::predict::{Model, Stream, StreamSettings};
use crate::training::RunFolder;

/// Longest request of a stream: two images of some 20 megapixels in base64.
const LONGEST_REQUEST_BYTES: usize = 64 << 20;

/// Arguments of `relcov predict`.
#[derive(Args)]
#[command(group(ArgGroup::new("input").args(["drive", "manifest", "config", "stream"])))]
#[command(after_help = "Examples:
  relcov predict --run checkpoints/kitti --drive kitti/2011_09_30/2011_09_30_drive_0034_sync --measurements vo.txt
  relcov predict --run checkpoints/robot --manifest pairs.csv --format g2o --out 'graphs/{drive}.g2o'
  relcov predict --run checkpoints/robot --manifest pairs.csv --format ros --floor 1e-6 --frame camera
  relcov predict --run checkpoints/synthetic --out 'predictions/{system}/{drive}.csv'
  robot | relcov predict --run checkpoints/robot --stream | filter

Without --drive, --manifest, --config or --stream: the measurements of the run's own configuration.
Formats, their order, side and units, and the fields of a stream: docs/predict.md.")]
pub struct PredictArguments {
    /// Run folder of a trained model
    #[arg(long, value_name = "RUN")]
    run: PathBuf,
    /// A drive in the KITTI raw layout: DATE/DRIVE
    #[arg(long, value_name = "FOLDER", requires = "measurements")]
    drive: Option<PathBuf>,
    /// With --drive: its measured poses
    #[arg(long, value_name = "FILE", requires = "drive")]
    measurements: Option<PathBuf>,
    /// With --drive: form of that file [default: relative for .csv, tum for .tum, else kitti]
    #[arg(long, value_enum, requires = "drive", value_name = "FORM")]
    measurement_format: Option<MeasurementFormat>,
    /// Whose motion the measurements describe [default: camera0 of a drive, camera2 of a manifest]
    #[arg(long, value_enum, value_name = "BODY", conflicts_with_all = ["config", "stream"])]
    measurement_frame: Option<BodyArgument>,
    /// A pairs manifest (docs/own_data.md)
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
    /// With --manifest: vehicle axes into those of the camera [default: the run's, else the vehicle is where the camera is]
    #[arg(long, value_name = "X,Y,Z,QX,QY,QZ,QW", value_parser = parse_pose, requires = "manifest", allow_hyphen_values = true)]
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
            perturbation: self.perturbation,
            floor: self.floor,
            trajectory: self.covariance,
            g2o_rotation: self.g2o_rotation,
        }
    }

    fn changes(&self, key: &str) -> bool {
        self.overrides.set.iter().any(|text| text.trim_start().starts_with(key))
    }
}

pub fn run(arguments: &PredictArguments, terminal: &Terminal) -> anyhow::Result<()> {
    arguments.format.check(&arguments.options())?;
    arguments.overrides.refuse_model_keys()?;
    let run = RunFolder::open(&arguments.run)?;
    let manifest = run.manifest()?;
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
    let dataset = Dataset::load(&config, PairScope::Measured)?;
    let pairs = dataset.require(split)?;
    let owners: BTreeSet<(usize, usize)> = pairs.pairs.iter().map(|pair| (pair.system, pair.id.drive)).collect();
    let names = |&(system, drive): &(usize, usize)| (&*dataset.systems[system], &*dataset.drives[drive].name);
    let sink = Sink::new(arguments, owners.iter().map(names))?;
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
    sink.write(&predicted, terminal)?;
    let of_split = dataset.coverage.iter().filter(|coverage| coverage.split == split);
    let measured: usize = of_split.flat_map(|coverage| &coverage.measured_pairs).sum();
    let mut left_out = String::new();
    for (pairs, why) in [
        (pairs.pairs.len() - count, "could not be read"),
        (measured.saturating_sub(pairs.pairs.len()), "have no images or no depth"),
    ] {
        if pairs > 0 {
            left_out += &format!("; {pairs} {why}");
        }
    }
    let rate = count as f64 / begin.elapsed().as_secs_f64();
    note(terminal.quiet, &format!("{count} covariances, {rate:.1} a second{left_out}"));
    Ok(())
}

/// The measurements of one drive.
fn of_drive(arguments: &PredictArguments, config: Config, drive: &Path) -> anyhow::Result<Config> {
    let path = arguments.measurements.as_deref().expect("clap requires it");
    if !path.is_file() {
        return Err(Error::Data(format!("--measurements {}: no such file", path.display())).into());
    }
    let folder = drive.canonicalize().map_err(Error::io("read", drive))?;
    let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let root = folder.parent().and_then(Path::parent).context("--drive: expected a folder ROOT/DATE/DRIVE")?;
    let path = path.canonicalize().map_err(Error::io("read", path))?;
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
    let form = arguments.measurement_format.unwrap_or(match extension {
        "csv" => MeasurementFormat::Relative,
        "tum" => MeasurementFormat::Tum,
        _ => MeasurementFormat::Kitti,
    });
    let frame = arguments.measurement_frame.map_or(MeasurementFrame::Camera0, BodyArgument::frame);
    let file = path.display().to_string();
    let trajectory = |format| SystemSource::Trajectory(TrajectoryConfig { path: file.clone(), format, frame });
    let source = match form {
        MeasurementFormat::Kitti => trajectory(TrajectoryFormat::Kitti),
        MeasurementFormat::Tum => trajectory(TrajectoryFormat::Tum),
        MeasurementFormat::Relative => SystemSource::Relative(RelativeConfig { path: file.clone(), frame }),
    };
    let system = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Config {
        data: only_test(&config.data, root.to_owned(), None, None, vec![DriveConfig { drive: name, frames: None }]),
        truth: TruthConfig::Oxts,
        systems: vec![SystemConfig { name: system, share: 1.0, source }],
        ..config
    })
}

/// All measurements of a manifest.
fn of_manifest(arguments: &PredictArguments, config: Config, path: &Path) -> anyhow::Result<Config> {
    let manifest = Manifest::load(path)?;
    let frame = arguments.measurement_frame.map_or(MeasurementFrame::Camera2, BodyArgument::frame);
    let system =
        |name: &str| SystemConfig { name: name.to_owned(), share: 1.0, source: SystemSource::Manifest { frame } };
    let drives = manifest.sequences().map(|name| DriveConfig { drive: name.to_owned(), frames: None });
    let data =
        only_test(&config.data, PathBuf::new(), Some(path.to_owned()), arguments.camera_from_vehicle, drives.collect());
    let depth = match &config.depth {
        _ if arguments.changes("depth.") => config.depth.clone(),
        _ if manifest.has_depth() => DepthConfig::Manifest {},
        DepthConfig::GroundPlane { .. } | DepthConfig::Monodepth2(_) => config.depth.clone(),
        DepthConfig::Lidar { .. } | DepthConfig::Files { .. } | DepthConfig::Manifest {} => {
            return Err(Error::malformed(
                path,
                crate::error::Place::Field("depth".to_owned()),
                "rows without a depth map",
                "one for each target frame, as the model was trained with; or --set depth.source=ground_plane, or a depth network (docs/depth.md)",
            )
            .into());
        }
    };
    let systems = manifest.systems().into_iter().map(system).collect();
    Ok(Config { data, depth, truth: TruthConfig::Manifest { frame }, systems, ..config })
}

/// The data of a configuration replaced by drives to predict for.
fn only_test(
    data: &DataConfig,
    root: PathBuf,
    manifest: Option<PathBuf>,
    camera_from_vehicle: Option<PoseNumbers>,
    test: Vec<DriveConfig>,
) -> DataConfig {
    let camera_from_vehicle = camera_from_vehicle.or(data.camera_from_vehicle).filter(|_| manifest.is_some());
    DataConfig {
        root,
        manifest,
        camera_from_vehicle,
        synthetic: None,
        train: Vec::new(),
        validation: Vec::new(),
        test,
        ..data.clone()
    }
}

/// A prediction that cannot be made is no reason to withhold the others.
fn lenient(arguments: &PredictArguments, mut config: Config) -> Config {
    if !arguments.changes("data.max_bad_fraction") {
        config.data.max_bad_fraction = 1.0;
    }
    config
}

/// One system alone, where it was asked for.
fn with_system(arguments: &PredictArguments, mut config: Config) -> Result<Config> {
    let Some(name) = &arguments.system else { return Ok(config) };
    let known: Vec<String> = config.systems.iter().map(|system| system.name.clone()).collect();
    config.systems.retain(|system| system.name == *name);
    if config.systems.is_empty() {
        return Err(Error::Data(format!("--system {name}: the data have {}", known.join(", "))));
    }
    Ok(config)
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
    let dataset = Dataset::load(&without, PairScope::Measured)?;
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

/// Where predictions go.
struct Sink<'a> {
    arguments: &'a PredictArguments,
}

impl<'a> Sink<'a> {
    /// Finds out before the work whether the trajectories of these systems and drives can be written.
    fn new<'b>(
        arguments: &'a PredictArguments,
        trajectories: impl Iterator<Item = (&'b str, &'b str)>,
    ) -> anyhow::Result<Self> {
        let sink = Self { arguments };
        let mut owners: BTreeMap<Option<PathBuf>, usize> = BTreeMap::new();
        trajectories.for_each(|(system, drive)| *owners.entry(sink.path(system, drive)).or_default() += 1);
        let format = arguments.format;
        if let Some(several) = owners.values().find(|&&owners| owners > 1 && !format.is_labelled()) {
            return Err(Error::Data(format!(
                "--format {} holds one system and one drive, and there are {several} of them for one output; give --out 'FOLDER/{{system}}/{{drive}}.{}', choose with --system, or take jsonl",
                format.name(),
                if format == Format::Ros { "jsonl" } else { format.name() }
            ))
            .into());
        }
        owners.keys().flatten().try_for_each(|path| require_no_folder(path))?;
        // A folder that bears no name of the data can be made before the work.
        let out = arguments.out.as_deref().filter(|out| out.parent().is_some_and(|folder| !is_template(folder)));
        out.map_or(Ok(()), make_folder)?;
        Ok(sink)
    }

    fn write(&self, predicted: &[MeasuredMotions], terminal: &Terminal) -> anyhow::Result<()> {
        let (format, options) = (self.arguments.format, self.arguments.options());
        let mut files: BTreeMap<Option<PathBuf>, String> = BTreeMap::new();
        for measured in predicted {
            let text = format.render(measured, &options)?;
            *files.entry(self.path(&measured.system, &measured.drive)).or_default() += &text;
        }
        for (path, text) in files {
            let Some(path) = path else {
                print_result(&text)?;
                continue;
            };
            make_folder(&path)?;
            write_atomically(&path, text.as_bytes())?;
            note(terminal.quiet, &format!("wrote {}", path.display()));
        }
        Ok(())
    }

    /// Where one system's predictions on one drive go; `None`: to stdout.
    fn path(&self, system: &str, drive: &str) -> Option<PathBuf> {
        let template = self.arguments.out.as_ref()?.display().to_string();
        Some(template.replace("{system}", system).replace("{drive}", drive).into())
    }
}

fn is_template(path: &Path) -> bool {
    let text = path.to_string_lossy();
    text.contains("{system}") || text.contains("{drive}")
}

/// Answers requests until stdin ends, or nobody listens any more.
fn stream(arguments: &PredictArguments, config: &Config, model: &Model) -> anyhow::Result<()> {
    if arguments.format != Format::Jsonl {
        return Err(Error::Data("--stream answers in JSON lines; leave --format out".to_owned()).into());
    }
    let settings = StreamSettings {
        depth: Some(config.depth.clone()),
        frame: arguments.frame.map(FrameArgument::frame),
        perturbation: arguments.perturbation,
        floor: arguments.floor,
    };
    let stream = Stream::new(model, &settings)?;
    let (mut requests, mut answers) = (io::stdin().lock(), io::stdout().lock());
    let mut line = Vec::new();
    loop {
        let answer = match read_request(&mut requests, &mut line).context("cannot read stdin")? {
            Request::End => return Ok(()),
            Request::Line if line.iter().all(u8::is_ascii_whitespace) => continue,
            Request::Line => match std::str::from_utf8(&line) {
                Ok(text) => stream.answer(text),
                Err(error) => Stream::refuse(&format!("not UTF-8: {error}")),
            },
            Request::TooLong => Stream::refuse(&format!(
                "a line of more than {} MiB; send paths, or smaller images",
                LONGEST_REQUEST_BYTES >> 20
            )),
        };
        match writeln!(answers, "{answer}").and_then(|()| answers.flush()) {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
            written => written.context("cannot write to stdout")?,
        }
    }
}

enum Request {
    Line,
    TooLong,
    End,
}

/// Reads up to a line end; what is longer than a request may be is passed over, so that memory stays bounded.
fn read_request(input: &mut impl BufRead, line: &mut Vec<u8>) -> io::Result<Request> {
    line.clear();
    line.shrink_to(1 << 20);
    let mut too_long = false;
    loop {
        let available = input.fill_buf()?;
        if available.is_empty() {
            return Ok(match (line.is_empty(), too_long) {
                (_, true) => Request::TooLong,
                (true, false) => Request::End,
                (false, false) => Request::Line,
            });
        }
        let end = available.iter().position(|&byte| byte == b'\n');
        let part = &available[..end.unwrap_or(available.len())];
        too_long |= line.len() + part.len() > LONGEST_REQUEST_BYTES;
        if too_long {
            line.clear();
        } else {
            line.extend_from_slice(part);
        }
        let taken = part.len() + usize::from(end.is_some());
        input.consume(taken);
        if end.is_some() {
            return Ok(if too_long { Request::TooLong } else { Request::Line });
        }
    }
}

impl BodyArgument {
    fn frame(self) -> MeasurementFrame {
        match self {
            Self::Camera0 => MeasurementFrame::Camera0,
            Self::Camera2 => MeasurementFrame::Camera2,
            Self::Vehicle => MeasurementFrame::Vehicle,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_lines_and_long_ones_are_passed_over() {
        let long = vec![b'x'; LONGEST_REQUEST_BYTES + 1];
        let bytes = [b"first\n".as_slice(), &long, b"\nlast"].concat();
        let mut input = io::BufReader::with_capacity(4096, bytes.as_slice());
        let mut line = Vec::new();
        let mut next = || (read_request(&mut input, &mut line).unwrap(), line.clone());
        assert!(matches!(next(), (Request::Line, text) if text == b"first"));
        assert!(matches!(next(), (Request::TooLong, _)));
        assert!(matches!(next(), (Request::Line, text) if text == b"last"));
        assert!(matches!(next(), (Request::End, _)));
    }

    #[test]
    fn a_floor_is_one_number_or_two() {
        assert_eq!(parse_floor("1e-6"), Ok([1e-6; 2]));
        assert_eq!(parse_floor("1e-4, 1e-6"), Ok([1e-4, 1e-6]));
        assert!(parse_floor("small").unwrap_err().contains("`small`") && parse_floor("1,2,3").is_err());
    }
}
