//! Running a model over the pairs of a split.

use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use burn::train::InferenceStep;

use crate::config::TrainingConfig;
use crate::data::{BatchLoader, Choice, Pair, PairId, PairReader, Split};
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, Tangent};
use crate::loss::LOG_VARIANCE_LIMIT;
use crate::model::CovarianceModel;

/// Outputs this close to their floor count as sitting on it, nats.
const FLOOR_MARGIN: f64 = 0.1;

/// A predicted diagonal covariance beside the error it should cover.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Which frames.
    pub pair: PairId,
    /// Index of the system.
    pub system: usize,
    /// e, order ρ then φ, m and rad.
    pub error: [f64; 6],
    /// d, ln m² and ln rad².
    pub log_variance: [f64; 6],
    /// `log T̂` in vehicle axes, m and rad.
    pub motion: Tangent,
    /// The covariance that the measurement states: the true one in simulated data.
    pub stated_covariance: Option<Covariance6>,
}

impl Prediction {
    /// A prediction for a pair.
    pub fn new(pair: &Pair, log_variance: [f64; 6]) -> Self {
        Self {
            pair: pair.id,
            system: pair.system,
            error: pair.error.into(),
            log_variance,
            motion: pair.motion,
            stated_covariance: pair.stated_covariance,
        }
    }

    /// The loss of this pair (paper Eq. 7): `sum(d) + eᵀ diag(exp(−d)) e`, d within the limits of
    /// [`gaussian_loss`](crate::loss::gaussian_loss).
    pub fn loss(&self) -> f64 {
        let limit = f64::from(LOG_VARIANCE_LIMIT);
        let terms = self.log_variance.iter().zip(self.error).map(|(d, e)| (d.clamp(-limit, limit), e));
        terms.map(|(d, e)| d + e * e * (-d).exp()).sum()
    }

    /// Diagonal of R, m² and rad².
    pub fn variance(&self) -> [f64; 6] {
        self.log_variance.map(f64::exp)
    }
}

/// Predicts every readable pair of a split, in order; `progress` is told how many are done and may
/// end it by an error.
///
/// # Errors
/// Too many frames are unreadable, the device failed, a prediction is not finite, or `progress` says so.
pub fn predict_split(
    model: &CovarianceModel,
    reader: &Arc<PairReader>,
    split: &Split,
    loading: &TrainingConfig,
    device: &Device,
    progress: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<Vec<Prediction>> {
    // Both systems look at the same images: side by side each is decoded once.
    let mut order: Vec<usize> = (0..split.pairs.len()).collect();
    order.sort_by_key(|&pair| (split.pairs[pair].id, split.pairs[pair].system));
    let choices: Vec<Choice> = order.into_iter().map(|pair| Choice { pair, substitutes: None }).collect();
    let requests: Vec<Vec<Choice>> = choices.chunks(loading.micro_batch).map(<[Choice]>::to_vec).collect();
    let pairs = Arc::new(split.pairs.clone());
    let batches = requests.len();
    let mut loader = BatchLoader::spawn(reader.clone(), pairs.clone(), requests.into_iter(), loading)?;

    let mut predictions = Vec::with_capacity(pairs.len());
    for _ in 0..batches {
        let batch = loader.next_batch()?;
        let Some(numbers) = batch.numbers else { continue };
        let values = read_values(InferenceStep::step(model, numbers.upload(device)).log_variance)?;
        for (&pair, log_variance) in batch.pairs.iter().zip(values.chunks_exact(6)) {
            let pair = &pairs[pair];
            let log_variance: [f64; 6] = log_variance.try_into().expect("six outputs");
            if log_variance.iter().any(|d| !d.is_finite()) {
                return Err(Error::Training(format!(
                    "the model predicts {log_variance:?} for frames {} and {}; its weights are not usable",
                    pair.id.source, pair.id.target
                )));
            }
            predictions.push(Prediction::new(pair, log_variance));
        }
        progress(predictions.len())?;
    }
    predictions.sort_by_key(|prediction| (prediction.system, prediction.pair));
    Ok(predictions)
}

/// Mean loss of one system's pairs; `None` without any.
pub fn mean_loss(predictions: &[Prediction], system: usize) -> Option<f64> {
    let losses: Vec<f64> =
        predictions.iter().filter(|prediction| prediction.system == system).map(Prediction::loss).collect();
    (!losses.is_empty()).then(|| losses.iter().sum::<f64>() / losses.len() as f64)
}

/// The numbers of a tensor, row-major, on the CPU.
///
/// # Errors
/// The device failed.
pub fn read_values<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f64>> {
    let data = tensor.try_into_data().map_err(|error| Error::Training(format!("the device failed: {error:?}")))?;
    Ok(data.iter::<f64>().collect())
}

/// Share of log-variances that sit on their floor.
pub fn share_at_floor<'a>(predictions: impl IntoIterator<Item = &'a Prediction>, floor: &[f64; 6]) -> f64 {
    let outputs = predictions.into_iter().flat_map(|prediction| prediction.log_variance.iter().zip(floor));
    let (mut total, mut low) = (0_usize, 0_usize);
    for (d, floor) in outputs {
        total += 1;
        low += usize::from(*d < floor + FLOOR_MARGIN);
    }
    low as f64 / total.max(1) as f64
}
