//! What training has reached: one row an epoch, and the sums of the epoch under way.

use serde::{Deserialize, Serialize};

/// Losses of a finished epoch (paper Eq. 7, mean over pairs, for each system).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochRow {
    /// Counted from 1.
    pub epoch: usize,
    /// Mini-batches since the start of training.
    pub batches: usize,
    /// Loss of each system over the epoch's mini-batches, dropout on; `None` for one that is not learned from.
    pub training_loss: Vec<Option<f64>>,
    /// Loss of each system on the watched split, dropout off; `None` for a system without pairs there.
    pub evaluation_loss: Vec<Option<f64>>,
    /// Share of predicted log-variances that sit on the floor, on the watched split.
    pub at_floor: f64,
    /// Training pairs per second, evaluation not counted.
    pub pairs_per_second: f64,
}

/// Everything besides weights that a resumed run must know.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct History {
    /// Mini-batches since the start of training.
    pub batches: usize,
    /// Finished epochs.
    pub rows: Vec<EpochRow>,
    /// Epoch of the lowest watched loss.
    pub best_epoch: Option<usize>,
    /// Mini-batches before the epoch under way.
    pub epoch_start: usize,
    /// Sum of losses and number of pairs of each system in the epoch under way.
    pub sums: Vec<(f64, usize)>,
    /// Seconds spent on the epoch under way.
    pub seconds: f64,
}

impl History {
    /// Training losses of one system, an epoch each; NaN for an epoch without any.
    pub fn training_losses(&self, system: usize) -> Vec<f64> {
        self.rows.iter().map(|row| row.training_loss[system].unwrap_or(f64::NAN)).collect()
    }

    /// Evaluation losses of one system, an epoch each; NaN for an epoch without any.
    pub fn evaluation_losses(&self, system: usize) -> Vec<f64> {
        self.rows.iter().map(|row| row.evaluation_loss[system].unwrap_or(f64::NAN)).collect()
    }

    /// Adds a pair's loss to the epoch under way.
    pub fn add(&mut self, system: usize, loss: f64) {
        let (sum, pairs) = &mut self.sums[system];
        *sum += loss;
        *pairs += 1;
    }

    /// A history with nothing done yet.
    pub fn new(systems: usize) -> Self {
        Self { sums: vec![(0.0, 0); systems], ..Self::default() }
    }

    /// Pairs learned in the epoch under way.
    pub fn pairs(&self) -> usize {
        self.sums.iter().map(|(_, pairs)| pairs).sum()
    }

    /// Pairs learned per second in the epoch under way.
    pub fn pairs_per_second(&self) -> f64 {
        self.pairs() as f64 / self.seconds
    }

    /// Closes the epoch under way with what the evaluation after it found.
    pub fn finish_epoch(&mut self, evaluation_loss: Vec<Option<f64>>, at_floor: f64) {
        self.rows.push(EpochRow {
            epoch: self.rows.len() + 1,
            batches: self.batches,
            training_loss: self.sums.iter().map(|&(sum, pairs)| (pairs > 0).then(|| sum / pairs as f64)).collect(),
            evaluation_loss,
            at_floor,
            pairs_per_second: self.pairs_per_second(),
        });
        self.sums.fill((0.0, 0));
        self.seconds = 0.0;
        self.epoch_start = self.batches;
    }

    /// The table `metrics.csv`: one row an epoch, losses in nats.
    pub fn to_csv(&self, systems: &[String]) -> String {
        let losses = |kind: &str| systems.iter().map(|system| format!(",{kind}_loss_{system}")).collect::<String>();
        let mut csv =
            format!("epoch,batches{}{},at_floor,pairs_per_second\n", losses("training"), losses("evaluation"));
        for row in &self.rows {
            let columns = |losses: &[Option<f64>]| -> String {
                losses.iter().map(|loss| loss.map_or(",".to_owned(), |loss| format!(",{loss:.6}"))).collect()
            };
            let (training, evaluation) = (columns(&row.training_loss), columns(&row.evaluation_loss));
            csv += &format!(
                "{},{}{training}{evaluation},{:.4},{:.2}\n",
                row.epoch, row.batches, row.at_floor, row.pairs_per_second
            );
        }
        csv
    }
}
