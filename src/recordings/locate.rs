//! Where recordings of each layout lie, and which lies in a folder.

use std::path::{Path, PathBuf};

use super::DATA_ROOT_VARIABLE;
use super::kitti_raw::date_of;
use super::layout::Layout;
use crate::error::{Error, Result};

/// Names that a message lists at most.
const MOST_NAMES: usize = 8;

/// The layouts that are told apart by their folders; a manifest is named by its file.
const LAYOUTS: [Layout; 4] = [Layout::KittiRaw, Layout::KittiOdometry, Layout::TumRgbd, Layout::Euroc];

impl Layout {
    /// Folder of a recording of that name below a root, where the name can be one of this layout.
    fn folder(self, root: &Path, name: &str) -> Option<PathBuf> {
        match self {
            Self::KittiRaw => date_of(name).map(|date| root.join(date).join(name)),
            Self::KittiOdometry => Some(root.join("sequences").join(name)),
            Self::TumRgbd | Self::Euroc => Some(root.join(name)),
            Self::Manifest => None,
        }
    }

    /// The layout itself, where there is a folder for a recording of that name.
    ///
    /// # Errors
    /// There is none.
    pub(super) fn require_folder(self, root: &Path, name: &str) -> Result<Self> {
        match self.folder(root, name).is_none_or(|folder| folder.is_dir()) {
            true => Ok(self),
            false => Err(nothing_there(root, name)),
        }
    }

    /// The recording of this layout in a folder.
    fn locate(self, folder: &Path) -> Option<Located> {
        let name = folder.file_name()?.to_str()?.to_owned();
        let above = if matches!(self, Self::KittiRaw | Self::KittiOdometry) { folder.parent()? } else { folder };
        let root = above.parent()?.to_owned();
        let is_there = self.folder(&root, &name).as_deref() == Some(folder) && self.fits(folder);
        is_there.then_some(Located { root, name, layout: self })
    }

    /// Whether something of this layout is in a folder, complete or not.
    fn fits(self, folder: &Path) -> bool {
        match self {
            Self::KittiRaw => {
                ["image_02", "image_03", "oxts", "velodyne_points"].iter().any(|part| folder.join(part).is_dir())
            }
            Self::KittiOdometry => folder.is_dir(),
            Self::TumRgbd => ["rgb.txt", "rgb", "depth.txt"].iter().any(|part| folder.join(part).exists()),
            Self::Euroc => folder.join("mav0").is_dir(),
            Self::Manifest => false,
        }
    }
}

/// Where a recording is, by its folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Located {
    /// The folder that `data.root` would name.
    pub(crate) root: PathBuf,
    /// Its name there.
    pub(crate) name: String,
    /// Its layout.
    pub(crate) layout: Layout,
}

impl Located {
    /// Whether it brings depth maps of its own.
    pub(crate) fn brings_depth(&self) -> bool {
        self.layout == Layout::TumRgbd && self.root.join(&self.name).join("depth.txt").is_file()
    }
}

/// Finds what recording lies in a folder: by the folder's name as it is called, for a link has its own; by what it leads
/// to where that is no recording.
///
/// # Errors
/// It is no recording, or could be several.
pub(crate) fn locate_recording(folder: &Path) -> Result<Located> {
    let resolved = folder.canonicalize().map_err(Error::io("read", folder))?;
    let called = std::path::absolute(folder).map_err(Error::io("read", folder))?;
    for path in [&called, &resolved] {
        let found: Vec<Located> = LAYOUTS.into_iter().filter_map(|layout| layout.locate(path)).collect();
        match found.as_slice() {
            [] => {}
            [located] => return Ok(located.clone()),
            several => {
                let names: Vec<&str> = several.iter().map(|located| located.layout.name()).collect();
                let folder = folder.display();
                return Err(Error::Data(format!(
                    "{folder}: can be read in {} layouts ({}); name the recording in a configuration with data.layout",
                    names.len(),
                    names.join(", ")
                )));
            }
        }
    }
    Err(Error::Data(format!(
        "{}: no recording; expected ROOT/DATE/DRIVE of KITTI raw, such as kitti/2011_09_30/2011_09_30_drive_0034_sync, ROOT/sequences/NN of KITTI odometry, or a folder with rgb.txt (TUM RGB-D) or mav0 (EuRoC)",
        folder.display()
    )))
}

/// The layout of the recording `name` below `root`.
///
/// # Errors
/// None fits, or several.
pub(super) fn layout_of(root: &Path, name: &str) -> Result<Layout> {
    let fitting =
        LAYOUTS.into_iter().filter(|layout| layout.folder(root, name).is_some_and(|folder| layout.fits(&folder)));
    let fitting: Vec<Layout> = fitting.collect();
    match fitting.as_slice() {
        [layout] => Ok(*layout),
        [] => Err(nothing_there(root, name)),
        several => {
            let names: Vec<String> = several.iter().map(|layout| format!("\"{}\"", layout.name())).collect();
            let problem = format!(
                "`{name}` below {} can be read in {} layouts; choose: {}",
                root.display(),
                several.len(),
                names.join(", ")
            );
            Err(Error::config("data.layout", problem))
        }
    }
}

/// What was looked for, and where; and where the root is a recording itself, that.
fn nothing_there(root: &Path, name: &str) -> Error {
    let is_recording = [Layout::TumRgbd, Layout::Euroc].iter().any(|layout| layout.fits(root));
    if let (true, Some(parent), Some(own)) = (is_recording, root.parent(), root.file_name()) {
        let (root, parent, own) = (root.display(), parent.display(), own.to_string_lossy());
        let problem =
            format!("{root} is a recording itself; set data.root = \"{parent}\" and name it: drive = \"{own}\"");
        return Error::config("data.root", problem);
    }
    if root.file_name().is_some_and(|own| own == "sequences") && root.join(name).is_dir() {
        let parent = root.parent().unwrap_or(Path::new("."));
        let problem = format!(
            "{} holds the sequences of KITTI odometry; set data.root = \"{}\"",
            root.display(),
            parent.display()
        );
        return Error::config("data.root", problem);
    }
    let looked: Vec<String> = LAYOUTS
        .into_iter()
        .filter_map(|layout| Some(format!("{} ({})", layout.folder(root, name)?.display(), layout.name())))
        .collect();
    Error::Data(format!(
        "{name}: no such drive below data.root = {} (set data.root or {DATA_ROOT_VARIABLE}); looked for {}{}",
        root.display(),
        looked.join(", "),
        sequences_below(root)
    ))
}

/// What sequences of KITTI odometry there are: `3` is none where `03` is.
fn sequences_below(root: &Path) -> String {
    let entries = std::fs::read_dir(root.join("sequences")).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort_unstable();
    names.truncate(MOST_NAMES);
    if names.is_empty() { String::new() } else { format!("; sequences holds {}", names.join(", ")) }
}
