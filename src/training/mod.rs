//! Training: the learner and the run folder it leaves behind.
//!
//! In: a [`Dataset`](crate::pairs::Dataset) and a [`Config`](crate::config::Config). Out: a run folder
//! with the best model. Tells its observer what happens by typed [`Event`]s and never prints.

mod curves;
pub mod depth;
mod events;
mod history;
mod learner;
mod lock;
mod manifest;
mod run_folder;
mod saved_state;
mod setup;

pub use events::{Event, Outcome, StopReason};
pub use history::{EpochRow, History};
pub use learner::Learner;
pub use manifest::{Manifest, SystemSummary};
pub use run_folder::{EVALUATION, FIGURES, LOSSES, PAIRS, RunFolder};
