//! The pairs of an experiment: frames of recordings joined with what systems measured, with the truth and with depth; the
//! pairs of each split; reading them ahead of the network; and the only door from the CPU to a device ([`PairBatch`]).
//!
//! Leaves to others: what lies on disk (`recordings`), who measured (`systems`), depth (`depth`).

mod batch;
mod coverage;
mod dataset;
mod generated;
mod loader;
mod manifest;
mod pair;
mod pairing;
mod reader;
mod settings;
mod split;

pub use batch::{EvidenceBatch, ImageBatch, Images, PairBatch, PairNumbers, RightBatch};
pub use coverage::{Coverage, FrameSpan};
pub use dataset::Dataset;
pub use loader::{BatchLoader, Choice, LoadedBatch, Loading, Request};
pub use manifest::manifest_of;
pub use pair::{Pair, PairId, PairScope};
pub(crate) use reader::SHOWS_NOTHING;
pub use reader::{BadFrame, PairReader, PairSample, RightImages};
pub use settings::{DataConfig, DriveConfig, PairInput, PairSettings};
pub(crate) use settings::{default_cache_mb, default_max_bad_fraction};
pub use split::{Split, SplitName};
