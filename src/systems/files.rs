//! Files of measured and true poses, one for each drive.

use std::path::{Path, PathBuf};

use super::frames::{Joined, frames_of_rows};
use super::sequences::odometry_sequence;
use super::settings::{SystemConfig, SystemSource, TrajectoryConfig, TrajectoryFormat, TruthConfig};
use crate::error::{Error, Place, Result};
use crate::files::{fill_template, read_text};
use crate::geometry::ErrorFrame;
use crate::recordings::{
    KittiPoses, LARGEST_DISTANCE_S, Layout, MeasurementFrame, Recording, Trajectory, parse_kitti_poses,
    parse_tum_trajectory, stated_axes,
};

/// The number of a drive's odometry sequence, in templates of paths.
const SEQUENCE: &str = "{sequence}";

/// That a file which states its axes is read in them.
pub(super) fn require_axes(stated: Option<ErrorFrame>, frame: MeasurementFrame, path: &Path) -> Result<()> {
    let expected = match frame {
        MeasurementFrame::Camera0 => None,
        MeasurementFrame::Camera => Some(ErrorFrame::Camera),
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

/// The trajectory of a drive; `None` without its file.
///
/// # Errors
/// It is malformed, or of other axes or times.
pub(super) fn load_trajectory(config: &TrajectoryConfig, drive: &Recording, root: &Path) -> Result<Option<Trajectory>> {
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
                        let sets = [drive.images.keys().copied().collect(), drive.poses.keys().copied().collect()];
                        frames_of_rows(poses.len(), &path, &Joined { whose: &drive.name, sequence, sets: &sets })?
                    }
                };
                frames.into_iter().zip(poses).collect()
            }
        },
        TrajectoryFormat::Tum => {
            require_axes(stated_axes(&text), config.frame, &path)?;
            let times = drive.require_times("a TUM trajectory")?;
            parse_tum_trajectory(&text, &path, times, LARGEST_DISTANCE_S)?
        }
    };
    Ok(Some(trajectory))
}

/// The file of a system's measurements on a drive, where it has one.
pub(crate) fn measurement_file(system: &SystemConfig, drive: &Recording, root: &Path) -> Option<PathBuf> {
    match &system.source {
        SystemSource::Trajectory(config) => Some(expand(&config.path, drive, root)),
        SystemSource::Relative(config) => Some(expand(&config.path, drive, root)),
        _ => None,
    }
}

/// The file of a drive's true poses, where they have one of their own.
pub(crate) fn truth_file(truth: &TruthConfig, drive: &Recording, root: &Path) -> Option<PathBuf> {
    if let TruthConfig::Trajectory(config) = truth { Some(expand(&config.path, drive, root)) } else { None }
}

/// A template's path for a drive.
pub(super) fn expand(template: &Path, drive: &Recording, root: &Path) -> PathBuf {
    let sequence = match drive.layout {
        Layout::KittiOdometry => drive.name.as_str(),
        _ => odometry_sequence(drive.short_name()).map_or("none", |sequence| sequence.number),
    };
    let slots = [("{drive}", drive.short_name()), ("{date}", drive.date()), (SEQUENCE, sequence)];
    root.join(fill_template(template, &slots))
}
