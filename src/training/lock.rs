//! One writer of a run folder at a time.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Held by whoever trains in the folder.
const LOCK: &str = ".lock";

/// That a folder is being written. The operating system lets go of it when its process ends, however it does.
#[derive(Debug)]
pub(super) struct Lock {
    path: PathBuf,
    _held: File,
}

impl Lock {
    /// Takes the folder; `None` on a file system without locks.
    ///
    /// # Errors
    /// Somebody holds it, or nothing can be written there.
    pub(super) fn take(folder: &Path) -> Result<Option<Self>> {
        let path = folder.join(LOCK);
        loop {
            let file = File::create(&path).map_err(Error::io("write", &path))?;
            match file.try_lock() {
                // Whoever held it before may have removed its name between the two steps.
                Ok(()) if is_of(&path, &file) => return Ok(Some(Self { path, _held: file })),
                Ok(()) => continue,
                Err(TryLockError::WouldBlock) => {
                    let problem = "is being trained already; wait for that or stop it, or choose another --set name=…";
                    return Err(Error::run(folder, problem));
                }
                Err(TryLockError::Error(_)) => return Ok(None),
            }
        }
    }
}

/// Whether a name is still that of an open file.
#[cfg(unix)]
fn is_of(path: &Path, file: &File) -> bool {
    use std::os::unix::fs::MetadataExt;
    let inode = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
    path.metadata().map(inode).is_ok_and(|named| file.metadata().map(inode).is_ok_and(|held| held == named))
}

/// Open files keep their names there.
#[cfg(not(unix))]
fn is_of(_: &Path, _: &File) -> bool {
    true
}

impl Drop for Lock {
    fn drop(&mut self) {
        if cfg!(unix) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_writer_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let first = Lock::take(folder.path()).unwrap();
        assert!(first.is_some());
        assert!(Lock::take(folder.path()).unwrap_err().to_string().contains("is being trained already"));
        drop(first);
        // What a killed writer leaves holds nobody up.
        std::fs::write(folder.path().join(LOCK), "").unwrap();
        assert!(Lock::take(folder.path()).unwrap().is_some());
        let missing = folder.path().join("missing");
        assert!(matches!(Lock::take(&missing), Err(Error::Io { .. })));
    }
}
