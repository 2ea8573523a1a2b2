//! The images that a depth network learns from: each with the one before it and the one after it, and the true
//! motion between them.

use std::collections::BTreeMap;
use std::sync::Arc;

use burn::tensor::Device;

use super::reprojection::NEIGHBOURS;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::files::sha256_hex;
use crate::geometry::Tangent;
use crate::model::ModelConfig;
use crate::pairs::{
    BatchLoader, Choice, Dataset, ImageBatch, Images, Pair, PairId, PairReader, PairScope, Request, Split, SplitName,
};
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
        Dataset::load(&Self::config(config).pairs(), PairScope::Images)
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
        let reader = Arc::new(PairReader::new(&loader.pairs(), dataset, split));
        Ok(Self { reader, fingerprint, pairs: Arc::new(pairs), loader })
    }

    pub fn len(&self) -> usize {
        self.pairs.len() / NEIGHBOURS
    }

    /// Shuffled mini-batches of `batch` targets without end, from the `first`-th on.
    pub fn shuffled(&self, seed: u64, batch: usize, first: usize) -> Result<TargetBatches> {
        let mut mixer = Mixer::new(seed, [(0..self.len(), batch.min(self.len()))]);
        let requests = (first..).map(move |batch| {
            let targets: Vec<usize> = mixer.plan(batch).pairs.iter().map(|planned| planned.pair).collect();
            request(&targets)
        });
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

    fn spawn(&self, requests: impl Iterator<Item = Request> + Send + 'static) -> Result<TargetBatches> {
        let loader =
            BatchLoader::spawn(self.reader.clone(), self.pairs.clone(), requests, &self.loader.training.loading())?;
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
    pub fn next(&mut self, device: &Device) -> Result<Option<ImageBatch>> {
        let batch = self.loader.next_batch()?;
        let whole = batch.complete;
        Ok(batch.numbers.filter(|_| whole).and_then(|numbers| numbers.upload(device).images))
    }
}

/// All targets with their first neighbour, then all with their second: as the loss wants them.
fn request(targets: &[usize]) -> Request {
    let choice = |neighbour: usize| {
        let pair = move |target| NEIGHBOURS * target + neighbour;
        targets.iter().map(move |target| Choice { pair: pair(target), draw: None, substitutes: None })
    };
    Request { choices: (0..NEIGHBOURS).flat_map(choice).collect(), images: Images::Included }
}

/// For each frame whose two neighbours are there: the pairs of which it is the target.
fn both_neighbours(split: &Split) -> Vec<Pair> {
    let mut by_source: BTreeMap<(usize, usize), Vec<&Pair>> = BTreeMap::new();
    split.pairs.iter().for_each(|pair| by_source.entry((pair.id.drive, pair.id.source)).or_default().push(pair));
    let step = |pair: &Pair| pair.id.target - pair.id.source;
    let mut pairs = Vec::new();
    for before in &split.pairs {
        let PairId { drive, target, .. } = before.id;
        // Where pairs are several numbers of frames apart: as nearly as far to one side as to the other as there are.
        let afters = by_source.get(&(drive, target)).into_iter().flatten();
        let Some(after) = afters.min_by_key(|after| step(after).abs_diff(step(before))) else { continue };
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

#[cfg(test)]
mod tests {
    use burn::tensor::Tensor;

    use super::super::photometric::Target;
    use super::*;
    use crate::synthetic::{Replace, SyntheticSettings, record};
    use crate::warp::{Warp, Warped};

    const CONFIG: &str = r#"
name = "street"
[data]
root = "data"
train = [{ drive = "2026_01_01_drive_0001_sync" }]
validation = []
test = []
[[systems]]
name = "truth"
share = 1.0
source = "truth"
[depth_training]
width = 192
height = 64
"#;

    /// Both neighbours of a target, warped by their motions and the depth of the road, look like it, and do not by
    /// each other's motion or none: a swapped or inverted pose would show.
    #[test]
    fn neighbours_are_explained_by_their_own_motion() {
        let folder = tempfile::tempdir().unwrap();
        let settings = SyntheticSettings {
            drives: 1,
            frames: 6,
            size: [192, 64],
            image_noise: 0.0,
            lidar_steps: 0,
            ..SyntheticSettings::default()
        };
        record(folder.path(), &settings, Replace::Never, &mut |_| Ok(())).unwrap();
        let mut config: Config = toml::from_str(CONFIG).unwrap();
        config.data.root = folder.path().to_owned();
        config.data.validation_fraction = 0.0;
        let dataset = Targets::load(&config).unwrap();
        let targets = Targets::new(&config, &dataset, SplitName::Train).unwrap();
        assert_eq!(targets.len(), 4, "six frames less the first and the last");

        let device = Device::flex();
        let batch = targets.in_order(4).unwrap().next(&device).unwrap().unwrap();
        let seen = Target::new(batch.target_image.clone());
        let error = |motion: Tensor<3>| {
            let depth = batch.target_depth.clone();
            let Warped { image, valid_mask } =
                Warp.forward(batch.source_image.clone(), depth, batch.intrinsics.clone(), motion);
            // The road: the lower third.
            let part = |tensor: Tensor<4>| tensor.narrow(2, 44, 20);
            let (error, valid) = (part(seen.photometric_error(image)), part(valid_mask));
            ((error * valid.clone()).sum() / valid.sum()).into_scalar::<f32>()
        };
        let motion = batch.source_from_target.clone();
        let own = error(motion.clone());
        let swapped = error(Tensor::cat(vec![motion.clone().narrow(0, 4, 4), motion.clone().narrow(0, 0, 4)], 0));
        let none = error(Tensor::eye(4, &device).unsqueeze::<3>().repeat_dim(0, 8));
        assert!(own < 0.6 * none && own < 0.6 * swapped, "{own}, without motion {none}, with the other's {swapped}");
    }
}
