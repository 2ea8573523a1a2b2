//! Writing whole files: under a partial name beside the final one, then renamed. A writer that was killed leaves the
//! partial name, by which it is known and removed.

use std::ffi::{OsStr, OsString};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tempfile::NamedTempFile;

use crate::error::{Error, Place, Result};

/// How every file that is not whole yet ends, and every folder.
const PARTIAL: &str = ".partial";

/// The hidden name under which a file or folder is written before it gets its own.
pub(crate) fn temporary_name(name: &str) -> String {
    format!(".{name}{PARTIAL}")
}

/// Whether a name is one of a file or folder that is not whole: ours, Burn's for what it saves under one of ours
/// (`.NAME.partial.RANDOM.tmp`), or that of earlier versions (`.tmpRANDOM`).
pub(crate) fn is_partial(name: &OsStr) -> bool {
    let Some(hidden) = name.to_str().and_then(|name| name.strip_prefix('.')) else { return false };
    let earlier =
        hidden.strip_prefix("tmp").is_some_and(|random| random.len() == 6 && random.chars().all(char::is_alphanumeric));
    hidden.ends_with(PARTIAL) || (hidden.contains(PARTIAL) && hidden.ends_with(".tmp")) || earlier
}

/// Removes what writers left in a folder that were killed at least so long ago: zero where nobody else writes there.
///
/// # Errors
/// The folder cannot be listed, or something cannot be removed.
pub(crate) fn remove_partial(folder: &Path, least_age: Duration) -> Result<()> {
    let is_old = |path: &Path| {
        let age = path.metadata().and_then(|metadata| metadata.modified()).ok().and_then(|time| time.elapsed().ok());
        least_age.is_zero() || age.is_some_and(|age| age >= least_age)
    };
    let entries = std::fs::read_dir(folder).map_err(Error::io("list", folder))?;
    for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
        if path.file_name().is_some_and(is_partial) && is_old(&path) {
            let removed = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
            removed.map_err(Error::io("remove", &path))?;
        }
    }
    Ok(())
}

/// That a file can be written there, as far as that can be told before: what is there is no folder.
///
/// # Errors
/// It is one.
pub(crate) fn require_no_folder(path: &Path) -> Result<()> {
    match path.is_dir() {
        true => Err(Error::malformed(path, Place::Whole, "a folder", "the name of a file to write")),
        false => Ok(()),
    }
}

/// Writes a file under a partial name beside it and renames it. A link is followed; what is no regular file, such as a
/// pipe, is written to as it is.
///
/// # Errors
/// It cannot be written; a file of that name stays as it was.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    require_no_folder(path)?;
    if path.metadata().is_ok_and(|metadata| !metadata.is_file()) {
        return std::fs::write(path, bytes).map_err(Error::io("write", path));
    }
    let followed = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let mut file = partial_beside(&followed).map_err(Error::io("write into the folder of", path))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(Error::io("write", path))?;
    file.persist(&followed).map_err(|error| Error::io("rename into place", path)(error.error))?;
    Ok(())
}

/// [Settles](settle) a file that someone else wrote, and gives it its final name.
///
/// # Errors
/// The disk does not take it; a file of that name stays as it was.
pub(crate) fn put_in_place(temporary: &Path, path: &Path) -> Result<()> {
    settle(temporary)?;
    std::fs::rename(temporary, path).map_err(Error::io("rename into place", path))
}

/// Makes sure a file that someone else wrote is on the disk and as readable as any other new one.
///
/// # Errors
/// The disk does not take it.
pub(crate) fn settle(path: &Path) -> Result<()> {
    make_readable(path).map_err(Error::io("set the permissions of", path))?;
    std::fs::File::open(path).and_then(|file| file.sync_all()).map_err(Error::io("write", path))
}

/// Writes a file under a partial name of this process's own and renames it, without waiting for the disk: for many small
/// files that can be made again.
///
/// # Errors
/// It cannot be written; a file of that name stays as it was.
pub(crate) fn write_renamed(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}", std::process::id()));
    let partial = path.with_file_name(hidden(&name));
    std::fs::write(&partial, bytes).map_err(Error::io("write", path))?;
    std::fs::rename(&partial, path).map_err(Error::io("rename into place", path))
}

/// `.NAME.partial`.
fn hidden(name: &OsStr) -> OsString {
    let mut hidden = OsString::from(".");
    hidden.push(name);
    hidden.push(PARTIAL);
    hidden
}

/// A temporary file that, unlike most, is as readable as any other new file: results are to be shared.
fn partial_beside(path: &Path) -> std::io::Result<NamedTempFile> {
    let mut prefix = OsString::from(".");
    prefix.push(path.file_name().unwrap_or_default());
    prefix.push(".");
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(PARTIAL);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(folder_of(path))
}

/// Gives a file the permissions of any other new one beside it: libraries that write through temporary files make them
/// their owner's alone.
fn make_readable(path: &Path) -> std::io::Result<()> {
    let permissions = partial_beside(path)?.as_file().metadata()?.permissions();
    std::fs::set_permissions(path, permissions)
}

fn folder_of(path: &Path) -> PathBuf {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new(".")).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_followed_and_folders_refused() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("target.txt");
        std::fs::write(&target, "old").unwrap();
        #[cfg(unix)]
        {
            let link = folder.path().join("link.txt");
            std::os::unix::fs::symlink(&target, &link).unwrap();
            write_atomically(&link, b"new").unwrap();
            assert!(link.is_symlink());
            assert_eq!(std::fs::read_to_string(&target).unwrap(), "new");
        }
        assert!(write_atomically(folder.path(), b"new").unwrap_err().to_string().contains("a folder"));
    }

    #[cfg(unix)]
    #[test]
    fn others_may_read_what_umask_lets_them() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let mode = |name: &str| folder.path().join(name).metadata().unwrap().permissions().mode() & 0o777;
        std::fs::write(folder.path().join("plain"), "").unwrap();
        std::fs::write(folder.path().join("private"), "").unwrap();
        std::fs::set_permissions(folder.path().join("private"), std::fs::Permissions::from_mode(0o600)).unwrap();
        put_in_place(&folder.path().join("private"), &folder.path().join("placed")).unwrap();
        write_atomically(&folder.path().join("written"), b"").unwrap();
        assert_eq!((mode("placed"), mode("written")), (mode("plain"), mode("plain")));
    }

    #[test]
    fn what_killed_writers_left_is_known_by_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let killed = partial_beside(&folder.path().join("scores.json")).unwrap().into_temp_path().keep().unwrap();
        let name = killed.file_name().unwrap().to_str().unwrap();
        assert!(name.starts_with(".scores.json.") && name.ends_with(PARTIAL), "{name}");
        for name in [".model.safetensors.partial.a1B2c3.tmp", ".tmpAbC123", ".1.png.77.partial"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        std::fs::create_dir(folder.path().join(temporary_name("state-1"))).unwrap();
        let kept = [".gitignore", ".tmp", "model.partial", "tmpAbC123", ".tmp-notes"];
        kept.iter().for_each(|name| std::fs::write(folder.path().join(name), "").unwrap());
        let count = || std::fs::read_dir(folder.path()).unwrap().count();
        let all = count();
        // Somebody may still be at work on them.
        remove_partial(folder.path(), Duration::from_secs(60)).unwrap();
        assert_eq!(count(), all);
        remove_partial(folder.path(), Duration::ZERO).unwrap();
        assert_eq!(count(), kept.len());
    }
}
