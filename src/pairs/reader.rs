//! Reads what the network needs of a pair: two images and the target's depth at its size.
//!
//! Decoded frames are cached within a fixed budget, so memory does not grow with the data set. A
//! frame that cannot be read is remembered and counted; too many end the run.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard};

use nalgebra::Vector2;
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use super::dataset::Dataset;
use super::pair::{Pair, PairId};
use super::settings::{PairInput, PairSettings};
use super::split::SplitName;
use crate::alignment::{AlignmentInput, Evidence, EvidenceInput, GreyImage, align};
use crate::depth::{DepthConfig, DepthMap, load_depth};
use crate::error::{Error, Result};
use crate::geometry::{Pinhole, Pose, Tangent};
use crate::recordings::{Recording, RgbImage};

/// A pair ready for the network.
#[derive(Clone, Debug)]
pub struct PairSample {
    /// `I_i` at network size.
    pub source_image: Arc<RgbImage>,
    /// `I_{i+1}` at network size.
    pub target_image: Arc<RgbImage>,
    /// Depth of the target, m.
    pub target_depth: Arc<DepthMap>,
    /// Colour camera at network size.
    pub camera: Pinhole,
    /// Measured `ⁱT̂ᵢ₊₁`, axes of the colour camera, m.
    pub source_from_target: Pose,
    /// e, m and rad; zero where it is not known.
    pub error: Tangent,
    /// What the right camera saw, for models that look at it.
    pub right: Option<RightImages>,
    /// What direct alignment says of e, in its axes, for models that ask.
    pub evidence: Option<Evidence>,
}

impl PairSample {
    /// Whether a pixel of the target with known depth lies inside the source image (paper Eq. 5): else a warp is black.
    pub fn shows_target(&self) -> bool {
        let Pinhole { width, height, .. } = self.camera;
        let (right, bottom) = (width as f64 - 1.0, height as f64 - 1.0);
        self.target_depth.known().any(|(u, v, depth)| {
            let point = self.camera.backproject(&Vector2::new(u as f64, v as f64), f64::from(depth));
            let seen = self.camera.project(&self.source_from_target.transform_point(&point));
            seen.is_some_and(|pixel| (0.0..=right).contains(&pixel.x) && (0.0..=bottom).contains(&pixel.y))
        })
    }

    /// Aligns the two images from the measured pose on; `errors_from_camera` are the axes of the errors.
    pub fn align(&self, errors_from_camera: &Pose) -> Evidence {
        let grey = |image: &RgbImage| GreyImage::from_rgb(image.width, image.height, &image.bytes);
        let evidence = align(&AlignmentInput {
            source_image: &grey(&self.source_image),
            target_image: &grey(&self.target_image),
            target_depth_m: &self.target_depth.depth_m,
            camera: self.camera,
            source_from_target: self.source_from_target,
        });
        evidence.transported(errors_from_camera)
    }
}

/// The right camera's part of a pair.
#[derive(Clone, Debug)]
pub struct RightImages {
    /// Of time i, at network size.
    pub source_image: Arc<RgbImage>,
    /// Of time i + 1, at network size.
    pub target_image: Arc<RgbImage>,
    /// Points of the left camera into the right one, m; both have the same intrinsics.
    pub right_from_left: Pose,
}

/// What is said of a pair that a warp cannot be made of.
pub(crate) const SHOWS_NOTHING: &str =
    "by its pose and depth the source image shows nothing of the target; is it source_from_target, in metres?";

/// A frame that could not be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BadFrame {
    /// Name of the drive.
    pub drive: String,
    /// Frame index.
    pub frame: usize,
    /// Why.
    pub problem: String,
}

/// Reads pairs; shared by loader threads.
pub struct PairReader {
    root: PathBuf,
    drives: Vec<Recording>,
    cameras: Vec<Pinhole>,
    depth: DepthConfig,
    stereo: bool,
    evidence: EvidenceInput,
    frames: Cache<FrameKey, Frame, FrameWeighter>,
    bad_frames: Mutex<BTreeMap<FrameKey, String>>,
    needs_overlap: bool,
    /// System and frames of the pairs whose source shows nothing of the target.
    blind_pairs: Mutex<BTreeSet<(usize, PairId)>>,
    systems: Vec<String>,
    max_bad_frames: f64,
    max_bad_fraction: f64,
}

/// What is read of a frame: drive and frame index.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum FrameKey {
    Image(usize, usize),
    RightImage(usize, usize),
    Depth(usize, usize),
}

#[derive(Clone)]
enum Frame {
    Image(Arc<RgbImage>),
    Depth(Arc<DepthMap>),
}

#[derive(Clone)]
struct FrameWeighter;

impl Weighter<FrameKey, Frame> for FrameWeighter {
    fn weight(&self, _: &FrameKey, frame: &Frame) -> u64 {
        match frame {
            Frame::Image(image) => image.bytes.len() as u64,
            Frame::Depth(depth) => 4 * depth.depth_m.len() as u64,
        }
    }
}

impl PairReader {
    /// A reader for the pairs of one split at the configured network size.
    pub fn new(config: &PairSettings, dataset: &Dataset, split: SplitName) -> Self {
        let PairInput { width, height, stereo, evidence, needs_overlap } = config.input;
        let cache_bytes = config.data.cache_mb as u64 * 1_000_000;
        let typical_frame = (3 * width * height) as u64;
        let pairs = &dataset.split(split).pairs;
        let frames: HashSet<_> =
            pairs.iter().flat_map(|pair| [(pair.id.drive, pair.id.source), (pair.id.drive, pair.id.target)]).collect();
        let max_bad_fraction = config.data.max_bad_fraction;
        Self {
            root: dataset.root.clone(),
            cameras: dataset.drives.iter().map(|drive| drive.calibration.camera.resized(width, height)).collect(),
            drives: dataset.drives.clone(),
            depth: config.depth.clone(),
            stereo,
            evidence,
            frames: Cache::with_weighter((cache_bytes / typical_frame) as usize + 1, cache_bytes, FrameWeighter),
            bad_frames: Mutex::default(),
            needs_overlap,
            blind_pairs: Mutex::default(),
            systems: dataset.systems.clone(),
            max_bad_frames: max_bad_fraction * frames.len() as f64,
            max_bad_fraction,
        }
    }

    /// Memory that a pair takes in a batch: its colour images and a depth map of 32-bit floats.
    pub fn pair_bytes(&self) -> usize {
        let planes = if self.stereo { 4 * 3 + 1 } else { 2 * 3 + 1 };
        self.cameras.first().map_or(0, |camera| planes * size_of::<f32>() * camera.width * camera.height)
    }

    /// Reads a pair, or `None` when one of its frames is bad, or the source shows nothing of the target to a model that
    /// looks at a warp of it.
    ///
    /// # Errors
    /// More frames are bad than the configuration allows.
    pub fn read(&self, pair: &Pair) -> Result<Option<PairSample>> {
        self.read_drawn(pair, None)
    }

    /// The same by another draw of a generated measurement.
    ///
    /// # Errors
    /// As [`PairReader::read`].
    pub fn read_drawn(&self, pair: &Pair, draw: Option<usize>) -> Result<Option<PairSample>> {
        let PairId { drive, source, target } = pair.id;
        let (source_key, target_key) = (FrameKey::Image(drive, source), FrameKey::Image(drive, target));
        let depth_key = FrameKey::Depth(drive, target);
        let right_keys = [source, target].map(|frame| FrameKey::RightImage(drive, frame));
        let mut keys = [source_key, target_key, depth_key].into_iter().chain(right_keys);
        if keys.any(|key| self.bad_frames_lock().contains_key(&key)) {
            return Ok(None);
        }
        let source_image = self.unless_bad(source_key, self.image(source_key))?;
        let target_image = self.unless_bad(target_key, self.image(target_key))?;
        let (Some(source_image), Some(target_image)) = (source_image, target_image) else { return Ok(None) };
        let target_depth = self.unless_bad(depth_key, self.target_depth(drive, target, &target_image))?;
        let Some(target_depth) = target_depth else { return Ok(None) };
        let mut right = None;
        if self.stereo {
            let [source_image, target_image] = right_keys.map(|key| self.unless_bad(key, self.image(key)));
            let (Some(source_image), Some(target_image)) = (source_image?, target_image?) else { return Ok(None) };
            let right_from_left = self.drives[drive].calibration.right_from_left.expect("checked with the pairs");
            right = Some(RightImages { source_image, target_image, right_from_left });
        }
        let (source_from_target, error) = pair.measured(draw);
        let camera = self.cameras[drive];
        let mut sample = PairSample {
            source_image,
            target_image,
            target_depth,
            camera,
            source_from_target,
            error,
            right,
            evidence: None,
        };
        if self.needs_overlap && !sample.shows_target() {
            self.blind_lock().insert((pair.system, pair.id));
            return Ok(None);
        }
        if self.evidence == EvidenceInput::Alignment {
            sample.evidence = Some(sample.align(&pair.errors_from_camera));
        }
        Ok(Some(sample))
    }

    /// The frames that could not be read so far.
    pub fn bad_frames(&self) -> Vec<BadFrame> {
        let bad_frame = |(key, problem): (&FrameKey, &String)| {
            let (FrameKey::Image(drive, frame) | FrameKey::RightImage(drive, frame) | FrameKey::Depth(drive, frame)) =
                *key;
            BadFrame { drive: self.drives[drive].name.clone(), frame, problem: problem.clone() }
        };
        self.bad_frames_lock().iter().map(bad_frame).collect()
    }

    /// The pairs that were left out so far because their source shows nothing of the target, each described.
    pub fn blind_pairs(&self) -> Vec<String> {
        self.blind_lock().iter().map(|&(system, id)| self.describe_blind(system, id)).collect()
    }

    fn describe_blind(&self, system: usize, id: PairId) -> String {
        let drive = &self.drives[id.drive].name;
        format!("{drive}, {}, frames {} and {}: {SHOWS_NOTHING}", self.systems[system], id.source, id.target)
    }

    fn blind_lock(&self) -> MutexGuard<'_, BTreeSet<(usize, PairId)>> {
        self.blind_pairs.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn image(&self, key: FrameKey) -> Result<Arc<RgbImage>> {
        if let Some(Frame::Image(image)) = self.frames.get(&key) {
            return Ok(image);
        }
        let (drive, image) = match key {
            FrameKey::RightImage(drive, frame) => (drive, self.drives[drive].read_right_image(frame)?),
            FrameKey::Image(drive, frame) | FrameKey::Depth(drive, frame) => {
                (drive, self.drives[drive].read_image(frame)?)
            }
        };
        let camera = &self.cameras[drive];
        let image = Arc::new(image.resized(camera.width, camera.height));
        self.frames.insert(key, Frame::Image(image.clone()));
        Ok(image)
    }

    fn target_depth(&self, drive: usize, frame: usize, image: &RgbImage) -> Result<Arc<DepthMap>> {
        // The road looks the same from every frame of a drive.
        let cached_frame = if matches!(self.depth, DepthConfig::GroundPlane { .. }) { 0 } else { frame };
        let key = FrameKey::Depth(drive, cached_frame);
        if let Some(Frame::Depth(depth)) = self.frames.get(&key) {
            return Ok(depth);
        }
        let camera = &self.cameras[drive];
        let depth = Arc::new(load_depth(&self.depth, &self.drives[drive], frame, &self.root, camera, image)?);
        self.frames.insert(key, Frame::Depth(depth.clone()));
        Ok(depth)
    }

    /// What was read, or `None` when it could not be: that is remembered, and too often an error.
    fn unless_bad<T>(&self, key: FrameKey, read: Result<T>) -> Result<Option<T>> {
        let problem = match read {
            Ok(value) => return Ok(Some(value)),
            Err(problem) => problem,
        };
        let mut bad_frames = self.bad_frames_lock();
        if bad_frames.insert(key, problem.to_string()).is_none() {
            tracing::warn!("skipping a frame: {problem}");
        }
        if bad_frames.len() as f64 > self.max_bad_frames {
            return Err(Error::Data(format!(
                "{} unreadable frames are more than data.max_bad_fraction = {} allows; the last: {problem}",
                bad_frames.len(),
                self.max_bad_fraction
            )));
        }
        Ok(None)
    }

    fn bad_frames_lock(&self) -> MutexGuard<'_, BTreeMap<FrameKey, String>> {
        self.bad_frames.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}
