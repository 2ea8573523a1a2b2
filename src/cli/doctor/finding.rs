//! What is found of one thing, and whom it is told.

/// What was found of one thing.
pub(super) enum Finding {
    Ok(String),
    /// Worth knowing; nothing is wrong.
    Note(String),
    Wrong {
        found: String,
        remedy: String,
    },
}

impl Finding {
    pub(super) fn wrong(found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Wrong { found: found.into(), remedy: remedy.into() }
    }

    /// Ok, or a note where something is scarce.
    pub(super) fn scarce(is_scarce: bool, found: String, remedy: &str) -> Self {
        if is_scarce { Self::Note(format!("{found}: scarce; {remedy}")) } else { Self::Ok(found) }
    }
}

/// Told of each thing that was looked at.
pub(super) type Say<'a> = &'a mut dyn FnMut(&str, Finding) -> anyhow::Result<()>;
