//! Reads batches ahead of the network: one thread keeps the order, a small pool decodes, a bounded
//! channel limits how far ahead.

use std::ops::Range;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

use rayon::ThreadPoolBuilder;
use rayon::prelude::*;

use super::batch::{Images, PairNumbers};
use super::pair::Pair;
use super::reader::{PairReader, PairSample};
use crate::alignment::Evidence;
use crate::error::{Error, Result};

/// How batches are read ahead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loading {
    /// Pairs in a batch.
    pub batch: usize,
    /// Threads that read.
    pub threads: usize,
    /// Most batches that wait to be taken.
    pub prefetch: usize,
    /// Most memory that waiting batches may take, MB; one waits in any case.
    pub prefetch_mb: usize,
}

/// A batch to read.
#[derive(Clone, Debug)]
pub struct Request {
    /// Its pairs.
    pub choices: Vec<Choice>,
    /// Whether their images are laid out, or their evidence alone.
    pub images: Images,
}

/// A pair to read, and what to do when it cannot be read.
#[derive(Clone, Debug)]
pub struct Choice {
    /// Index of the pair.
    pub pair: usize,
    /// Which draw of a generated measurement; `None`: that of the data set. Others are as they were measured.
    pub draw: Option<usize>,
    /// Pairs that may stand in for it, the next readable one after it; none: it is left out.
    pub substitutes: Option<Range<usize>>,
}

/// A batch as it comes from the loader.
#[derive(Clone, Debug)]
pub struct LoadedBatch {
    /// Indices of the pairs that were read, in order.
    pub pairs: Vec<usize>,
    /// Their numbers; `None` when every pair was left out.
    pub numbers: Option<PairNumbers>,
    /// Their evidence, where the reader makes any.
    pub evidence: Vec<Option<Evidence>>,
    /// Whether no pair was left out.
    pub complete: bool,
}

/// Batches that are read in the background, in the order they were asked for.
pub struct BatchLoader {
    batches: Option<Receiver<Result<LoadedBatch>>>,
    thread: Option<JoinHandle<()>>,
}

impl BatchLoader {
    /// Starts reading.
    ///
    /// # Errors
    /// Threads cannot be started.
    pub fn spawn(
        reader: Arc<PairReader>,
        pairs: Arc<Vec<Pair>>,
        requests: impl Iterator<Item = Request> + Send + 'static,
        loading: &Loading,
    ) -> Result<Self> {
        let failed = |error: &dyn std::fmt::Display| Error::Training(format!("cannot start loader threads: {error}"));
        let pool = ThreadPoolBuilder::new()
            .num_threads(loading.threads)
            .thread_name(|index| format!("loader-{index}"))
            .build()
            .map_err(|error| failed(&error))?;
        let batch_bytes = loading.batch * reader.pair_bytes();
        let fitting = loading.prefetch_mb.saturating_mul(1_000_000) / batch_bytes.max(1);
        // One more waits in the producer's hands.
        let (sender, batches) = sync_channel(fitting.min(loading.prefetch).saturating_sub(1));
        let thread = std::thread::Builder::new()
            .name("loader".to_owned())
            .spawn(move || {
                for request in requests {
                    let batch = pool.install(|| load(&reader, &pairs, &request));
                    let failed = batch.is_err();
                    // The receiver is gone when training stopped.
                    if sender.send(batch).is_err() || failed {
                        return;
                    }
                }
            })
            .map_err(|error| failed(&error))?;
        Ok(Self { batches: Some(batches), thread: Some(thread) })
    }

    /// The next batch of those asked for.
    ///
    /// # Errors
    /// Too many frames are unreadable, or the loader ended early.
    pub fn next_batch(&mut self) -> Result<LoadedBatch> {
        let ended = || Error::Training("the data loader ended early; its message stands above".to_owned());
        self.batches.as_ref().and_then(|batches| batches.recv().ok()).ok_or_else(ended)?
    }
}

impl Drop for BatchLoader {
    fn drop(&mut self) {
        drop(self.batches.take());
        if let Some(thread) = self.thread.take() {
            // A panic of the loader has already been printed; the batches it owed are missed.
            let _ = thread.join();
        }
    }
}

fn load(reader: &PairReader, pairs: &[Pair], request: &Request) -> Result<LoadedBatch> {
    let read: Vec<Option<(usize, PairSample)>> =
        request.choices.par_iter().map(|choice| read_choice(reader, pairs, choice)).collect::<Result<_>>()?;
    let (pairs, samples): (Vec<usize>, Vec<PairSample>) = read.into_iter().flatten().unzip();
    let numbers = (!samples.is_empty()).then(|| PairNumbers::new(&samples, request.images));
    let complete = pairs.len() == request.choices.len();
    Ok(LoadedBatch { pairs, numbers, evidence: samples.into_iter().map(|sample| sample.evidence).collect(), complete })
}

fn read_choice(reader: &PairReader, pairs: &[Pair], choice: &Choice) -> Result<Option<(usize, PairSample)>> {
    let candidates: Box<dyn Iterator<Item = usize>> = match &choice.substitutes {
        None => Box::new(std::iter::once(choice.pair)),
        Some(range) => Box::new((choice.pair..range.end).chain(range.start..choice.pair)),
    };
    for candidate in candidates {
        if let Some(sample) = reader.read_drawn(&pairs[candidate], choice.draw)? {
            return Ok(Some((candidate, sample)));
        }
    }
    match &choice.substitutes {
        None => Ok(None),
        Some(_) => Err(Error::Data("not one pair of a system can be read".to_owned())),
    }
}
