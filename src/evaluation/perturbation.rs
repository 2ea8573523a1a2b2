//! Does the model see a wrong pose? The paper's thought experiment (Section IV-B): the same image
//! twice, so the true motion is none, and a measured pose `exp(ε)`.

use burn::tensor::Device;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::baselines::Baselines;
use super::prediction::read_values;
use super::ranks::spearman;
use crate::error::Result;
use crate::geometry::{ErrorFrame, Pose, Tangent};
use crate::model::CovarianceModel;
use crate::pairs::{Dataset, Pair, PairBatch, PairReader, PairSample, RightImages, Split};
use crate::systems::standard_normal;

/// Images that are perturbed, and perturbations of each.
const IMAGES: usize = 64;
const PERTURBATIONS: usize = 8;
/// Smallest and largest perturbation, in standard deviations of the system's errors.
const SIZE: [f64; 2] = [0.1, 10.0];

/// Rank correlation of predicted σ with the size of the perturbation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PerturbationResponse {
    /// Measurements made.
    pub pairs: usize,
    /// Between the geometric mean of σ over all components and `|ε|`, both in units of the system's
    /// constant σ.
    pub spearman: Option<f64>,
    /// Between σ and `|ε|` of each component.
    pub spearman_by_component: [Option<f64>; 6],
    /// Medians over the smallest, middle and largest third of `|ε|` of the geometric mean σ.
    pub median_sigma_by_third: [f64; 3],
}

/// Perturbs images of a split: `ε = s u σ`, u a random direction, s log-uniform from 0.1 to 10, σ the
/// first system's constant standard deviations, by the baselines that its model's run fitted. The error frame is the
/// model's.
///
/// `None` in world axes, in which an image alone has no place, and for a system the run was not trained
/// on or that has no errors.
///
/// # Errors
/// Too many frames are unreadable, or the device failed.
pub fn perturbation_response(
    model: &CovarianceModel,
    reader: &PairReader,
    dataset: &Dataset,
    split: &Split,
    baselines: &[(String, Baselines)],
    error_frame: ErrorFrame,
    device: &Device,
) -> Result<Option<PerturbationResponse>> {
    let first = baselines.iter().find(|(system, _)| *system == dataset.systems[0]);
    let constant = first.map(|(_, fitted)| fitted.mean_squared_error);
    let Some(constant_variance) = constant.filter(|variance| variance.iter().all(|&value| value > 0.0)) else {
        return Ok(None);
    };
    let camera_from_frame = |pair: &Pair| match error_frame {
        ErrorFrame::Vehicle => Some(dataset.drives[pair.id.drive].calibration.camera_from_vehicle),
        ErrorFrame::Camera => Some(Pose::identity()),
        ErrorFrame::World => None,
    };
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let (mut sizes, mut sigmas): (Vec<f64>, Vec<f64>) = Default::default();
    let (mut components, mut component_sigmas): ([Vec<f64>; 6], [Vec<f64>; 6]) = Default::default();
    let pairs = &split.pairs[split.systems[0].clone()];
    for pair in pairs.iter().step_by(pairs.len().div_ceil(IMAGES).max(1)) {
        let Some(camera_from_frame) = camera_from_frame(pair) else { return Ok(None) };
        let Some(sample) = reader.read(pair)? else { continue };
        let perturbations: Vec<Tangent> = (0..PERTURBATIONS)
            .map(|_| {
                let direction = Tangent::from_fn(|_, _| standard_normal(&mut random)).normalize();
                let size = (SIZE[0].ln() + (SIZE[1] / SIZE[0]).ln() * random.random_range(0.0..1.0)).exp();
                size * direction.component_mul(&Tangent::from(constant_variance.map(f64::sqrt)))
            })
            .collect();
        let samples: Vec<PairSample> = perturbations
            .iter()
            .map(|perturbation| {
                let mut sample = PairSample {
                    source_image: sample.target_image.clone(),
                    right: sample
                        .right
                        .as_ref()
                        .map(|right| RightImages { source_image: right.target_image.clone(), ..right.clone() }),
                    source_from_target: Pose::exp(perturbation).conjugated_by(&camera_from_frame),
                    ..sample.clone()
                };
                sample.evidence = sample.evidence.as_ref().map(|_| sample.align(&pair.errors_from_camera));
                sample
            })
            .collect();
        let outputs = read_values(model.forward(&PairBatch::new(&samples, device)))?;
        let evidence: Vec<_> = samples.into_iter().map(|sample| sample.evidence).collect();
        for (perturbation, estimate) in perturbations.iter().zip(model.estimates(&outputs, &evidence)?) {
            let variance = estimate.covariance.variance();
            let relative = |c: usize| (variance[c] / constant_variance[c]).sqrt();
            sigmas.push((0..6).map(|c| relative(c).ln()).sum::<f64>() / 6.0);
            sizes.push((0..6).map(|c| perturbation[c] * perturbation[c] / constant_variance[c]).sum::<f64>().sqrt());
            for c in 0..6 {
                components[c].push(perturbation[c].abs());
                component_sigmas[c].push(variance[c]);
            }
        }
    }
    if sizes.is_empty() {
        return Ok(None);
    }
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by(|&a, &b| sizes[a].total_cmp(&sizes[b]));
    let third = |part: usize| {
        let range = part * order.len() / 3..(part + 1) * order.len() / 3;
        super::ranks::median(order[range].iter().map(|&index| sigmas[index]).collect()).unwrap_or(f64::NAN).exp()
    };
    Ok(Some(PerturbationResponse {
        pairs: sizes.len(),
        spearman: spearman(&sizes, &sigmas),
        spearman_by_component: std::array::from_fn(|c| spearman(&components[c], &component_sigmas[c])),
        median_sigma_by_third: [0, 1, 2].map(third),
    }))
}
