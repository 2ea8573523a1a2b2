//! Measured relative poses of a drive, from whatever source a configuration names.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::files::{expand, load_trajectory, require_axes};
use super::motions::{Steps, apart, motions_of, warn_of_long_steps};
use super::relative::{Statement, parse_relative_poses, warn_of_turns};
use super::settings::{SystemConfig, SystemSource};
use super::truth::{Truth, require_packets};
use crate::error::{Error, Result};
use crate::files::read_text;
use crate::geometry::{Covariance6, Pose};
use crate::recordings::{MeasurementFrame, Recording};

/// One system's relative poses on one drive.
#[derive(Clone, Debug)]
pub struct Measurements {
    /// The body whose motion they are.
    pub frame: MeasurementFrame,
    /// `source_from_target` by source and target frame.
    pub relative_poses: BTreeMap<(usize, usize), Pose>,
    /// Covariances of their errors where the file states them, same axes; the true ones in simulated data.
    pub covariances: BTreeMap<(usize, usize), Covariance6>,
    /// The file that was looked for and is not there.
    pub missing_file: Option<PathBuf>,
}

impl Measurements {
    /// The frames that they reach.
    pub fn frames(&self) -> BTreeSet<usize> {
        self.relative_poses.keys().flat_map(|&(source, target)| [source, target]).collect()
    }
}

/// Measured relative poses of one system on one drive: those between frames so many apart; without `gaps`, between
/// neighbouring frames or keyframes, and all that files and manifests list.
///
/// # Errors
/// The measurement file is malformed. A file that does not exist gives no measurements and is named
/// in the result.
pub fn load_measurements(
    system: &SystemConfig,
    drive: &Recording,
    root: &Path,
    truth: &Truth,
    gaps: &[usize],
) -> Result<Measurements> {
    let found = |frame, relative_poses| Measurements {
        frame,
        relative_poses,
        covariances: BTreeMap::new(),
        missing_file: None,
    };
    let missing = |frame, path| Measurements { missing_file: Some(path), ..found(frame, BTreeMap::new()) };
    Ok(match &system.source {
        // True here; the data set draws their errors.
        SystemSource::Truth {} | SystemSource::Perturbation(_) => found(MeasurementFrame::Vehicle, truth.motions(gaps)),
        SystemSource::Oxts {} => {
            require_packets(drive, "systems", "")?;
            let gaps = if gaps.is_empty() { &[1] } else { gaps };
            found(MeasurementFrame::Vehicle, motions_of(&drive.poses, Steps::Apart(gaps)))
        }
        SystemSource::Trajectory(config) => match load_trajectory(config, drive, root)? {
            Some(trajectory) => {
                let steps = if gaps.is_empty() { Steps::Keyframes } else { Steps::Apart(gaps) };
                let motions = motions_of(&trajectory, steps);
                let path = expand(&config.path, drive, root);
                if steps == Steps::Keyframes {
                    warn_of_long_steps(&motions, &path);
                }
                warn_of_turns(motions.values(), &path);
                found(config.frame, motions)
            }
            None => missing(config.frame, expand(&config.path, drive, root)),
        },
        SystemSource::Manifest { frame } => {
            let listed = drive.listed.as_ref().ok_or_else(|| {
                let problem = format!(
                    "source `manifest` of `{}` needs data.manifest, the file that lists its pairs",
                    system.name
                );
                Error::config("systems", problem)
            })?;
            found(*frame, listed.measurements.get(&system.name).map(|motions| apart(motions, gaps)).unwrap_or_default())
        }
        SystemSource::Relative(config) => {
            let path = expand(&config.path, drive, root);
            if !path.exists() {
                return Ok(missing(config.frame, path));
            }
            let text = read_text(&path)?;
            require_axes(Statement::of(&text, &path)?.frame, config.frame, &path)?;
            let poses = parse_relative_poses(&text, &path)?;
            let covariances = poses.iter().filter_map(|pose| Some(((pose.source, pose.target), pose.covariance?)));
            Measurements {
                covariances: apart(&covariances.collect(), gaps),
                ..found(
                    config.frame,
                    apart(
                        &poses.iter().map(|pose| ((pose.source, pose.target), pose.source_from_target)).collect(),
                        gaps,
                    ),
                )
            }
        }
    })
}
