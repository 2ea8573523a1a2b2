//! How good predicted covariances are: predictions, metrics, baselines, and the files that keep them.
//!
//! The only door from the device back to the CPU ([`predict_split`]); everything after it is f64.
//! Knows nothing of tables and pictures (`report`).

mod metrics;
mod prediction;
mod results;

pub use metrics::{Metrics, evaluate};
pub use prediction::{Prediction, mean_loss, predict_split, read_values, share_at_floor};
pub use results::{Evaluation, MethodName, SystemEvaluation, evaluate_run, write_results};
