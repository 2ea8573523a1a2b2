//! Writes drives in the KITTI raw layout: resumable, a few frames in memory.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use nalgebra::Vector3;
use rayon::prelude::*;

use super::folder::{Claim, Replace, create_folder};
use super::packets::{packet, timestamps};
use super::random::mix;
use super::rig::Rig;
use super::sensors::{Exposure, View, beam_directions, photograph, scan};
use super::settings::SyntheticSettings;
use super::systems::{SYSTEMS, measure};
use super::world::{Moment, World};
use crate::depth::{DepthMap, encode_depth_png};
use crate::error::{Error, Result};
use crate::files::{put_in_place, remove_partial, write_renamed};
use crate::geometry::{Pinhole, Pose};
use crate::systems::{RelativePose, format_relative_pose, relative_pose_header};

/// How far a recording is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecordingProgress {
    /// Frames that are there.
    pub done: usize,
    /// Frames in all.
    pub frames: usize,
}

/// Renders a data set into `out`, or what is still missing of it; whether anything was.
///
/// `progress` is told how many frames are there and may end the work by an error; what was written
/// stays and is not rendered again. That holds for a process that is killed, not for a machine that loses power.
///
/// # Errors
/// A setting is out of range; the folder holds other data; it cannot be written; or `progress` says so.
pub fn record(
    out: &Path,
    settings: &SyntheticSettings,
    replace: Replace,
    progress: &mut dyn FnMut(RecordingProgress) -> Result<()>,
) -> Result<bool> {
    settings.validate("")?;
    let Some(claim) = Claim::stake(out, settings, replace)? else { return Ok(false) };
    create_folder(&claim.date_folder())?;
    let rig = Rig::install(&claim.date_folder(), settings.size)?;
    let beams = beam_directions(settings.lidar_steps);
    let frames = settings.drives * settings.frames;
    for drive in 1..=settings.drives {
        let before = (drive - 1) * settings.frames;
        let studio = Studio { settings, rig: &rig, beams: &beams, folders: DriveFolders::new(&claim, drive) };
        studio.record_drive(drive, &mut |done| progress(RecordingProgress { done: before + done, frames }))?;
    }
    claim.complete()?;
    Ok(true)
}

/// Where the files of a drive go.
struct DriveFolders {
    drive: PathBuf,
    /// One file for each of [`SYSTEMS`].
    measurements: [PathBuf; 4],
}

impl DriveFolders {
    fn new(claim: &Claim, drive: usize) -> Self {
        Self { drive: claim.drive_folder(drive), measurements: SYSTEMS.map(|system| claim.measurements(system, drive)) }
    }

    fn file(&self, sensor: &str, frame: usize, extension: &str) -> PathBuf {
        self.drive.join(format!("{sensor}/data/{frame:010}.{extension}"))
    }
}

/// The measurements of a drive, row by row, under partial names until it is whole.
struct MeasurementFiles<'a>(Vec<(&'a Path, PathBuf, BufWriter<File>)>);

impl<'a> MeasurementFiles<'a> {
    fn create(paths: &'a [PathBuf]) -> Result<Self> {
        let create = |path: &'a PathBuf| {
            let partial = path.with_extension("csv.partial");
            let file = File::create(&partial).map_err(Error::io("write", &partial))?;
            let mut writer = BufWriter::new(file);
            writer.write_all(relative_pose_header().as_bytes()).map_err(Error::io("write", &partial))?;
            Ok((path.as_path(), partial, writer))
        };
        Ok(Self(paths.iter().map(create).collect::<Result<_>>()?))
    }

    fn append(&mut self, poses: &[RelativePose]) -> Result<()> {
        for ((_, partial, writer), pose) in self.0.iter_mut().zip(poses) {
            writer.write_all(format_relative_pose(pose).as_bytes()).map_err(Error::io("write", partial))?;
        }
        Ok(())
    }

    fn finish(self) -> Result<()> {
        for (path, partial, mut writer) in self.0 {
            writer.flush().map_err(Error::io("write", &partial))?;
            put_in_place(&partial, path)?;
        }
        Ok(())
    }
}

/// Records one drive.
struct Studio<'a> {
    settings: &'a SyntheticSettings,
    rig: &'a Rig,
    beams: &'a [Vector3<f64>],
    folders: DriveFolders,
}

impl Studio<'_> {
    fn record_drive(&self, drive: usize, progress: &mut dyn FnMut(usize) -> Result<()>) -> Result<()> {
        let frames = self.settings.frames;
        // Measurements are written last: a drive that has them is whole.
        if self.folders.measurements.iter().all(|path| path.exists()) {
            return progress(frames);
        }
        self.lay_out()?;
        let mut world = World::new(self.settings, drive);
        let seed = world.seed();
        let mut files = MeasurementFiles::create(&self.folders.measurements)?;
        let mut carried: Option<Moment> = None;
        let mut start = Vector3::zeros();
        let at_once = 4 * rayon::current_num_threads();
        let done = AtomicUsize::new(0);
        for first in (0..frames).step_by(at_once) {
            let count = at_once.min(frames - first);
            let moments: Vec<Moment> = (0..count).map(|_| world.next_moment()).collect();
            if first == 0 {
                start = moments[0].world_from_vehicle.translation;
            }
            let measured: Vec<_> = (0..count)
                .into_par_iter()
                .map(|index| {
                    let target = &moments[index];
                    self.record_frame(target, seed, &start)?;
                    done.fetch_add(1, Ordering::Relaxed);
                    let source = if index > 0 { Some(&moments[index - 1]) } else { carried.as_ref() };
                    Ok(source.map(|source| measure(self.settings, self.rig, seed, source, target)))
                })
                .collect::<Result<_>>()?;
            for poses in measured.iter().flatten() {
                files.append(poses)?;
            }
            carried = moments.into_iter().next_back();
            progress(done.load(Ordering::Relaxed))?;
        }
        files.finish()
    }

    fn lay_out(&self) -> Result<()> {
        for sensor in ["image_02", "image_03", "velodyne_points", "oxts", "depth_02"] {
            if sensor == "velodyne_points" && self.beams.is_empty() {
                continue;
            }
            let folder = self.folders.drive.join(sensor);
            create_folder(&folder.join("data"))?;
            remove_partial(&folder.join("data"), Duration::ZERO)?;
            let times = timestamps(self.settings.frames);
            write_renamed(&folder.join("timestamps.txt"), times.as_bytes())?;
            if sensor == "velodyne_points" {
                for name in ["timestamps_start.txt", "timestamps_end.txt"] {
                    write_renamed(&folder.join(name), times.as_bytes())?;
                }
            }
        }
        for path in &self.folders.measurements {
            create_folder(path.parent().expect("a file in a folder"))?;
        }
        Ok(())
    }

    /// Writes everything of a frame, the left image last: a frame that has it is whole.
    fn record_frame(&self, moment: &Moment, seed: u64, start: &Vector3<f64>) -> Result<()> {
        let file = |sensor, extension| self.folders.file(sensor, moment.frame, extension);
        let left = file("image_02", "png");
        if left.exists() {
            return Ok(());
        }
        let vehicle_from_left = self.rig.vehicle_from_camera();
        let vehicle_from_right = vehicle_from_left * self.rig.camera2_from_camera3();
        let (right_image, _) = self.photograph(moment, seed, &vehicle_from_right, 3);
        write_renamed(&file("image_03", "png"), &right_image)?;
        if !self.beams.is_empty() {
            let velodyne = moment.world_from_vehicle * self.rig.vehicle_from_velodyne();
            let points = scan(&moment.scene, &velodyne, self.beams, seed, moment.frame as u64);
            write_renamed(&file("velodyne_points", "bin"), &points)?;
        }
        write_renamed(&file("oxts", "txt"), packet(moment, start).as_bytes())?;
        let (left_image, depth) = self.photograph(moment, seed, &vehicle_from_left, 2);
        write_renamed(&file("depth_02", "png"), &encode_depth_png(&depth))?;
        write_renamed(&left, &left_image)
    }

    /// A colour image as PNG, and its depth.
    fn photograph(&self, moment: &Moment, seed: u64, vehicle_from_camera: &Pose, camera: u64) -> (Vec<u8>, DepthMap) {
        let view = |world_from_vehicle: &Pose| View {
            scene: &moment.scene,
            light: &moment.light,
            camera: self.rig.camera(),
            world_from_camera: *world_from_vehicle * *vehicle_from_camera,
        };
        let views: Vec<View<'_>> = moment.exposed_world_from_vehicle.iter().map(view).collect();
        let exposure = Exposure {
            gain: moment.gain,
            noise: self.settings.image_noise,
            key: mix(seed ^ mix((moment.frame as u64) << 8 | camera)),
        };
        let (pixels, depth) = photograph(&views, &exposure);
        let Pinhole { width, height, .. } = self.rig.camera();
        let mut png = Vec::new();
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Up)
            .write_image(&pixels, width as u32, height as u32, ExtendedColorType::Rgb8)
            .expect("three bytes a pixel");
        (png, depth)
    }
}
