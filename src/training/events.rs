//! What a learner tells: the steps of a training, and how it ended.

use super::history::EpochRow;

/// What an observer is told.
#[derive(Clone, Debug)]
pub enum Event<'a> {
    /// Training begins or continues.
    Started {
        /// Batches already done (0 for a new run).
        batches_done: usize,
        /// Batches in an epoch.
        batches_per_epoch: usize,
        /// Trainable weights.
        parameters: usize,
        /// Loss of the constant predictor on the watched split, for each system.
        constant_loss: &'a [Option<f64>],
    },
    /// A mini-batch was learned.
    Batch {
        /// Counted from 1.
        epoch: usize,
        /// Of the epoch, counted from 1.
        batch: usize,
        /// Pairs learned per second in this epoch.
        pairs_per_second: f64,
        /// Mean loss of the batch.
        loss: f64,
    },
    /// The watched pairs are being evaluated after an epoch.
    Evaluation {
        /// Pairs done.
        done: usize,
        /// Pairs in all.
        pairs: usize,
    },
    /// An epoch was finished and saved.
    Epoch {
        /// Its losses.
        row: &'a EpochRow,
        /// Whether it is the best so far.
        best: bool,
    },
}

/// How a training ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Why.
    pub reason: StopReason,
    /// Finished epochs.
    pub epochs: usize,
    /// The epoch whose model was kept.
    pub best_epoch: usize,
}

/// Why a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// Training and evaluation loss diverged.
    Diverged,
    /// All epochs were done.
    AllEpochs,
}
