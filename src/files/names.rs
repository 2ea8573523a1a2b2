//! Names of files: as the user wrote them, and as the operating system has them.

use std::path::{Path, PathBuf};

use crate::error::{Error, Result, excerpt};

/// Fit to name a folder and a column.
pub(crate) fn is_plain(name: &str) -> bool {
    !name.is_empty() && !name.starts_with('.') && name.chars().all(|c| c.is_alphanumeric() || "-_.".contains(c))
}

/// The extension in lower case: `VO.CSV` is a CSV file.
pub(crate) fn extension(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

/// The last name of a path as it was written; that of the folder it stands for where it ends in dots. A link has its own.
pub(crate) fn own_name(path: &Path) -> String {
    let resolved = || path.canonicalize().ok()?.file_name().map(ToOwned::to_owned);
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let name = absolute.file_name().map(ToOwned::to_owned).or_else(resolved);
    name.unwrap_or_else(|| path.as_os_str().to_owned()).to_string_lossy().into_owned()
}

/// A path as the text that a configuration holds.
///
/// # Errors
/// Its bytes are no UTF-8; as text it would be another path.
pub(crate) fn utf8_name(path: &Path) -> Result<String> {
    path.to_str().map(str::to_owned).ok_or_else(|| {
        Error::Data(format!("{}: the path is no UTF-8, which configurations cannot hold; rename it", path.display()))
    })
}

/// Slots of the templates of measurement files, and of depth maps.
pub(crate) const MEASUREMENT_SLOTS: [&str; 3] = ["{drive}", "{date}", "{sequence}"];
pub(crate) const DEPTH_SLOTS: [&str; 3] = ["{date}", "{drive}", "{frame}"];

/// That a template has no slots but these: one that is misspelt would be a name.
///
/// # Errors
/// Names the slot and those there are.
pub(crate) fn require_slots(template: &Path, known: &[&str]) -> Result<(), String> {
    let text = template.to_string_lossy();
    for (begin, _) in text.match_indices('{') {
        let length = text[begin..].find('}').map_or(text.len() - begin, |length| length + 1);
        let slot = &text[begin..begin + length];
        if !known.contains(&slot) {
            return Err(format!("unknown slot {}; there are {}", excerpt(slot), known.join(", ")));
        }
    }
    Ok(())
}

/// That a file that is to be written is none that is read.
///
/// # Errors
/// It is one of them.
pub(crate) fn require_apart(written: &Path, read: &[&Path]) -> Result<()> {
    if !written.exists() {
        return Ok(());
    }
    let same = |path: &&&Path| is_same_file(written, path);
    match read.iter().find(same) {
        None => Ok(()),
        Some(_) => {
            Err(Error::Data(format!("{}: would be written over what is read; name another file", written.display())))
        }
    }
}

/// Whether two names are of one file, by links of any kind.
fn is_same_file(one: &Path, other: &Path) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let inode = |path: &Path| path.metadata().map(|metadata| (metadata.dev(), metadata.ino())).ok();
        inode(one).is_some_and(|found| inode(other) == Some(found))
    }
    #[cfg(not(unix))]
    {
        one.canonicalize().ok().is_some_and(|path| other.canonicalize().is_ok_and(|other| other == path))
    }
}

/// A path with the slots of its template filled, such as `{drive}`; all else stays as it is, UTF-8 or not.
pub(crate) fn fill_template(template: &Path, slots: &[(&str, &str)]) -> PathBuf {
    let fill = |text: &str| slots.iter().fold(text.to_owned(), |text, (slot, value)| text.replace(slot, value));
    match template.to_str() {
        Some(text) => PathBuf::from(fill(text)),
        None => template
            .iter()
            .map(|part| part.to_str().map_or_else(|| part.to_owned(), |part| fill(part).into()))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_what_it_is_called() {
        assert_eq!(extension(Path::new("logs/VO.CSV")), "csv");
        assert_eq!(own_name(Path::new("runs/best/")), "best");
        let folder = tempfile::tempdir().unwrap();
        let inner = folder.path().join("inner");
        std::fs::create_dir(&inner).unwrap();
        assert_eq!(own_name(&inner.join(".")), "inner");
        assert_eq!(own_name(&inner.join("..")), own_name(folder.path()));
    }

    #[test]
    fn slots_are_filled() {
        let slots = [("{system}", "vo"), ("{drive}", "lab")];
        assert_eq!(fill_template(Path::new("a/{system}/{drive}.csv"), &slots), Path::new("a/vo/lab.csv"));
    }

    #[test]
    fn a_misspelt_slot_is_no_name() {
        assert_eq!(require_slots(Path::new("vo/{drive}/{date}.txt"), &MEASUREMENT_SLOTS), Ok(()));
        assert!(require_slots(Path::new("{drive.txt"), &MEASUREMENT_SLOTS).unwrap_err().contains("`{drive.txt`"));
        let message = require_slots(Path::new("{drive}/{frmae}.png"), &DEPTH_SLOTS).unwrap_err();
        assert_eq!(message, "unknown slot `{frmae}`; there are {date}, {drive}, {frame}");
    }

    #[test]
    fn what_is_read_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let (read, other) = (folder.path().join("vo.csv"), folder.path().join("out.csv"));
        std::fs::write(&read, "").unwrap();
        assert!(require_apart(&other, &[&read]).is_ok());
        let linked = folder.path().join("linked.csv");
        std::fs::hard_link(&read, &linked).unwrap();
        assert_eq!(require_apart(&linked, &[&read]).is_err(), cfg!(unix));
        let spelt_otherwise = folder.path().join(".").join("vo.csv");
        assert!(
            require_apart(&spelt_otherwise, &[&other, &read]).unwrap_err().to_string().contains("name another file")
        );
    }

    #[cfg(unix)]
    #[test]
    fn a_path_that_is_no_utf8_stays_that_path() {
        use std::ffi::OsStr;
        use std::os::unix::ffi::OsStrExt;
        let path = |bytes: &'static [u8]| Path::new(OsStr::from_bytes(bytes));
        assert_eq!(
            fill_template(path(b"/d\xe9p\xf4t/{system}.csv"), &[("{system}", "vo")]),
            path(b"/d\xe9p\xf4t/vo.csv")
        );
        assert!(utf8_name(path(b"d\xe9p\xf4t")).unwrap_err().to_string().contains("no UTF-8"));
    }
}
