//! Running a model over the pairs of a split.

use std::sync::Arc;

use burn::tensor::{Device, Tensor};

use crate::alignment::NoVerdict;
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, Posterior, Tangent};
use crate::model::{CovarianceModel, Estimate};
use crate::pairs::{BatchLoader, Choice, Images, Loading, Pair, PairId, PairReader, Request, Split};

/// Outputs this close to their floor count as sitting on it, nats.
const FLOOR_MARGIN: f64 = 0.1;

/// A predicted covariance beside the error it should cover.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Which frames.
    pub pair: PairId,
    /// Index of the system.
    pub system: usize,
    /// e, order ρ then φ, m and rad.
    pub error: [f64; 6],
    /// Predicted covariance R, m² and rad².
    pub covariance: Covariance6,
    /// What is predicted of the error itself, of a model that does; R is its second moment.
    pub posterior: Option<Posterior>,
    /// Why the images say nothing of this error, where they do not.
    pub no_verdict: Option<NoVerdict>,
    /// `log T̂` in vehicle axes, m and rad.
    pub motion: Tangent,
    /// The covariance that the measurement states: the true one in simulated data.
    pub stated_covariance: Option<Covariance6>,
}

impl Prediction {
    /// A constant's prediction for a pair.
    pub fn constant(pair: &Pair, covariance: Covariance6) -> Self {
        Self::new(pair, Estimate { covariance, posterior: None, no_verdict: None })
    }

    /// What a model says of a pair.
    pub fn new(pair: &Pair, estimate: Estimate) -> Self {
        let Estimate { covariance, posterior, no_verdict } = estimate;
        Self {
            pair: pair.id,
            system: pair.system,
            error: pair.error.into(),
            covariance,
            posterior,
            no_verdict,
            motion: pair.motion,
            stated_covariance: pair.stated_covariance,
        }
    }

    /// What the model said.
    pub fn estimate(&self) -> Estimate {
        Estimate { covariance: self.covariance, posterior: self.posterior, no_verdict: self.no_verdict }
    }

    /// The loss of this pair, as training has it: `ln det R + eᵀR⁻¹e` (paper Eq. 7); of a posterior `corrected_share` of it
    /// is `ln det C + (e − μ)ᵀC⁻¹(e − μ)`.
    pub fn loss(&self, corrected_share: f64) -> f64 {
        let score = |covariance: &Covariance6, error: &Tangent| {
            let (distance, log_determinant) = covariance.mahalanobis(error).expect("predictions are positive");
            distance + log_determinant
        };
        let error = Tangent::from(self.error);
        let whole = score(&self.covariance, &error);
        self.posterior.map_or(whole, |posterior| {
            let corrected = score(&posterior.covariance, &(error - posterior.mean));
            corrected_share * corrected + (1.0 - corrected_share) * whole
        })
    }

    /// Diagonal of R, m² and rad².
    pub fn variance(&self) -> [f64; 6] {
        self.covariance.variance().into()
    }
}

/// Predicts every readable pair of a split, in order, with their images or by evidence alone; `progress` is told how many are done and may
/// end it by an error.
///
/// # Errors
/// Too many frames are unreadable, the device failed, a prediction is not finite, or `progress` says so.
pub fn predict_split(
    model: &CovarianceModel,
    reader: &Arc<PairReader>,
    split: &Split,
    images: Images,
    loading: &Loading,
    device: &Device,
    progress: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<Vec<Prediction>> {
    // Both systems look at the same images: side by side each is decoded once.
    let mut order: Vec<usize> = (0..split.pairs.len()).collect();
    order.sort_by_key(|&pair| (split.pairs[pair].id, split.pairs[pair].system));
    let choices: Vec<Choice> = order.into_iter().map(|pair| Choice { pair, draw: None, substitutes: None }).collect();
    let request = |choices: &[Choice]| Request { choices: choices.to_vec(), images };
    let requests: Vec<Request> = choices.chunks(loading.batch).map(request).collect();
    let pairs = Arc::new(split.pairs.clone());
    let batches = requests.len();
    let mut loader = BatchLoader::spawn(reader.clone(), pairs.clone(), requests.into_iter(), loading)?;

    let mut predictions = Vec::with_capacity(pairs.len());
    for _ in 0..batches {
        let batch = loader.next_batch()?;
        let Some(numbers) = batch.numbers else { continue };
        let outputs = read_values(model.forward(&numbers.upload(device)))?;
        let estimates = model.estimates(&outputs, &batch.evidence)?;
        predictions
            .extend(batch.pairs.iter().zip(estimates).map(|(&pair, estimate)| Prediction::new(&pairs[pair], estimate)));
        progress(predictions.len())?;
    }
    predictions.sort_by_key(|prediction| (prediction.system, prediction.pair));
    Ok(predictions)
}

/// Mean loss of one system's pairs; `None` without any.
pub fn mean_loss(predictions: &[Prediction], system: usize, corrected_share: f64) -> Option<f64> {
    let of_system = predictions.iter().filter(|prediction| prediction.system == system);
    let losses: Vec<f64> = of_system.map(|prediction| prediction.loss(corrected_share)).collect();
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

/// Share of log-variances d (of `R = L D(exp(d)) Lᵀ`) that sit on their floor.
pub fn share_at_floor<'a>(covariances: impl IntoIterator<Item = &'a Covariance6>, floor: &[f64; 6]) -> f64 {
    let (mut total, mut low) = (0_usize, 0_usize);
    for covariance in covariances {
        let pivots = covariance.pivots().expect("predictions are positive");
        total += 6;
        low += pivots.iter().zip(floor).filter(|(pivot, floor)| pivot.ln() < **floor + FLOOR_MARGIN).count();
    }
    low as f64 / total.max(1) as f64
}
