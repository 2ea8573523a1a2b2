//! Runs a depth network over the frames of an experiment and keeps its maps: each once, in batches, with images
//! decoded ahead and maps written in parallel. Memory holds a few batches, however many frames there are.

use std::collections::BTreeMap;
use std::sync::mpsc::sync_channel;

use rayon::ThreadPoolBuilder;
use rayon::prelude::*;

use super::cache::CacheManifest;
use super::{DepthCache, DepthEstimator, DepthMap, ScaleRule, ScaleScope, encode_depth_png, project_scan, read_scan};
use crate::config::NetworkDepthConfig;
use crate::data::{Drive, RgbImage, read_image};
use crate::error::{Error, Result};
use crate::files::write_renamed;

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
    /// Sequences without a usable scan, which took the mean factor of the others.
    pub borrowed: Vec<String>,
    /// Frames whose image cannot be read, and why; they have no map.
    pub unreadable: Vec<String>,
    /// Mean factor of each sequence.
    pub sequence_factors: BTreeMap<String, f64>,
}

/// A frame of a drive, by their indices.
pub type FrameId = (usize, usize);

/// Makes the maps that a cache lacks.
///
/// `observe` hears how many of how many are done; an error of its ends the work. What is finished stays, and the next
/// call goes on from there. Frames whose image cannot be read have no map.
///
/// # Errors
/// The cache was made otherwise or cannot be written, no scale can be found, or more than `max_bad_fraction` of the
/// frames cannot be read.
pub fn precompute(
    estimator: &DepthEstimator,
    config: &NetworkDepthConfig,
    drives: &[Drive],
    frames: &[FrameId],
    max_bad_fraction: f64,
    observe: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<PrecomputeSummary> {
    let cache = DepthCache::of(config);
    let mut manifest = cache.begin(CacheManifest::new(estimator, config))?;
    let missing: Vec<FrameId> =
        frames.iter().copied().filter(|&(drive, frame)| !cache.map_path(&drives[drive], frame).is_file()).collect();
    let mut summary = PrecomputeSummary { kept: frames.len() - missing.len(), ..PrecomputeSummary::default() };
    let max_bad_frames = max_bad_fraction * frames.len() as f64;
    let run = NetworkRun { estimator, drives, rule: manifest.scale(), max_bad_frames };
    run.find_sequence_factors(&missing, &mut manifest, &mut summary)?;
    cache.write(&manifest)?;
    summary.sequence_factors.clone_from(&manifest.sequence_factors);
    for drive in drives {
        let folder = cache.map_path(drive, 0).parent().expect("a map lies in a folder").to_owned();
        std::fs::create_dir_all(&folder).map_err(Error::io("create the folder", &folder))?;
    }
    let total = missing.len();
    let unreadable = run.for_each_batch(&missing, |maps| {
        let scaled: Vec<(FrameId, DepthMap)> = maps
            .into_iter()
            .map(|map| {
                let own = (config.scope == ScaleScope::Frame).then(|| run.own_factor(&map)).flatten();
                *(if own.is_some() { &mut summary.by_own_scan } else { &mut summary.by_sequence }) += 1;
                let of_sequence = || manifest.sequence_factors[&drives[map.id.0].name];
                (map.id, map.depth.scaled(own.unwrap_or_else(of_sequence)))
            })
            .collect();
        scaled.par_iter().try_for_each(|((drive, frame), map)| {
            write_renamed(&cache.map_path(&drives[*drive], *frame), &encode_depth_png(map))
        })?;
        summary.made += scaled.len();
        observe(summary.made, total)
    })?;
    summary.unreadable = unreadable;
    Ok(summary)
}

/// A network at work on the frames of some drives.
struct NetworkRun<'a> {
    estimator: &'a DepthEstimator,
    drives: &'a [Drive],
    rule: ScaleRule,
    max_bad_frames: f64,
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

impl NetworkRun<'_> {
    /// Adds the factors of the sequences that have none yet.
    fn find_sequence_factors(
        &self,
        missing: &[FrameId],
        manifest: &mut CacheManifest,
        summary: &mut PrecomputeSummary,
    ) -> Result<()> {
        let mut lacking: Vec<usize> = missing.iter().map(|(drive, _)| *drive).collect();
        lacking.dedup();
        lacking.retain(|&drive| !manifest.sequence_factors.contains_key(&self.drives[drive].name));
        let mut without = Vec::new();
        for drive in lacking {
            let name = &self.drives[drive].name;
            match self.sequence_factor(drive)? {
                Some(factor) => {
                    manifest.sequence_factors.insert(name.clone(), factor);
                }
                None => without.push(name.clone()),
            }
        }
        if without.is_empty() {
            return Ok(());
        }
        let known: Vec<f64> = manifest.sequence_factors.values().copied().collect();
        if known.is_empty() {
            return Err(Error::config(
                "depth.scale",
                format!(
                    "metres by LiDAR need scans (velodyne_points), and none of {} has a usable one; a factor that is known needs none: depth.scale = {{ fixed = 5.4 }} for published weights trained on stereo pairs",
                    without.join(", ")
                ),
            ));
        }
        let mean = known.iter().sum::<f64>() / known.len() as f64;
        for name in without {
            tracing::warn!(
                "{name} has no usable LiDAR scan: its depth takes the mean factor of the other sequences, {mean:.3}"
            );
            manifest.sequence_factors.insert(name.clone(), mean);
            summary.borrowed.push(name);
        }
        Ok(())
    }

    /// Mean of the factors of scans spread over a sequence, `None` without a usable one.
    fn sequence_factor(&self, drive: usize) -> Result<Option<f64>> {
        if let ScaleRule::Fixed(factor) = self.rule {
            return Ok(Some(factor));
        }
        let Drive { scans, images, .. } = &self.drives[drive];
        let scanned: Vec<usize> = scans.keys().copied().filter(|frame| images.contains_key(frame)).collect();
        let count = scanned.len().min(SCANS_FOR_A_SEQUENCE);
        let spread: Vec<FrameId> =
            (0..count).map(|index| (drive, scanned[(2 * index + 1) * scanned.len() / (2 * count)])).collect();
        let mut factors = Vec::new();
        self.for_each_batch(&spread, |maps| {
            factors.extend(maps.iter().filter_map(|map| self.own_factor(map)));
            Ok(())
        })?;
        Ok((!factors.is_empty()).then(|| factors.iter().sum::<f64>() / factors.len() as f64))
    }

    /// The factor of a frame by its own scan; a scan that gives none is warned of.
    fn own_factor(&self, map: &NetworkMap) -> Option<f64> {
        let (drive, frame) = map.id;
        let Drive { name, calibration, .. } = &self.drives[drive];
        let factor = self.rule.factor(&map.depth, map.returns.as_ref()?, &calibration.camera2);
        factor.inspect_err(|error| tracing::warn!("{name}, frame {frame}: {error}")).ok()
    }

    /// Runs the network over frames, decoding the next ones meanwhile. Returns what could not be read.
    fn for_each_batch(
        &self,
        frames: &[FrameId],
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
                    let batch: Vec<_> = pool.install(|| ids.par_iter().map(|&id| self.prepare(id)).collect());
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

    fn prepare(&self, id: FrameId) -> Result<PreparedFrame> {
        let (drive, frame) = id;
        let Drive { name, calibration, images, scans, .. } = &self.drives[drive];
        let path = &images[&frame];
        let named = |error: Error| match error {
            Error::Data(problem) => Error::Data(format!("{}: {problem}", path.display())),
            error => error,
        };
        let image = self.estimator.prepare(read_image(path)?).map_err(named)?;
        let scan = scans.get(&frame).filter(|_| self.rule.needs_lidar());
        let returns = scan.and_then(|scan| {
            let points = read_scan(scan).inspect_err(|error| tracing::warn!("{name}, frame {frame}: {error}")).ok()?;
            Some(project_scan(&points, &calibration.camera2_from_velodyne, &calibration.camera2))
        });
        Ok(PreparedFrame { id, image, returns })
    }
}
