//! Measured relative poses of a drive, from whatever source a configuration names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::relative::{parse_relative_poses, stated_frame};
use super::sequences::odometry_sequence;
use super::trajectory::{Trajectory, parse_kitti_trajectory, parse_tum_trajectory};
use super::truth::{Truth, consecutive};
use crate::config::{MeasurementFrame, SystemConfig, SystemSource, TrajectoryConfig, TrajectoryFormat};
use crate::data::Drive;
use crate::error::{Error, Place, Result};
use crate::files::read_text;
use crate::geometry::{Covariance6, Pose};

/// Largest distance in time between a TUM row and the frame it belongs to, s: a fifth of KITTI's period.
const TUM_TOLERANCE_S: f64 = 0.02;

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
        SystemSource::Oxts {} => found(MeasurementFrame::Vehicle, consecutive(&drive.oxts_poses)),
        SystemSource::Trajectory(config) => match load_trajectory(config, drive, root)? {
            Some(trajectory) => found(config.frame, consecutive(&trajectory)),
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
            require_frame(&text, config.frame, &path)?;
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

/// That a file which states its axes is read in them.
fn require_frame(text: &str, frame: MeasurementFrame, path: &Path) -> Result<()> {
    let expected = match frame {
        MeasurementFrame::Camera0 => "camera0",
        MeasurementFrame::Camera2 => "camera",
        MeasurementFrame::Vehicle => "vehicle",
    };
    match stated_frame(text).filter(|stated| *stated != expected) {
        None => Ok(()),
        Some(stated) => Err(Error::malformed(
            path,
            Place::Line(1),
            format!("motions in axes `{stated}`"),
            format!(
                "those of `{expected}`, as the configuration or --measurement-frame says; set frame to `vehicle`, or `camera2` for `camera`"
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
        TrajectoryFormat::Kitti => {
            let by_sequence = config.path.contains("{sequence}");
            let first_frame =
                odometry_sequence(drive.short_name()).filter(|_| by_sequence).map_or(0, |cut| cut.first_frame);
            parse_kitti_trajectory(&text, &path, first_frame)?
        }
        TrajectoryFormat::Tum => parse_tum_trajectory(&text, &path, &drive.timestamps_s, TUM_TOLERANCE_S)?,
    };
    Ok(Some(trajectory))
}

fn expand(template: &str, drive: &Drive, root: &Path) -> PathBuf {
    let sequence = odometry_sequence(drive.short_name()).map_or("none", |sequence| sequence.number);
    root.join(
        template.replace("{drive}", drive.short_name()).replace("{date}", drive.date()).replace("{sequence}", sequence),
    )
}
