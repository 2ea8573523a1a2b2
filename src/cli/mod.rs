//! The command line: arguments, their meaning, progress and exit codes. The only room that prints.
//!
//! Results go to stdout, progress and logs to stderr. Exit codes: 0 fine, 1 failed, 2 usage, 130 interrupted.

mod depth;
mod doctor;
mod eval;
mod fuse;
mod init;
mod inspect;
mod manual;
mod output;
mod predict;
mod progress;
mod report;
mod synth;
mod train;
mod train_depth;
mod version;

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};

use crate::config::Config;
use crate::device::DEVICE_NAMES;
use crate::error::Error;
use crate::geometry::ErrorFrame;
use crate::model::{MinLogVariance, ModelConfig};
use crate::pairs::SplitName;
use crate::training::{Manifest, RunFolder};

/// Exit codes.
const FINE: u8 = 0;
const FAILED: u8 = 1;
const USAGE: u8 = 2;
/// After Ctrl-C, as shells expect it.
const INTERRUPTED: u8 = 130;

#[derive(Parser)]
#[command(name = "relcov", about = "Error bars for any relative-pose measurement", long_about = None)]
#[command(arg_required_else_help = true, disable_version_flag = true)]
#[command(after_help = "First steps:
  relcov doctor                                     does it work on this machine?
  relcov init .                                     sample configurations, where there are none yet
  relcov train --config configs/synthetic.toml      renders a world, trains on it, prints the table

Examples:
  relcov inspect --config configs/kitti_sample.toml
  relcov eval --run checkpoints/synthetic --full
  relcov report checkpoints/synthetic --html report.html
  relcov predict --run checkpoints/synthetic --manifest pairs.csv --format jsonl --out predictions.jsonl
  relcov fuse --odometry vo=vo.csv --odometry wheel=wheel.csv --fixes gnss.csv --out fused.tum")]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    /// Print version, features, instructions and devices
    #[arg(short = 'V', long, exclusive = true)]
    version: bool,
    /// Print a shell's completions
    #[arg(long, value_name = "SHELL", value_enum, exclusive = true)]
    completions: Option<clap_complete::Shell>,
    /// Write man pages into a folder
    #[arg(long, value_name = "DIR", exclusive = true)]
    man_pages: Option<PathBuf>,
    /// More messages (-v: steps, -vv: everything)
    #[arg(short, long, action = clap::ArgAction::Count, global = true)]
    verbose: u8,
    /// No progress, only warnings and errors
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
}

#[derive(Subcommand)]
enum Command {
    /// Write the sample configurations into a folder
    Init(init::InitArguments),
    /// Check that everything works on this machine, and say what to do where it does not
    Doctor(doctor::DoctorArguments),
    /// Train a covariance model and print the MDE table of its test split
    Train(train::TrainArguments),
    /// Judge predicted covariances: MDE table, proper scores, calibration, figures
    Eval(eval::EvalArguments),
    /// Covariances of new measurements, in the form that the next program reads
    Predict(predict::PredictArguments),
    /// Fuse several systems and absolute fixes to one trajectory, weighted by their covariances
    Fuse(fuse::FuseArguments),
    /// Show what a configuration finds: drives, frames, pairs, systems, depth, problems
    Inspect(inspect::InspectArguments),
    /// Make the depth maps of an experiment by a network, or judge any depth against LiDAR
    Depth(depth::DepthArguments),
    /// Train a depth network on images and the true motion between them
    TrainDepth(train_depth::TrainDepthArguments),
    /// Compare results: tables, figures, one page
    Report(report::ReportArguments),
    /// Render a synthetic street world in the KITTI raw layout, with systems of known covariance
    Synth(synth::SynthArguments),
}

/// Arguments that change a configuration.
#[derive(Args)]
struct Overrides {
    /// Override a configuration key (TOML value or plain text); repeatable
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[arg(long, value_name = "DEVICE", help = format!("Where to compute: {DEVICE_NAMES} [default: the configuration's, else auto]"))]
    device: Option<String>,
}

impl Overrides {
    fn load(&self, path: &Path) -> Result<Config, Error> {
        let mut config = Config::load(path, &self.set)?;
        if let Some(device) = &self.device {
            config.device.clone_from(device);
        }
        Ok(config)
    }

    /// That they leave the shape of a trained model alone.
    fn refuse_model_keys(&self) -> Result<(), Error> {
        match self.set.iter().find(|key| key.trim_start().starts_with("model.")) {
            Some(key) => Err(Error::config(key, "a trained model keeps its shape; train another run for another one")),
            None => Ok(()),
        }
    }

    /// The configuration of data for a trained model: another one's, or that of its run. The data may be another
    /// configuration's; the model is the run's.
    ///
    /// # Errors
    /// As [`Config::load`], or errors are in other axes than the model's covariances.
    fn load_for_run(&self, config: Option<&Path>, run: &RunFolder, manifest: &Manifest) -> Result<Config, Error> {
        fit_to_run(self.load(config.unwrap_or(&run.config_path()))?, manifest)
    }

    /// The configuration of a run, for data that will take the place of its own.
    ///
    /// # Errors
    /// A key is set that those data replace.
    fn load_for_other_data(&self, run: &RunFolder, manifest: &Manifest) -> Result<Config, Error> {
        let key = |text: &str| text.split('=').next().unwrap_or_default().trim().to_owned();
        let counts = |key: &String| KEYS_FOR_OTHER_DATA.iter().any(|prefix| key.starts_with(prefix));
        if let Some(key) = self.set.iter().map(|text| key(text)).find(|key| !counts(key)) {
            let problem = "changes nothing about --drive, --manifest or --stream; leave it out";
            return Err(Error::config(key, problem));
        }
        let mut config = Config::load_for_other_data(&run.config_path(), &self.set)?;
        if let Some(device) = &self.device {
            config.device.clone_from(device);
        }
        fit_to_run(config, manifest)
    }
}

/// Keys of a run's configuration that count where other data take the place of its own: how depth is made, and how it is
/// read and predicted.
const KEYS_FOR_OTHER_DATA: [&str; 11] = [
    "depth",
    "device",
    "data.camera_from_vehicle",
    "data.max_bad_fraction",
    "data.cache_mb",
    "training.batch",
    "training.micro_batch",
    "training.loader_threads",
    "training.prefetch",
    "model",
    "checkpoints",
];

/// Gives a configuration the shape of a trained model.
fn fit_to_run(mut config: Config, manifest: &Manifest) -> Result<Config, Error> {
    let architecture = &manifest.architecture;
    config.model = ModelConfig {
        width: architecture.width,
        height: architecture.height,
        pair: architecture.pair,
        input: architecture.input,
        validity_mask: architecture.validity_mask,
        stereo: architecture.stereo,
        pose: architecture.pose,
        evidence: architecture.evidence,
        network: architecture.network,
        head: architecture.head,
        dropout: architecture.dropout,
        min_log_variance: architecture.log_variance_floor.map_or(MinLogVariance::Off, MinLogVariance::Absolute),
    };
    let (found, trained) = (config.data.error_frame, manifest.conventions.error_frame);
    if found == trained {
        return Ok(config);
    }
    let (found, trained) = (found.name(), trained.name());
    Err(Error::config(
        "data.error_frame",
        format!(
            "`{found}` is not the `{trained}` this model was trained for; covariances of a diagonal model cannot be compared across frames"
        ),
    ))
}

/// A role of pairs.
#[derive(Clone, Copy, ValueEnum)]
enum SplitArgument {
    Train,
    Validation,
    Test,
}

impl SplitArgument {
    fn name(self) -> SplitName {
        match self {
            Self::Train => SplitName::Train,
            Self::Validation => SplitName::Validation,
            Self::Test => SplitName::Test,
        }
    }
}

/// Axes of errors and covariances.
#[derive(Clone, Copy, ValueEnum)]
enum FrameArgument {
    Vehicle,
    Camera,
    World,
}

impl FrameArgument {
    fn frame(self) -> ErrorFrame {
        match self {
            Self::Vehicle => ErrorFrame::Vehicle,
            Self::Camera => ErrorFrame::Camera,
            Self::World => ErrorFrame::World,
        }
    }
}

/// What every command needs to know of its surroundings.
struct Terminal {
    quiet: bool,
}

/// Runs the program with the arguments of its process; its exit code.
pub fn run() -> u8 {
    run_with(std::env::args_os())
}

/// Runs the program with these arguments, the first being its name; its exit code.
pub fn run_with(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let arguments = match Arguments::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(error) => {
            // As if printed, when it cannot be.
            let _ = error.print();
            return if error.use_stderr() { USAGE } else { FINE };
        }
    };
    start_log(arguments.verbose, arguments.quiet);
    match dispatch(arguments) {
        Ok(code) => code,
        Err(error) if matches!(error.downcast_ref(), Some(Error::Interrupted)) => INTERRUPTED,
        Err(error) => {
            progress::note(false, &format!("error: {error:#}"));
            FAILED
        }
    }
}

fn dispatch(arguments: Arguments) -> anyhow::Result<u8> {
    let terminal = Terminal { quiet: arguments.quiet };
    let command = match (arguments.command, arguments.version, arguments.completions, arguments.man_pages) {
        (Some(command), false, None, None) => command,
        (None, true, ..) => return print_result(&version::describe()).map(|()| FINE),
        (None, _, Some(shell), _) => return print_result(&manual::completions(shell)).map(|()| FINE),
        (None, .., Some(folder)) => return manual::write_pages(&folder).map(|()| FINE),
        (None, false, None, None) => {
            progress::note(false, &Arguments::command().render_help().to_string());
            return Ok(USAGE);
        }
        (Some(_), ..) => {
            progress::note(false, "error: --version, --completions and --man-pages stand alone, without a command");
            return Ok(USAGE);
        }
    };
    match command {
        Command::Init(arguments) => init::run(&arguments, &terminal),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Train(arguments) => train::run(arguments, &terminal),
        Command::Eval(arguments) => eval::run(arguments, &terminal),
        Command::Predict(arguments) => predict::run(&arguments, &terminal),
        Command::Fuse(arguments) => fuse::run(&arguments, &terminal),
        Command::Inspect(arguments) => inspect::run(&arguments),
        Command::Depth(arguments) => depth::run(&arguments, &terminal),
        Command::TrainDepth(arguments) => train_depth::run(&arguments, &terminal),
        Command::Report(arguments) => report::run(&arguments, &terminal),
        Command::Synth(arguments) => synth::run(&arguments, &terminal),
    }
    .map(|()| FINE)
}

fn start_log(verbose: u8, quiet: bool) {
    let level = match (quiet, verbose) {
        (true, _) => "error,relcov=warn",
        (_, 0) => "error,relcov=warn",
        (_, 1) => "warn,relcov=debug",
        _ => "info,relcov=trace",
    };
    let colours = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let log = tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| level.into()))
        .with_writer(progress::LogWriter::default)
        .with_ansi(colours)
        .with_target(false)
        .without_time()
        .finish();
    // Whoever calls the command line from a program of theirs may have a log already.
    let _ = tracing::subscriber::set_global_default(log);
}

/// Writes a result to stdout; a reader that went away (`| head`) is no failure.
fn print_result(text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}
