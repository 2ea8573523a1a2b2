//! Judges the configured depth of frames against LiDAR scans or files of true depth.

use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use rayon::prelude::*;

use super::{DepthMap, DepthScores, ScaleRule, files, fill_gaps, native_depth, project_scan, read_scan};
use crate::depth::{DepthConfig, FrameId};
use crate::error::Result;
use crate::recordings::{KITTI_STEPS_PER_METRE, Recording};

/// Frames that are read at once.
const BATCH: usize = 16;

/// LiDAR cannot be judged by returns it was filled from: of every so many degrees of elevation a band, about one ring of
/// KITTI's scanner, is left out and judged, and its borders are left out and not judged, so that no ring is in both.
const PERIOD_DEG: f32 = 1.6;
const BAND_DEG: f32 = 0.4;
const GUARD_DEG: f32 = 0.15;

/// A depth source and what it is judged by.
pub struct DepthJudge<'a> {
    depth: &'a DepthConfig,
    truth: Option<&'a str>,
    root: PathBuf,
    /// Size at which LiDAR maps are filled, px.
    size: [usize; 2],
    max_bad_fraction: f64,
}

/// Scores of each frame that has a true depth.
#[derive(Clone, Debug, Default)]
pub struct JudgedDepth {
    /// Of the maps as they are.
    pub scores: Vec<DepthScores>,
    /// Of the maps brought to the truth's median, as monocular depth is compared.
    pub median_scaled: Vec<DepthScores>,
    /// Frames without a scan or true map, or none of whose true pixels is judged.
    pub without_truth: usize,
    /// Frames whose image, depth or truth cannot be read.
    pub unreadable: usize,
}

impl<'a> DepthJudge<'a> {
    /// `truth`: a path below `data.root` with `{date}`, `{drive}` and `{frame}`; without one, the LiDAR's scans.
    ///
    /// `size`: width and height at which LiDAR maps are filled, px; `root`: `data.root`.
    pub fn new(
        depth: &'a DepthConfig,
        truth: Option<&'a str>,
        root: &Path,
        size: [usize; 2],
        max_bad_fraction: f64,
    ) -> Self {
        Self { depth, truth, root: root.to_owned(), size, max_bad_fraction }
    }

    /// What is taken for true, in words.
    pub fn truth_name(&self) -> String {
        match (self.truth, self.depth) {
            (Some(path), _) => format!("files {path}"),
            (None, DepthConfig::Lidar { .. }) => "a quarter of the LiDAR's rings, left out of the maps".to_owned(),
            (None, _) => "LiDAR returns".to_owned(),
        }
    }

    /// Scores frame by frame.
    ///
    /// # Errors
    /// More frames cannot be read than `data.max_bad_fraction` allows.
    pub fn scores(
        &self,
        drives: &[Recording],
        frames: &[FrameId],
        observe: &mut dyn FnMut(usize),
    ) -> Result<JudgedDepth> {
        let mut judged = JudgedDepth::default();
        for (batch, frames_of_batch) in frames.chunks(BATCH).enumerate() {
            let scores: Vec<Result<Option<[DepthScores; 2]>>> =
                frames_of_batch.par_iter().map(|&(drive, frame)| self.score(&drives[drive], frame)).collect();
            for scores in scores {
                match scores {
                    Ok(Some([as_it_is, median_scaled])) => {
                        judged.scores.push(as_it_is);
                        judged.median_scaled.push(median_scaled);
                    }
                    Ok(None) => judged.without_truth += 1,
                    Err(error) => {
                        tracing::warn!("not judged: {error}");
                        judged.unreadable += 1;
                        if judged.unreadable as f64 > self.max_bad_fraction * frames.len() as f64 {
                            return Err(error);
                        }
                    }
                }
            }
            observe((batch * BATCH + frames_of_batch.len()).min(frames.len()));
        }
        Ok(judged)
    }

    fn score(&self, drive: &Recording, frame: usize) -> Result<Option<[DepthScores; 2]>> {
        let camera = &drive.calibration.camera;
        let judged = match (self.truth, self.depth) {
            (None, DepthConfig::Lidar { fill_radius_px }) => self.with_rings_left_out(drive, frame, *fill_radius_px)?,
            _ => match self.true_depth(drive, frame)? {
                Some(truth) => {
                    let image = drive.read_image(frame)?;
                    Some((native_depth(self.depth, drive, frame, &self.root, camera, &image)?, truth))
                }
                None => None,
            },
        };
        let Some((depth, truth)) = judged else { return Ok(None) };
        let Some(scores) = DepthScores::of_image(&depth, &truth) else { return Ok(None) };
        let Ok(factor) = ScaleRule::Median.factor(&depth, &truth, camera) else { return Ok(None) };
        Ok(DepthScores::of_image(&depth.scaled(factor), &truth).map(|median_scaled| [scores, median_scaled]))
    }

    fn true_depth(&self, drive: &Recording, frame: usize) -> Result<Option<DepthMap>> {
        if let Some(template) = self.truth {
            let path = files::depth_path(template, drive, frame, &self.root);
            return if path.is_file() {
                files::read_depth_of(&path, drive.image_size(), KITTI_STEPS_PER_METRE).map(Some)
            } else {
                Ok(None)
            };
        }
        let Some(scan) = drive.scans.get(&frame) else { return Ok(None) };
        let calibration = &drive.calibration;
        Ok(Some(project_scan(&read_scan(scan)?, &calibration.camera_from_velodyne, &calibration.camera)))
    }

    /// A map filled from some rings of a scan, and the others' returns.
    fn with_rings_left_out(
        &self,
        drive: &Recording,
        frame: usize,
        radius_px: usize,
    ) -> Result<Option<(DepthMap, DepthMap)>> {
        let Some(scan) = drive.scans.get(&frame) else { return Ok(None) };
        let [width, height] = self.size;
        let camera = drive.calibration.camera.resized(width, height);
        let image = drive.read_image(frame)?.resized(width, height);
        let place_in_period_deg =
            |point: &Vector3<f32>| (point.z / point.xy().norm()).atan().to_degrees().rem_euclid(PERIOD_DEG);
        let (truth, rest): (Vec<Vector3<f32>>, Vec<Vector3<f32>>) =
            read_scan(scan)?.into_iter().partition(|point| place_in_period_deg(point) < BAND_DEG);
        let kept_deg = BAND_DEG + GUARD_DEG..PERIOD_DEG - GUARD_DEG;
        let kept: Vec<Vector3<f32>> =
            rest.into_iter().filter(|point| kept_deg.contains(&place_in_period_deg(point))).collect();
        let project = |points: &[Vector3<f32>]| project_scan(points, &drive.calibration.camera_from_velodyne, &camera);
        Ok(Some((fill_gaps(&project(&kept), &image, radius_px), project(&truth))))
    }
}
