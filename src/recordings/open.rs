//! Opens a recording by its name, in whichever layout it lies there.

use std::path::Path;

use super::euroc::load_euroc;
use super::kitti_odometry::load_kitti_odometry;
use super::kitti_raw::load_kitti_raw;
use super::layout::Layout;
use super::locate::layout_of;
use super::recording::Recording;
use super::settings::CameraConfig;
use super::tum_rgbd::load_tum_rgbd;
use crate::error::{Error, Result};
use crate::files::is_plain;
use crate::geometry::Pose;
use crate::time::Time;

/// What is known of a recording beside where it lies.
#[derive(Clone, Copy, Debug, Default)]
pub struct Opening<'a> {
    /// Its layout; `None`: the one that fits.
    pub layout: Option<Layout>,
    /// Its camera, for layouts that do not say it.
    pub camera: Option<&'a CameraConfig>,
    /// The camera of recordings that have none of their own and none that is known.
    pub usual_camera: Option<&'a CameraConfig>,
    /// Vehicle axes into those of the camera, for layouts that know no vehicle; `None`: the vehicle is where the camera is,
    /// x forward, y left, z up.
    pub camera_from_vehicle: Option<&'a Pose>,
}

/// Opens the recording `name` below `root`.
///
/// # Errors
/// There is none of a known layout, or two fit; or it cannot be read.
pub fn open_recording(root: &Path, name: &str, opening: &Opening) -> Result<Recording> {
    if !is_plain(name) {
        let problem = format!("drive `{name}` cannot name a folder below data.root; use letters, digits, - and _");
        return Err(Error::config("data", problem));
    }
    let layout = match opening.layout {
        Some(layout) => layout.require_folder(root, name)?,
        None => layout_of(root, name)?,
    };
    if !layout.takes_camera() && (opening.camera.is_some() || opening.usual_camera.is_some()) {
        let problem = format!("{name}: a recording in the layout `{}` brings its own calibration", layout.name());
        return Err(Error::config("data.camera", problem));
    }
    if !layout.takes_vehicle() && opening.camera_from_vehicle.is_some() {
        let problem = format!("{name}: the calibration of a recording in the layout `{}` says it", layout.name());
        return Err(Error::config("data.camera_from_vehicle", problem));
    }
    let folder = root.join(name);
    let recording = match layout {
        Layout::KittiRaw => load_kitti_raw(root, name)?,
        Layout::KittiOdometry => load_kitti_odometry(root, name, opening.camera_from_vehicle)?,
        Layout::TumRgbd => {
            load_tum_rgbd(&folder, name, opening.camera, opening.usual_camera, opening.camera_from_vehicle)?
        }
        Layout::Euroc => load_euroc(&folder, name)?,
        Layout::Manifest => {
            return Err(Error::config("data.layout", "`manifest` needs the file: data.manifest = \"pairs.csv\""));
        }
    };
    let remark = remark_of_rate(&recording);
    Ok(Recording { remarks: recording.remarks.iter().cloned().chain(remark).collect(), ..recording })
}

/// Frames of cameras are not farther apart in time, s, nor nearer: times may be in other units.
const USUAL_PERIOD_S: std::ops::RangeInclusive<f64> = 1e-4..=10.0;

fn remark_of_rate(recording: &Recording) -> Option<String> {
    let times: Vec<Time> = recording.times.values().copied().collect();
    let mut periods: Vec<f64> = times.windows(2).map(|pair| pair[1].since(pair[0])).collect();
    periods.sort_by(f64::total_cmp);
    let median = *periods.get(periods.len() / 2)?;
    let unusual = !USUAL_PERIOD_S.contains(&median);
    unusual.then(|| {
        format!("its frames are {median} s apart by their times ({}); are those seconds?", recording.layout.times())
    })
}
