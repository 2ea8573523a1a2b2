//! Whose folder is it? A data set claims its folder, keeps its settings there, and removes nothing but
//! its own files.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::settings::SyntheticSettings;
use super::systems::SYSTEMS;
use crate::error::{Error, Result};
use crate::files::{read_text, write_atomically};

/// Date that all drives bear.
const DATE: &str = "2026_01_01";
/// Where the settings of a data set are kept, below its folder.
const MANIFEST: &str = "synthetic.json";
/// Held while a data set is rendered.
const LOCK: &str = "synthetic.lock";
/// Version of what is rendered: other numbers come with other bytes.
const VERSION: u32 = 1;

/// What to do with a folder that holds something else.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Replace {
    /// Leave it and say so.
    Never,
    /// Remove the synthetic data set that is there, and nothing but that.
    Synthetic,
}

/// What a folder holds, beside the data.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Manifest {
    version: u32,
    complete: bool,
    /// [`SyntheticSettings`], of this version or another.
    settings: serde_json::Value,
}

/// A folder that belongs to one data set; locked against a second process.
pub(super) struct Claim {
    root: PathBuf,
    settings: serde_json::Value,
    /// Unlocked when it is closed.
    _lock: File,
}

/// Name of a drive, counted from 1.
pub fn drive_name(drive: usize) -> String {
    format!("{DATE}_drive_{drive:04}_sync")
}

/// Whether a folder holds a rendered data set, whose stated covariances are the true ones.
pub fn is_synthetic(root: &Path) -> bool {
    root.join(MANIFEST).is_file()
}

/// Whether a folder holds the whole data set with these settings.
pub fn is_rendered(root: &Path, settings: &SyntheticSettings) -> bool {
    let manifest = read_text(&root.join(MANIFEST)).ok().and_then(|text| serde_json::from_str::<Manifest>(&text).ok());
    manifest.is_some_and(|found| found.complete && found.version == VERSION && found.settings == as_json(settings))
}

impl Claim {
    /// Claims a folder for a data set; `None` when all of it is there already.
    ///
    /// # Errors
    /// The folder holds something else, another process renders into it, or it cannot be written.
    pub(super) fn stake(root: &Path, settings: &SyntheticSettings, replace: Replace) -> Result<Option<Self>> {
        // A finished data set may be read-only, and many may read it at once.
        if replace == Replace::Never && is_rendered(root, settings) {
            return Ok(None);
        }
        create_folder(root)?;
        let path = root.join(MANIFEST);
        if !path.exists() && !is_empty(root)? {
            return Err(Error::Data(format!(
                "{}: holds files that are no synthetic data set (no {MANIFEST}); choose an empty or new folder",
                root.display()
            )));
        }
        let claim = Self { root: root.to_owned(), settings: as_json(settings), _lock: lock(root)? };
        if !path.exists() {
            claim.write_manifest(false)?;
            return Ok(Some(claim));
        }
        let found: Manifest = serde_json::from_str(&read_text(&path)?).map_err(|error| {
            Error::Data(format!(
                "{}: {error}; expected the settings of a synthetic data set. Remove {} yourself if nothing in it is needed",
                path.display(),
                root.display()
            ))
        })?;
        let same = found.settings == claim.settings && found.version == VERSION;
        match replace {
            // Also what an interrupted replacement has begun.
            _ if same && !found.complete => Ok(Some(claim)),
            Replace::Never if same => Ok(None),
            Replace::Never => Err(Error::Data(format!(
                "{}: holds a synthetic data set with other settings ({}); choose another folder, or replace it with --force",
                root.display(),
                claim.differences(&found)
            ))),
            Replace::Synthetic => {
                // Should this be interrupted, the old data set counts as incomplete.
                write_json(&path, &Manifest { complete: false, ..found })?;
                remove_data(root)?;
                claim.write_manifest(false)?;
                Ok(Some(claim))
            }
        }
    }

    /// Folder of the drives and their calibration.
    pub(super) fn date_folder(&self) -> PathBuf {
        self.root.join(DATE)
    }

    /// Folder of a drive.
    pub(super) fn drive_folder(&self, drive: usize) -> PathBuf {
        self.date_folder().join(drive_name(drive))
    }

    /// File of a system's measurements on a drive.
    pub(super) fn measurements(&self, system: &str, drive: usize) -> PathBuf {
        self.root.join("measurements").join(system).join(format!("{DATE}_drive_{drive:04}.csv"))
    }

    /// Says that everything is there.
    pub(super) fn complete(&self) -> Result<()> {
        self.write_manifest(true)
    }

    fn write_manifest(&self, complete: bool) -> Result<()> {
        write_json(&self.root.join(MANIFEST), &Manifest { version: VERSION, complete, settings: self.settings.clone() })
    }

    /// Which settings of a data set are not the wanted ones.
    fn differences(&self, found: &Manifest) -> String {
        let wanted = self.settings.as_object().expect("settings are a table");
        let differing = wanted.iter().filter(|(key, value)| found.settings.get(key.as_str()) != Some(value));
        let there = |key: &str| found.settings.get(key).map_or("nothing".to_owned(), ToString::to_string);
        let mut list: Vec<String> =
            differing.map(|(key, value)| format!("{key} = {} there, {value} wanted", there(key))).collect();
        if found.version != VERSION {
            list.push(format!("version {} there, {VERSION} wanted", found.version));
        }
        list.join("; ")
    }
}

pub(super) fn create_folder(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))
}

fn as_json(settings: &SyntheticSettings) -> serde_json::Value {
    serde_json::to_value(settings).expect("settings are JSON")
}

fn write_json(path: &Path, manifest: &Manifest) -> Result<()> {
    let json = serde_json::to_string_pretty(manifest).expect("a manifest is JSON");
    write_atomically(path, json.as_bytes())
}

/// Nothing but what a command killed at its very beginning leaves.
fn is_empty(folder: &Path) -> Result<bool> {
    let names = names_in(folder)?;
    Ok(names.iter().all(|name| name == LOCK || name.starts_with(".tmp")))
}

fn names_in(folder: &Path) -> Result<Vec<String>> {
    let entries = std::fs::read_dir(folder).map_err(Error::io("list", folder))?;
    let names = entries.map(|entry| Ok(entry.map_err(Error::io("list", folder))?.file_name()));
    names.map(|name| name.map(|name| name.to_string_lossy().into_owned())).collect()
}

fn lock(root: &Path) -> Result<File> {
    let path = root.join(LOCK);
    let file = File::create(&path).map_err(Error::io("write", &path))?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => Err(Error::Data(format!(
            "{}: another relcov is rendering into this folder; wait for it, then start again",
            root.display()
        ))),
        // File systems without locks are taken as they are.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(file),
    }
}

/// Removes what a data set has written, measurements first: a drive that has them counts as whole.
fn remove_data(root: &Path) -> Result<()> {
    let remove = |path: &Path| match path.is_dir() {
        true => std::fs::remove_dir_all(path).map_err(Error::io("remove", path)),
        false => std::fs::remove_file(path).map_err(Error::io("remove", path)),
    };
    // `2026_01_01_drive_0001` and one of these ends.
    let is_drive = |name: &str, ends: &[&str]| {
        let rest = name.strip_prefix(DATE).and_then(|rest| rest.strip_prefix("_drive_"));
        let numbered =
            |(number, end): (&str, &str)| number.bytes().all(|byte| byte.is_ascii_digit()) && ends.contains(&end);
        rest.and_then(|rest| rest.split_at_checked(4)).is_some_and(numbered)
    };
    let is_ours = |folder: &Path, name: &str| match folder.ends_with(DATE) {
        true => is_drive(name, &["_sync"]) || (name.starts_with("calib_") && name.ends_with(".txt")),
        false => is_drive(name, &[".csv", ".csv.partial"]),
    };
    let measurements = root.join("measurements");
    let systems = SYSTEMS.map(|system| measurements.join(system));
    for folder in systems.iter().chain([&root.join(DATE)]).filter(|folder| folder.is_dir()) {
        for name in names_in(folder)?.iter().filter(|name| is_ours(folder, name)) {
            remove(&folder.join(name))?;
        }
    }
    // Folders in which something else lies stay.
    for folder in systems.iter().chain([&measurements, &root.join(DATE)]) {
        let _ = std::fs::remove_dir(folder);
    }
    Ok(())
}
