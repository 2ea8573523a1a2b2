//! Measurements with their errors and predicted covariances, free of images and models: what every score and
//! figure is made from.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use super::prediction::Prediction;
use crate::data::{Dataset, Split};
use crate::files::sha256_hex;
use crate::geometry::{Covariance6, ErrorFrame};

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
    /// What was predicted, m² and rad².
    pub covariance: Option<Covariance6>,
    /// What the measurement itself states, m² and rad².
    pub stated: Option<Covariance6>,
}

impl PairTable {
    /// The predictions of a model for a split.
    pub fn from_predictions(predictions: &[Prediction], dataset: &Dataset, error_frame: ErrorFrame) -> Self {
        let names = drive_names(dataset);
        let systems = dataset.systems.iter().zip(&dataset.simulated).enumerate().map(|(index, (name, &simulated))| {
            let rows = predictions.iter().filter(|prediction| prediction.system == index).map(|prediction| PairRow {
                drive: names[prediction.pair.drive].clone(),
                source: prediction.pair.source,
                target: prediction.pair.target,
                interval_s: interval_s(dataset, prediction.pair.drive, prediction.pair.source, prediction.pair.target),
                motion: Some(prediction.motion.into()),
                error: prediction.error,
                covariance: Some(prediction.covariance),
                stated: prediction.stated_covariance,
            });
            SystemPairs::new(name, simulated, rows)
        });
        Self { error_frame, systems: systems.collect() }
    }

    /// The measurements of a split without predictions.
    pub fn from_split(split: &Split, dataset: &Dataset, error_frame: ErrorFrame) -> Self {
        let names = drive_names(dataset);
        let systems = dataset.systems.iter().zip(&dataset.simulated).enumerate().map(|(index, (name, &simulated))| {
            let rows = split.pairs_of(index).iter().map(|pair| PairRow {
                drive: names[pair.id.drive].clone(),
                source: pair.id.source,
                target: pair.id.target,
                interval_s: interval_s(dataset, pair.id.drive, pair.id.source, pair.id.target),
                motion: Some(pair.motion.into()),
                error: pair.error.into(),
                covariance: None,
                stated: pair.stated_covariance,
            });
            SystemPairs::new(name, simulated, rows)
        });
        Self { error_frame, systems: systems.collect() }
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

    /// The measurements of a system in the order of their names.
    fn new(name: &str, simulated: bool, rows: impl Iterator<Item = PairRow>) -> Self {
        let mut rows: Vec<PairRow> = rows.collect();
        rows.sort_by_key(PairRow::key);
        Self { name: name.to_owned(), simulated, rows }
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

    /// Measured speed, m/s.
    pub fn speed_m_s(&self) -> Option<f64> {
        let [x, y, z, ..] = self.motion?;
        Some((x * x + y * y + z * z).sqrt() / self.interval_s?)
    }
}

fn drive_names(dataset: &Dataset) -> Vec<Arc<str>> {
    dataset.drives.iter().map(|drive| Arc::from(drive.name.as_str())).collect()
}

fn interval_s(dataset: &Dataset, drive: usize, source: usize, target: usize) -> Option<f64> {
    let times: &BTreeMap<usize, f64> = &dataset.drives[drive].timestamps_s;
    Some(times.get(&target)? - times.get(&source)?).filter(|&interval| interval > 0.0)
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
        stated: Some(Covariance6::from_std_devs(&Tangent::repeat(0.2))),
    }
}
