//! The variables of the pose graph: `X(i)` is the pose `world_from_body` of the i-th frame that some motion reaches.

use factrs::assign_symbols;
use factrs::core::SE3;

assign_symbols!(X: SE3);
