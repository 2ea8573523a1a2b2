//! Whole files: reading text and numbers with errors that name the place, and writing so that whatever
//! bears its final name is complete.

use std::io::Write;
use std::path::Path;

use sha2::{Digest, Sha256};
use tempfile::NamedTempFile;

use crate::error::{Error, Place, Result};

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

/// Writes a file under a temporary name beside it and renames it.
///
/// # Errors
/// It cannot be written; a file of that name stays as it was.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = temporary_in(folder).map_err(Error::io("write into", folder))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(Error::io("write", path))?;
    file.persist(path).map_err(|error| Error::io("rename into place", path)(error.error))?;
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
