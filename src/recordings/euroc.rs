//! EuRoC, or ASL: `mav0/{cam0,cam1,state_groundtruth_estimate0}`, each with `data.csv` and `sensor.yaml`; images below
//! `data`.
//!
//! Times are whole nanoseconds; a frame is a row of cam0's list, counted from 0. Both cameras are taken to the intrinsics
//! of the left one's undistorted images; they are not rectified to each other. The vehicle is the body of the calibration:
//! in EuRoC's recordings the IMU, which does not sit there with x forward and z up.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::association::LARGEST_DISTANCE_S;
use super::calibration::Calibration;
use super::layout::Layout;
use super::recording::Recording;
use super::sensor_yaml::{BodyCamera, load_body_camera, load_body_from_sensor};
use super::time_list::{ListForm, TimeList};
use super::trajectory::{Trajectory, parse_euroc_trajectory};
use super::undistortion::Undistortion;
use crate::error::{Error, Place, Result};
use crate::files::read_text;
use crate::geometry::Pose;
use crate::time::{EXPECTED_NANOSECONDS, Time};

/// Its lists.
const LIST: ListForm = ListForm {
    separates: |c| c == ',',
    parse_time: Time::parse_nanoseconds,
    expected_time: EXPECTED_NANOSECONDS,
    expected_line: "a time in nanoseconds, a comma and the name of a file below `data`",
    folder: "data",
};

/// Largest distance in time between images of both cameras, s: one signal triggers them.
const STEREO_DISTANCE_S: f64 = 1e-3;

/// Where true poses are, in the order of preference.
const TRUTHS: [&str; 2] = ["state_groundtruth_estimate0", "mocap0"];

/// Reads the recording in a folder that holds `mav0`.
///
/// # Errors
/// List or calibration of cam0 is missing or malformed, or not one of its images is there; or those of cam1 or the truth are
/// malformed or of another clock. What lists name and is not there is counted in its remarks.
pub fn load_euroc(folder: &Path, name: &str) -> Result<Recording> {
    let rig = folder.join("mav0");
    let left_files = CameraFiles::below(&rig.join("cam0"));
    let (list, left) = left_files.load()?;
    let mut remarks: Vec<String> = list.absent("images").into_iter().collect();
    let (images, times) = (list.frames()?, list.times());

    let camera = left.rectified;
    let calibration = Calibration::of_camera(camera, Some(&left.body_from_camera.inverse()));
    let mut sources = vec![left_files.list, left_files.calibration];
    let mut recording = Recording {
        images,
        lens: Undistortion::to(&left.lens, camera),
        ..Recording::new(Layout::Euroc, name, calibration)
    };

    let right_files = CameraFiles::below(&rig.join("cam1"));
    if right_files.list.is_file() || right_files.calibration.is_file() {
        let (list, right) = right_files.load()?;
        let [width, height] = [right.lens.camera.width, right.lens.camera.height];
        if [width, height] != [camera.width, camera.height] {
            let expected = format!("{}x{} as of cam0: both have one size", camera.width, camera.height);
            let place = Place::Field("resolution".to_owned());
            return Err(Error::malformed(&right_files.calibration, place, format!("{width}x{height} px"), expected));
        }
        recording.right_images = list.nearest_to(&times, STEREO_DISTANCE_S, "right images", &mut remarks)?;
        recording.right_lens = Undistortion::to(&right.lens, camera);
        recording.calibration.right_from_left = Some(right.body_from_camera.inverse() * left.body_from_camera);
        sources.extend([right_files.list, right_files.calibration]);
    }

    let truths = TRUTHS.map(|sensor| rig.join(sensor).join("data.csv"));
    match truths.iter().find(|path| path.is_file()) {
        Some(path) => {
            recording.poses = load_truth(path, &times, &mut remarks)?;
            sources.push(path.clone());
        }
        None => remarks.push(format!("{}: not there; it brings no true poses", truths[0].display())),
    }
    Ok(Recording { times, remarks, sources, ..recording })
}

/// The files of a camera.
struct CameraFiles {
    list: PathBuf,
    calibration: PathBuf,
}

impl CameraFiles {
    fn below(folder: &Path) -> Self {
        Self { list: folder.join("data.csv"), calibration: folder.join("sensor.yaml") }
    }

    fn load(&self) -> Result<(TimeList, BodyCamera)> {
        for (path, expected) in [(&self.list, LIST.expected_line), (&self.calibration, "the calibration of the camera")]
        {
            if !path.is_file() {
                return Err(Error::malformed(path, Place::Whole, "no such file", expected));
            }
        }
        Ok((TimeList::load(&self.list, &LIST)?, load_body_camera(&self.calibration)?))
    }
}

/// True poses of the body, `world_from_vehicle`. The file has those of its sensor, which is elsewhere on the body where the
/// calibration beside it says so: markers of a motion capture.
fn load_truth(path: &Path, times: &BTreeMap<usize, Time>, remarks: &mut Vec<String>) -> Result<Trajectory> {
    let truth = parse_euroc_trajectory(&read_text(path)?, path, times, LARGEST_DISTANCE_S)?;
    remarks.extend(truth.remark);
    let poses = truth.poses;
    let calibration = path.with_file_name("sensor.yaml");
    if !calibration.is_file() {
        return Ok(poses);
    }
    let sensor_from_body = load_body_from_sensor(&calibration)?.inverse();
    let of_body = |(frame, world_from_sensor): (usize, Pose)| (frame, world_from_sensor * sensor_from_body);
    Ok(poses.into_iter().map(of_body).collect())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::{Matrix4, Vector3};
    use tempfile::TempDir;

    use super::*;
    use crate::geometry::{Lens, Pinhole};
    use crate::recordings::{Opening, open_recording, read_image};

    const BODY_FROM_LEFT: &str = "[0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]";
    const BODY_FROM_RIGHT: &str = "[0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556,
         0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024,
        -0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038,
         0.0, 0.0, 0.0, 1.0]";
    const FIRST_NS: i64 = 1_403_636_579_763_555_584;
    const PERIOD_NS: i64 = 50_000_000;
    const FRAMES: i64 = 4;
    /// Those of EuRoC, at an eighth of its size.
    const LEFT: Lens = Lens {
        camera: Pinhole { fx: 57.33175, fy: 57.162, cx: 45.901875, cy: 31.046875, width: 94, height: 60 },
        distortion: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0],
    };
    const RIGHT: Lens = Lens {
        camera: Pinhole { fx: 57.198375, fy: 57.01675, cx: 47.499875, cy: 31.88925, width: 94, height: 60 },
        distortion: [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05, 0.0],
    };

    /// The file of MH_01_easy.
    fn sensor_yaml(body_from_camera: &str, lens: &Lens) -> String {
        let Pinhole { fx, fy, cx, cy, width, height } = lens.camera;
        let [k1, k2, p1, p2, _] = lens.distortion;
        format!(
            "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n# Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n  data: {body_from_camera}\n\n# Camera specific definitions.\nrate_hz: 20\nresolution: [{width}, {height}]\ncamera_model: pinhole\nintrinsics: [{fx}, {fy}, {cx}, {cy}] #fu, fv, cu, cv\ndistortion_model: radial-tangential\ndistortion_coefficients: [{k1}, {k2}, {p1}, {p2:e}]\n"
        )
    }

    fn camera(rig: &Path, camera: &str, offset_ns: i64, yaml: &str) {
        let folder = rig.join(camera);
        std::fs::create_dir_all(folder.join("data")).unwrap();
        let mut list = "#timestamp [ns],filename\n".to_owned();
        for frame in 0..FRAMES {
            let time = FIRST_NS + frame * PERIOD_NS + offset_ns;
            let grey = |column: u32, row: u32| image::Luma([(2 * column + row + 10 * frame as u32) as u8]);
            image::GrayImage::from_fn(94, 60, grey).save(folder.join(format!("data/{time}.png"))).unwrap();
            list += &format!("{time},{time}.png\n");
        }
        std::fs::write(folder.join("data.csv"), list).unwrap();
        std::fs::write(folder.join("sensor.yaml"), yaml).unwrap();
    }

    /// Rows at 200 Hz, 2 ms beside the frames; the body moves 1 m/s along x, turned by 90° around z.
    fn truth(first_ns: i64) -> String {
        let mut text = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]\n".to_owned();
        for row in 0..40 {
            let (time, x) = (first_ns + row * 5_000_000 + 2_000_000, 5e-3 * row as f64);
            text += &format!("{time},{x},2,3,0.7071068,0,0,0.7071068,1.0\n");
        }
        text
    }

    fn recording() -> TempDir {
        let root = TempDir::new().unwrap();
        let rig = root.path().join("MH_01_easy/mav0");
        camera(&rig, "cam0", 0, &sensor_yaml(BODY_FROM_LEFT, &LEFT));
        camera(&rig, "cam1", 200_000, &sensor_yaml(BODY_FROM_RIGHT, &RIGHT));
        std::fs::create_dir_all(rig.join(TRUTHS[0])).unwrap();
        std::fs::write(rig.join(TRUTHS[0]).join("data.csv"), truth(FIRST_NS)).unwrap();
        root
    }

    fn open(root: &TempDir) -> Result<Recording> {
        open_recording(root.path(), "MH_01_easy", &Opening::default())
    }

    fn parsed(matrix: &str) -> Matrix4<f64> {
        let numbers = matrix.trim_matches(['[', ']']).split(',').map(|word| word.trim().parse().unwrap());
        Matrix4::from_row_iterator(numbers)
    }

    #[test]
    fn poses_are_those_of_the_body_at_the_times_of_frames() {
        let root = recording();
        let recording = open(&root).unwrap();
        assert_eq!((recording.layout, recording.images.len()), (Layout::Euroc, 4));
        assert_eq!(recording.times[&3], Time::from_nanoseconds(FIRST_NS + 3 * PERIOD_NS));
        assert!(recording.remarks.is_empty(), "{:?}", recording.remarks);
        for (frame, pose) in &recording.poses {
            // The row 2 ms after a frame is nearer than the one 3 ms before.
            assert_relative_eq!(pose.translation, Vector3::new(0.05 * *frame as f64, 2.0, 3.0), epsilon = 1e-12);
            assert_relative_eq!(pose.rotation * Vector3::x(), Vector3::y(), epsilon = 1e-7);
        }
        assert_eq!(recording.poses.len(), 4);
        let body_from_camera = recording.calibration.camera_from_vehicle.inverse();
        assert_relative_eq!(body_from_camera.matrix(), parsed(BODY_FROM_LEFT), epsilon = 1e-6);
        let camera = recording.calibration.camera;
        assert_eq!(camera, LEFT.rectified().unwrap());
        let image = recording.read_image(2).unwrap();
        let distorted = read_image(&recording.images[&2]).unwrap();
        assert_eq!(image, Undistortion::new(&LEFT, camera).image(&distorted));
        assert_ne!(image, distorted);
    }

    #[test]
    fn right_images_are_taken_to_the_intrinsics_of_the_left_ones() {
        let root = recording();
        let recording = open(&root).unwrap();
        let right_from_left = recording.calibration.right_from_left.unwrap();
        let expected = parsed(BODY_FROM_RIGHT).try_inverse().unwrap() * parsed(BODY_FROM_LEFT);
        assert_relative_eq!(right_from_left.matrix(), expected, epsilon = 1e-6);
        // By numpy.
        let offset = Vector3::new(-0.110073808, 0.000399121547, -0.000853702503);
        assert_relative_eq!(right_from_left.translation, offset, epsilon = 1e-7);
        let distorted = read_image(&recording.right_images[&1]).unwrap();
        let expected = Undistortion::new(&RIGHT, recording.calibration.camera).image(&distorted);
        assert_eq!(recording.read_right_image(1).unwrap(), expected);

        std::fs::remove_dir_all(root.path().join("MH_01_easy/mav0/cam1")).unwrap();
        let recording = open(&root).unwrap();
        assert!(recording.right_images.is_empty() && recording.calibration.right_from_left.is_none());
        assert!(recording.remarks.is_empty());
    }

    #[test]
    fn what_is_not_there_is_counted_and_markers_are_not_the_body() {
        let root = recording();
        let rig = root.path().join("MH_01_easy/mav0");
        for (camera, offset_ns) in [("cam0", 0), ("cam1", 200_000)] {
            let time = FIRST_NS + 2 * PERIOD_NS + offset_ns;
            std::fs::remove_file(rig.join(camera).join(format!("data/{time}.png"))).unwrap();
        }
        std::fs::rename(rig.join(TRUTHS[0]), rig.join(TRUTHS[1])).unwrap();
        let marker = "[1, 0, 0, 0.5,  0, 1, 0, 0,  0, 0, 1, 0,  0, 0, 0, 1]";
        let yaml = format!("sensor_type: mocap\nT_BS:\n  cols: 4\n  rows: 4\n  data: {marker}\n");
        std::fs::write(rig.join("mocap0/sensor.yaml"), yaml).unwrap();
        let recording = open(&root).unwrap();
        assert_eq!(recording.images.keys().collect::<Vec<_>>(), [&0, &1, &3]);
        assert_eq!(recording.right_images.keys().collect::<Vec<_>>(), [&0, &1, &3]);
        assert_relative_eq!(recording.poses[&1].translation, Vector3::new(0.05, 1.5, 3.0), epsilon = 1e-7);
        let [left, right] = recording.remarks.as_slice() else { panic!("{:?}", recording.remarks) };
        assert!(left.contains("cam0/data.csv: 1 of its 4 images are not there, the first on line 4"), "{left}");
        assert!(right.contains("cam1/data.csv: 1 of its 4 right images are not there"), "{right}");

        std::fs::remove_dir_all(rig.join("mocap0")).unwrap();
        let remarks = open(&root).unwrap().remarks;
        assert!(remarks[2].ends_with("state_groundtruth_estimate0/data.csv: not there; it brings no true poses"));
    }

    #[test]
    fn bad_files_are_named_with_their_line() {
        const NEXT: &str = "1403636579813555584,";
        let (cam0, cam1, truth) = ("cam0/sensor.yaml", "cam1/sensor.yaml", "state_groundtruth_estimate0/data.csv");
        for (file, from, to, words) in [
            ("cam0/data.csv", NEXT, "1403636579.81,", "line 3: found time `1403636579.81`; expected whole nanoseconds"),
            ("cam0/data.csv", NEXT, "1403636579763555584,", "line 3: found time 1403636579.763555584 after"),
            (
                "cam0/data.csv",
                NEXT,
                "1403636579813555584 ",
                "line 3: found `1403636579813555584 1403636579813555584.png`",
            ),
            ("cam1/data.csv", "\n1", "\n2", "found 4 right images, 2403636579.763755584 to"),
            (cam0, "pinhole", "omni", "line 17: found camera_model omni; expected pinhole; undistort"),
            (cam0, "radial-tangential", "equidistant", "line 19: found distortion_model equidistant; expected radial"),
            (cam0, "radial-tangential", "none", "line 20: found distortion_coefficients [-0.28340811"),
            (
                cam0,
                ", 0.07395907",
                "",
                "line 20: found distortion_coefficients of 3 numbers; expected [k1, k2, p1, p2]",
            ),
            (cam0, "-0.28340811", "-2.8", "line 20: found a distortion [-2.8,"),
            (cam0, "0.07395907", ".nan", "line 20: found [-0.28340811, NaN"),
            (cam0, "distortion_coefficients", "coefficients", "line 19: found distortion_coefficients of 0 numbers"),
            (cam0, "[57.33175, ", "[", "line 18: found intrinsics of 3 numbers; expected [fu, fv, cu, cv]"),
            (cam0, "57.33175", "-57", "line 18: found focal lengths -57 and 57.162"),
            (cam0, "45.901875", "367.215", "line 18: found a principal point (367.215, 31.046875) outside"),
            (cam0, "[94, 60]", "[94]", "line 16: found resolution of 1 numbers; expected [width, height]"),
            (
                cam0,
                "[94, 60]",
                "[94, 1000000]",
                "line 16: found resolution [94, 1000000]; expected [width, height], 2 to",
            ),
            (cam0, "intrinsics", "intrinsic", "missing field `intrinsics`"),
            (cam0, "pinhole", "[", "cam0/sensor.yaml, line"),
            (cam0, "0.0148655429818", "0.148655429818", "line 9: found |RᵀR − I| = "),
            (cam0, "-0.0216401454975", "-216", "line 9: found an offset of 2.2e2 m; expected T_BS"),
            (cam0, "0.0, 1.0]", "1.0, 1.0]", "line 9: found the last row [0.0, 0.0, 1.0, 1.0]"),
            (cam0, "0.0, 1.0]", "1.0]", "line 9: found 15 numbers"),
            (cam1, "[94, 60]", "[94, 62]", "cam1/sensor.yaml, field `resolution`: found 94x62 px; expected 94x60"),
            (truth, "q_RS_w [], q_RS_x []", "q_RS_x [], q_RS_w []", "line 1: found `#timestamp"),
            (truth, ",0.7071068,1.0\n", "\n", "line 2: found 7 cells; expected at least 8: timestamp [ns]"),
            (truth, ",0.7071068,0,", ",0.9,0,", "line 2: found a quaternion of length 1.1446"),
            (truth, ",2,", ",nan,", "line 2: found `nan`; expected a finite number"),
            (truth, "\n1", "\n1.5e", "line 2: found time `1.5e403"),
            (truth, "\n14", "\n24", "found 40 poses, 2403636579.765555584 to"),
        ] {
            let root = recording();
            let path = root.path().join("MH_01_easy/mav0").join(file);
            let text = std::fs::read_to_string(&path).unwrap();
            assert!(text.contains(from), "{file}: {from}");
            std::fs::write(&path, text.replace(from, to)).unwrap();
            let message = open(&root).unwrap_err().to_string();
            assert!(message.contains(file) && message.contains(words), "{message}");
        }
        for missing in ["cam0/data.csv", "cam0/sensor.yaml", "cam1/sensor.yaml"] {
            let root = recording();
            std::fs::remove_file(root.path().join("MH_01_easy/mav0").join(missing)).unwrap();
            let message = open(&root).unwrap_err().to_string();
            assert!(message.contains(&format!("{missing}: found no such file; expected ")), "{message}");
        }
    }

    #[test]
    fn images_of_another_size_than_the_calibration_says_are_refused() {
        let root = recording();
        let path = root.path().join(format!("MH_01_easy/mav0/cam0/data/{FIRST_NS}.png"));
        image::GrayImage::new(92, 60).save(path).unwrap();
        let message = open(&root).unwrap().read_image(0).unwrap_err().to_string();
        assert!(message.contains("found 92x60 pixels; expected 94x60 as in sensor.yaml (resolution)"), "{message}");
    }

    #[test]
    fn distortion_may_have_another_name_a_fifth_coefficient_or_be_none() {
        let lens_of = |from: &str, to: &str| {
            let root = recording();
            let path = root.path().join("MH_01_easy/mav0/cam0/sensor.yaml");
            let text = std::fs::read_to_string(&path).unwrap();
            let (begin, _) = text.split_once("distortion_model").unwrap();
            std::fs::write(&path, if from.is_empty() { begin.to_owned() + to } else { text.replace(from, to) })
                .unwrap();
            load_body_camera(&path).unwrap().lens
        };
        assert_eq!(lens_of("radial-tangential", "radtan"), LEFT);
        let [k1, k2, p1, p2, _] = LEFT.distortion;
        let five = format!("distortion_model: radtan\ndistortion_coefficients: [{k1}, {k2}, {p1}, {p2}, 0.01]");
        assert_eq!(lens_of("", &five).distortion, [k1, k2, p1, p2, 0.01]);
        for none in
            ["", "distortion_model: none\ndistortion_coefficients: []", "distortion_coefficients: [0, 0, 0, 0.0]"]
        {
            assert_eq!(lens_of("", none), Lens { distortion: [0.0; 5], ..LEFT });
        }
    }

    #[test]
    fn a_root_that_is_a_recording_is_said_to_be_one() {
        let root = recording();
        let itself = root.path().join("MH_01_easy");
        let message = open_recording(&itself, "MH_01_easy", &Opening::default()).unwrap_err().to_string();
        assert!(message.contains("is a recording itself") && message.contains("drive = \"MH_01_easy\""), "{message}");
        let message = open_recording(root.path(), "MH_02", &Opening::default()).unwrap_err().to_string();
        assert!(message.contains("MH_02 (euroc)"), "{message}");
    }
}
