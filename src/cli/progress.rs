//! Progress on stderr: a bar on a terminal, plain lines elsewhere, and a log that does not tear it.

use std::io::{self, IsTerminal, Write};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::error::escaped;

/// Time between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(30);

fn bars() -> &'static MultiProgress {
    static BARS: OnceLock<MultiProgress> = OnceLock::new();
    BARS.get_or_init(|| MultiProgress::with_draw_target(ProgressDrawTarget::stderr()))
}

/// Where the log goes: above the bar.
#[derive(Default)]
pub struct LogWriter;

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // As if written, when it cannot be: see `note`.
        let _ = bars().suspend(|| io::stderr().write_all(bytes));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

/// Prints a line to stderr without tearing the bar. A stderr that is closed or full costs the line,
/// never the run.
pub fn note(quiet: bool, text: &str) {
    if !quiet {
        bars().suspend(|| {
            let _ = writeln!(io::stderr(), "{}", escaped(&text));
        });
    }
}

/// A counter towards a known total.
pub struct Progress {
    bar: Option<ProgressBar>,
    lines: bool,
    label: String,
    total: usize,
    begin: Instant,
    first: usize,
    last_line: Instant,
}

impl Progress {
    /// Begins at `done` of `total`.
    pub fn new(quiet: bool, label: &str, done: usize, total: usize) -> Self {
        let terminal = io::stderr().is_terminal();
        let bar = (terminal && !quiet).then(|| {
            let bar = bars().add(ProgressBar::new(total as u64));
            let style = ProgressStyle::with_template("{prefix} [{bar:30}] {pos}/{len} {msg}, {eta} left")
                .expect("a fixed template");
            bar.set_style(style.progress_chars("=> "));
            bar.set_prefix(label.to_owned());
            bar.set_position(done as u64);
            bar.reset_eta();
            bar
        });
        let now = Instant::now();
        Self {
            bar,
            lines: !terminal && !quiet,
            label: label.to_owned(),
            total,
            begin: now,
            first: done,
            last_line: now,
        }
    }

    /// Sets the count and what is said beside it.
    pub fn set(&mut self, done: usize, message: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(message.to_owned());
            bar.set_position(done as u64);
        }
        if self.lines && self.last_line.elapsed() >= LINE_EVERY {
            let per_item = self.begin.elapsed().as_secs_f64() / (done - self.first).max(1) as f64;
            let left = Duration::from_secs_f64(per_item * self.total.saturating_sub(done) as f64);
            let left = indicatif::HumanDuration(left);
            note(false, &format!("{} {done}/{} {message}, {left} left", self.label, self.total));
            self.last_line = Instant::now();
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
