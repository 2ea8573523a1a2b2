//! Fast CPU operations: what training and prediction spend their time in, for Burn's flex backend.
//!
//! Tensors of any device come in; on flex with 32-bit floats they go to the kernels of this room, on
//! every other device to Burn's own operations, with the same result up to rounding. One departure: a
//! value that is not kept counts as 0 even if it is NaN (dropped by dropout, or a weight times an input
//! of 0 in a product with one row). The kernels themselves work on plain slices, know nothing of Burn,
//! and hold all `unsafe` of the crate: each block says why it is sound. They are written once, generic
//! over vector instructions (`RELCOV_INSTRUCTIONS` forces a set, see `instructions.rs`).

#![allow(unsafe_code, reason = "the one room where speed needs it")]
#![deny(clippy::undocumented_unsafe_blocks)]
#![cfg_attr(not(feature = "flex"), allow(unused, dead_code, reason = "only flex has kernels"))]

mod activation;
mod adam;
mod block;
mod border;
mod buffer;
mod convolution;
mod dense;
#[cfg(feature = "flex")]
mod extension;
#[cfg(feature = "flex")]
mod flex;
mod fused;
mod instructions;
mod layouts;
mod operations;
mod optimiser;
mod pool;
mod product;
mod reference;
mod self_test;
mod shape;
mod tile;
mod warp;

pub(crate) use block::{Block, double};
pub(crate) use border::Border;
pub(crate) use fused::Activation;
pub(crate) use instructions::{Instructions, Kernel};
pub(crate) use operations::{conv2d, linear, max_pool, relu_dropout, warp};
pub use optimiser::Adam;
pub(crate) use self_test::{deviation_by, deviation_on};
pub(crate) use warp::Validity;
