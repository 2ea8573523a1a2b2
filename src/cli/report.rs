//! `relcov report`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::output::{OutputArguments, make_folder};
use super::progress::note;
use super::terminal::Terminal;
use crate::error::Result;
use crate::files::{require_apart, write_atomically};
use crate::report::{Comparison, Entry, html_page};
use crate::training::RunFolder;

/// Arguments of `relcov report`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov report checkpoints/synthetic
  relcov report checkpoints/synthetic checkpoints/ablation_* --html report.html
  relcov report checkpoints/synthetic --full
  relcov report before.json after.json --intervals --format markdown
  relcov report checkpoints/kitti --save-table table.tex --save-plot figures

A result is a run folder that `relcov eval` has been run on, or a file written by --save-results.")]
pub struct ReportArguments {
    /// Results to set side by side
    #[arg(required = true, value_name = "RUN")]
    results: Vec<PathBuf>,
    /// Write one self-contained page with tables, figures, configurations and conventions
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArguments,
}

pub fn run(arguments: &ReportArguments, terminal: &Terminal) -> anyhow::Result<()> {
    arguments.output.check(arguments.results.len())?;
    let measurements: Vec<PathBuf> = arguments.results.iter().map(|path| path.with_extension("csv")).collect();
    let runs: Vec<PathBuf> = arguments.results.iter().flat_map(|path| RunFolder::at(path).files()).collect();
    let results = arguments.results.iter().chain(&measurements).chain(&runs);
    let read: Vec<&Path> = results.map(PathBuf::as_path).collect();
    arguments.output.require_apart(&read)?;
    arguments.html.as_deref().map_or(Ok(()), |html| require_apart(html, &read))?;
    arguments.html.as_deref().map(make_folder).transpose()?;
    let entries = arguments.results.iter().map(|path| Entry::load(path)).collect::<Result<Vec<_>>>()?;
    let comparison = Comparison::new(entries)?;
    arguments.output.deliver(&comparison, terminal)?;
    if let Some(path) = &arguments.html {
        write_atomically(path, html_page(&comparison)?.as_bytes())?;
        note(terminal.quiet, &format!("wrote {}", path.display()));
    }
    Ok(())
}
