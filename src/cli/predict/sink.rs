//! Where predictions go: stdout, or files named after their systems and drives.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::arguments::PredictArguments;
use crate::cli::output::make_folder;
use crate::cli::progress::note;
use crate::cli::terminal::{Terminal, print_result};
use crate::error::Error;
use crate::export::{Format, MeasuredMotions};
use crate::files::{fill_template, require_apart, require_no_folder, require_slots, write_atomically};

/// What stands for names in `--out`.
const SLOTS: [&str; 2] = ["{system}", "{drive}"];

/// Where predictions go.
pub(super) struct Sink<'a> {
    arguments: &'a PredictArguments,
}

impl<'a> Sink<'a> {
    /// Finds out before the work whether the trajectories of these systems and drives can be written, and over no file
    /// that is read.
    pub(super) fn new<'b>(
        arguments: &'a PredictArguments,
        read: &[PathBuf],
        trajectories: impl Iterator<Item = (&'b str, &'b str)>,
    ) -> anyhow::Result<Self> {
        let sink = Self { arguments };
        if let Some(out) = &arguments.out {
            require_slots(out, &SLOTS).map_err(|problem| Error::Data(format!("--out {}: {problem}", out.display())))?;
        }
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
        let read: Vec<&Path> = read.iter().map(PathBuf::as_path).collect();
        owners.keys().flatten().try_for_each(|path| {
            require_no_folder(path)?;
            require_apart(path, &read)
        })?;
        // A folder that bears no name of the data can be made before the work.
        let out = arguments.out.as_deref().filter(|out| out.parent().is_some_and(|folder| !is_template(folder)));
        out.map_or(Ok(()), make_folder)?;
        Ok(sink)
    }

    pub(super) fn write(&self, predicted: &[MeasuredMotions], terminal: &Terminal) -> anyhow::Result<()> {
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
        let template = self.arguments.out.as_ref().filter(|out| out.as_os_str() != "-")?;
        Some(fill_template(template, &[("{system}", system), ("{drive}", drive)]))
    }
}

fn is_template(path: &Path) -> bool {
    let text = path.to_string_lossy();
    text.contains("{system}") || text.contains("{drive}")
}
