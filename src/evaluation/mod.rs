//! How good predicted covariances are: predictions, metrics, baselines, and the files that keep them.
//!
//! The only room that takes numbers from the device back to the CPU ([`read_values`]); everything after it is f64.
//! Scores come from a [`PairTable`], which knows neither images nor models. Knows nothing of tables and
//! pictures (`report`).

mod against_true;
mod baselines;
mod bootstrap;
mod by_name;
mod calibration;
mod correction;
mod depth_sources;
mod joint_scores;
mod log_linear;
mod methods;
mod metrics;
mod pair_file;
mod pair_reader;
mod pair_table;
mod perturbation;
mod prediction;
mod ranks;
mod recalibration;
mod results;
mod separation;
mod sparsification;
mod warped;

pub use against_true::AgainstTrue;
pub use baselines::Baselines;
pub use bootstrap::{BootstrapSettings, Resamples, optimal_block_length};
pub use by_name::ByName;
pub use calibration::{BinnedCalibration, CalibrationBin, ConditionalCalibration, calibration_bins};
pub use correction::RmsRatio;
pub use depth_sources::{SourceComparison, SourceScores, compare_depth_sources};
pub use log_linear::LogLinear;
pub use methods::Method;
pub use metrics::{CHI_SQUARED_6_95, Difference, Metrics, evaluate};
pub use pair_file::write_pairs;
pub use pair_reader::read_pairs;
pub use pair_table::{PairRow, PairTable, SystemPairs};
pub use perturbation::{PerturbationResponse, perturbation_response};
pub use prediction::{Prediction, mean_loss, predict_split, read_values, share_at_floor};
pub use ranks::quantile;
pub use recalibration::Recalibration;
pub use results::{Evaluation, Origin, SystemEvaluation, evaluate_table};
pub use separation::{Separation, separation};
pub use sparsification::{sparsification_areas, sparsification_curve};
pub use warped::{WarpedPair, warp_pair};
