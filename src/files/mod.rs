//! Files as people have them: text and tables read with errors that name the place, names as the operating system has
//! them, and writing so that whatever bears its final name is whole.

mod names;
mod table;
mod text;
mod write;

use std::io::Read;
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::error::{Error, Place, Result};

pub(crate) use names::{
    DEPTH_SLOTS, MEASUREMENT_SLOTS, extension, fill_template, is_plain, own_name, require_apart, require_slots,
    utf8_name,
};
pub(crate) use table::{Form, Header, Row, Table};
pub(crate) use text::{LARGEST_FRAME, frame_index, parse_numbers, read_text, remarks, rows, without_mark};
pub(crate) use write::{
    is_partial, put_in_place, remove_partial, require_no_folder, settle, temporary_name, write_atomically,
    write_renamed,
};

/// Larger files are no images.
const LARGEST_FILE_BYTES: u64 = 256 << 20;

/// SHA-256 in hexadecimal.
pub(crate) fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// That a file can be opened: libraries that read it by its name say less of why it cannot.
///
/// # Errors
/// It is not there, the user may not read it, or it is a pointer of Git LFS.
pub(crate) fn require_readable(path: &Path) -> Result<()> {
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(Error::io("read", path))?;
    file.take(LFS_POINTER.len() as u64).read_to_end(&mut head).map_err(Error::io("read", path))?;
    require_fetched(&head, path)
}

/// How Git LFS begins what stands for a file that was not fetched.
const LFS_POINTER: &[u8] = b"version https://git-lfs.github.com/spec";

/// That a file is there itself.
///
/// # Errors
/// It is a pointer of Git LFS.
fn require_fetched(bytes: &[u8], path: &Path) -> Result<()> {
    match bytes.starts_with(LFS_POINTER) {
        false => Ok(()),
        true => Err(Error::malformed(path, Place::Whole, "a pointer of Git LFS", "the file itself: git lfs pull")),
    }
}

/// Reads a whole file of bytes: a regular one, and not one so large that it can only be a mistake.
///
/// # Errors
/// It cannot be read, is a folder, a pipe or a device, or larger than any image is.
pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    require_regular(path)?;
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    require_fetched(&bytes, path).map(|()| bytes)
}

/// That a file is one that [`read_bytes`] reads: opening a pipe may wait for ever.
///
/// # Errors
/// As [`read_bytes`].
pub(crate) fn require_regular(path: &Path) -> Result<()> {
    let metadata = std::fs::metadata(path).map_err(Error::io("read", path))?;
    if !metadata.is_file() || metadata.len() > LARGEST_FILE_BYTES {
        let found = if metadata.is_file() { format!("{} bytes", metadata.len()) } else { "no regular file".to_owned() };
        let expected = format!("a file of at most {} MiB", LARGEST_FILE_BYTES >> 20);
        return Err(Error::malformed(path, Place::Whole, found, expected));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    #[test]
    fn a_device_is_no_file() {
        let message = super::read_bytes("/dev/null".as_ref()).unwrap_err().to_string();
        assert!(message.contains("no regular file"), "{message}");
    }

    #[test]
    fn a_pointer_of_git_lfs_is_not_the_file() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
            .unwrap();
        let [text, bytes, weights] = [
            super::read_text(file.path()).map(drop),
            super::read_bytes(file.path()).map(drop),
            super::require_readable(file.path()),
        ];
        for read in [text, bytes, weights] {
            assert!(read.unwrap_err().to_string().contains("found a pointer of Git LFS; expected the file itself"));
        }
    }
}
