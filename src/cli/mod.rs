//! The command line: arguments, their meaning, progress and exit codes. The only room that prints.
//!
//! Results go to stdout, progress and logs to stderr. Exit codes: 0 fine, 1 failed, 2 usage, 130 interrupted.

mod choices;
mod depth;
mod doctor;
mod eval;
mod exit_codes;
mod fuse;
mod init;
mod inspect;
mod manifest;
mod manual;
mod output;
mod overrides;
mod predict;
mod progress;
mod report;
mod synth;
mod terminal;
mod train;
mod train_depth;
mod version;

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::PathBuf;

use clap::{CommandFactory, Parser, Subcommand};

use crate::error::Error;
use exit_codes::{FAILED, FINE, INTERRUPTED, USAGE};
use terminal::{Terminal, print_result};

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
    /// List the pairs of recordings in any layout as a manifest
    Manifest(manifest::ManifestArguments),
    /// Make the depth maps of an experiment by a network, or judge any depth against LiDAR
    Depth(depth::DepthArguments),
    /// Train a depth network on images and the true motion between them
    TrainDepth(train_depth::TrainDepthArguments),
    /// Compare results: tables, figures, one page
    Report(report::ReportArguments),
    /// Render a synthetic street world in the KITTI raw layout, with systems of known covariance
    Synth(synth::SynthArguments),
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
        (None, _, Some(shell), _) => {
            return print_result(&manual::completions(shell, Arguments::command())).map(|()| FINE);
        }
        (None, .., Some(folder)) => return manual::write_pages(&folder, Arguments::command()).map(|()| FINE),
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
        Command::Manifest(arguments) => manifest::run(&arguments, &terminal),
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
