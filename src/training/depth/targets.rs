//! The images that a depth network learns from: each with the one before it and the one after it, and the true
//! motion between them.

use std::collections::BTreeMap;
use std::sync::Arc;

use burn::tensor::Device;

use super::reprojection::NEIGHBOURS;
use crate::config::{Config, ModelConfig};
use crate::data::{BatchLoader, Choice, Dataset, Pair, PairBatch, PairId, PairReader, PairScope, Split, SplitName};
use crate::error::{Error, Result};
use crate::files::sha256_hex;
use crate::geometry::Tangent;
use crate::systems::Mixer;

/// The targets of one split.
pub(super) struct Targets {
    reader: Arc<PairReader>,
    /// Tells these targets from others.
    pub fingerprint: String,
    /// Target by target: the pair with the image before, then the one with the image after.
    pairs: Arc<Vec<Pair>>,
    loader: Config,
}

impl Targets {
    /// The configuration that gives pairs of true motions at the depth network's size.
    pub fn config(config: &Config) -> Config {
        let mut config = config.with_truth_alone();
        let (width, height) = (config.depth_training.width, config.depth_training.height);
        config.model = ModelConfig { width, height, ..ModelConfig::default() };
        config.training.micro_batch = NEIGHBOURS * config.depth_training.batch;
        config
    }

    /// The data that [`Targets::config`] asks for.
    ///
    /// # Errors
    /// As [`Dataset::load`].
    pub fn load(config: &Config) -> Result<Dataset> {
        Dataset::load(&Self::config(config), PairScope::Images)
    }

    /// The targets of a split of that data.
    ///
    /// # Errors
    /// There is none.
    pub fn new(config: &Config, dataset: &Dataset, split: SplitName) -> Result<Self> {
        let pairs = both_neighbours(dataset.split(split));
        if pairs.is_empty() {
            return Err(Error::Data(format!(
                "split `{}` has no three images in a row with true poses, which training depth needs; `relcov inspect --config …` shows what each drive holds, data.{} (or data.validation_fraction) chooses",
                split.name(),
                split.name()
            )));
        }
        let names = pairs
            .iter()
            .map(|Pair { id, .. }| format!("{} {} {}\n", dataset.drives[id.drive].name, id.source, id.target));
        let fingerprint = sha256_hex(names.collect::<String>().as_bytes());
        let loader = Self::config(config);
        let reader = Arc::new(PairReader::new(&loader, dataset, split));
        Ok(Self { reader, fingerprint, pairs: Arc::new(pairs), loader })
    }

    pub fn len(&self) -> usize {
        self.pairs.len() / NEIGHBOURS
    }

    /// Shuffled mini-batches of `batch` targets without end, from the `first`-th on.
    pub fn shuffled(&self, seed: u64, batch: usize, first: usize) -> Result<TargetBatches> {
        let mut mixer = Mixer::new(seed, [(0..self.len(), batch.min(self.len()))]);
        let requests = (first..).map(move |batch| request(&mixer.plan(batch).pairs));
        self.spawn(requests)
    }

    /// All targets in order, once.
    pub fn in_order(&self, batch: usize) -> Result<TargetBatches> {
        let count = self.len();
        let requests = (0..count).step_by(batch).map(move |first| {
            let targets: Vec<usize> = (first..count.min(first + batch)).collect();
            request(&targets)
        });
        self.spawn(requests)
    }

    fn spawn(&self, requests: impl Iterator<Item = Vec<Choice>> + Send + 'static) -> Result<TargetBatches> {
        let loader = BatchLoader::spawn(self.reader.clone(), self.pairs.clone(), requests, &self.loader.training)?;
        Ok(TargetBatches { loader })
    }
}

/// Mini-batches of targets, read ahead.
pub(super) struct TargetBatches {
    loader: BatchLoader,
}

impl TargetBatches {
    /// The next mini-batch, or `None` where one of its images cannot be read.
    ///
    /// # Errors
    /// Too many images cannot be read.
    pub fn next(&mut self, device: &Device) -> Result<Option<PairBatch>> {
        let batch = self.loader.next_batch()?;
        let whole = batch.complete;
        Ok(batch.numbers.filter(|_| whole).map(|numbers| numbers.upload(device)))
    }
}

/// All targets with their first neighbour, then all with their second: as the loss wants them.
fn request(targets: &[usize]) -> Vec<Choice> {
    let choice = |neighbour: usize| {
        targets.iter().map(move |target| Choice { pair: NEIGHBOURS * target + neighbour, substitutes: None })
    };
    (0..NEIGHBOURS).flat_map(choice).collect()
}

/// For each frame whose two neighbours are there: the pairs of which it is the target.
fn both_neighbours(split: &Split) -> Vec<Pair> {
    let by_source: BTreeMap<(usize, usize), &Pair> =
        split.pairs.iter().map(|pair| ((pair.id.drive, pair.id.source), pair)).collect();
    let mut pairs = Vec::new();
    for before in &split.pairs {
        let PairId { drive, target, .. } = before.id;
        let Some(after) = by_source.get(&(drive, target)) else { continue };
        pairs.push(before.clone());
        pairs.push(Pair {
            id: PairId { drive, source: after.id.target, target },
            source_from_target: after.source_from_target.inverse(),
            error: Tangent::zeros(),
            ..before.clone()
        });
    }
    pairs
}
