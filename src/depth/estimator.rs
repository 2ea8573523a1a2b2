//! A depth network with its weights: images in, depth maps out.

use std::path::Path;

use burn::store::{ModuleSnapshot, SafetensorsStore};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use super::monodepth2::{Monodepth2, PublishedWeights, disparity_to_depth, is_input_size};
use super::{DepthMap, ScaleRule};
use crate::error::{Error, Place, Result};
use crate::files::{put_in_place, read_text, sha256_hex, temporary_name, write_atomically};
use crate::recordings::RgbImage;

/// What `relcov train-depth` leaves: weights, and what they are for.
const METRIC_WEIGHTS: &str = "depth.safetensors";
const METRIC_MANIFEST: &str = "depth.json";
/// The files of a folder of published weights.
const PUBLISHED: [&str; 2] = ["encoder.pth", "depth.pth"];

/// How much wider or narrower than the network's input an image may be before its content is squeezed too much.
const MOST_SQUEEZE: f64 = 1.2;
/// Units of depths of the published networks that were trained on stereo pairs, m (Monodepth2: a baseline of 0.1 for
/// KITTI's 0.54 m).
const STEREO_UNIT_M: f64 = 5.4;

/// Least and most depth that a network can state, in its units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthRange {
    /// At disparity 1.
    pub min: f64,
    /// At disparity 0.
    pub max: f64,
}

impl DepthRange {
    /// Of the published networks.
    pub const PUBLISHED: Self = Self { min: 0.1, max: 100.0 };
}

/// A frozen depth network.
///
/// ```no_run
/// # use relcov::depth::{DepthEstimator, ScaleRule};
/// # use relcov::recordings::read_image;
/// # fn main() -> relcov::Result<()> {
/// let device = relcov::device::open_device("auto")?;
/// let estimator = DepthEstimator::load("weights/mono+stereo_640x192".as_ref(), &device)?;
/// let image = read_image("frame.png".as_ref())?;
/// // Metres, by the factor that belongs to weights trained on stereo pairs; see ScaleRule for those that have none.
/// let depth = estimator.estimate(&[image])?.swap_remove(0).scaled(5.4);
/// # let _ = (depth, ScaleRule::Mean);
/// # Ok(())
/// # }
/// ```
pub struct DepthEstimator {
    network: Monodepth2,
    weights: Weights,
    /// Input width, px.
    pub width: usize,
    /// Input height, px.
    pub height: usize,
    range: DepthRange,
    /// The rule these weights call for: their own factor where they have one, else by LiDAR.
    pub default_scale: ScaleRule,
    /// Name and SHA-256 of each file of weights.
    pub hashes: Vec<(String, String)>,
    device: Device,
}

/// Where weights come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Weights {
    /// The authors of Monodepth2.
    Published,
    /// Training here: depths are metres.
    Metric,
}

/// Beside weights that were trained here.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct MetricManifest {
    schema: u32,
    width: usize,
    height: usize,
    range_m: DepthRange,
}

impl DepthEstimator {
    /// Loads the weights of a folder: `encoder.pth` and `depth.pth` as Monodepth2's authors publish them, or what
    /// `relcov train-depth` made.
    ///
    /// # Errors
    /// The folder holds neither; a file is damaged or of another architecture.
    pub fn load(folder: &Path, device: &Device) -> Result<Self> {
        // A frozen network has no gradients.
        let device = device.clone().inner();
        let (metric, published) = (holds_metric_weights(folder), holds_published_weights(folder));
        if metric && published {
            return Err(Error::Data(format!(
                "{}: two depth networks there, a published one and one that `relcov train-depth` made; keep each in a folder of its own",
                folder.display()
            )));
        }
        if metric {
            return Self::load_metric(folder, device);
        }
        if !published {
            return Err(Error::Data(format!(
                "{}: no depth network there; expected encoder.pth and depth.pth as published by Monodepth2, or a folder that `relcov train-depth` made; docs/depth.md says where to get weights, and how to do without",
                folder.display()
            )));
        }
        let PublishedWeights { network, width, height, stereo } = PublishedWeights::load(folder, &device)?;
        let default_scale = if stereo { ScaleRule::Fixed(STEREO_UNIT_M) } else { ScaleRule::Mean };
        let hashes = weight_hashes(folder)?;
        Ok(Self {
            network,
            weights: Weights::Published,
            width,
            height,
            range: DepthRange::PUBLISHED,
            default_scale,
            hashes,
            device,
        })
    }

    fn load_metric(folder: &Path, device: Device) -> Result<Self> {
        let path = folder.join(METRIC_MANIFEST);
        let expected = "what `relcov train-depth` of this version writes";
        let malformed = |found: String| Error::malformed(&path, Place::Whole, found, expected);
        let MetricManifest { schema, width, height, range_m } =
            serde_json::from_str(&read_text(&path)?).map_err(|error| malformed(error.to_string()))?;
        let sizes = is_input_size(width) && is_input_size(height);
        if schema != 1 || !sizes || !(range_m.min > 0.0 && range_m.max > range_m.min) {
            return Err(malformed(format!("schema {schema}, {width}x{height}, {range_m:?}")));
        }
        let mut network = Monodepth2::init(0.5, &device);
        let weights = folder.join(METRIC_WEIGHTS);
        let malformed = |found: String| {
            let found = found.lines().find(|line| !line.trim().is_empty()).unwrap_or_default().to_owned();
            Error::malformed(&weights, Place::Whole, found, expected)
        };
        let applied = network
            .load_from(&mut SafetensorsStore::from_file(&weights))
            .map_err(|error| malformed(error.to_string()))?;
        if !applied.is_success() {
            return Err(malformed(applied.to_string()));
        }
        let hashes = weight_hashes(folder)?;
        Ok(Self {
            network,
            weights: Weights::Metric,
            width,
            height,
            range: range_m,
            default_scale: ScaleRule::Fixed(1.0),
            hashes,
            device,
        })
    }

    /// Keeps a network whose depths are metres, for [`DepthEstimator::load`].
    ///
    /// # Errors
    /// The folder cannot be written; what was there stays.
    pub fn save_metric(network: &Monodepth2, size: [usize; 2], range_m: DepthRange, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
        let weights = folder.join(METRIC_WEIGHTS);
        let temporary = folder.join(temporary_name(METRIC_WEIGHTS));
        network.save_into(&mut SafetensorsStore::from_file(&temporary).overwrite(true)).map_err(|error| {
            let _ = std::fs::remove_file(&temporary);
            Error::Io { action: "write", path: weights.clone(), reason: std::io::Error::other(error.to_string()) }
        })?;
        put_in_place(&temporary, &weights)?;
        let [width, height] = size;
        let manifest = MetricManifest { schema: 1, width, height, range_m };
        let json = serde_json::to_string_pretty(&manifest).expect("a manifest is JSON");
        write_atomically(&folder.join(METRIC_MANIFEST), json.as_bytes())
    }

    /// Removes what [`DepthEstimator::save_metric`] wrote into a folder.
    ///
    /// # Errors
    /// A file cannot be removed.
    pub fn remove_metric(folder: &Path) -> Result<()> {
        let files = [METRIC_MANIFEST, METRIC_WEIGHTS].map(|file| folder.join(file));
        let mut present = files.iter().filter(|path| path.exists());
        present.try_for_each(|path| std::fs::remove_file(path).map_err(Error::io("remove", path)))
    }

    /// An image as the network was trained to take it: Lanczos for published weights, bilinear for those made here.
    ///
    /// # Errors
    /// The image's aspect is so different that the network would see another world.
    pub fn prepare(&self, image: RgbImage) -> Result<RgbImage> {
        require_aspect([image.width, image.height], [self.width, self.height])?;
        Ok(match self.weights {
            Weights::Published => image.resized_sharply(self.width, self.height),
            Weights::Metric => image.resized(self.width, self.height),
        })
    }

    /// Depth maps at the network's size, in its units: metres after [`DepthMap::scaled`]. Where its aspect is not the
    /// images', [`DepthMap::resized`] gives them that again.
    ///
    /// # Errors
    /// An image has another aspect, or the network's output is not finite.
    pub fn estimate(&self, images: &[RgbImage]) -> Result<Vec<DepthMap>> {
        let prepared = images.iter().map(|image| self.prepare(image.clone())).collect::<Result<Vec<_>>>()?;
        self.estimate_prepared(&prepared)
    }

    /// The same for images that are [prepared](DepthEstimator::prepare).
    pub(super) fn estimate_prepared(&self, images: &[RgbImage]) -> Result<Vec<DepthMap>> {
        let (width, height) = (self.width, self.height);
        let mut planes = Vec::with_capacity(3 * width * height * images.len());
        images.iter().for_each(|image| image.extend_planar(&mut planes));
        let images = TensorData::new(planes, [images.len(), 3, height, width]);
        let disparity = self.network.disparity(Tensor::from_data(images, &self.device));
        let depth = disparity_to_depth(disparity, self.range.min, self.range.max);
        let depths = depth
            .into_data()
            .try_into_vec::<f32>()
            .map_err(|error| Error::Data(format!("the depth network's output cannot be read: {error:?}")))?;
        if depths.iter().any(|depth| !depth.is_finite()) {
            return Err(Error::Data("the depth network's output is not finite: damaged weights".to_owned()));
        }
        Ok(depths
            .chunks_exact(width * height)
            .map(|depth_m| DepthMap { width, height, depth_m: depth_m.to_vec() })
            .collect())
    }
}

/// That an image keeps its look when it is brought to a network's size.
///
/// # Errors
/// The aspects differ too much.
pub(crate) fn require_aspect(image: [usize; 2], network: [usize; 2]) -> Result<()> {
    let squeeze = (image[0] * network[1]) as f64 / (image[1] * network[0]) as f64;
    if (1.0 / MOST_SQUEEZE..=MOST_SQUEEZE).contains(&squeeze) {
        return Ok(());
    }
    Err(Error::Data(format!(
        "an image of {}x{} pixels is squeezed {squeeze:.2} times to fit the depth network's {}x{}; crop it to that aspect, or take a network trained at its own",
        image[0], image[1], network[0], network[1]
    )))
}

/// Whether a folder holds published weights, or a part of them.
pub(crate) fn holds_published_weights(folder: &Path) -> bool {
    PUBLISHED.iter().any(|file| folder.join(file).is_file())
}

/// Whether a folder holds weights that were trained here.
pub(crate) fn holds_metric_weights(folder: &Path) -> bool {
    folder.join(METRIC_MANIFEST).is_file()
}

/// Name and SHA-256 of each file of a folder's weights.
pub(super) fn weight_hashes(folder: &Path) -> Result<Vec<(String, String)>> {
    let files: &[&str] = if holds_metric_weights(folder) { &[METRIC_WEIGHTS] } else { &PUBLISHED };
    let hash = |file: &&str| {
        let path = folder.join(file);
        let bytes = std::fs::read(&path).map_err(Error::io("read", &path))?;
        Ok(((*file).to_owned(), sha256_hex(&bytes)))
    };
    files.iter().map(hash).collect()
}
