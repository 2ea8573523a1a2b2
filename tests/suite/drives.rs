//! One drive, written in every layout that recordings have.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use nalgebra::UnitQuaternion;
use relcov::config::Config;
use relcov::geometry::Pose;
use relcov::pairs::{Dataset, PairScope};
use relcov::recordings::{Recording, load_kitti_raw, parse_kitti_trajectory};

use crate::support::{DRIVE, SIZE, write_config, write_drive};

/// Frames of the drive.
pub const FRAMES: usize = 24;
/// First time of the recording, s.
const BEGIN_S: f64 = 1_300_000_000.0;

/// The layouts in which [`Drives`] holds its drive.
pub const LAYOUTS: [&str; 4] = ["kitti_raw", "kitti_odometry", "tum_rgbd", "euroc"];

/// One drive in each layout, with a configuration.
pub struct Drives {
    pub folder: tempfile::TempDir,
}

impl Drives {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_drive(&folder.path().join("raw"), FRAMES);
        write_stereo_and_scans(&folder.path().join("raw/2020_01_01"));
        let drives = Self { folder };
        let recording = load_kitti_raw(&drives.path("raw"), DRIVE).unwrap();
        let odometry = std::fs::read_to_string(drives.path("raw/vo/2020_01_01_drive_0001.txt")).unwrap();
        drives.write_odometry(&recording, &odometry);
        drives.write_tum(&recording, &odometry);
        drives.write_euroc(&recording);
        write_config(drives.folder.path(), &drives.path("raw"));
        drives
    }

    pub fn path(&self, below: &str) -> PathBuf {
        self.folder.path().join(below)
    }

    fn write_odometry(&self, recording: &Recording, odometry: &str) {
        let sequence = self.path("odometry/sequences/07");
        std::fs::create_dir_all(sequence.join("image_2")).unwrap();
        std::fs::create_dir_all(self.path("odometry/poses")).unwrap();
        std::fs::create_dir_all(self.path("odometry/results/vo")).unwrap();
        for (frame, path) in &recording.images {
            std::fs::copy(path, sequence.join(format!("image_2/{frame:06}.png"))).unwrap();
        }
        let (width, height) = SIZE;
        let projection =
            |offset: i32| format!("60 0 {} {offset} 0 60 {} 0 0 0 1 0", width as f64 / 2.0, height as f64 / 2.0);
        let [p0, p2, p3] = [0, -3, -33].map(projection);
        let calibration = format!("P0: {p0}\nP2: {p2}\nP3: {p3}\nTr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n");
        for (folder, files) in [("image_3", &recording.right_images), ("velodyne", &recording.scans)] {
            std::fs::create_dir_all(sequence.join(folder)).unwrap();
            for (frame, path) in files {
                let extension = path.extension().unwrap().to_str().unwrap();
                std::fs::copy(path, sequence.join(format!("{folder}/{frame:06}.{extension}"))).unwrap();
            }
        }
        std::fs::write(sequence.join("calib.txt"), calibration).unwrap();
        let times: String = (0..FRAMES).map(|frame| format!("{:.6e}\n", frame as f64 * 0.1)).collect();
        std::fs::write(sequence.join("times.txt"), times).unwrap();
        let calibration = &recording.calibration;
        let vehicle_from_camera0 = calibration.camera_from_vehicle.inverse() * calibration.camera_from_camera0;
        let rows: String =
            recording.poses.values().map(|pose| kitti_row(&(*pose * vehicle_from_camera0)) + "\n").collect();
        std::fs::write(self.path("odometry/poses/07.txt"), rows).unwrap();
        std::fs::write(self.path("odometry/results/vo/07.txt"), odometry).unwrap();
    }

    fn write_tum(&self, recording: &Recording, odometry: &str) {
        let desk = self.path("tum/desk");
        std::fs::create_dir_all(desk.join("rgb")).unwrap();
        std::fs::create_dir_all(desk.join("depth")).unwrap();
        let time = |frame: usize| BEGIN_S + frame as f64 / 30.0;
        let (mut rgb, mut depth) = ("# color images\n# timestamp filename\n".to_owned(), String::new());
        for (frame, path) in &recording.images {
            let name = format!("rgb/{:.6}.png", time(*frame));
            std::fs::copy(path, desk.join(&name)).unwrap();
            writeln!(rgb, "{:.6} {name}", time(*frame)).unwrap();
            // Another clock of the same rate: some milliseconds off.
            let name = format!("depth/{:.6}.png", time(*frame) + 0.006);
            image::ImageBuffer::from_pixel(SIZE.0 as u32, SIZE.1 as u32, image::Luma([10_000_u16]))
                .save(desk.join(&name))
                .unwrap();
            writeln!(depth, "{:.6} {name}", time(*frame) + 0.006).unwrap();
        }
        std::fs::write(desk.join("rgb.txt"), rgb).unwrap();
        std::fs::write(desk.join("depth.txt"), depth).unwrap();
        let calibration = &recording.calibration;
        let vehicle_from_camera = calibration.camera_from_vehicle.inverse();
        let truth: String = recording
            .poses
            .iter()
            .map(|(frame, pose)| tum_row(time(*frame) + 0.002, &(*pose * vehicle_from_camera)))
            .collect();
        std::fs::write(desk.join("groundtruth.txt"), truth).unwrap();
        let camera0_from_camera = calibration.camera_from_camera0.inverse();
        let measured = parse_kitti_trajectory(odometry, "vo".as_ref(), 0).unwrap();
        let measured: String =
            measured.iter().map(|(frame, pose)| tum_row(time(*frame), &(*pose * camera0_from_camera))).collect();
        std::fs::write(self.path("tum/desk_vo.txt"), measured).unwrap();
    }

    /// The body is the vehicle of KITTI raw.
    fn write_euroc(&self, recording: &Recording) {
        let rig = self.path("euroc/MH_01_easy/mav0");
        std::fs::create_dir_all(rig.join("cam0/data")).unwrap();
        std::fs::create_dir_all(rig.join("state_groundtruth_estimate0")).unwrap();
        let nanoseconds = |frame: usize| 1_403_636_579_763_555_584 + frame as i64 * 50_000_000;
        let mut list = "#timestamp [ns],filename\n".to_owned();
        for (frame, path) in &recording.images {
            let name = format!("{}.png", nanoseconds(*frame));
            std::fs::copy(path, rig.join("cam0/data").join(&name)).unwrap();
            writeln!(list, "{},{name}", nanoseconds(*frame)).unwrap();
        }
        std::fs::write(rig.join("cam0/data.csv"), list).unwrap();
        let body_from_camera = recording.calibration.camera_from_vehicle.inverse().matrix().transpose();
        let numbers = body_from_camera.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
        let (width, height) = SIZE;
        let yaml = format!(
            "T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nresolution: [{width}, {height}]\ncamera_model: pinhole\nintrinsics: [60, 60, 48, 24]\ndistortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
        );
        std::fs::write(rig.join("cam0/sensor.yaml"), yaml).unwrap();
        let mut truth =
            "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
                .to_owned();
        for (frame, pose) in &recording.poses {
            let [x, y, z, w] = UnitQuaternion::from_rotation_matrix(&pose.rotation).coords.into();
            let t = pose.translation;
            writeln!(truth, "{},{},{},{},{w},{x},{y},{z}", nanoseconds(*frame) + 2_000_000, t.x, t.y, t.z).unwrap();
        }
        std::fs::write(rig.join("state_groundtruth_estimate0/data.csv"), truth).unwrap();
        // As estimators write it: of the camera, times to the nanosecond.
        let measured = std::fs::read_to_string(self.path("tum/desk_vo.txt")).unwrap();
        let timed = |(frame, row): (usize, &str)| {
            let (second, nanosecond) = (nanoseconds(frame) / 1_000_000_000, nanoseconds(frame) % 1_000_000_000);
            format!("{second}.{nanosecond:09} {}\n", row.split_once(' ').unwrap().1)
        };
        std::fs::write(
            self.path("euroc/MH_01_easy_vo.txt"),
            measured.lines().enumerate().map(timed).collect::<String>(),
        )
        .unwrap();
    }

    /// The configuration of KITTI raw with what is other in a layout.
    pub fn settings(&self, layout: &str) -> Vec<String> {
        let splits = |drive: &str| {
            [("train", [0, 16]), ("validation", [16, 20]), ("test", [20, 24])]
                .map(|(split, frames)| format!("data.{split}=[{{ drive = \"{drive}\", frames = {frames:?} }}]"))
        };
        let (width, height) = SIZE;
        let camera =
            format!("data.camera={{ width = {width}, height = {height}, fx = 60, fy = 60, cx = 48, cy = 24 }}");
        let (root, drive, others): (&str, &str, Vec<String>) = match layout {
            "kitti_raw" => ("raw", DRIVE, vec![]),
            "kitti_odometry" => ("odometry", "07", vec!["systems.0.path=results/vo/{sequence}.txt".to_owned()]),
            "tum_rgbd" => (
                "tum",
                "desk",
                vec![
                    camera,
                    "systems.0.path={drive}_vo.txt".to_owned(),
                    "systems.0.format=tum".to_owned(),
                    "systems.0.frame=camera2".to_owned(),
                    // As in KITTI raw: at camera 0, 5 cm to the left of the camera.
                    "data.camera_from_vehicle=[-0.05, 0, 0, 0.5, -0.5, 0.5, 0.5]".to_owned(),
                ],
            ),
            "euroc" => (
                "euroc",
                "MH_01_easy",
                ["path={drive}_vo.txt", "format=tum", "frame=camera2"].map(|set| format!("systems.0.{set}")).into(),
            ),
            other => panic!("{other}"),
        };
        let root = format!("data.root={:?}", self.path(root).display().to_string());
        [root].into_iter().chain(splits(drive)).chain(others).collect()
    }

    pub fn load(&self, settings: &[String]) -> Dataset {
        let config = Config::load(&self.path("config.toml"), settings).unwrap();
        Dataset::load(&config.pairs(), PairScope::Images).unwrap()
    }

    /// The program with the configuration of a layout.
    pub fn run(&self, command: &str, settings: &[String]) -> Command {
        let mut program = Command::cargo_bin("relcov").unwrap();
        program.args([command, "--config"]).arg(self.path("config.toml"));
        for setting in settings {
            program.args(["--set", setting]);
        }
        program.current_dir(self.folder.path());
        program
    }
}

/// A right camera half a metre beside the left one, and a scan of a wall 10 m before the scanner.
fn write_stereo_and_scans(date: &Path) {
    let (width, height) = SIZE;
    let camera = format!("S_rect_03: {width} {height}\nP_rect_03: 60 0 48 -33 0 60 24 0 0 0 1 0\n");
    let path = date.join("calib_cam_to_cam.txt");
    std::fs::write(&path, std::fs::read_to_string(&path).unwrap() + &camera).unwrap();
    std::fs::write(date.join("calib_velo_to_cam.txt"), "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\n").unwrap();
    // The vehicle stays where camera 0 is: the IMU is as far before the scanner as the camera is.
    std::fs::write(date.join("calib_imu_to_velo.txt"), "R: 1 0 0 0 1 0 0 0 1\nT: 0.27 0 -0.08\n").unwrap();
    let drive = date.join(DRIVE);
    std::fs::create_dir_all(drive.join("image_03/data")).unwrap();
    std::fs::create_dir_all(drive.join("velodyne_points/data")).unwrap();
    let points = (-20..20).flat_map(|y| (-8..8).map(move |z| [10.0, 0.4 * y as f32, 0.4 * z as f32, 0.5]));
    let scan: Vec<u8> = points.flatten().flat_map(f32::to_le_bytes).collect();
    for frame in 0..FRAMES {
        let left = drive.join(format!("image_02/data/{frame:010}.png"));
        std::fs::copy(left, drive.join(format!("image_03/data/{frame:010}.png"))).unwrap();
        std::fs::write(drive.join(format!("velodyne_points/data/{frame:010}.bin")), &scan).unwrap();
    }
}

fn kitti_row(pose: &Pose) -> String {
    let m = pose.matrix();
    (0..12).map(|k| format!("{:.15e}", m[(k / 4, k % 4)])).collect::<Vec<_>>().join(" ")
}

fn tum_row(time: f64, pose: &Pose) -> String {
    let quaternion = UnitQuaternion::from_rotation_matrix(&pose.rotation);
    let numbers = pose.translation.iter().chain(quaternion.coords.iter());
    format!("{time:.6} {}\n", numbers.map(|value| format!("{value:.15}")).collect::<Vec<_>>().join(" "))
}
