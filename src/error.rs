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
    #[error("{}: cannot {action}: {reason}", path.display())]
    Io {
        /// What was tried ("read", "create the folder").
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// Why it failed, as the operating system puts it.
        reason: io::Error,
    },
    /// A file's content is not what its format says.
    #[error("{}{place}: found {found}; expected {expected}", path.display())]
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
    #[error("configuration: `{key}`: {problem}")]
    Config {
        /// Dotted key.
        key: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// The data a configuration asks for do not suffice.
    #[error("{0}")]
    Data(String),
    /// A device cannot be used.
    #[error("device `{name}`: {problem}")]
    Device {
        /// As given by the user.
        name: String,
        /// What is wrong and what to do.
        problem: String,
    },
    /// A run folder cannot be used.
    #[error("run {}: {problem}", folder.display())]
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
