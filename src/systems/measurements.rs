//! Measured relative poses of a drive, from whatever source a configuration names.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::frames::{Joined, frames_of_rows};
use super::relative::{Statement, parse_relative_poses, warn_of_turns};
use super::sequences::odometry_sequence;
use super::trajectory::{KittiPoses, Trajectory, parse_kitti_poses, parse_tum_trajectory};
use super::truth::{Steps, Truth, motions_of};
use crate::config::{MeasurementFrame, SystemConfig, SystemSource, TrajectoryConfig, TrajectoryFormat};
use crate::data::{Drive, Motions};
use crate::error::{Error, Place, Result};
use crate::files::{fill_template, read_text, remarks};
use crate::geometry::{Covariance6, ErrorFrame, Pose};

/// Largest distance in time between a TUM row and the frame it belongs to, s: a fifth of KITTI's period.
const TUM_TOLERANCE_S: f64 = 0.02;

/// Longer steps of a trajectory, in units of its median, are gaps.
const MOST_STEPS: usize = 10;

/// The number of a drive's odometry sequence, in templates of paths.
const SEQUENCE: &str = "{sequence}";

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

/// Measured relative poses of one system on one drive.
///
/// # Errors
/// The measurement file is malformed. A file that does not exist gives no measurements and is named
/// in the result.
pub fn load_measurements(system: &SystemConfig, drive: &Drive, root: &Path, truth: &Truth) -> Result<Measurements> {
    let found = |frame, relative_poses| Measurements {
        frame,
        relative_poses,
        covariances: BTreeMap::new(),
        missing_file: None,
    };
    let missing = |frame, path| Measurements { missing_file: Some(path), ..found(frame, BTreeMap::new()) };
    Ok(match &system.source {
        // True here; the data set draws their errors.
        SystemSource::Truth {} | SystemSource::Perturbation(_) => found(MeasurementFrame::Vehicle, truth.motions()),
        SystemSource::Oxts {} => found(MeasurementFrame::Vehicle, motions_of(&drive.oxts_poses, Steps::Consecutive)),
        SystemSource::Trajectory(config) => match load_trajectory(config, drive, root)? {
            Some(trajectory) => {
                let motions = motions_of(&trajectory, Steps::Keyframes);
                let path = expand(&config.path, drive, root);
                warn_of_long_steps(&motions, &path);
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
            found(*frame, listed.measurements.get(&system.name).cloned().unwrap_or_default())
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
                covariances: covariances.collect(),
                ..found(
                    config.frame,
                    poses.iter().map(|pose| ((pose.source, pose.target), pose.source_from_target)).collect(),
                )
            }
        }
    })
}

/// Says that a trajectory has a gap that is no keyframe's: many times as long as its usual step.
fn warn_of_long_steps(motions: &Motions, path: &Path) {
    let mut steps: Vec<usize> = motions.keys().map(|(source, target)| target - source).collect();
    steps.sort_unstable();
    let longest = motions.keys().max_by_key(|(source, target)| target - source);
    let (Some(&usual), Some(&(source, target))) = (steps.get(steps.len() / 2), longest) else { return };
    if target - source > MOST_STEPS * usual {
        let path = path.display();
        tracing::warn!("{path}: no pose between frames {source} and {target}, which is taken for one motion");
    }
}

/// The axes that the first line of a TUM trajectory states which relcov wrote: `…, axes: vehicle`.
fn stated_axes(text: &str) -> Option<ErrorFrame> {
    let (_, remark) = remarks(text).next()?;
    let (_, axes) = remark.split_once("axes: ")?;
    ErrorFrame::of(axes.split(|c: char| !c.is_alphabetic()).next()?)
}

/// That a file which states its axes is read in them.
fn require_axes(stated: Option<ErrorFrame>, frame: MeasurementFrame, path: &Path) -> Result<()> {
    let expected = match frame {
        MeasurementFrame::Camera0 => None,
        MeasurementFrame::Camera2 => Some(ErrorFrame::Camera),
        MeasurementFrame::Vehicle => Some(ErrorFrame::Vehicle),
    };
    match stated.filter(|stated| Some(*stated) != expected) {
        None => Ok(()),
        Some(stated) => Err(Error::malformed(
            path,
            Place::Line(1),
            format!("motions in axes `{}`", stated.name()),
            format!(
                "those of `{}`, as the configuration or --measurement-frame says; set frame to `vehicle`, or `camera2` for `camera`",
                expected.map_or("camera0", ErrorFrame::name)
            ),
        )),
    }
}

pub(super) fn load_trajectory(config: &TrajectoryConfig, drive: &Drive, root: &Path) -> Result<Option<Trajectory>> {
    let path = expand(&config.path, drive, root);
    if !path.exists() {
        return Ok(None);
    }
    let text = read_text(&path)?;
    let trajectory = match config.format {
        TrajectoryFormat::Kitti => match parse_kitti_poses(&text, &path)? {
            KittiPoses::Framed(trajectory) => trajectory,
            KittiPoses::Rows(poses) => {
                let sequence = odometry_sequence(drive.short_name());
                let is_sequence = config.path.to_string_lossy().contains(SEQUENCE);
                let frames = match sequence.filter(|_| is_sequence) {
                    Some(cut) => (cut.first_frame..).take(poses.len()).collect(),
                    None => {
                        let sets = [drive.images.keys().copied().collect(), drive.oxts_poses.keys().copied().collect()];
                        frames_of_rows(poses.len(), &path, &Joined { whose: &drive.name, sequence, sets: &sets })?
                    }
                };
                frames.into_iter().zip(poses).collect()
            }
        },
        TrajectoryFormat::Tum => {
            require_axes(stated_axes(&text), config.frame, &path)?;
            let times = drive.require_times("a TUM trajectory")?;
            parse_tum_trajectory(&text, &path, times, TUM_TOLERANCE_S)?
        }
    };
    Ok(Some(trajectory))
}

/// The file of a system's measurements on a drive, where it has one.
pub(crate) fn measurement_file(system: &SystemConfig, drive: &Drive, root: &Path) -> Option<PathBuf> {
    match &system.source {
        SystemSource::Trajectory(config) => Some(expand(&config.path, drive, root)),
        SystemSource::Relative(config) => Some(expand(&config.path, drive, root)),
        _ => None,
    }
}

fn expand(template: &Path, drive: &Drive, root: &Path) -> PathBuf {
    let sequence = odometry_sequence(drive.short_name()).map_or("none", |sequence| sequence.number);
    let slots = [("{drive}", drive.short_name()), ("{date}", drive.date()), (SEQUENCE, sequence)];
    root.join(fill_template(template, &slots))
}
