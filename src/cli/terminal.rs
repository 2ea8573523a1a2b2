//! Where results are printed, and how much is said beside them.

/// What every command needs to know of its surroundings.
pub(super) struct Terminal {
    pub(super) quiet: bool,
}

/// Writes a result to stdout; a reader that went away (`| head`) is no failure.
pub(super) fn print_result(text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}
