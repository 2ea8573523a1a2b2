//! Joins measured poses, true poses and images of a drive into pairs with their errors.

use std::collections::BTreeMap;
use std::path::PathBuf;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::coverage::{Coverage, FrameSpan};
use super::pair::{Pair, PairId, PairScope};
use super::settings::{DriveConfig, PairSettings};
use super::split::SplitName;
use crate::depth::{DepthConfig, depth_file, has_depth};
use crate::error::{Error, Result};
use crate::geometry::{Pose, Tangent};
use crate::recordings::{CameraConfig, Manifest, MeasurementFrame, Opening, Recording, open_recording};
use crate::systems::{Measurements, Truth, load_measurements};

/// Joins drive after drive; each is read once, however many splits name it.
pub(super) struct Pairing<'a> {
    config: &'a PairSettings<'a>,
    scope: PairScope,
    drives: Vec<Recording>,
    /// For each drive: the truth and each system's measurements.
    sources: Vec<(Truth, Vec<Measurements>)>,
    /// The camera that each was read with, where the configuration says one.
    cameras: Vec<Option<CameraConfig>>,
    /// The manifest, where the data are listed in one.
    manifest: Option<Manifest>,
}

impl<'a> Pairing<'a> {
    /// Reads the manifest, if the data are listed in one.
    ///
    /// # Errors
    /// The manifest is missing or malformed.
    pub(super) fn new(config: &'a PairSettings<'a>, scope: PairScope) -> Result<Self> {
        let manifest = config.data.manifest.as_deref().map(Manifest::load).transpose()?;
        Ok(Self { config, scope, drives: Vec::new(), cameras: Vec::new(), sources: Vec::new(), manifest })
    }

    /// The drives seen so far.
    pub(super) fn into_drives(self) -> Vec<Recording> {
        self.drives
    }

    /// The pairs a drive, or a part of it, gives to a split.
    ///
    /// # Errors
    /// The drive, its calibration or a measurement file is missing or malformed, or too many packets
    /// are unreadable.
    pub(super) fn pair_drive(&mut self, split: SplitName, wanted: &DriveConfig) -> Result<(Coverage, Vec<Pair>)> {
        let index = self.drive_index(wanted)?;
        let drive = &self.drives[index];
        let (truth, systems) = &self.sources[index];
        let root = &self.config.data.root;
        let wanted_frame = |frame: usize| wanted.frames.is_none_or(|[first, end]| (first..end).contains(&frame));
        // A step over several frames must not reach over the cut into another split.
        let wanted_pair = |&(source, target): &(usize, usize)| {
            wanted_frame(source) && wanted.frames.is_none_or(|[_, end]| target <= end)
        };
        let cameras =
            if self.config.input.stereo { vec![&drive.images, &drive.right_images] } else { vec![&drive.images] };
        let has_images = |&(source, target): &(usize, usize)| {
            cameras.iter().all(|images| images.contains_key(&source) && images.contains_key(&target))
        };
        let has_depth = |&(_, target): &(usize, usize)| has_depth(self.config.depth, drive, target, root);

        let pose_pairs: Vec<(usize, usize)> =
            truth.motions(&self.config.data.gap).into_keys().filter(wanted_pair).collect();
        let image_pairs: Vec<_> = pose_pairs.iter().copied().filter(has_images).collect();
        let depth_pairs = image_pairs.iter().copied().filter(has_depth).count();

        let count = |files: &BTreeMap<usize, PathBuf>| files.keys().filter(|&&frame| wanted_frame(frame)).count();
        let mut pairs = Vec::new();
        let (mut measured_pairs, mut measured_with_images) = (Vec::new(), Vec::new());
        let mut missing_depth = None;
        for (system, measurements) in systems.iter().enumerate() {
            let (mut measured, mut with_images) = (0, 0);
            for (&(source, target), measured_pose) in &measurements.relative_poses {
                let true_motion = truth.motion(source, target);
                if !wanted_pair(&(source, target)) || (true_motion.is_none() && self.scope != PairScope::Measured) {
                    continue;
                }
                measured += 1;
                let pair = (source, target);
                with_images += usize::from(has_images(&pair));
                if self.scope != PairScope::Poses && !(has_images(&pair) && has_depth(&pair)) {
                    if has_images(&pair) && missing_depth.is_none() {
                        missing_depth = depth_file(self.config.depth, drive, target, root);
                    }
                    continue;
                }
                let vehicle_from_camera = drive.calibration.camera_from_vehicle.inverse();
                let camera_from_body = drive.calibration.camera_from(measurements.frame);
                let source_from_target = measured_pose.conjugated_by(&camera_from_body);
                let measured_motion = measured_pose.conjugated_by(&(vehicle_from_camera * camera_from_body));
                let world_from_vehicle = truth.world_from_vehicle(source);
                let Some(frame_from_vehicle) =
                    drive.calibration.axes_from_vehicle(self.config.data.error_frame, world_from_vehicle)
                else {
                    return Err(no_world(&drive.name, source));
                };
                // A system that is the truth has no error, not one of rounding.
                let is_truth = |true_motion: &Pose| {
                    measurements.frame == MeasurementFrame::Vehicle && measured_pose == true_motion
                };
                let error = match true_motion.filter(|true_motion| !is_truth(true_motion)) {
                    None => Tangent::zeros(),
                    Some(true_motion) => Pose::error(
                        &measured_motion.conjugated_by(&frame_from_vehicle),
                        &true_motion.conjugated_by(&frame_from_vehicle),
                    ),
                };
                let frame_from_body = frame_from_vehicle * vehicle_from_camera * camera_from_body;
                let stated_covariance = measurements.covariances.get(&pair);
                pairs.push(Pair {
                    id: PairId { drive: index, source, target },
                    system,
                    source_from_target,
                    error,
                    is_judged: true_motion.is_some(),
                    motion: measured_motion.log(),
                    errors_from_camera: frame_from_vehicle * vehicle_from_camera,
                    generated: None,
                    stated_covariance: stated_covariance.map(|covariance| covariance.transported(&frame_from_body)),
                });
            }
            measured_pairs.push(measured);
            measured_with_images.push(with_images);
        }
        let coverage = Coverage {
            split,
            drive: index,
            frames: wanted.frames,
            true_poses: truth.frames().filter(|&frame| wanted_frame(frame)).count(),
            images: count(&drive.images),
            right_images: count(&drive.right_images),
            scans: count(&drive.scans),
            pose_pairs: pose_pairs.len(),
            image_pairs: image_pairs.len(),
            depth_pairs,
            measured_pairs,
            measured_with_images,
            missing_depth,
            measured_frames: systems.iter().map(|system| FrameSpan::of(system.frames())).collect(),
            true_frames: FrameSpan::of(truth.frames()),
            image_frames: FrameSpan::of(drive.images.keys().copied()),
            missing_files: systems.iter().map(|system| system.missing_file.clone()).collect(),
        };
        Ok((coverage, pairs))
    }

    fn drive_index(&mut self, wanted: &DriveConfig) -> Result<usize> {
        let name = &wanted.drive;
        let data = self.config.data;
        let camera = wanted.camera.as_ref();
        if let Some(index) = self.drives.iter().position(|drive| drive.name == *name) {
            let problem = || format!("`{name}` is named with another camera before");
            let same = self.cameras[index] == camera.cloned();
            return if same { Ok(index) } else { Err(Error::config("data", problem())) };
        }
        let root = &data.root;
        let camera_from_vehicle = data.camera_from_vehicle.map(pose_of_numbers);
        let drive = match &self.manifest {
            None => {
                let camera_from_vehicle = camera_from_vehicle.as_ref();
                let usual_camera = data.camera.as_ref();
                open_recording(root, name, &Opening { layout: data.layout, camera, usual_camera, camera_from_vehicle })?
            }
            Some(manifest) => manifest.recording(name, camera_from_vehicle.as_ref())?,
        };
        if matches!(self.config.depth, DepthConfig::GroundPlane { .. }) && !drive.depth.is_empty() {
            tracing::warn!(
                "{name} brings depth maps, and depth.source = \"ground_plane\" takes a flat road for depth; set depth.source = \"recording\""
            );
        }
        let place = |drive: &Recording| drive.images.values().next().and_then(|path| path.canonicalize().ok());
        if let (Some(own), None) = (place(&drive), &self.manifest)
            && let Some(twin) = self.drives.iter().find(|twin| place(twin).as_ref() == Some(&own))
        {
            let problem = format!("`{name}` is `{}` by another name; name it once", twin.name);
            return Err(Error::config("data", problem));
        }
        if let Some(first) = drive.remarks.first() {
            let others = match drive.remarks.len() {
                1 => String::new(),
                count => format!(" (and {} other remarks: relcov inspect)", count - 1),
            };
            tracing::warn!("{name}: {first}{others}");
        }
        let packets = drive.poses.len() + drive.problems.len();
        let limit = self.config.data.max_bad_fraction;
        if drive.problems.len() as f64 > limit * packets as f64 {
            return Err(Error::Data(format!(
                "{name}: {} of {packets} packets are unreadable, more than data.max_bad_fraction = {limit} allows; the first: {}",
                drive.problems.len(),
                drive.problems[0]
            )));
        }
        for (what, problems) in [("packets", &drive.problems), ("times", &drive.time_problems)] {
            if let Some(first) = problems.first() {
                tracing::warn!("{name}: {} problems with its {what}; the first: {first}", problems.len());
            }
        }
        if self.config.input.stereo && self.scope != PairScope::Poses && drive.calibration.right_from_left.is_none() {
            return Err(Error::config(
                "model.stereo",
                format!("{name} has no right camera: {}", drive.layout.right_camera()),
            ));
        }
        let truth = Truth::load(self.config.truth, &drive, root)?;
        let systems = self
            .config
            .systems
            .iter()
            .map(|system| load_measurements(system, &drive, root, &truth, &self.config.data.gap))
            .collect::<Result<_>>()?;
        tracing::debug!("{name}: {} poses, {} images", drive.poses.len(), drive.images.len());
        self.drives.push(drive);
        self.cameras.push(camera.cloned());
        self.sources.push((truth, systems));
        Ok(self.drives.len() - 1)
    }
}

/// A pose of `x y z qx qy qz qw`, which the configuration has checked.
fn pose_of_numbers([x, y, z, qx, qy, qz, qw]: [f64; 7]) -> Pose {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz)).to_rotation_matrix();
    Pose::new(rotation, Vector3::new(x, y, z))
}

fn no_world(drive: &str, frame: usize) -> Error {
    Error::Data(format!(
        "{drive}, frame {frame}: errors in axes of the world (data.error_frame) need the true absolute pose there, which the data do not have"
    ))
}
