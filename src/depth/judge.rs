//! Judges the configured depth of frames against LiDAR scans or files of true depth.

use std::path::PathBuf;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::{
    DepthMap, DepthScores, ScaleRule, files, fill_gaps, native_depth, project_scan, read_depth_png, read_scan,
};
use crate::config::{Config, DepthConfig};
use crate::data::{Drive, read_image};
use crate::depth::FrameId;
use crate::error::Result;

/// Frames that are read at once.
const BATCH: usize = 16;

/// LiDAR cannot be judged by returns it was filled from: beams of every fourth band of this elevation, about one
/// ring of KITTI's scanner, are left out and judged.
const BAND_DEG: f32 = 0.4;
const BANDS: i32 = 4;

/// A depth source and what it is judged by.
pub struct DepthJudge<'a> {
    depth: &'a DepthConfig,
    truth: Option<&'a str>,
    root: PathBuf,
    /// Size at which LiDAR maps are filled, px.
    size: [usize; 2],
}

/// Scores of each frame that has a true depth.
#[derive(Clone, Debug, Default)]
pub struct JudgedDepth {
    /// Of the maps as they are.
    pub scores: Vec<DepthScores>,
    /// Of the maps brought to the truth's median, as monocular depth is compared.
    pub median_scaled: Vec<DepthScores>,
    /// Frames without a scan or true map, or whose truth has no pixel that is judged.
    pub without_truth: usize,
}

impl<'a> DepthJudge<'a> {
    /// `truth`: a path below `data.root` with `{date}`, `{drive}` and `{frame}`; without one, the LiDAR's scans.
    pub fn new(config: &'a Config, truth: Option<&'a str>) -> Self {
        let size = [config.model.width, config.model.height];
        Self { depth: &config.depth, truth, root: config.data.root.clone(), size }
    }

    /// What is taken for true, in words.
    pub fn truth_name(&self) -> String {
        match (self.truth, self.depth) {
            (Some(path), _) => format!("files {path}"),
            (None, DepthConfig::Lidar { .. }) => "every fourth LiDAR ring, left out of the maps".to_owned(),
            (None, _) => "LiDAR returns".to_owned(),
        }
    }

    /// Scores frame by frame.
    ///
    /// # Errors
    /// A frame's image, depth or truth is malformed.
    pub fn scores(&self, drives: &[Drive], frames: &[FrameId], observe: &mut dyn FnMut(usize)) -> Result<JudgedDepth> {
        let mut judged = JudgedDepth::default();
        for (batch, frames_of_batch) in frames.chunks(BATCH).enumerate() {
            let scores: Vec<Option<[DepthScores; 2]>> = frames_of_batch
                .par_iter()
                .map(|&(drive, frame)| self.score(&drives[drive], frame))
                .collect::<Result<_>>()?;
            for scores in scores {
                match scores {
                    Some([as_it_is, median_scaled]) => {
                        judged.scores.push(as_it_is);
                        judged.median_scaled.push(median_scaled);
                    }
                    None => judged.without_truth += 1,
                }
            }
            observe((batch * BATCH + frames_of_batch.len()).min(frames.len()));
        }
        Ok(judged)
    }

    fn score(&self, drive: &Drive, frame: usize) -> Result<Option<[DepthScores; 2]>> {
        let camera = &drive.calibration.camera2;
        let judged = match (self.truth, self.depth) {
            (None, DepthConfig::Lidar { fill_radius_px }) => self.with_rings_left_out(drive, frame, *fill_radius_px)?,
            _ => match self.true_depth(drive, frame)? {
                Some(truth) => {
                    let image = read_image(&drive.images[&frame])?;
                    Some((native_depth(self.depth, drive, frame, &self.root, camera, &image)?, truth))
                }
                None => None,
            },
        };
        let Some((depth, truth)) = judged else { return Ok(None) };
        let Some(scores) = DepthScores::of_image(&depth, &truth) else { return Ok(None) };
        let factor = ScaleRule::Median.factor(&depth, &truth, camera)?;
        Ok(DepthScores::of_image(&depth.scaled(factor), &truth).map(|median_scaled| [scores, median_scaled]))
    }

    fn true_depth(&self, drive: &Drive, frame: usize) -> Result<Option<DepthMap>> {
        if let Some(template) = self.truth {
            let path = files::depth_path(template, drive, frame, &self.root);
            return if path.is_file() { read_depth_png(&path).map(Some) } else { Ok(None) };
        }
        let Some(scan) = drive.scans.get(&frame) else { return Ok(None) };
        let calibration = &drive.calibration;
        Ok(Some(project_scan(&read_scan(scan)?, &calibration.camera2_from_velodyne, &calibration.camera2)))
    }

    /// A map filled from some rings of a scan, and the others' returns.
    fn with_rings_left_out(
        &self,
        drive: &Drive,
        frame: usize,
        radius_px: usize,
    ) -> Result<Option<(DepthMap, DepthMap)>> {
        let Some(scan) = drive.scans.get(&frame) else { return Ok(None) };
        let [width, height] = self.size;
        let camera = drive.calibration.camera2.resized(width, height);
        let image = read_image(&drive.images[&frame])?.resized(width, height);
        let left_out = |point: &Vector3<f32>| {
            let elevation_deg = (point.z / point.xy().norm()).atan().to_degrees();
            ((elevation_deg / BAND_DEG).floor() as i32).rem_euclid(BANDS) == 0
        };
        let (truth, kept): (Vec<Vector3<f32>>, _) = read_scan(scan)?.into_iter().partition(left_out);
        let project = |points: &[Vector3<f32>]| project_scan(points, &drive.calibration.camera2_from_velodyne, &camera);
        Ok(Some((fill_gaps(&project(&kept), &image, radius_px), project(&truth))))
    }
}
