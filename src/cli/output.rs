//! Where results go: the table on stdout, and files on request.

use std::path::{Path, PathBuf};

use clap::Args;

use super::progress::note;
use super::terminal::{Terminal, print_result};
use crate::error::{Error, Result};
use crate::evaluation::write_pairs;
use crate::files::{extension, require_apart, write_atomically};
use crate::report::{Comparison, Detail, Intervals, TableFormat, figures, render_results};

/// How much of a result is shown.
#[derive(Args)]
pub struct DetailArgument {
    /// Show every table: CRPS, calibration, true σ, separation of systems
    #[arg(long)]
    full: bool,
}

impl DetailArgument {
    pub fn detail(&self) -> Detail {
        if self.full { Detail::Full } else { Detail::Short }
    }
}

/// Arguments of results.
#[derive(Args)]
pub struct OutputArguments {
    /// Form of the table on stdout
    #[arg(long, value_enum, default_value = "text", value_name = "FORM")]
    format: TableFormat,
    #[command(flatten)]
    detail: DetailArgument,
    /// Show block-bootstrap intervals
    #[arg(long)]
    intervals: bool,
    /// Write the table to a file: .txt, .md, .csv or .tex
    #[arg(long, value_name = "FILE")]
    save_table: Option<PathBuf>,
    /// Write all figures into a folder, as SVG and PNG
    #[arg(long, value_name = "FOLDER")]
    save_plot: Option<PathBuf>,
    /// Write scores to a .json file and the measurements behind them to a .csv beside it
    #[arg(long, value_name = "FILE")]
    save_results: Option<PathBuf>,
}

impl OutputArguments {
    /// Finds out before the work whether its results, so many, can be written.
    pub fn check(&self, results: usize) -> Result<()> {
        if self.save_results.is_some() && results != 1 {
            return Err(Error::Data(format!("--save-results takes one result, not {results}")));
        }
        if let Some(path) = &self.save_table {
            table_format(path)?;
        }
        if let Some(path) = &self.save_results
            && extension(path) != "json"
        {
            return Err(Error::Data(format!("--save-results {}: the file's name must end in .json", path.display())));
        }
        if let (Some(table), Some(results)) = (&self.save_table, &self.save_results)
            && *table == results.with_extension("csv")
        {
            let problem = "--save-results writes its measurements there; name the table otherwise";
            return Err(Error::Data(format!("--save-table {}: {problem}", table.display())));
        }
        [&self.save_table, &self.save_results].into_iter().flatten().try_for_each(|path| make_folder(path))?;
        if let Some(folder) = &self.save_plot {
            std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
        }
        Ok(())
    }

    /// That nothing that is read is written over.
    ///
    /// # Errors
    /// Something would be.
    pub fn require_apart(&self, read: &[&Path]) -> Result<()> {
        self.written().try_for_each(|path| require_apart(&path, read))
    }

    /// Whether a file that will be written is there already.
    pub fn replaces(&self) -> bool {
        self.written().any(|path| path.exists())
    }

    fn written(&self) -> impl Iterator<Item = PathBuf> {
        let results = self.save_results.iter().flat_map(|path| [path.clone(), path.with_extension("csv")]);
        results.chain(self.save_table.clone())
    }

    /// Prints the table and writes what was asked for. The table first: a folder that cannot be written must
    /// not cost it.
    pub fn deliver(&self, comparison: &Comparison, terminal: &Terminal) -> anyhow::Result<()> {
        let intervals = if self.intervals { Intervals::Shown } else { Intervals::Hidden };
        let detail = self.detail.detail();
        print_result(&render_results(comparison, self.format, intervals, detail))?;
        comparison.warnings.iter().for_each(|warning| note(false, &format!("warning: {warning}")));
        let wrote = |path: &Path| note(terminal.quiet, &format!("wrote {}", path.display()));
        if let Some(path) = &self.save_table {
            let table = render_results(comparison, table_format(path)?, intervals, detail);
            write_atomically(path, table.as_bytes())?;
            wrote(path);
        }
        if let Some(path) = &self.save_results {
            let [entry] = comparison.entries.as_slice() else { unreachable!("checked before") };
            entry.evaluation.write(path)?;
            write_pairs(&path.with_extension("csv"), &entry.table)?;
            wrote(path);
        }
        if let Some(folder) = &self.save_plot {
            let count = figures::write_figures(comparison, folder)?;
            note(terminal.quiet, &format!("wrote {count} figures into {}", folder.display()));
        }
        Ok(())
    }
}

/// That a picture is called one, and so is no other file of the user's.
///
/// # Errors
/// It is not.
pub fn require_png(path: &Path) -> Result<()> {
    match extension(path).as_str() {
        "png" => Ok(()),
        _ => Err(Error::Data(format!("--contact-sheet {}: the file's name must end in .png", path.display()))),
    }
}

/// Makes the folder of a file that is yet to be written.
pub fn make_folder(path: &Path) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))
}

fn table_format(path: &Path) -> Result<TableFormat> {
    TableFormat::of_extension(&extension(path)).ok_or_else(|| {
        Error::Data(format!("--save-table {}: the file's name must end in .txt, .md, .csv or .tex", path.display()))
    })
}
