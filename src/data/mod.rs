//! From files to pairs: KITTI raw drives, their calibration, packets and frames, or a pairs manifest; the pairs of each
//! split; reading them ahead of the network; and the only door from the CPU to a device
//! ([`PairBatch`]).
//!
//! Leaves to others: where measured poses come from (`systems`), depth (`depth`).

mod batch;
mod calibration;
mod coverage;
mod dataset;
mod drive;
mod generated;
mod image;
mod loader;
mod manifest;
mod oxts;
mod pairing;
mod reader;
mod times;

pub(crate) use self::image::decode;
pub use self::image::{RgbImage, decode_image, read_image};
pub use batch::{EvidenceBatch, ImageBatch, Images, PairBatch, PairNumbers, RightBatch};
pub use calibration::Calibration;
pub use coverage::{Coverage, FrameSpan};
pub use dataset::{Dataset, Pair, PairId, PairScope, Split, SplitName};
pub use drive::Drive;
pub use loader::{BatchLoader, Choice, LoadedBatch, Request};
pub use manifest::{Listed, Manifest, Motions, camera_axes_from_vehicle};
pub(crate) use oxts::EARTH_RADIUS_M;
pub use oxts::{OxtsPacket, world_from_vehicle};
pub(crate) use reader::SHOWS_NOTHING;
pub use reader::{BadFrame, PairReader, PairSample, RightImages};
