//! Lists of files by time, as the recordings of TUM RGB-D and EuRoC have them: a time and the name of a file a line.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ffi::OsString;
use std::fs::DirEntry;
use std::path::{Path, PathBuf};

use super::association::Association;
use super::recording::FrameFiles;
use crate::error::{Error, Place, Result, excerpt};
use crate::files::{read_text, rows};
use crate::time::Time;

/// How a layout writes its lists.
pub(super) struct ListForm {
    /// Whether a character stands between time and name.
    pub(super) separates: fn(char) -> bool,
    pub(super) parse_time: fn(&str) -> Option<Time>,
    /// What its times look like, for messages.
    pub(super) expected_time: &'static str,
    /// What a line holds, for messages.
    pub(super) expected_line: &'static str,
    /// Where the files are below the folder of the list.
    pub(super) folder: &'static str,
}

/// A line of a list.
struct TimedFile {
    time: Time,
    path: PathBuf,
    is_there: bool,
}

/// A list that was read.
pub(super) struct TimeList {
    /// In order of time.
    files: Vec<TimedFile>,
    path: PathBuf,
    /// Line of the first that is not there.
    first_absent: Option<usize>,
}

impl TimeList {
    /// Reads a list and looks which of its files are there; their paths are below the list's folder.
    ///
    /// # Errors
    /// Names the line: no time and name, a time in another unit or not after the one before. Or there is no line.
    pub(super) fn load(path: &Path, form: &ListForm) -> Result<Self> {
        let text = read_text(path)?;
        let folder = path.parent().unwrap_or(Path::new("")).join(form.folder);
        let mut list = Self { files: Vec::new(), path: path.to_owned(), first_absent: None };
        let mut folders = FolderContents::default();
        let mut names = HashSet::new();
        for (place, line) in rows(&text) {
            let malformed = |found: String, expected: &str| Error::malformed(path, place.clone(), found, expected);
            let Some((word, name)) = line.trim().split_once(form.separates) else {
                return Err(malformed(excerpt(line.trim()), form.expected_line));
            };
            let time = (form.parse_time)(word.trim())
                .ok_or_else(|| malformed(format!("time {}", excerpt(word)), form.expected_time))?;
            if let Some(last) = list.files.last().map(|file| file.time).filter(|last| time <= *last) {
                return Err(malformed(format!("time {time} after {last}"), "increasing times"));
            }
            let path = folder.join(name.trim());
            if !names.insert(path.clone()) {
                return Err(malformed(format!("{} again", excerpt(name.trim())), "each file once"));
            }
            let is_there = folders.hold(&path);
            if let (false, None, Place::Line(line)) = (is_there, list.first_absent, &place) {
                list.first_absent = Some(*line);
            }
            list.files.push(TimedFile { time, path, is_there });
        }
        match list.files.is_empty() {
            true => Err(Error::malformed(path, Place::Whole, "no row", format!("lines of {}", form.expected_line))),
            false => Ok(list),
        }
    }

    /// That no file stands in another list too.
    ///
    /// # Errors
    /// One does: one of the lists is another's.
    pub(super) fn require_others(&self, other: &Self) -> Result<()> {
        let known: HashSet<&Path> = other.files.iter().map(|file| file.path.as_path()).collect();
        match self.files.iter().find(|file| known.contains(file.path.as_path())) {
            None => Ok(()),
            Some(file) => {
                let (path, other) = (file.path.display(), other.path.display());
                let expected = format!("files that {other} does not list");
                Err(Error::malformed(&self.path, Place::Whole, path.to_string(), expected))
            }
        }
    }

    /// First and last time.
    fn span(&self) -> Option<[Time; 2]> {
        Some([self.files.first()?.time, self.files.last()?.time])
    }

    /// Its files that are there, each a frame by its place in the list.
    ///
    /// # Errors
    /// Not one is there.
    pub(super) fn frames(&self) -> Result<FrameFiles> {
        let present = self.files.iter().enumerate().filter(|(_, file)| file.is_there);
        let frames: FrameFiles = present.map(|(frame, file)| (frame, file.path.clone())).collect();
        match frames.is_empty() {
            false => Ok(frames),
            true => {
                let first = self.files.first().map_or(String::new(), |file| file.path.display().to_string());
                let found = format!("{} images, none of which is there, the first {first}", self.files.len());
                Err(Error::malformed(&self.path, Place::Whole, found, "names of files below its folder"))
            }
        }
    }

    /// Times of those frames.
    pub(super) fn times(&self) -> BTreeMap<usize, Time> {
        self.files.iter().map(|file| file.time).enumerate().collect()
    }

    /// The file nearest in time to each frame of another sensor; `what` they are. What is not there, and what is of no
    /// frame, is counted in remarks.
    ///
    /// # Errors
    /// Not one is near to a frame: another clock.
    pub(super) fn nearest_to(
        &self,
        times: &BTreeMap<usize, Time>,
        limit_s: f64,
        what: &str,
        remarks: &mut Vec<String>,
    ) -> Result<FrameFiles> {
        remarks.extend(self.absent(what));
        let mut nearest = Association::new(times, limit_s);
        self.files.iter().enumerate().for_each(|(index, file)| nearest.offer(file.time, index));
        let span = nearest.span();
        let nearest = nearest.into_nearest();
        let (Some([first, last]), Some([begin, end])) = (self.span(), span) else { return Ok(FrameFiles::new()) };
        if nearest.is_empty() {
            let expected = format!("times of images, {begin} to {end}, to {limit_s} s: those of one clock");
            let found = format!("{} {what}, {first} to {last} s", self.files.len());
            return Err(Error::malformed(&self.path, Place::Whole, found, expected));
        }
        let alone = self.files.len() - nearest.len();
        if alone > 0 {
            let (path, all) = (self.path.display(), self.files.len());
            remarks.push(format!(
                "{path}: {alone} of its {all} {what} are of no image: none is nearer than {limit_s} s, or another one is nearer to it"
            ));
        }
        let files = nearest.into_iter().map(|(frame, index)| (frame, &self.files[index]));
        Ok(files.filter(|(_, file)| file.is_there).map(|(frame, file)| (frame, file.path.clone())).collect())
    }

    /// How many files are not there, and where the list names the first of them; `what` they are.
    pub(super) fn absent(&self, what: &str) -> Option<String> {
        let absent = self.files.iter().filter(|file| !file.is_there).count();
        let line = self.first_absent?;
        let (path, all) = (self.path.display(), self.files.len());
        Some(format!("{path}: {absent} of its {all} {what} are not there, the first on line {line}"))
    }
}

/// What folders hold: each is looked through once, however many files a list names.
#[derive(Default)]
struct FolderContents(HashMap<PathBuf, HashSet<OsString>>);

impl FolderContents {
    fn hold(&mut self, file: &Path) -> bool {
        let (folder, name) = (file.parent().unwrap_or(Path::new("")), file.file_name());
        if !self.0.contains_key(folder) {
            let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
            // A link may lead nowhere, and a folder is no file.
            let is_file = |entry: &DirEntry| match entry.file_type() {
                Ok(kind) if kind.is_symlink() => entry.path().is_file(),
                kind => kind.is_ok_and(|kind| kind.is_file()),
            };
            self.0.insert(folder.to_owned(), entries.filter(is_file).map(|entry| entry.file_name()).collect());
        }
        name.is_some_and(|name| self.0[folder].contains(name))
    }
}
