//! Judges the configured depth of frames against LiDAR scans or files of true depth.

use std::path::PathBuf;

use rayon::prelude::*;

use super::{DepthMap, DepthScores, ScaleRule, files, native_depth, project_scan, read_depth_png, read_scan};
use crate::config::{Config, DepthConfig};
use crate::data::{Drive, read_image};
use crate::depth::FrameId;
use crate::error::Result;

/// Frames that are read at once.
const BATCH: usize = 16;

/// A depth source and what it is judged by.
pub struct DepthJudge<'a> {
    depth: &'a DepthConfig,
    truth: Option<&'a str>,
    root: PathBuf,
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
        Self { depth: &config.depth, truth, root: config.data.root.clone() }
    }

    /// What is taken for true, in words.
    pub fn truth_name(&self) -> String {
        self.truth.map_or_else(|| "LiDAR returns".to_owned(), |path| format!("files {path}"))
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
        let Some(truth) = self.true_depth(drive, frame)? else { return Ok(None) };
        let camera = &drive.calibration.camera2;
        let image = read_image(&drive.images[&frame])?;
        let depth = native_depth(self.depth, drive, frame, &self.root, camera, &image)?;
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
}
