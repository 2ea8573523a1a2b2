//! The plan of a training: how large mini-batches are, how fast is learned in which stage, what is watched, and when to
//! stop.
//!
//! Leaves carrying it out to `training`.

mod depth;
mod divergence;
mod rate;
mod settings;
mod stages;

pub use depth::DepthTrainingConfig;
pub use divergence::DivergenceRule;
pub(crate) use rate::rate_factor;
pub use settings::{Schedule, StopConfig, TrainingConfig, WatchedSplit};
pub(crate) use stages::Stages;
