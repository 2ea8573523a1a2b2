//! Generated measurements of a data set: true motions, wrong by drawn errors (the paper's "measurement generation").

use std::sync::Arc;

use nalgebra::Vector6;

use super::pair::Pair;
use super::settings::PairSettings;
use crate::error::{Error, Result};
use crate::recordings::Recording;
use crate::systems::{Perturbation, PerturbationConfig, SystemConfig, SystemSource};

/// Gives the pairs of generated systems, true so far, the errors of their first draw; the size of their errors, for each
/// system that is generated and has pairs. `splits` are train, validation and test.
///
/// # Errors
/// Nothing tells how large the errors shall be.
pub(super) fn generate(
    config: &PairSettings,
    drives: &[Recording],
    splits: &mut [Vec<Pair>; 3],
) -> Result<Vec<Option<[f64; 6]>>> {
    let mut sizes = vec![None; config.systems.len()];
    for (system, SystemConfig { name, source, .. }) in config.systems.iter().enumerate() {
        let SystemSource::Perturbation(PerturbationConfig { base }) = source else { continue };
        if splits.iter().flatten().all(|pair| pair.system != system) {
            // Without a true pose nothing can be generated; who needs the pairs says so.
            continue;
        }
        let base = match base {
            Some(base) => *base,
            None => typical_error(config, &splits[0]).ok_or_else(|| no_size(system, name))?,
        };
        sizes[system] = Some(base);
        let drive_names = drives.iter().map(|drive| drive.name.as_str());
        let perturbation = Arc::new(Perturbation::new(config.seed, name, base, drive_names));
        for pair in splits.iter_mut().flatten().filter(|pair| pair.system == system) {
            let error = perturbation.draw(pair.id.drive, [pair.id.source, pair.id.target], 0);
            pair.source_from_target = pair.wrong_by(&error);
            let vehicle_from_camera = drives[pair.id.drive].calibration.camera_from_vehicle.inverse();
            pair.motion = pair.source_from_target.conjugated_by(&vehicle_from_camera).log();
            pair.error = error;
            pair.generated = Some(perturbation.clone());
        }
    }
    Ok(sizes)
}

/// Root mean square of the errors of all measuring systems that are learned from; `None` where a component has none.
fn typical_error(config: &PairSettings, train: &[Pair]) -> Option<[f64; 6]> {
    let measures = |pair: &&Pair| {
        let system = &config.systems[pair.system];
        system.share > 0.0 && !matches!(system.source, SystemSource::Truth {} | SystemSource::Perturbation(_))
    };
    let errors: Vec<_> = train.iter().filter(measures).map(|pair| pair.error).collect();
    let sum: Vector6<f64> = errors.iter().map(|error| error.component_mul(error)).sum();
    let typical = (sum / errors.len().max(1) as f64).map(f64::sqrt);
    (typical.min() > 0.0).then(|| typical.into())
}

fn no_size(system: usize, name: &str) -> Error {
    Error::config(
        format!("systems.{system}.base"),
        format!(
            "the training pairs show no errors of other systems in every component, which could tell the size of those of `{name}`; give six sizes, m and rad"
        ),
    )
}
