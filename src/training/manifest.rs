//! The manifest of a run: everything its stored model depends on.

use nalgebra::Matrix3x4;
use serde::{Deserialize, Serialize};

use crate::evaluation::Baselines;
use crate::geometry::{Conventions, Pose};
use crate::model::Architecture;

/// Version of the run folder's layout.
pub(super) const LAYOUT: u32 = 1;
/// The pinned version of Burn, whose records the state files are.
pub(super) const BURN_VERSION: &str = "0.22.1";

/// Largest `|RᵀR − I|` of a rotation that was written in full.
const ROUNDING: f64 = 1e-9;

/// What a stored model depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of the folder's layout.
    pub layout: u32,
    /// Version of this program.
    pub relcov_version: String,
    /// Commit it was built from, if known.
    pub git_commit: Option<String>,
    /// Version of Burn.
    pub burn_version: String,
    /// Backend the run was started on.
    pub device: String,
    /// Seed of the run.
    pub seed: u64,
    /// Order, units, frames of every number.
    pub conventions: Conventions,
    /// Shape of the model.
    pub architecture: Architecture,
    /// What every first prediction was: ln(mean e²) of the mixed training set.
    pub initial_log_variance: [f64; 6],
    /// Vehicle axes into those of the camera on the first training drive: the upper three rows of the matrix, row by row, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_from_vehicle: Option<[f64; 12]>,
    /// The systems it was trained on.
    pub systems: Vec<SystemSummary>,
    /// Hash of all pairs and errors.
    pub data_fingerprint: String,
    /// Hash of every setting that a resumed run must share.
    pub experiment_fingerprint: String,
}

impl Manifest {
    /// Vehicle axes into those of the camera on the first training drive, m; `None` where the run does not say.
    pub fn camera_from_vehicle(&self) -> Option<Pose> {
        let rows = Matrix3x4::from_row_slice(&self.camera_from_vehicle?);
        let rotation = rows.fixed_columns::<3>(0).into();
        Pose::from_rounded_parts(rotation, rows.column(3).into(), ROUNDING).ok()
    }
}

/// A system as the training set shows it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SystemSummary {
    /// Its name.
    pub name: String,
    /// Its share of each mini-batch.
    pub share: f64,
    /// Its training pairs.
    pub training_pairs: usize,
    /// The baselines fitted to them.
    #[serde(flatten)]
    pub baselines: Baselines,
}
