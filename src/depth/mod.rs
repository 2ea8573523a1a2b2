//! Depth of the target image, in metres along the optical axis, at the network's size; 0 = unknown.
//!
//! Four sources: PNG files, LiDAR scans, a flat road, a depth network ([`monodepth2`]) whose maps are kept in a cache.

mod cache;
mod estimator;
mod files;
mod fill;
mod ground_plane;
mod judge;
mod lidar;
mod live;
mod map;
pub mod monodepth2;
mod precompute;
mod scale;
mod scores;
mod settings;
mod source;

pub use cache::DepthCache;
pub use estimator::{DepthEstimator, DepthRange};
pub(crate) use estimator::{holds_metric_weights, holds_published_weights, require_aspect};
pub(crate) use files::encode_depth_png;
pub use files::{decode_depth_png, read_depth_png, write_depth_png};
pub use fill::fill_gaps;
pub use ground_plane::ground_plane_depth;
pub use judge::{DepthJudge, JudgedDepth};
pub use lidar::{project_scan, read_scan};
pub use live::LiveDepth;
pub use map::DepthMap;
pub(crate) use map::EXPECTED_ASPECT;
pub use precompute::{FrameId, PrecomputeSummary, Present, precompute};
pub use scale::{ScaleRule, ScaleScope};
pub use scores::DepthScores;
pub use settings::{DepthConfig, NetworkDepthConfig};
pub(crate) use source::{depth_file, map_file};
pub use source::{has_depth, load_depth, native_depth};
