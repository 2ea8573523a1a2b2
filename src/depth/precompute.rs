//! Runs a depth network over the frames of an experiment and keeps its maps: each once, in batches, with images
//! decoded ahead and maps written in parallel. Memory holds a few batches, however many frames there are.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::sync_channel;

use rayon::ThreadPoolBuilder;
use rayon::prelude::*;

use super::cache::CacheManifest;
use super::estimator::require_aspect;
use super::files::FARTHEST_M;
use super::{DepthCache, DepthEstimator, DepthMap, ScaleRule, ScaleScope, encode_depth_png, project_scan, read_scan};
use crate::depth::NetworkDepthConfig;
use crate::error::{Error, Result};
use crate::files::write_renamed;
use crate::geometry::Pinhole;
use crate::recordings::{Recording, RgbImage};

/// Frames that go through the network at once.
const BATCH: usize = 4;
/// Batches that wait for the network.
const PREFETCH: usize = 2;
/// Scans from which a sequence's factor is taken: spread evenly over it.
const SCANS_FOR_A_SEQUENCE: usize = 50;

/// What was done.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PrecomputeSummary {
    /// Maps that were there already.
    pub kept: usize,
    /// Maps that were made.
    pub made: usize,
    /// Of the maps made, those scaled by the frame's own scan.
    pub by_own_scan: usize,
    /// Of the maps made, those scaled by the factor of their sequence.
    pub by_sequence: usize,
    /// Sequences without a usable scan that needed a factor.
    pub borrowed: Vec<String>,
    /// Frames whose image cannot be read, and why; they have no map.
    pub unreadable: Vec<String>,
    /// Mean factor of each sequence that was needed and has scans.
    pub sequence_factors: BTreeMap<String, f64>,
    /// What the sequences without take.
    pub borrowed_factor: Option<f64>,
}

/// A frame of a drive, by their indices.
pub type FrameId = (usize, usize);

/// What happens to maps that are there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Present {
    /// They stay, if they were made by the same weights and settings.
    Keep,
    /// They are removed once the new ones can be made.
    Replace,
}

/// Makes the maps that a cache lacks.
///
/// `observe` hears how many of how many are done; an error of its ends the work. What is finished stays, and the next
/// call goes on from there. Frames whose image cannot be read have no map.
///
/// # Errors
/// The cache was made otherwise or cannot be written, the images have another aspect than the network, no scale can be
/// found, or more than `max_bad_fraction` of the frames cannot be read.
pub fn precompute(
    estimator: &DepthEstimator,
    config: &NetworkDepthConfig,
    drives: &[Recording],
    frames: &[FrameId],
    max_bad_fraction: f64,
    present: Present,
    observe: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<PrecomputeSummary> {
    for Recording { name, calibration, .. } in drives {
        let Pinhole { width, height, .. } = calibration.camera;
        let named = |error: Error| Error::Data(format!("{name}: {error}"));
        require_aspect([width, height], [estimator.width, estimator.height]).map_err(named)?;
    }
    let cache = DepthCache::of(config);
    let wanted = CacheManifest::new(estimator, config);
    let mut manifest = match present {
        Present::Keep => cache.begin(wanted)?,
        Present::Replace => cache.refuse_foreign().map(|()| wanted)?,
    };
    manifest.add_drives(drives, cache.folder())?;
    let is_missing = |&(drive, frame): &FrameId| present == Present::Replace || !cache.holds(&drives[drive], frame);
    let missing: Vec<FrameId> = frames.iter().copied().filter(is_missing).collect();
    let mut summary = PrecomputeSummary { kept: frames.len() - missing.len(), ..PrecomputeSummary::default() };
    let max_bad_frames = max_bad_fraction * frames.len() as f64;
    let run = NetworkRun { estimator, drives, rule: manifest.scale(), max_bad_frames };
    let mut factors = SequenceFactors::new(&run, std::mem::take(&mut manifest.sequence_factors));
    let has_own_scan =
        |&(drive, frame): &FrameId| config.scope == ScaleScope::Frame && drives[drive].scans.contains_key(&frame);
    // Found now rather than after hours: whether there is a scale at all.
    for id in missing.iter().filter(|id| !has_own_scan(id)) {
        factors.of(id.0)?;
    }
    if present == Present::Replace {
        cache.clear()?;
    }
    manifest.sequence_factors.clone_from(&factors.measured);
    cache.write(&manifest)?;
    for drive in drives {
        let folder = cache.map_path(drive, 0).parent().expect("a map lies in a folder").to_owned();
        std::fs::create_dir_all(&folder).map_err(Error::io("create the folder", &folder))?;
    }
    let total = missing.len();
    let scans = if config.scope == ScaleScope::Frame { Scans::Read } else { Scans::Leave };
    summary.unreadable = run.for_each_batch(&missing, scans, |maps| {
        let mut scaled = Vec::with_capacity(maps.len());
        for map in maps {
            let own = if config.scope == ScaleScope::Frame { run.own_factor(&map) } else { None };
            *(if own.is_some() { &mut summary.by_own_scan } else { &mut summary.by_sequence }) += 1;
            let factor = own.map_or_else(|| factors.of(map.id.0), Ok)?;
            // What lies beyond the format is far, not unknown.
            scaled.push((map.id, map.depth.scaled(factor).bounded(FARTHEST_M)));
        }
        scaled.par_iter().try_for_each(|((drive, frame), map)| {
            write_renamed(&cache.map_path(&drives[*drive], *frame), &encode_depth_png(map))
        })?;
        summary.made += scaled.len();
        observe(summary.made, total)
    })?;
    if factors.measured != manifest.sequence_factors {
        manifest.sequence_factors.clone_from(&factors.measured);
        cache.write(&manifest)?;
    }
    summary.sequence_factors = factors.measured;
    summary.borrowed = factors.without.into_iter().map(|drive| drives[drive].name.clone()).collect();
    summary.borrowed_factor = factors.borrowed;
    Ok(summary)
}

/// A network at work on the frames of some drives.
struct NetworkRun<'a> {
    estimator: &'a DepthEstimator,
    drives: &'a [Recording],
    rule: ScaleRule,
    max_bad_frames: f64,
}

/// Whether scans are wanted beside images.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Scans {
    Read,
    Leave,
}

/// A frame as the network takes it.
struct PreparedFrame {
    id: FrameId,
    image: RgbImage,
    returns: Option<DepthMap>,
}

/// What the network says of a frame, in its units, and what the LiDAR does.
struct NetworkMap {
    id: FrameId,
    depth: DepthMap,
    returns: Option<DepthMap>,
}

/// The factors of sequences, each found when it is first needed.
struct SequenceFactors<'a> {
    run: &'a NetworkRun<'a>,
    /// Of sequences with usable scans.
    measured: BTreeMap<String, f64>,
    /// Sequences without.
    without: BTreeSet<usize>,
    /// What those take: the mean of all others.
    borrowed: Option<f64>,
}

impl<'a> SequenceFactors<'a> {
    fn new(run: &'a NetworkRun<'a>, measured: BTreeMap<String, f64>) -> Self {
        Self { run, measured, without: BTreeSet::new(), borrowed: None }
    }

    fn of(&mut self, drive: usize) -> Result<f64> {
        if let ScaleRule::Fixed(factor) = self.run.rule {
            return Ok(factor);
        }
        match (self.measured(drive)?, self.borrowed) {
            (Some(factor), _) | (None, Some(factor)) => Ok(factor),
            (None, None) => self.borrow(drive),
        }
    }

    fn measured(&mut self, drive: usize) -> Result<Option<f64>> {
        let name = &self.run.drives[drive].name;
        if let Some(factor) = self.measured.get(name) {
            return Ok(Some(*factor));
        }
        if self.without.contains(&drive) {
            return Ok(None);
        }
        let factor = self.run.sequence_factor(drive)?;
        match factor {
            Some(factor) => drop(self.measured.insert(name.clone(), factor)),
            None => drop(self.without.insert(drive)),
        }
        Ok(factor)
    }

    fn borrow(&mut self, for_drive: usize) -> Result<f64> {
        let mut known = Vec::new();
        for drive in 0..self.run.drives.len() {
            known.extend(self.measured(drive)?);
        }
        let name = &self.run.drives[for_drive].name;
        if known.is_empty() {
            return Err(Error::config(
                "depth.scale",
                format!(
                    "metres by LiDAR need scans (velodyne_points), and neither {name} nor another drive of the experiment has a usable one; a factor that is known needs none: depth.scale = {{ fixed = 5.4 }} for published weights trained on stereo pairs"
                ),
            ));
        }
        let mean = known.iter().sum::<f64>() / known.len() as f64;
        tracing::warn!(
            "{name} has no usable LiDAR scan: its depth takes the mean factor of the other sequences, {mean:.3}"
        );
        self.borrowed = Some(mean);
        Ok(mean)
    }
}

impl NetworkRun<'_> {
    /// Mean of the factors of scans spread over a sequence, `None` without a usable one.
    fn sequence_factor(&self, drive: usize) -> Result<Option<f64>> {
        let Recording { scans, images, .. } = &self.drives[drive];
        let scanned: Vec<usize> = scans.keys().copied().filter(|frame| images.contains_key(frame)).collect();
        let count = scanned.len().min(SCANS_FOR_A_SEQUENCE);
        let spread: Vec<FrameId> =
            (0..count).map(|index| (drive, scanned[(2 * index + 1) * scanned.len() / (2 * count)])).collect();
        let mut factors = Vec::new();
        self.for_each_batch(&spread, Scans::Read, |maps| {
            factors.extend(maps.iter().filter_map(|map| self.own_factor(map)));
            Ok(())
        })?;
        Ok((!factors.is_empty()).then(|| factors.iter().sum::<f64>() / factors.len() as f64))
    }

    /// The factor of a frame by its own scan; a scan that gives none is warned of.
    fn own_factor(&self, map: &NetworkMap) -> Option<f64> {
        let (drive, frame) = map.id;
        let Recording { name, calibration, .. } = &self.drives[drive];
        let factor = self.rule.factor(&map.depth, map.returns.as_ref()?, &calibration.camera);
        factor.inspect_err(|error| tracing::warn!("{name}, frame {frame}: {error}")).ok()
    }

    /// Runs the network over frames, decoding the next ones meanwhile. Returns what could not be read.
    fn for_each_batch(
        &self,
        frames: &[FrameId],
        scans: Scans,
        mut take: impl FnMut(Vec<NetworkMap>) -> Result<()>,
    ) -> Result<Vec<String>> {
        let pool = ThreadPoolBuilder::new()
            .thread_name(|index| format!("depth-loader-{index}"))
            .build()
            .map_err(|error| Error::Data(format!("cannot start loader threads: {error}")))?;
        let (sender, batches) = sync_channel(PREFETCH - 1);
        std::thread::scope(|scope| {
            scope.spawn(move || {
                for ids in frames.chunks(BATCH) {
                    let batch: Vec<_> = pool.install(|| ids.par_iter().map(|&id| self.prepare(id, scans)).collect());
                    // The receiver is gone when the work was given up.
                    if sender.send(batch).is_err() {
                        return;
                    }
                }
            });
            let mut unreadable = Vec::new();
            for batch in batches {
                let (mut images, mut rest) = (Vec::new(), Vec::new());
                for frame in batch {
                    match frame {
                        Ok(PreparedFrame { id, image, returns }) => {
                            images.push(image);
                            rest.push((id, returns));
                        }
                        Err(error) => {
                            tracing::warn!("no depth map: {error}");
                            unreadable.push(error.to_string());
                            if unreadable.len() as f64 > self.max_bad_frames {
                                return Err(Error::Data(format!(
                                    "{} unusable frames are more than data.max_bad_fraction allows; the last: {error}",
                                    unreadable.len()
                                )));
                            }
                        }
                    }
                }
                if !images.is_empty() {
                    let depths = self.estimator.estimate_prepared(&images)?;
                    let maps =
                        depths.into_iter().zip(rest).map(|(depth, (id, returns))| NetworkMap { id, depth, returns });
                    take(maps.collect())?;
                }
            }
            Ok(unreadable)
        })
    }

    fn prepare(&self, id: FrameId, scans: Scans) -> Result<PreparedFrame> {
        let (drive, frame) = id;
        let drive = &self.drives[drive];
        let image = self.estimator.prepare(drive.read_image(frame)?)?;
        let scan = drive.scans.get(&frame).filter(|_| scans == Scans::Read && self.rule.needs_lidar());
        let returns = scan.and_then(|scan| {
            let Recording { name, calibration, .. } = drive;
            let points = read_scan(scan).inspect_err(|error| tracing::warn!("{name}, frame {frame}: {error}")).ok()?;
            Some(project_scan(&points, &calibration.camera_from_velodyne, &calibration.camera))
        });
        Ok(PreparedFrame { id, image, returns })
    }
}
