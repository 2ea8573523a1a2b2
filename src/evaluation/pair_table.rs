//! Measurements with their errors and predicted covariances, free of images and models: what every score and
//! figure is made from.

use std::ops::Range;
use std::sync::Arc;

use super::correction::{corrected_covariance, corrected_error};
use super::prediction::Prediction;
use crate::alignment::NoVerdict;
use crate::files::sha256_hex;
use crate::geometry::{Covariance6, ErrorFrame, Posterior};
use crate::pairs::{Dataset, Pair, PairId, Split};

/// All systems of a split.
#[derive(Clone, Debug, PartialEq)]
pub struct PairTable {
    /// Axes of errors and covariances.
    pub error_frame: ErrorFrame,
    /// The systems, in the order of tables.
    pub systems: Vec<SystemPairs>,
}

/// The measurements of one system, drive after drive, frame after frame.
#[derive(Clone, Debug, PartialEq)]
pub struct SystemPairs {
    /// Its name.
    pub name: String,
    /// Whether the covariances it states are the true ones.
    pub simulated: bool,
    /// Its measurements.
    pub rows: Vec<PairRow>,
}

/// One measurement.
#[derive(Clone, Debug, PartialEq)]
pub struct PairRow {
    /// Where it was made.
    pub drive: Arc<str>,
    /// Frame i.
    pub source: usize,
    /// Frame i + 1.
    pub target: usize,
    /// Time between the frames, s.
    pub interval_s: Option<f64>,
    /// `log T̂` in vehicle axes, order ρ then φ, m and rad.
    pub motion: Option<[f64; 6]>,
    /// e, order ρ then φ, m and rad.
    pub error: [f64; 6],
    /// The predicted covariance R, m² and rad².
    pub covariance: Option<Covariance6>,
    /// What was predicted of the error itself; R is its second moment.
    pub posterior: Option<Posterior>,
    /// Why the images say nothing of this error, where they do not.
    pub no_verdict: Option<NoVerdict>,
    /// What the measurement itself states, m² and rad².
    pub stated: Option<Covariance6>,
}

impl PairTable {
    /// The predictions of a model for a split.
    pub fn from_predictions(predictions: &[Prediction], dataset: &Dataset, error_frame: ErrorFrame) -> Self {
        Self::collect(dataset, error_frame, |system, drives| {
            let rows = predictions.iter().filter(|row| row.system == system);
            let row = |row: &Prediction| PairRow {
                motion: Some(row.motion.into()),
                error: row.error,
                covariance: Some(row.covariance),
                posterior: row.posterior,
                no_verdict: row.no_verdict,
                stated: row.stated_covariance,
                ..drives.row(row.pair)
            };
            rows.map(row).collect()
        })
    }

    /// The measurements of a split without predictions.
    pub fn from_split(split: &Split, dataset: &Dataset, error_frame: ErrorFrame) -> Self {
        Self::collect(dataset, error_frame, |system, drives| {
            let row = |pair: &Pair| PairRow {
                motion: Some(pair.motion.into()),
                error: pair.error.into(),
                stated: pair.stated_covariance,
                ..drives.row(pair.id)
            };
            split.pairs_of(system).iter().map(row).collect()
        })
    }

    /// System by system, rows in the order of their names.
    fn collect(
        dataset: &Dataset,
        error_frame: ErrorFrame,
        rows_of: impl Fn(usize, &DriveNames) -> Vec<PairRow>,
    ) -> Self {
        let drives =
            DriveNames { dataset, names: dataset.drives.iter().map(|drive| Arc::from(drive.name.as_str())).collect() };
        let systems = dataset.systems.iter().zip(&dataset.simulated).enumerate().map(|(index, (name, &simulated))| {
            let mut rows = rows_of(index, &drives);
            rows.sort_by_key(PairRow::key);
            SystemPairs { name: name.clone(), simulated, rows }
        });
        Self { error_frame, systems: systems.collect() }
    }
}

/// The drives of a data set, each name kept once.
struct DriveNames<'a> {
    dataset: &'a Dataset,
    names: Vec<Arc<str>>,
}

impl DriveNames<'_> {
    /// Where and when a pair was made; nothing measured yet.
    fn row(&self, pair: PairId) -> PairRow {
        let times = &self.dataset.drives[pair.drive].times;
        let interval_s =
            times.get(&pair.target).zip(times.get(&pair.source)).map(|(target, source)| target.since(*source));
        PairRow {
            drive: self.names[pair.drive].clone(),
            source: pair.source,
            target: pair.target,
            interval_s: interval_s.filter(|&interval| interval > 0.0),
            motion: None,
            error: [0.0; 6],
            covariance: None,
            posterior: None,
            no_verdict: None,
            stated: None,
        }
    }
}

impl SystemPairs {
    /// Errors of all rows, m and rad.
    pub fn errors(&self) -> Vec<[f64; 6]> {
        self.rows.iter().map(|row| row.error).collect()
    }

    /// Hash of which measurements these are and by how much they are wrong.
    pub fn fingerprint(&self) -> String {
        let mut text = String::new();
        for PairRow { drive, source, target, error, .. } in &self.rows {
            // A tenth of a micrometre: the same on every machine's libm.
            let error = error.map(|error| (error * 1e7).round() as i64);
            text += &format!("{drive} {source} {target} {error:?}\n");
        }
        sha256_hex(text.as_bytes())
    }

    /// Whether it is the truth itself.
    pub fn is_truth(&self) -> bool {
        !self.rows.is_empty() && self.rows.iter().all(|row| row.error == [0.0; 6])
    }

    /// The rows of each drive.
    pub fn drives(&self) -> Vec<Range<usize>> {
        let mut first = 0;
        let lengths = self.rows.chunk_by(|a, b| a.drive == b.drive).map(<[PairRow]>::len);
        lengths
            .map(|length| {
                first += length;
                first - length..first
            })
            .collect()
    }
}

impl PairRow {
    /// Which frames, in an order that sorts them.
    pub fn key(&self) -> (Arc<str>, usize, usize) {
        (self.drive.clone(), self.source, self.target)
    }

    /// What is left of the error once the predicted part is taken away; e where none was predicted. m and rad.
    pub fn corrected_error(&self) -> [f64; 6] {
        corrected_error(&self.error, self.posterior.as_ref())
    }

    /// The predicted covariance of what is left; R where no part of the error was predicted.
    pub fn corrected_covariance(&self) -> Option<Covariance6> {
        Some(corrected_covariance(&self.covariance?, self.posterior.as_ref()))
    }

    /// Measured speed, m/s.
    pub fn speed_m_s(&self) -> Option<f64> {
        let [x, y, z, ..] = self.motion?;
        Some((x * x + y * y + z * z).sqrt() / self.interval_s?)
    }
}

/// A measurement with equal errors and variances in all components, whose true σ is 0.2.
#[cfg(test)]
pub(super) fn made_row(source: usize, error: f64, variance: f64) -> PairRow {
    use crate::geometry::Tangent;
    PairRow {
        drive: Arc::from("drive"),
        source,
        target: source + 1,
        interval_s: Some(0.1),
        motion: None,
        error: [error; 6],
        covariance: Some(Covariance6::from_variances(&Tangent::repeat(variance))),
        posterior: None,
        no_verdict: None,
        stated: Some(Covariance6::from_std_devs(&Tangent::repeat(0.2))),
    }
}
