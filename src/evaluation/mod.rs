//! How good predicted covariances are: predictions, metrics, baselines, and the files that keep them.
//!
//! The only room that takes numbers from the device back to the CPU ([`read_values`]); everything after it is f64.
//! Knows nothing of tables and pictures (`report`).

mod baselines;
mod log_linear;
mod metrics;
mod perturbation;
mod prediction;
mod ranks;
mod results;
mod warped;

pub use baselines::Baselines;
pub use log_linear::LogLinear;
pub use metrics::{AgainstTrue, Metrics, evaluate, evaluate_full};
pub use perturbation::{PerturbationResponse, perturbation_response};
pub use prediction::{Prediction, mean_loss, predict_split, read_values, share_at_floor};
pub use results::{Evaluation, MethodName, Separation, SystemEvaluation, evaluate_run, write_results};
pub use warped::{WarpedPair, warp_pair};
