//! Error bars for any relative-pose measurement.
//!
//! Two camera images and the relative pose that some system (visual odometry, GNSS, wheels, ICP, …)
//! measured between them go in; the 6x6 covariance of that measurement comes out. Image i is warped
//! into view i+1 by the measured pose and a depth map; a small network looks at both and predicts
//! six log-variances, trained by the Gaussian likelihood of real errors.
//!
//! | to | see |
//! |---|---|
//! | predict a covariance with a trained model | [`Model`], its input a [`Measurement`], its output a [`Covariance6`] |
//! | know the error that the images show, and what remains without it | [`Model::judge`], its output a [`Judgement`]; [`alignment`] |
//! | predict for a whole data set, or for a stream of JSON lines | [`Model::predict_measurements`], [`Stream`], or `relcov predict` |
//! | hand covariances to GTSAM, g2o, ROS, … | [`export`] |
//! | fuse systems and fixes to a trajectory | [`fusion`], or `relcov fuse` |
//! | know what order, side, frame and unit a number has | [`geometry`] |
//! | train | [`training::Learner`], or `relcov train` |
//! | have depth for the warp, or train a network for it | [`depth`], [`training::depth`], or `relcov depth`, `relcov train-depth` |
//! | judge a model, or any covariances | [`evaluation`], or `relcov eval` |
//! | compare results, draw them | [`report`], or `relcov report` |
//! | have data whose true covariances are known | [`synthetic`], or `relcov synth` |
//! | read the method | [`model`], [`warp`], [`network`], [`loss`] |
//! | know why it is fast | [`kernels`] |
//!
//! Data flow one way: [`recordings`] → [`pairs`] (with [`systems`], [`depth`] and [`alignment`]) → [`warp`] → [`network`] → [`loss`] →
//! [`training`] (by its [`schedule`]) → [`evaluation`] → [`report`]; a trained [`Model`] → [`export`], [`fusion`]. Two worlds meet at two doors: [`pairs::PairBatch`] takes
//! f64 poses to f32 tensors, [`evaluation`] and [`Model::predict`] bring numbers back.
#![warn(missing_docs)]
#![deny(unsafe_code)]

pub mod alignment;
pub mod config;
pub mod depth;
pub mod device;
pub mod error;
pub mod evaluation;
pub mod export;
mod files;
pub mod fusion;
pub mod geometry;
pub mod kernels;
pub mod loss;
pub mod model;
pub mod network;
pub mod pairs;
mod predict;
pub mod recordings;
pub mod report;
pub mod schedule;
pub mod synthetic;
pub mod systems;
pub mod time;
pub mod training;
pub mod warp;

pub use error::{Error, Result};
pub use geometry::Covariance6;
pub use predict::{Judgement, Measurement, Model, RightView, Stream, StreamSettings};

#[doc(hidden)]
pub mod cli;

/// The commit this was built from, where that is known.
pub(crate) const COMMIT: Option<&str> = option_env!("RELCOV_GIT_COMMIT");
