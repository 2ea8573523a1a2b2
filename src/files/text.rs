//! Text files, whatever editor or program wrote them, and the numbers in them.

use std::path::Path;

use super::require_fetched;
use crate::error::{Error, Place, Result, excerpt};

/// Frame indices above this are taken for mistakes.
pub(crate) const LARGEST_FRAME: usize = 1_000_000_000;

/// What some editors put before the first character of a file.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// How files in other encodings begin; the longer ones first.
const OTHER_ENCODINGS: [(&[u8], &str); 4] = [
    (b"\xff\xfe\0\0", "UTF-32 text"),
    (b"\0\0\xfe\xff", "UTF-32 text"),
    (b"\xff\xfe", "UTF-16 text"),
    (b"\xfe\xff", "UTF-16 text"),
];

/// Reads a whole text file: UTF-8 with or without a byte order mark, lines that end as they do on any system.
///
/// # Errors
/// It cannot be read, or is in another encoding, which is named.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    decode(std::fs::read(path).map_err(Error::io("read", path))?, path)
}

fn decode(bytes: Vec<u8>, path: &Path) -> Result<String> {
    let refused =
        |place, found: &str| Error::malformed(path, place, found, "text in UTF-8; save or convert it as that");
    require_fetched(&bytes, path)?;
    if let Some((_, name)) = OTHER_ENCODINGS.iter().find(|(begin, _)| bytes.starts_with(begin)) {
        return Err(refused(Place::Whole, name));
    }
    let line_of = |byte: usize| Place::Line(1 + bytes[..byte].iter().filter(|byte| **byte == b'\n').count());
    if let Some(zero) = bytes.iter().position(|byte| *byte == 0) {
        return Err(refused(line_of(zero), "a zero byte: no text, or UTF-16 without its mark"));
    }
    let invalid = std::str::from_utf8(&bytes).err().map(|error| error.valid_up_to());
    if let Some(byte) = invalid {
        let found = format!("byte 0x{:02X}, which is no UTF-8: Latin-1 text, or none at all", bytes[byte]);
        return Err(refused(line_of(byte), &found));
    }
    let mut text = String::from_utf8(bytes).expect("checked");
    if text.contains('\r') {
        text = text.replace("\r\n", "\n").replace('\r', "\n");
    }
    match text.starts_with(BYTE_ORDER_MARK) {
        true => Ok(without_mark(&text).to_owned()),
        false => Ok(text),
    }
}

/// A text without the mark that some editors put before it.
pub(crate) fn without_mark(text: &str) -> &str {
    text.trim_start_matches(BYTE_ORDER_MARK)
}

/// The lines of a text that hold something, with their places; blank ones and remarks (`#`) are passed over.
pub(crate) fn rows(text: &str) -> impl Iterator<Item = (Place, &str)> {
    let lines = without_mark(text).lines().enumerate();
    lines.filter(|(_, line)| !is_passed_over(line)).map(|(index, line)| (Place::Line(index + 1), line))
}

/// The remarks of a text, with their places; quoted ones too, as spreadsheets write them.
pub(crate) fn remarks(text: &str) -> impl Iterator<Item = (Place, &str)> {
    let lines = without_mark(text).lines().enumerate().map(|(index, line)| (Place::Line(index + 1), line.trim()));
    lines.filter(|(_, line)| line.trim_start_matches('"').starts_with('#'))
}

/// Whether a line is blank or a remark.
pub(super) fn is_passed_over(line: &str) -> bool {
    let line = line.trim_start();
    line.is_empty() || line.starts_with('#')
}

/// Parses finite numbers that blanks separate.
pub(crate) fn parse_numbers(text: &str, path: &Path, place: &Place) -> Result<Vec<f64>> {
    let number = |word: &str| match word.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => {
            let separated = word.contains([',', ';']);
            let expected =
                if separated { "numbers separated by blanks, with decimal points" } else { "a finite number" };
            Err(Error::malformed(path, place.clone(), excerpt(word), expected))
        }
    };
    text.split_whitespace().map(number).collect()
}

/// A frame index as text: a whole number, which some programs write `3.0`.
///
/// # Errors
/// It is none, or larger than frames are.
pub(crate) fn frame_index(text: &str, path: &Path, place: &Place) -> Result<usize> {
    let value = text.parse::<f64>().ok();
    match value.filter(|value| *value >= 0.0 && value.fract() == 0.0) {
        Some(value) if value <= LARGEST_FRAME as f64 => Ok(value as usize),
        Some(_) => Err(Error::malformed(
            path,
            place.clone(),
            format!("frame {}", excerpt(text)),
            format!("at most {LARGEST_FRAME}; a time? number the frames from 0"),
        )),
        None => Err(Error::malformed(path, place.clone(), format!("frame {}", excerpt(text)), "a whole number from 0")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(bytes: &[u8]) -> Result<String> {
        decode(bytes.to_vec(), Path::new("poses.txt"))
    }

    #[test]
    fn lines_are_the_files_whatever_ended_them() {
        for bytes in [b"\xef\xbb\xbf1\n\n# two\n3\n".as_slice(), b"1\r\n\r\n# two\r\n3", b"1\r\r# two\r3\r"] {
            let text = text(bytes).unwrap();
            let rows: Vec<_> = rows(&text).collect();
            assert_eq!(rows, [(Place::Line(1), "1"), (Place::Line(4), "3")]);
        }
    }

    #[test]
    fn other_encodings_are_named() {
        for (bytes, words) in [
            (b"\xff\xfe1\0\n\0".as_slice(), "found UTF-16 text; expected text in UTF-8"),
            (b"\xfe\xff\0" as &[u8], "UTF-16 text"),
            (b"\xff\xfe\0\0", "UTF-32 text"),
            (b"1\n2\0", "line 2: found a zero byte: no text, or UTF-16 without its mark"),
            (b"# f\xfcr\n", "line 1: found byte 0xFC, which is no UTF-8: Latin-1 text"),
        ] {
            let message = text(bytes).unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }

    #[test]
    fn a_time_is_no_frame() {
        let frame = |text| frame_index(text, Path::new("ns.csv"), &Place::Line(1));
        assert_eq!((frame("17").unwrap(), frame("3.0").unwrap()), (17, 3));
        let message = frame("1403636579763555584").unwrap_err().to_string();
        assert!(message.contains("`1403636579763555584`; expected at most 1000000000; a time?"), "{message}");
        assert!(frame("-1").unwrap_err().to_string().contains("whole number"));
    }
}
