//! Predictions for all measurements of a data set, ready to be exported.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::Model;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::evaluation::{Prediction, predict_split};
use crate::export::{MeasuredMotion, MeasuredMotions, Verdict};
use crate::geometry::{ErrorFrame, Pose};
use crate::model::Estimate;
use crate::pairs::{Dataset, PairReader, Split};
use crate::recordings::Recording;
use crate::systems::TruthConfig;

impl Model {
    /// Predicts every readable measurement of a split, images decoded ahead of the network; one entry for each system
    /// and drive, in their order; poses, covariances and what is known of the errors in axes of `output`. `config` is the
    /// data set's, with the size of this model.
    ///
    /// `progress` is told how many are done and may end it by an error.
    ///
    /// # Errors
    /// Too many frames are unreadable, the device failed, or axes of the world are asked for and the vehicle's pose in it
    /// is not known.
    pub fn predict_measurements(
        &self,
        config: &Config,
        dataset: &Dataset,
        split: &Split,
        output: ErrorFrame,
        progress: &mut dyn FnMut(usize) -> Result<()>,
    ) -> Result<Vec<MeasuredMotions>> {
        let reader = Arc::new(PairReader::new(&config.pairs(), dataset, split.name));
        let images = self.architecture.images();
        let predictions =
            predict_split(&self.network, &reader, split, images, &config.training.loading(), &self.device, progress)?;
        let blind = reader.blind_pairs();
        if let Some(first) = blind.first() {
            tracing::warn!("{} pairs are left out; the first: {first}", blind.len());
        }
        let mut groups: BTreeMap<(usize, usize), Vec<MeasuredMotion>> = BTreeMap::new();
        for prediction in &predictions {
            let Prediction { pair, system, motion, .. } = prediction;
            let drive = &dataset.drives[pair.drive];
            let world_from_vehicle = drive
                .poses
                .get(&pair.source)
                .filter(|_| matches!(config.truth, TruthConfig::Oxts {} | TruthConfig::Recording {}));
            let axes = |frame| axes_from_vehicle(drive, frame, world_from_vehicle);
            let output_from_vehicle = axes(output)?;
            let estimate =
                in_axes(self.recalibrated(prediction.estimate()), &axes(self.error_frame)?, &output_from_vehicle);
            let times = drive.times.get(&pair.source).zip(drive.times.get(&pair.target));
            groups.entry((*system, pair.drive)).or_default().push(MeasuredMotion {
                source: pair.source,
                target: pair.target,
                times: times.map(|(&source, &target)| [source, target]),
                source_from_target: Pose::exp(motion).conjugated_by(&output_from_vehicle),
                covariance: estimate.covariance,
                posterior: estimate.posterior,
                verdict: self.has_evidence().then(|| Verdict::of(estimate.no_verdict)),
            });
        }
        let named = |((system, drive), motions): ((usize, usize), Vec<MeasuredMotion>)| MeasuredMotions {
            system: dataset.systems[system].clone(),
            drive: dataset.drives[drive].name.clone(),
            frame: output,
            motions,
        };
        Ok(groups.into_iter().map(named).collect())
    }
}

/// What was said of an error in axes of its own, in those of the output.
fn in_axes(estimate: Estimate, errors_from_vehicle: &Pose, output_from_vehicle: &Pose) -> Estimate {
    if errors_from_vehicle == output_from_vehicle {
        return estimate;
    }
    let output_from_errors = *output_from_vehicle * errors_from_vehicle.inverse();
    Estimate {
        covariance: estimate.covariance.transported(&output_from_errors),
        posterior: estimate.posterior.map(|posterior| posterior.transported(&output_from_errors)),
        ..estimate
    }
}

fn axes_from_vehicle(drive: &Recording, frame: ErrorFrame, world_from_vehicle: Option<&Pose>) -> Result<Pose> {
    drive.calibration.axes_from_vehicle(frame, world_from_vehicle).ok_or_else(|| {
        Error::Data(format!(
            "{}: axes of the world need the vehicle's pose in it (truth.source = \"recording\"), which these data do not have; take --frame vehicle or camera",
            drive.name
        ))
    })
}
