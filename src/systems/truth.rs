//! The true motions of a drive: from absolute poses, or listed pair by pair.

use std::path::Path;

use super::files::load_trajectory;
use super::motions::{Steps, apart, motions_of};
use super::settings::TruthConfig;
use crate::error::{Error, Result};
use crate::geometry::Pose;
use crate::recordings::{Layout, MeasurementFrame, Motions, Recording, Trajectory};

/// What counts as the true motion of the vehicle.
#[derive(Clone, Debug)]
pub enum Truth {
    /// By its poses `world_from_vehicle`.
    Poses(Trajectory),
    /// `source_from_target` pair by pair, vehicle axes.
    Motions(Motions),
}

impl Truth {
    /// Loads what the configuration takes for true.
    ///
    /// # Errors
    /// The trajectory file is malformed. A file that does not exist gives no poses.
    pub fn load(truth: &TruthConfig, drive: &Recording, root: &Path) -> Result<Self> {
        let calibration = &drive.calibration;
        let vehicle_from = |frame| calibration.camera_from_vehicle.inverse() * calibration.camera_from(frame);
        match truth {
            TruthConfig::Oxts {} => {
                require_packets(drive, "truth.source", "; `recording` takes the poses that it brings")?;
                Ok(Self::Poses(drive.poses.clone()))
            }
            TruthConfig::Recording {} if drive.listed.is_none() => Ok(Self::Poses(drive.poses.clone())),
            TruthConfig::Recording {} => {
                Self::load(&TruthConfig::Manifest { frame: MeasurementFrame::Camera }, drive, root)
            }
            TruthConfig::Trajectory(config) => {
                let body_from_vehicle = vehicle_from(config.frame).inverse();
                let poses = load_trajectory(config, drive, root)?.unwrap_or_default();
                let poses =
                    poses.into_iter().map(|(frame, world_from_body)| (frame, world_from_body * body_from_vehicle));
                Ok(Self::Poses(poses.collect()))
            }
            TruthConfig::Manifest { frame } => {
                let listed = drive.listed.as_ref().ok_or_else(|| {
                    Error::config("truth.source", "`manifest` needs data.manifest, the file that lists the pairs")
                })?;
                let vehicle_from_body = vehicle_from(*frame);
                let in_vehicle_axes =
                    |(&pair, motion): (&(usize, usize), &Pose)| (pair, motion.conjugated_by(&vehicle_from_body));
                Ok(Self::Motions(listed.true_motions.iter().map(in_vehicle_axes).collect()))
            }
        }
    }

    /// `source_from_target` of the vehicle.
    pub fn motion(&self, source: usize, target: usize) -> Option<Pose> {
        match self {
            Self::Poses(poses) => Some(poses.get(&source)?.inverse() * *poses.get(&target)?),
            Self::Motions(motions) => motions.get(&(source, target)).copied(),
        }
    }

    /// `world_from_vehicle` at a frame, where poses are absolute.
    pub fn world_from_vehicle(&self, frame: usize) -> Option<&Pose> {
        match self {
            Self::Poses(poses) => poses.get(&frame),
            Self::Motions(_) => None,
        }
    }

    /// Its poses; where motions are listed pair by pair, those chained from the first frame. `None` when they do not make
    /// one chain.
    pub fn trajectory(&self) -> Option<Trajectory> {
        let motions = match self {
            Self::Poses(poses) => return Some(poses.clone()),
            Self::Motions(motions) => motions,
        };
        let (&(first, _), _) = motions.first_key_value()?;
        let mut poses = Trajectory::from([(first, Pose::identity())]);
        for (&(source, target), motion) in motions {
            let world_from_source = *poses.get(&source)?;
            poses.entry(target).or_insert(world_from_source * *motion);
        }
        Some(poses)
    }

    /// Motions between frames so many apart; without `gaps`, between neighbouring ones, or all that are listed.
    pub fn motions(&self, gaps: &[usize]) -> Motions {
        match self {
            Self::Poses(poses) => motions_of(poses, Steps::Apart(if gaps.is_empty() { &[1] } else { gaps })),
            Self::Motions(motions) => apart(motions, gaps),
        }
    }

    /// Frames whose true pose, or true motion to a later frame, is known.
    pub fn frames(&self) -> impl Iterator<Item = usize> {
        let frames: Vec<usize> = match self {
            Self::Poses(poses) => poses.keys().copied().collect(),
            Self::Motions(motions) => motions
                .keys()
                .map(|&(source, _)| source)
                .collect::<std::collections::BTreeSet<_>>()
                .into_iter()
                .collect(),
        };
        frames.into_iter()
    }
}

/// That a recording has the GNSS/INS packets which a key of the configuration asks for.
///
/// # Errors
/// It is in another layout.
pub(super) fn require_packets(drive: &Recording, key: &str, remedy: &str) -> Result<()> {
    match drive.layout {
        Layout::KittiRaw => Ok(()),
        other => Err(Error::config(
            key,
            format!("`oxts` is KITTI raw's, and {} lies in the layout `{}`{remedy}", drive.name, other.name()),
        )),
    }
}
