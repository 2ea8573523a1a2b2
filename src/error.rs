//! Errors written for the person who must act: where, what was found, what was expected, what to do.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// Result of everything in this library that touches files, configurations or devices.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What can go wrong.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused a file operation.
    #[error("{}: cannot {action}: {reason}", shown(path))]
    Io {
        /// What was tried ("read", "create the folder").
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// Why it failed, as the operating system puts it.
        reason: io::Error,
    },
    /// A file's content is not what its format says.
    #[error("{}{place}: found {}; expected {expected}", shown(path), lines_shortened(found))]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line or field.
        place: Place,
        /// What stands there.
        found: String,
        /// What should.
        expected: String,
    },
    /// A configuration value cannot be used.
    #[error("configuration: {}: {}", excerpt(key), lines_shortened(problem))]
    Config {
        /// Dotted key.
        key: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// The data a configuration asks for do not suffice.
    #[error("{}", lines_shortened(_0))]
    Data(String),
    /// A device cannot be used.
    #[error("device {}: {problem}", excerpt(name))]
    Device {
        /// As given by the user.
        name: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// A run folder cannot be used.
    #[error("run {}: {problem}", shown(folder))]
    Run {
        /// The run folder.
        folder: PathBuf,
        /// What is wrong and what to do.
        problem: String,
    },
    /// Training cannot go on.
    #[error("training: {0}")]
    Training(String),
    /// The caller asked to stop. What was reached is saved.
    #[error("interrupted")]
    Interrupted,
}

/// Where in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// The file as a whole.
    Whole,
    /// A line, counted from 1.
    Line(usize),
    /// A named field.
    Field(String),
}

impl fmt::Display for Place {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Whole => Ok(()),
            Self::Line(line) => write!(formatter, ", line {line}"),
            Self::Field(field) => write!(formatter, ", field `{field}`"),
        }
    }
}

/// Most characters of a user's own content in a message.
const LONGEST_EXCERPT: usize = 80;

/// What stands in a file, fit for a message: in backticks, at most 80 characters of it, control characters escaped.
pub(crate) fn excerpt(content: &str) -> String {
    let short: String = content.chars().take(LONGEST_EXCERPT).collect();
    let more = if short.len() < content.len() { "…" } else { "" };
    format!("`{}{more}`", escaped(&short.replace('\n', "\\n")))
}

/// Most characters of another library's message, which may hold a user's content.
const LONGEST_MESSAGE: usize = 100;

/// Another library's message, at most 100 characters of it.
pub(crate) fn shortened(message: &str) -> String {
    let short: String = message.chars().take(LONGEST_MESSAGE).collect();
    if short.len() < message.len() { short + "…" } else { short }
}

/// Longest path that a message shows whole, characters, and how many from its end of a longer one.
const LONGEST_PATH: usize = 240;
const END_OF_PATH: usize = 80;

/// A path, fit for a message.
fn shown(path: &Path) -> String {
    let text = escaped(&path.display());
    let length = text.chars().count();
    if length <= LONGEST_PATH {
        text
    } else {
        format!("…{}", text.chars().skip(length - END_OF_PATH).collect::<String>())
    }
}

/// Most characters of a line of what was found, whoever wrote it.
const LONGEST_LINE: usize = 320;

/// What was found, its lines not longer than a reader wants them.
fn lines_shortened(found: &str) -> String {
    let short = |line: &str| match line.char_indices().nth(LONGEST_LINE) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line.to_owned(),
    };
    escaped(&found.lines().map(short).collect::<Vec<_>>().join("\n"))
}

/// A text whose control characters (but line breaks), and those that turn the direction of what follows, a terminal shows
/// instead of obeying them.
pub(crate) fn escaped(text: &dyn fmt::Display) -> String {
    let text = text.to_string();
    let turns = |c: char| matches!(c, '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    let obeyed = |c: char| c.is_control() && c != '\n' || turns(c);
    let shown = |c: char| if obeyed(c) { c.escape_default().to_string() } else { c.to_string() };
    if text.chars().any(obeyed) { text.chars().map(shown).collect() } else { text }
}

impl Error {
    /// For `map_err` on file operations.
    pub fn io(action: &'static str, path: impl AsRef<Path>) -> impl FnOnce(io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |reason| Self::Io { action, path, reason }
    }

    /// A file whose content is not what its format says.
    pub fn malformed(
        path: impl AsRef<Path>,
        place: Place,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        Self::Malformed { path: path.as_ref().to_owned(), place, found: found.into(), expected: expected.into() }
    }

    /// A configuration value that cannot be used.
    pub fn config(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Config { key: key.into(), problem: problem.into() }
    }

    /// A run folder that cannot be used.
    pub fn run(folder: impl AsRef<Path>, problem: impl Into<String>) -> Self {
        Self::Run { folder: folder.as_ref().to_owned(), problem: problem.into() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_user_wrote_is_shown_short_and_harmless() {
        assert_eq!(excerpt("1,5"), "`1,5`");
        assert_eq!(excerpt("\u{1b}[2Jred\n"), "`\\u{1b}[2Jred\\n`");
        let long = excerpt(&"é".repeat(5_000_000));
        assert_eq!(long.chars().count(), LONGEST_EXCERPT + 3);
        let error = Error::malformed("a\rb.csv", Place::Line(3), "\u{7}", "a number");
        assert_eq!(error.to_string(), "a\\rb.csv, line 3: found \\u{7}; expected a number");
    }
}
