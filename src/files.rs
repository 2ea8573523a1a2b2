//! Whole files: reading text and numbers with errors that name the place, and writing so that whatever
//! bears its final name is complete.

use std::io::Write;
use std::path::Path;

use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use crate::error::{Error, Place, Result};

/// Larger files are no images.
const LARGEST_FILE_BYTES: u64 = 256 << 20;

/// Reads a whole text file.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).map_err(Error::io("read", path))
}

/// Fit to name a folder and a column.
pub(crate) fn is_plain(name: &str) -> bool {
    !name.is_empty() && !name.starts_with('.') && name.chars().all(|c| c.is_alphanumeric() || "-_.".contains(c))
}

/// SHA-256 in hexadecimal.
pub(crate) fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Parses whitespace-separated finite numbers.
pub(crate) fn parse_numbers(text: &str, path: &Path, place: &Place) -> Result<Vec<f64>> {
    text.split_whitespace()
        .map(|word| match word.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(value),
            _ => Err(Error::malformed(path, place.clone(), format!("`{word}`"), "a finite number")),
        })
        .collect()
}

/// Reads a whole file of bytes: a regular one, and not one so large that it can only be a mistake.
///
/// # Errors
/// It cannot be read, is a folder, a pipe or a device, or larger than any image is.
pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let metadata = std::fs::metadata(path).map_err(Error::io("read", path))?;
    if !metadata.is_file() || metadata.len() > LARGEST_FILE_BYTES {
        let found = if metadata.is_file() { format!("{} bytes", metadata.len()) } else { "no regular file".to_owned() };
        let expected = format!("a file of at most {} MiB", LARGEST_FILE_BYTES >> 20);
        return Err(Error::malformed(path, Place::Whole, found, expected));
    }
    std::fs::read(path).map_err(Error::io("read", path))
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

/// Writes a file under a temporary name beside it and renames it. A link is followed; what is no regular file, such as a
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
    let folder = followed.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = temporary_in(folder).map_err(Error::io("write into", folder))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(Error::io("write", path))?;
    file.persist(&followed).map_err(|error| Error::io("rename into place", path)(error.error))?;
    Ok(())
}

/// Makes sure a file that someone else wrote is on the disk, and gives it its final name.
///
/// # Errors
/// The disk does not take it; a file of that name stays as it was.
pub(crate) fn put_in_place(temporary: &Path, path: &Path) -> Result<()> {
    let written = std::fs::File::open(temporary).and_then(|file| file.sync_all());
    written.map_err(Error::io("write", path))?;
    std::fs::rename(temporary, path).map_err(Error::io("rename into place", path))
}

/// Writes a file under a partial name of this process's own and renames it, without waiting for the disk: for many small
/// files that can be made again.
///
/// # Errors
/// It cannot be written; a file of that name stays as it was.
pub(crate) fn write_renamed(path: &Path, bytes: &[u8]) -> Result<()> {
    let mut partial = path.as_os_str().to_owned();
    partial.push(format!(".{}.partial", std::process::id()));
    std::fs::write(&partial, bytes).map_err(Error::io("write", path))?;
    std::fs::rename(&partial, path).map_err(Error::io("rename into place", path))
}

/// A temporary file that, unlike most, is as readable as any other new file: results are to be shared.
fn temporary_in(folder: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    builder.tempfile_in(folder)
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
            let message = read_bytes(Path::new("/dev/null")).unwrap_err().to_string();
            assert!(message.contains("no regular file"), "{message}");
        }
        assert!(write_atomically(folder.path(), b"new").unwrap_err().to_string().contains("a folder"));
    }
}
