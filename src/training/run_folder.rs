//! The run folder: configuration, manifest, best model, losses, and the state a resumed run needs.
//!
//! ```text
//! checkpoints/NAME/
//!   config.toml         the effective configuration
//!   manifest.json       versions, conventions, architecture, data fingerprint, baselines
//!   metrics.csv         one row an epoch
//!   losses.svg          the same as a picture
//!   model.safetensors   weights of the best epoch
//!   recalibration.json  factors on its variances, fitted to the validation split
//!   state-B-E/          after B mini-batches and E epochs: weights, optimiser, history (the newest only)
//! ```
//!
//! Everything is written under a temporary name and renamed: whatever bears its final name is whole.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use burn::store::{ModuleSnapshot, SafetensorsStore};
use burn::tensor::Device;

use super::lock::Lock;
use super::manifest::{LAYOUT, Manifest};
use crate::config::Config;
use crate::error::{Error, Place, Result, shortened};
use crate::evaluation::Recalibration;
use crate::files::{put_in_place, read_text, remove_partial, require_readable, temporary_name, write_atomically};
use crate::geometry::Conventions;
use crate::model::{Architecture, CovarianceModel};

const CONFIG: &str = "config.toml";
const MANIFEST: &str = "manifest.json";
pub(super) const METRICS: &str = "metrics.csv";
/// The losses of a run as a picture.
pub const LOSSES: &str = "losses.svg";
const MODEL: &str = "model.safetensors";
/// What is not whole after that time never will be.
const LONGEST_SAVE: Duration = Duration::from_secs(600);
/// What an evaluation leaves in the folder: its scores.
pub const EVALUATION: &str = "evaluation.json";
/// The measurements behind it.
pub const PAIRS: &str = "pairs.csv";
/// Folder of its figures.
pub const FIGURES: &str = "figures";
const RECALIBRATION: &str = "recalibration.json";
/// What belongs to one state of the model, and not to the next.
const RESULTS: [&str; 3] = [EVALUATION, PAIRS, RECALIBRATION];

/// A run folder on disk.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
    /// Held as long as this process writes a run.
    lock: Option<Arc<Lock>>,
}

impl RunFolder {
    /// Makes sure that a folder holds no run yet.
    ///
    /// # Errors
    /// It does, or it cannot be read.
    pub fn require_free(path: &Path) -> Result<()> {
        match Self::at(path).is_taken()? {
            false => Ok(()),
            true => Err(Error::run(
                path,
                "already holds a run; continue it with --resume, choose another --set name=…, or replace it with --force",
            )),
        }
    }

    fn is_taken(&self) -> Result<bool> {
        Ok(self.path.is_dir()
            && (self.path.join(MANIFEST).exists() || self.path.join(MODEL).exists() || !self.states()?.is_empty()))
    }

    /// A folder as it is, whatever it holds.
    pub fn at(path: &Path) -> Self {
        Self { path: path.to_owned(), lock: None }
    }

    /// The folder for whoever is to write a run there: nobody else does, and what killed processes left is removed.
    ///
    /// # Errors
    /// Somebody holds it, or what was left cannot be removed.
    pub fn owned(mut self) -> Result<Self> {
        self.lock = Lock::take(&self.path)?.map(Arc::new);
        remove_partial(&self.path, Duration::ZERO)?;
        Ok(self)
    }

    /// Starts a run in a folder that holds none, or replaces the one it holds.
    ///
    /// # Errors
    /// The folder holds a run and `replace` is false, or it cannot be written.
    pub fn create(path: &Path, replace: bool) -> Result<Self> {
        if !replace {
            Self::require_free(path)?;
        }
        std::fs::create_dir_all(path).map_err(Error::io("create the folder", path))?;
        let run = Self::at(path).owned()?;
        if !replace {
            // Somebody may have trained there meanwhile.
            Self::require_free(path)?;
        } else if run.is_taken()? {
            run.clear()?;
        }
        Ok(run)
    }

    /// Opens a folder that holds a run.
    ///
    /// # Errors
    /// There is no run.
    pub fn open(path: &Path) -> Result<Self> {
        if !path.is_dir() {
            return Err(Error::run(path, "no such folder; `relcov train` makes run folders below `checkpoints`"));
        }
        if !path.join(MANIFEST).is_file() {
            return Err(Error::run(
                path,
                format!("holds no {MANIFEST}, so no run was started here; expected a folder made by `relcov train`"),
            ));
        }
        let run = Self::at(path);
        // Where it cannot be removed, it does no harm.
        let _ = remove_partial(path, LONGEST_SAVE);
        Ok(run)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The files of a run and its results, there or not: nothing else is to be written over them.
    pub fn files(&self) -> Vec<PathBuf> {
        let names = [CONFIG, MANIFEST, METRICS, LOSSES, MODEL, EVALUATION, PAIRS, RECALIBRATION];
        names.map(|name| self.path.join(name)).into()
    }

    /// Path of the effective configuration.
    pub fn config_path(&self) -> PathBuf {
        self.path.join(CONFIG)
    }

    /// Writes the effective configuration.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_config(&self, config: &Config) -> Result<()> {
        write_atomically(&self.config_path(), config.to_toml().as_bytes())
    }

    /// Writes the manifest, once in a run.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_manifest(&self, manifest: &Manifest) -> Result<()> {
        let json = serde_json::to_string_pretty(manifest).expect("a manifest is JSON");
        write_atomically(&self.path.join(MANIFEST), json.as_bytes())
    }

    /// Reads the manifest and checks that this program can use it.
    ///
    /// # Errors
    /// It is unreadable, of another layout, or made under other conventions.
    pub fn manifest(&self) -> Result<Manifest> {
        let path = self.path.join(MANIFEST);
        let manifest: Manifest = serde_json::from_str(&read_text(&path)?).map_err(|error| {
            Error::malformed(&path, Place::Whole, shortened(&error.to_string()), "the manifest of a relcov run")
        })?;
        if manifest.layout != LAYOUT {
            let problem = format!(
                "has layout {} and this program (relcov {}) reads {LAYOUT}; use relcov {}",
                manifest.layout,
                env!("CARGO_PKG_VERSION"),
                manifest.relcov_version
            );
            return Err(Error::run(&self.path, problem));
        }
        let ours = Conventions::new(manifest.conventions.error_frame);
        if manifest.conventions != ours {
            return Err(Error::run(
                &self.path,
                format!(
                    "was made under other conventions: {}; this program uses {}",
                    json(&manifest.conventions),
                    json(&ours)
                ),
            ));
        }
        Ok(manifest)
    }

    /// Saves the best model so far.
    ///
    /// # Errors
    /// It cannot be written; the previous one stays.
    pub fn save_model(&self, model: &CovarianceModel) -> Result<()> {
        let path = self.path.join(MODEL);
        let temporary = self.path.join(temporary_name(MODEL));
        let mut store = SafetensorsStore::from_file(&temporary).overwrite(true);
        model.save_into(&mut store).map_err(|error| {
            let _ = std::fs::remove_file(&temporary);
            Error::Io { action: "write", path: path.clone(), reason: std::io::Error::other(error.to_string()) }
        })?;
        put_in_place(&temporary, &path)?;
        // Results of an earlier model are not this one's.
        self.remove_results()
    }

    fn remove_results(&self) -> Result<()> {
        self.remove_figures()?;
        let files = RESULTS.map(|file| self.path.join(file));
        files.iter().filter(|path| path.exists()).try_for_each(|path| remove(path))
    }

    /// Removes the figures of an evaluation, and their folder if nothing else is in it.
    ///
    /// # Errors
    /// One cannot be removed.
    pub fn remove_figures(&self) -> Result<()> {
        let folder = self.path.join(FIGURES);
        let Ok(entries) = std::fs::read_dir(&folder) else { return Ok(()) };
        for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
            if path.extension().is_some_and(|extension| extension == "svg" || extension == "png") {
                remove(&path)?;
            }
        }
        // Not empty: someone keeps other files there.
        let _ = std::fs::remove_dir(&folder);
        Ok(())
    }

    /// Loads the best model onto a device.
    ///
    /// # Errors
    /// There is none yet, it is damaged, or it does not have the manifest's shape.
    pub fn load_model(&self, manifest: &Manifest, device: &Device) -> Result<CovarianceModel> {
        let path = self.path.join(MODEL);
        if !path.is_file() {
            return Err(Error::run(
                &self.path,
                format!(
                    "holds no {MODEL} yet: the first epoch was not finished; continue with `relcov train --resume`"
                ),
            ));
        }
        require_readable(&path)?;
        let mut model = manifest.architecture.init(manifest.initial_log_variance, device);
        let expected = || {
            let Architecture { width, height, pair, pose, head, network, evidence, .. } = &manifest.architecture;
            let channels = manifest.architecture.channels();
            format!(
                "weights for {width}x{height}, {channels} channels, network {network:?}, evidence {evidence:?}, pair {pair:?}, pose {pose:?}, head {head:?}, as manifest.json says"
            )
        };
        // Runs of earlier versions have c1…c5 in the network itself.
        let mut store =
            SafetensorsStore::from_file(&path).with_key_remapping(r"^network\.(c[1-5])\.", "network.convolutions.$1.");
        let applied = model
            .load_from(&mut store)
            .map_err(|error| Error::malformed(&path, Place::Whole, first_line(&error.to_string()), expected()))?;
        if !applied.is_success() {
            return Err(Error::malformed(&path, Place::Whole, first_line(&applied.to_string()), expected()));
        }
        Ok(model)
    }

    /// Keeps the factors that make the best model's variances right.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn write_recalibration(&self, recalibration: &Recalibration) -> Result<()> {
        let json = serde_json::to_string_pretty(recalibration).expect("a recalibration is JSON");
        write_atomically(&self.path.join(RECALIBRATION), json.as_bytes())
    }

    /// Those factors; `None` where none were fitted.
    ///
    /// # Errors
    /// They are unreadable, or no factors.
    pub fn recalibration(&self) -> Result<Option<Recalibration>> {
        let path = self.path.join(RECALIBRATION);
        if !path.exists() {
            return Ok(None);
        }
        let expected = "six factors between 1e-6 and 1e6; `relcov eval --recalibrate` fits them anew";
        let recalibration: Recalibration = serde_json::from_str(&read_text(&path)?).map_err(|error| {
            Error::malformed(&path, Place::Line(error.line()), shortened(&error.to_string()), expected)
        })?;
        if !recalibration.is_usable() {
            let found = format!("{:?}", recalibration.factors);
            return Err(Error::malformed(&path, Place::Field("factors".to_owned()), found, expected));
        }
        Ok(Some(recalibration))
    }

    /// Removes what a run wrote, and nothing else; the manifest last, so that a run stays one until
    /// nothing is left of it.
    fn clear(&self) -> Result<()> {
        for folder in self.states()? {
            std::fs::remove_dir_all(&folder).map_err(Error::io("remove", &folder))?;
        }
        self.remove_results()?;
        for file in [METRICS, LOSSES, MODEL, CONFIG, MANIFEST] {
            let path = self.path.join(file);
            if path.exists() {
                remove(&path)?;
            }
        }
        Ok(())
    }
}

fn remove(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        // Somebody else was quicker.
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        removed => removed.map_err(Error::io("remove", path)),
    }
}

fn json(conventions: &Conventions) -> String {
    serde_json::to_string(conventions).expect("conventions are JSON")
}

pub(super) fn first_line(text: &str) -> String {
    text.lines().find(|line| !line.trim().is_empty()).unwrap_or("nothing").trim().to_owned()
}
