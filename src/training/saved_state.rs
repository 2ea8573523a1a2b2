//! The state of a run that is under way, in its folder: weights, optimiser, history. Written whole or not at all.

use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::optim::{ModuleOptimizer, OptimizerRecord};
use burn::store::ModuleRecord;

use super::curves::loss_curves;
use super::history::History;
use super::run_folder::{LOSSES, METRICS, RunFolder, first_line};
use crate::error::{Error, Place, Result};
use crate::files::{read_text, require_readable, settle, temporary_name, write_atomically};
use crate::model::CovarianceModel;

const STATE_PREFIX: &str = "state-";
const STATE_MODEL: &str = "model.bpk";
const STATE_OPTIMISER: &str = "optimiser.bpk";
const STATE_HISTORY: &str = "history.json";
/// Tensors Adam keeps for each weight: first and second moment.
const ADAM_MOMENTS: usize = 2;

impl RunFolder {
    /// Saves everything a resumed run needs, then the tables people read, then drops older states.
    ///
    /// # Errors
    /// It cannot be written; the previous state stays.
    pub fn save_state(
        &self,
        model: &CovarianceModel,
        optimiser: &ModuleOptimizer,
        history: &History,
        systems: &[String],
    ) -> Result<()> {
        // Mini-batches and finished epochs say all there is to know: a state of that name is this one.
        let name = format!("{STATE_PREFIX}{:09}-{:05}", history.batches, history.rows.len());
        self.keep_state(&name, |folder| {
            write_records(folder, model, optimiser)?;
            let json = serde_json::to_string_pretty(history).expect("a history is JSON");
            write_atomically(&folder.join(STATE_HISTORY), json.as_bytes())
        })?;
        write_atomically(&self.path().join(METRICS), history.to_csv(systems).as_bytes())?;
        match loss_curves(history, systems) {
            Some(svg) => write_atomically(&self.path().join(LOSSES), svg.as_bytes()),
            None => Ok(()),
        }
    }

    /// Keeps a state under a name that sorts after those of earlier ones, which are then removed. It is whole before
    /// it bears its name.
    ///
    /// # Errors
    /// It cannot be written; the previous state stays.
    pub(super) fn keep_state(&self, name: &str, write: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
        let folder = self.path().join(name);
        if !folder.exists() {
            let temporary = self.path().join(temporary_name(name));
            if temporary.exists() {
                std::fs::remove_dir_all(&temporary).map_err(Error::io("remove", &temporary))?;
            }
            let written = std::fs::create_dir(&temporary).map_err(Error::io("create the folder", &temporary));
            let written = written
                .and_then(|()| write(&temporary))
                .and_then(|()| std::fs::rename(&temporary, &folder).map_err(Error::io("rename into place", &folder)));
            if let Err(error) = written {
                let _ = std::fs::remove_dir_all(&temporary);
                return Err(error);
            }
            tracing::debug!("saved {}", folder.display());
        }
        let old = self.states()?.into_iter().filter(|state| state != &folder);
        for old in old {
            std::fs::remove_dir_all(&old).map_err(Error::io("remove", &old))?;
        }
        Ok(())
    }

    /// Loads the newest state into a model and an optimiser.
    ///
    /// # Errors
    /// There is none, or it is damaged.
    pub fn load_state(
        &self,
        model: CovarianceModel,
        optimiser: ModuleOptimizer,
        systems: usize,
    ) -> Result<(CovarianceModel, ModuleOptimizer, History)> {
        let Some(folder) = self.states()?.pop() else {
            return Err(Error::run(
                self.path(),
                "holds no saved state; start anew with `relcov train --config … --force`",
            ));
        };
        let path = folder.join(STATE_HISTORY);
        let history: History =
            serde_json::from_str(&read_text(&path)?).map_err(|error| damaged(&folder, STATE_HISTORY, &error))?;
        if history.sums.len() != systems || history.rows.iter().any(|row| row.training_loss.len() != systems) {
            return Err(damaged(&folder, STATE_HISTORY, &"losses of another number of systems"));
        }
        let (model, optimiser) = read_records(&folder, model, optimiser, history.batches)?;
        Ok((model, optimiser, history))
    }

    /// State folders, oldest first.
    pub(super) fn states(&self) -> Result<Vec<PathBuf>> {
        self.folders(|name| {
            let numbers = name.strip_prefix(STATE_PREFIX)?;
            numbers.split('-').all(|number| number.parse::<usize>().is_ok()).then_some(())
        })
    }

    /// Folders in this one whose name is wanted, in order.
    fn folders(&self, wanted: impl Fn(&str) -> Option<()>) -> Result<Vec<PathBuf>> {
        let entries = std::fs::read_dir(self.path()).map_err(Error::io("list", self.path()))?;
        let mut folders: Vec<PathBuf> = entries
            .filter_map(|entry| Some(entry.ok()?.path()))
            .filter(|path| path.is_dir() && path.file_name().and_then(|name| wanted(name.to_str()?)).is_some())
            .collect();
        folders.sort();
        Ok(folders)
    }
}

/// Weights and Adam's moments, on the disk when this returns.
pub(super) fn write_records<M: Module>(folder: &Path, model: &M, optimiser: &ModuleOptimizer) -> Result<()> {
    let failed = |file: &str| {
        let path = folder.join(file);
        move |error: burn::store::RecordError| Error::Io {
            action: "write",
            path,
            reason: std::io::Error::other(error.to_string()),
        }
    };
    model.clone().into_record().save(folder.join(STATE_MODEL)).map_err(failed(STATE_MODEL))?;
    optimiser.to_record().save(folder.join(STATE_OPTIMISER)).map_err(failed(STATE_OPTIMISER))?;
    for file in [STATE_MODEL, STATE_OPTIMISER] {
        settle(&folder.join(file))?;
    }
    Ok(())
}

/// What [`write_records`] wrote after `steps` of the optimiser.
pub(super) fn read_records<M: Module>(
    folder: &Path,
    model: M,
    optimiser: ModuleOptimizer,
    steps: usize,
) -> Result<(M, ModuleOptimizer)> {
    for file in [STATE_MODEL, STATE_OPTIMISER] {
        require_readable(&folder.join(file))?;
    }
    let record = ModuleRecord::load(folder.join(STATE_MODEL)).map_err(|error| damaged(folder, STATE_MODEL, &error))?;
    let weights = record.len();
    let model = model.try_load_record(record).map_err(|error| damaged(folder, STATE_MODEL, &error))?;
    let record = OptimizerRecord::load(folder.join(STATE_OPTIMISER))
        .map_err(|error| damaged(folder, STATE_OPTIMISER, &error))?;
    // Adam keeps nothing of weights that no step has moved: before the first one, and of those that look at images while
    // evidence alone is learned.
    let fits =
        record.len() % ADAM_MOMENTS == 0 && record.len() <= ADAM_MOMENTS * weights && record.is_empty() == (steps == 0);
    if !fits {
        let found = format!("{} tensors for {weights} weights", record.len());
        return Err(damaged(folder, STATE_OPTIMISER, &found));
    }
    Ok((model, optimiser.load_record(record)))
}

pub(super) fn damaged(folder: &Path, file: &str, error: &dyn std::fmt::Display) -> Error {
    let found = first_line(&error.to_string());
    Error::malformed(folder.join(file), Place::Whole, found, "a state saved by this version of relcov")
}
