//! Files of a folder by their frame index.

use std::path::Path;

use super::recording::FrameFiles;
use crate::error::{Error, Place, Result};
use crate::files::{LARGEST_FRAME, extension};

/// Extensions of images.
pub(super) const IMAGES: [&str; 3] = ["png", "jpg", "jpeg"];

/// Files named by their frame index; a folder that is absent holds none.
pub(super) fn list_frames(folder: &Path, extensions: &[&str]) -> Result<FrameFiles> {
    if !folder.is_dir() {
        return Ok(FrameFiles::new());
    }
    let mut frames = FrameFiles::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io("list", folder))? {
        let path = entry.map_err(Error::io("list", folder))?.path();
        let extension = extension(&path);
        let index = path.file_stem().and_then(|stem| stem.to_str()).and_then(|stem| stem.parse().ok());
        let Some(index) = index.filter(|_| extensions.contains(&extension.as_str())) else { continue };
        if index > LARGEST_FRAME {
            return Err(Error::malformed(
                path,
                Place::Whole,
                format!("frame index {index}"),
                format!("at most {LARGEST_FRAME}"),
            ));
        }
        if let Some(twin) = frames.insert(index, path.clone()) {
            let found = format!("a second file of frame {index} beside {}", twin.display());
            return Err(Error::malformed(
                path,
                Place::Whole,
                found,
                "one file for each frame; remove or move the other",
            ));
        }
    }
    Ok(frames)
}
