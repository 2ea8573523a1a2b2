//! TUM RGB-D: `rgb.txt`, `depth.txt` and `groundtruth.txt`, each with a time a line; images and depth maps beside them.
//!
//! Colour, depth and truth run on clocks of their own and are joined by the nearest time. Depth maps are 16-bit PNG,
//! metres x 5000, registered to the colour images. The layout says nothing of the camera: it is the configuration's, or
//! the known one of fr1, fr2 and fr3.

use std::collections::BTreeMap;
use std::path::Path;

use super::association::LARGEST_DISTANCE_S;
use super::calibration::Calibration;
use super::image::{is_grey_16, size_of_first};
use super::layout::Layout;
use super::recording::{FrameFiles, Recording};
use super::settings::CameraConfig;
use super::time_list::{ListForm, TimeList};
use super::trajectory::{match_tum_poses, stated_axes};
use super::undistortion::Undistortion;
use crate::error::{Error, Place, Result};
use crate::files::read_text;
use crate::geometry::{ErrorFrame, Lens, OWN_INTRINSICS, Pinhole, Pose};
use crate::time::{EXPECTED_SECONDS, Time};

/// Images whose headers are looked at: a recording has tens of thousands.
const LOOKED_AT: usize = 16;
/// Steps of a metre in its depth maps.
const STEPS_PER_METRE: f32 = 5000.0;

/// Its lists.
const LIST: ListForm = ListForm {
    separates: char::is_whitespace,
    parse_time: Time::parse_seconds,
    expected_time: EXPECTED_SECONDS,
    expected_line: "a time in seconds and the name of a file",
    folder: "",
};

/// The colour cameras of the benchmark (Sturm et al. 2012, "Intrinsic camera calibration of the Kinect") by a word
/// of their recordings' names: fx fy cx cy, and k1 k2 p1 p2 k3.
const KNOWN: [([&str; 2], [f64; 4], [f64; 5]); 3] = [
    (["freiburg1", "fr1"], [517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    (["freiburg2", "fr2"], [520.9, 521.0, 325.1, 249.7], [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    (["freiburg3", "fr3"], [535.4, 539.2, 320.1, 247.6], [0.0; 5]),
];
/// Size of their images, px.
const KNOWN_SIZE: [usize; 2] = [640, 480];

/// Reads the recording in a folder.
///
/// `camera`: its colour camera; `None`: the known one, else `usual_camera`, and both are refused where they differ.
/// `camera_from_vehicle`: vehicle axes into those of the colour camera; `None`: the vehicle is where the camera is, x
/// forward, y left, z up.
///
/// # Errors
/// `rgb.txt` is missing, not one of its images is there, or nothing tells the camera; or a list or the truth is malformed
/// or of another clock. What lists name and is not there, and depth maps of no image, are counted in its remarks.
pub fn load_tum_rgbd(
    folder: &Path,
    name: &str,
    camera: Option<&CameraConfig>,
    usual_camera: Option<&CameraConfig>,
    camera_from_vehicle: Option<&Pose>,
) -> Result<Recording> {
    let [colour_file, depth_file, truth_file] =
        ["rgb.txt", "depth.txt", "groundtruth.txt"].map(|name| folder.join(name));
    if !colour_file.is_file() {
        let expected = "the list of its images: a time in seconds and the name of a file a line";
        return Err(Error::malformed(&colour_file, Place::Whole, "no such file", expected));
    }
    let colour = TimeList::load(&colour_file, &LIST)?;
    let mut remarks: Vec<String> = colour.absent("images").into_iter().collect();
    let (images, times) = (colour.frames()?, colour.times());
    require_colour(&images)?;
    let size = size_of_first(images.values())?;
    let lens = lens_of(name, camera, usual_camera, size)?;
    let (rectified, undistortion) = Undistortion::of(&lens).ok_or_else(|| no_rectified(name))?;
    let calibration = Calibration::of_camera(rectified, camera_from_vehicle);
    let camera_from_vehicle = calibration.camera_from_vehicle;
    let depth = match depth_file.is_file() {
        true => {
            let list = TimeList::load(&depth_file, &LIST)?;
            list.require_others(&colour)?;
            list.nearest_to(&times, LARGEST_DISTANCE_S, "depth maps", &mut remarks)?
        }
        false => {
            remarks.push(format!("{}: not there; it brings no depth", depth_file.display()));
            FrameFiles::new()
        }
    };
    let poses = match truth_file.is_file() {
        true => {
            let text = read_text(&truth_file)?;
            if let Some(axes) = stated_axes(&text).filter(|axes| *axes != ErrorFrame::Camera) {
                let found = format!("poses in axes `{}`", axes.name());
                return Err(Error::malformed(&truth_file, Place::Line(1), found, "those of the colour camera"));
            }
            let truth = match_tum_poses(&text, &truth_file, &times, LARGEST_DISTANCE_S)?;
            remarks.extend(truth.remark);
            truth.poses
        }
        false => {
            remarks.push(format!("{}: not there; it brings no true poses", truth_file.display()));
            BTreeMap::new()
        }
    };
    let of_vehicle = |(frame, world_from_camera): (usize, Pose)| (frame, world_from_camera * camera_from_vehicle);
    Ok(Recording {
        images,
        depth,
        depth_steps_per_metre: STEPS_PER_METRE,
        lens: undistortion,
        poses: poses.into_iter().map(of_vehicle).collect(),
        times,
        remarks,
        sources: vec![colour_file, depth_file, truth_file],
        ..Recording::new(Layout::TumRgbd, name, calibration)
    })
}

/// That images, some of them spread over all, are none of 16 bits of grey, as depth maps are.
fn require_colour(images: &FrameFiles) -> Result<()> {
    let step = images.len().div_ceil(LOOKED_AT).max(1);
    match images.values().step_by(step).find(|path| is_grey_16(path)) {
        None => Ok(()),
        Some(path) => {
            let expected = "a colour image; are depth maps listed in rgb.txt?";
            Err(Error::malformed(path, Place::Whole, "16-bit grey pixels", expected))
        }
    }
}

/// The benchmark's camera of a recording, where a word of its name says it.
fn known_lens(name: &str) -> Option<Lens> {
    let name = name.to_lowercase();
    let mut words = name.split(|c: char| !c.is_alphanumeric());
    let (_, [fx, fy, cx, cy], distortion) =
        words.find_map(|word| KNOWN.iter().find(|(names, ..)| names.contains(&word)))?;
    let [width, height] = KNOWN_SIZE;
    Some(Lens { camera: Pinhole { fx: *fx, fy: *fy, cx: *cx, cy: *cy, width, height }, distortion: *distortion })
}

/// Whether the camera of a recording is known by its name.
pub(crate) fn is_known_camera(name: &str) -> bool {
    known_lens(name).is_some()
}

/// The camera with its distortion.
fn lens_of(
    name: &str,
    camera: Option<&CameraConfig>,
    usual_camera: Option<&CameraConfig>,
    [width, height]: [usize; 2],
) -> Result<Lens> {
    let key = if camera.is_some() { "camera" } else { "data.camera" };
    let refuse = |problem: String| Err(Error::config(key, problem));
    let beside = format!("{{ drive = \"{name}\", camera = {{ … }} }}");
    let lens = match (camera, known_lens(name), usual_camera) {
        (Some(camera), ..) => camera.lens(),
        (None, Some(known), Some(usual)) if usual.lens() != known => {
            return refuse(format!(
                "is another than that of the TUM benchmark which the name of `{name}` says; give the one that is right beside it: {beside}"
            ));
        }
        (None, Some(known), _) => known,
        (None, None, Some(usual)) => usual.lens(),
        (None, None, None) => {
            return refuse(format!(
                "nothing tells the camera of `{name}`, whose name has no word fr1, fr2 or fr3; give data.camera = {{ width, height, fx, fy, cx, cy, distortion }}, px, or {beside}"
            ));
        }
    };
    let camera = lens.camera;
    if [camera.width, camera.height] != [width, height] {
        let remedy = if key == "camera" {
            "give the intrinsics of these images".to_owned()
        } else {
            format!("give its own: {beside}")
        };
        return refuse(format!(
            "is of images of {}x{} pixels, and the first of `{name}` has {width}x{height}; {remedy}",
            camera.width, camera.height
        ));
    }
    camera
        .require_centre()
        .map_err(|found| Error::config(key, format!("`{name}`: {found}; expected {OWN_INTRINSICS}")))?;
    Ok(lens)
}

fn no_rectified(name: &str) -> Error {
    let problem = format!("`{name}`: by this distortion different rays meet in one pixel; is it k1 k2 p1 p2 k3?");
    Error::config("data.camera.distortion", problem)
}
