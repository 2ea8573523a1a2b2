//! Lists of files by time, as TUM RGB-D recordings have them: `timestamp filename` a line.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::error::{Error, Place, Result, excerpt};
use crate::files::{read_text, rows};
use crate::time::{EXPECTED_SECONDS, Time};

/// A line of a list.
pub(super) struct TimedFile {
    pub(super) time: Time,
    pub(super) path: PathBuf,
}

/// A list that was read.
pub(super) struct TimeList {
    /// In order of time.
    pub(super) files: Vec<TimedFile>,
    /// Those that are there.
    present: BTreeSet<PathBuf>,
    path: PathBuf,
    /// Line of the first that is not.
    first_absent: Option<usize>,
}

impl TimeList {
    /// Reads a list and looks which of its files are there; their paths are below the list's folder.
    ///
    /// # Errors
    /// Names the line: no time and name, a time that is none in seconds or not after the one before. Or there is no line.
    pub(super) fn load(path: &Path) -> Result<Self> {
        let text = read_text(path)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut list = Self { files: Vec::new(), present: BTreeSet::new(), path: path.to_owned(), first_absent: None };
        let mut folders = FolderContents::default();
        for (place, line) in rows(&text) {
            let malformed = |found: String, expected: &str| Error::malformed(path, place.clone(), found, expected);
            let Some((word, name)) = line.trim().split_once(char::is_whitespace) else {
                return Err(malformed(excerpt(line.trim()), "a time in seconds and the name of a file"));
            };
            let time = Time::parse_seconds(word)
                .ok_or_else(|| malformed(format!("time {}", excerpt(word)), EXPECTED_SECONDS))?;
            if let Some(last) = list.files.last().map(|file| file.time).filter(|last| time <= *last) {
                return Err(malformed(format!("time {time} after {last}"), "increasing times"));
            }
            let file = folder.join(name.trim());
            if folders.hold(&file) {
                list.present.insert(file.clone());
            } else if let (None, Place::Line(line)) = (list.first_absent, &place) {
                list.first_absent = Some(*line);
            }
            list.files.push(TimedFile { time, path: file });
        }
        match list.files.is_empty() {
            true => {
                Err(Error::malformed(path, Place::Whole, "no row", "a time in seconds and the name of a file a line"))
            }
            false => Ok(list),
        }
    }

    /// First and last time.
    pub(super) fn span(&self) -> Option<[Time; 2]> {
        Some([self.files.first()?.time, self.files.last()?.time])
    }

    /// Whether a file of the list is there.
    pub(super) fn is_present(&self, file: &TimedFile) -> bool {
        self.present.contains(&file.path)
    }

    /// How many files are not there, and where the list names the first of them; `what` they are.
    pub(super) fn absent(&self, what: &str) -> Option<String> {
        let absent = self.files.len() - self.present.len();
        let line = self.first_absent?;
        let (path, all) = (self.path.display(), self.files.len());
        Some(format!("{path}: {absent} of its {all} {what} are not there, the first on line {line}"))
    }
}

/// What folders hold: each is looked through once, however many files a list names.
#[derive(Default)]
struct FolderContents {
    looked_through: BTreeSet<PathBuf>,
    files: BTreeSet<PathBuf>,
}

impl FolderContents {
    fn hold(&mut self, file: &Path) -> bool {
        let folder = file.parent().unwrap_or(Path::new(""));
        if self.looked_through.insert(folder.to_owned()) {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
            self.files.extend(entries.map(|entry| folder.join(entry.file_name())));
        }
        self.files.contains(file)
    }
}
