//! Opens a recording by its name, in whichever layout it lies there.

use std::path::{Path, PathBuf};

use super::DATA_ROOT_VARIABLE;
use super::euroc::load_euroc;
use super::kitti_odometry::load_kitti_odometry;
use super::kitti_raw::{date_of, load_kitti_raw};
use super::layout::Layout;
use super::recording::Recording;
use super::settings::CameraConfig;
use super::tum_rgbd::load_tum_rgbd;
use crate::error::{Error, Result};
use crate::files::is_plain;
use crate::geometry::Pose;

/// What is known of a recording beside where it lies.
#[derive(Clone, Copy, Debug, Default)]
pub struct Opening<'a> {
    /// Its layout; `None`: the one that fits.
    pub layout: Option<Layout>,
    /// Its camera, for layouts that do not say it.
    pub camera: Option<&'a CameraConfig>,
    /// Vehicle axes into those of the camera, for layouts without other sensors; `None`: the vehicle is where the camera
    /// is, x forward, y left, z up.
    pub camera_from_vehicle: Option<&'a Pose>,
}

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
            Self::KittiRaw | Self::KittiOdometry => folder.is_dir(),
            Self::TumRgbd => ["rgb.txt", "rgb", "depth.txt"].iter().any(|part| folder.join(part).exists()),
            Self::Euroc => folder.join("mav0").is_dir(),
            Self::Manifest => false,
        }
    }
}

/// Opens the recording `name` below `root`.
///
/// # Errors
/// There is none of a known layout, or two fit; or it cannot be read.
pub fn open_recording(root: &Path, name: &str, opening: &Opening) -> Result<Recording> {
    if !is_plain(name) {
        let problem = format!("drive `{name}` cannot name a folder below data.root; use letters, digits, - and _");
        return Err(Error::config("data", problem));
    }
    let layout = opening.layout.map_or_else(|| detect(root, name), Ok)?;
    let takes_camera = layout.takes_camera();
    if opening.camera.is_some() && !takes_camera {
        let problem = format!("{name}: a recording in the layout `{}` brings its own calibration", layout.name());
        return Err(Error::config("data.camera", problem));
    }
    if opening.camera_from_vehicle.is_some() && !takes_camera {
        let problem = format!("{name}: a recording in the layout `{}` has calibration files", layout.name());
        return Err(Error::config("data.camera_from_vehicle", problem));
    }
    match layout {
        Layout::KittiRaw => load_kitti_raw(root, name),
        Layout::KittiOdometry => load_kitti_odometry(root, name),
        Layout::TumRgbd => load_tum_rgbd(&root.join(name), name, opening.camera, opening.camera_from_vehicle),
        Layout::Euroc => load_euroc(&root.join(name), name),
        Layout::Manifest => {
            Err(Error::config("data.layout", "`manifest` needs the file: data.manifest = \"pairs.csv\""))
        }
    }
}

/// Where a recording is, by its folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Located {
    /// The folder that `data.root` would name.
    pub root: PathBuf,
    /// Its name there.
    pub name: String,
    /// Its layout.
    pub layout: Layout,
}

/// Finds what recording lies in a folder: by the folder's name as it is called, for a link has its own; by what it leads
/// to where that is no recording.
///
/// # Errors
/// It is no recording, or could be several.
pub fn locate_recording(folder: &Path) -> Result<Located> {
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
        "{}: no recording; expected ROOT/DATE/DRIVE of KITTI raw, such as kitti/2011_09_30/2011_09_30_drive_0034_sync, ROOT/sequences/NN of KITTI odometry, or a folder with rgb.txt (TUM RGB-D)",
        folder.display()
    )))
}

fn detect(root: &Path, name: &str) -> Result<Layout> {
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
    let looked: Vec<String> = LAYOUTS
        .into_iter()
        .filter_map(|layout| Some(format!("{} ({})", layout.folder(root, name)?.display(), layout.name())))
        .collect();
    Error::Data(format!(
        "{name}: no such drive below data.root = {} (set data.root or {DATA_ROOT_VARIABLE}); looked for {}",
        root.display(),
        looked.join(", ")
    ))
}
