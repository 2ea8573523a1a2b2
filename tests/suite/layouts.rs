//! Recordings as people keep them: one drive in every layout is the same to all that follows, with its lens or without,
//! and real samples give what others counted. What is wrong with a layout: `layouts_in_trouble`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use nalgebra::UnitQuaternion;
use predicates::str::contains;
use relcov::config::Config;
use relcov::depth::{DepthConfig, native_depth};
use relcov::geometry::{Lens, Pinhole, Pose};
use relcov::pairs::{Dataset, Pair, PairReader, PairScope, SplitName};
use relcov::recordings::{
    CameraConfig, Opening, Recording, load_kitti_odometry, load_kitti_raw, open_recording, parse_kitti_trajectory,
};

use crate::support::{DRIVE, SIZE, shared, write_config, write_drive};

const FRAMES: usize = 24;
/// First time of the recording, s.
const BEGIN_S: f64 = 1_300_000_000.0;

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

/// A configuration of pairs that a manifest lists.
const LISTED: &str = r#"name = "listed"
[data]
train = []
test = []
[truth]
source = "manifest"
[[systems]]
name = "vo"
share = 0.75
source = "manifest"
[[systems]]
name = "gnss"
share = 0.25
source = "manifest"
[training]
batch = 8
"#;

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
        let mut program = relcov();
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

/// All pairs, split by split.
fn pairs(dataset: &Dataset) -> impl Iterator<Item = &Pair> {
    [&dataset.train, &dataset.validation, &dataset.test].into_iter().flat_map(|split| &split.pairs)
}

/// That two data sets hold the same measurements with the same errors, but for rounding in their files.
fn assert_same(dataset: &Dataset, other: &Dataset, name: &str) {
    assert_eq!(pairs(dataset).count(), pairs(other).count(), "{name}");
    for (pair, twin) in pairs(dataset).zip(pairs(other)) {
        assert_eq!((pair.id, pair.system), (twin.id, twin.system), "{name}");
        let far = (pair.source_from_target.matrix() - twin.source_from_target.matrix()).norm();
        assert!(far < 1e-7, "{name}, {:?}: measured poses differ by {far:e}", pair.id);
        let far = (pair.error - twin.error).norm();
        assert!(far < 1e-7, "{name}, {:?}: errors {} and {}", pair.id, pair.error, twin.error);
    }
}

#[test]
fn one_drive_in_every_layout_gives_the_same_pairs() {
    let drives = Drives::new();
    let raw = drives.load(&drives.settings("kitti_raw"));
    assert!(pairs(&raw).filter(|pair| pair.system == 0).all(|pair| pair.error.norm() > 1e-3));
    for layout in &LAYOUTS[1..] {
        assert_same(&raw, &drives.load(&drives.settings(layout)), layout);
        let named = [drives.settings(layout), vec![format!("data.layout={layout}")]].concat();
        assert_same(&raw, &drives.load(&named), layout);
    }
}

#[test]
fn pairs_are_as_many_frames_apart_as_asked_for() {
    let drives = Drives::new();
    for layout in LAYOUTS {
        let with = |gap: &str| drives.load(&[drives.settings(layout), vec![format!("data.gap={gap}")]].concat());
        let counts = |dataset: &Dataset| [&dataset.train, &dataset.test].map(|split| split.pairs_of(0).len());
        // The last frame of the drive is 23; a pair may reach to the first frame of the next split.
        assert_eq!([counts(&with("1")), counts(&with("3")), counts(&with("[1, 3]"))], [[16, 3], [14, 1], [30, 4]]);
        assert_eq!(counts(&drives.load(&drives.settings(layout))), [16, 3]);
        let three = with("3");
        let one = with("1");
        let step = |frame: usize| one.train.pairs_of(0)[frame].source_from_target;
        let far = three.train.pairs_of(0)[0].source_from_target.matrix() - (step(0) * step(1) * step(2)).matrix();
        assert!(far.norm() < 1e-9);
    }
    for (gap, words) in [("0", "1 to 10000"), ("[2, 2]", "names a number twice"), ("\"far\"", "a number of frames")] {
        let set = [drives.settings("kitti_raw"), vec![format!("data.gap={gap}")]].concat();
        drives.run("inspect", &set).assert().code(1).stderr(contains(words));
    }
}

#[test]
fn a_manifest_of_any_layout_lists_the_same_pairs() {
    let drives = Drives::new();
    for layout in LAYOUTS {
        let mut settings = drives.settings(layout);
        if layout == "tum_rgbd" {
            settings.push("depth.source=recording".to_owned());
        }
        settings.push("data.gap=[1, 2]".to_owned());
        let original = drives.load(&settings);
        let out = format!("{layout}.csv");
        drives.run("manifest", &settings).args(["--out", &out]).assert().success().stderr(contains(" rows"));
        let splits = settings.iter().filter(|setting| {
            ["data.train", "data.validation", "data.test"].contains(&&setting[..setting.find('=').unwrap()])
        });
        let manifest = format!("data.manifest={:?}", drives.path(&out).display().to_string());
        let listed: Vec<String> = splits.cloned().chain([manifest]).collect();
        let path = drives.path("listed.toml");
        std::fs::write(&path, LISTED).unwrap();
        let dataset = Dataset::load(&Config::load(&path, &listed).unwrap().pairs(), PairScope::Images).unwrap();
        assert_eq!(pairs(&original).count(), pairs(&dataset).count());
        for (pair, twin) in pairs(&original).zip(pairs(&dataset)) {
            assert_eq!((pair.id, pair.system), (twin.id, twin.system));
            // In axes of the camera: of the vehicle a manifest knows nothing.
            let far = (pair.source_from_target.matrix() - twin.source_from_target.matrix()).norm();
            assert!(far < 1e-12, "{layout}: {far}");
            let [truth, other] = [pair, twin].map(|pair| pair.true_source_from_target().unwrap());
            let far = (truth.matrix() - other.matrix()).norm();
            assert!(far < 1e-9, "{layout}: {far}");
        }
        assert_eq!(original.drives[0].times, dataset.drives[0].times, "{layout}");
        // The same images, and the same depth: 10,000 steps of 5,000 a metre.
        let sample = |dataset: &Dataset, settings: &[String], path: &Path| {
            let config = Config::load(path, settings).unwrap();
            let reader = PairReader::new(&config.pairs(), dataset, SplitName::Train);
            reader.read(&dataset.train.pairs[3]).unwrap().expect("a readable pair")
        };
        let depth = if layout == "tum_rgbd" { "depth.source=manifest" } else { "depth.source=ground_plane" };
        let listed =
            [listed, vec![depth.to_owned(), "model.width=32".to_owned(), "model.height=16".to_owned()]].concat();
        let [one, two] = [(&original, &settings, "config.toml"), (&dataset, &listed, "listed.toml")]
            .map(|(dataset, settings, name)| sample(dataset, settings, &drives.path(name)));
        assert_eq!(
            (one.camera, &one.target_image, &one.source_image),
            (two.camera, &two.target_image, &two.source_image)
        );
        assert_eq!(one.target_depth.depth_m, two.target_depth.depth_m, "{layout}");
        if layout == "tum_rgbd" {
            assert!(two.target_depth.depth_m.iter().all(|depth| *depth == 2.0));
        }
    }
}

#[test]
fn the_sensors_of_kitti_odometry_are_those_of_kitti_raw() {
    let drives = Drives::new();
    let raw = load_kitti_raw(&drives.path("raw"), DRIVE).unwrap();
    let odometry = load_kitti_odometry(&drives.path("odometry"), "07", None).unwrap();
    let (calibration, other) = (&raw.calibration, &odometry.calibration);
    assert_eq!(calibration.camera, other.camera);
    let right = |recording: &Recording| recording.calibration.right_from_left.unwrap();
    for (pose, twin) in [
        (calibration.camera_from_camera0, other.camera_from_camera0),
        (calibration.camera_from_velodyne, other.camera_from_velodyne),
        (calibration.camera_from_vehicle, other.camera_from_vehicle),
        (right(&raw), right(&odometry)),
    ] {
        assert!((pose.matrix() - twin.matrix()).norm() < 1e-12, "{pose:?} and {twin:?}");
    }
    assert_eq!(right(&odometry).translation.x, -0.5);
    assert_eq!((odometry.right_images.len(), odometry.scans.len(), odometry.times.len()), (FRAMES, FRAMES, FRAMES));
    let lidar = DepthConfig::Lidar { fill_radius_px: 4 };
    let depth = |recording: &Recording| {
        let image = recording.read_image(3).unwrap();
        native_depth(&lidar, recording, 3, "".as_ref(), &recording.calibration.camera, &image).unwrap()
    };
    assert_eq!(depth(&raw).depth_m, depth(&odometry).depth_m);
    // Without colour images the grey ones, and their projections, are used.
    let sequence = drives.path("odometry/sequences/07");
    std::fs::rename(sequence.join("image_2"), sequence.join("image_0")).unwrap();
    let grey = load_kitti_odometry(&drives.path("odometry"), "07", None).unwrap();
    assert_eq!(grey.calibration.camera_from_camera0, Pose::identity());
    assert_eq!((grey.images.len(), grey.right_images.len(), grey.calibration.right_from_left), (FRAMES, 0, None));
}

/// A smooth scene as a camera sees it along a ray: a grey level, and a depth in m.
fn scene(ray: &nalgebra::Vector2<f64>) -> (f64, f64) {
    (127.0 + 100.0 * (9.0 * ray.x).sin() * (7.0 * ray.y).cos(), 3.0 + ray.x + 0.5 * ray.y)
}

#[test]
fn what_comes_through_a_lens_is_what_a_pinhole_camera_would_have_seen() {
    let folder = tempfile::tempdir().unwrap();
    let bent = folder.path().join("bent");
    std::fs::create_dir_all(bent.join("rgb")).unwrap();
    std::fs::create_dir_all(bent.join("depth")).unwrap();
    let camera = Pinhole { fx: 150.0, fy: 148.0, cx: 78.0, cy: 61.0, width: 160, height: 120 };
    let lens = Lens { camera, distortion: [-0.28, 0.07, 2e-4, 2e-5, 0.0] };
    let seen = |u: u32, v: u32| scene(&lens.undistort(&nalgebra::Vector2::new(f64::from(u), f64::from(v))).unwrap());
    let image = image::GrayImage::from_fn(160, 120, |u, v| image::Luma([seen(u, v).0.round() as u8]));
    let depth = image::ImageBuffer::from_fn(160, 120, |u, v| image::Luma([(5000.0 * seen(u, v).1).round() as u16]));
    let (mut rgb, mut maps, mut truth) = (String::new(), String::new(), String::new());
    for time in ["1.0", "2.0", "3.0"] {
        image.save(bent.join(format!("rgb/{time}.png"))).unwrap();
        depth.save(bent.join(format!("depth/{time}.png"))).unwrap();
        writeln!(rgb, "{time} rgb/{time}.png").unwrap();
        writeln!(maps, "{time} depth/{time}.png").unwrap();
        writeln!(truth, "{time} {time} 0 0 0 0 0 1").unwrap();
    }
    for (name, text) in [("rgb.txt", rgb), ("depth.txt", maps), ("groundtruth.txt", truth)] {
        std::fs::write(bent.join(name), text).unwrap();
    }
    let told = CameraConfig {
        width: 160,
        height: 120,
        fx: 150.0,
        fy: 148.0,
        cx: 78.0,
        cy: 61.0,
        distortion: vec![-0.28, 0.07, 2e-4, 2e-5],
    };
    let opening = Opening { camera: Some(&told), ..Opening::default() };
    let recording = open_recording(folder.path(), "bent", &opening).unwrap();

    let config = folder.path().join("bent.toml");
    let head = "name = \"bent\"\n[data]\ntest = []\n[[systems]]\nname = \"vo\"\nshare = 1.0\n[model]\nwidth = 80\nheight = 60\n";
    let own = head.replace("[data]", "[data]\nroot = \".\"\ncamera = { width = 160, height = 120, fx = 150, fy = 148, cx = 78, cy = 61, distortion = [-0.28, 0.07, 2e-4, 2e-5] }");
    let own = own.replace("test = []", "test = []\ntrain = [{ drive = \"bent\" }]\nvalidation_fraction = 0");
    std::fs::write(
        &config,
        own.replace("share = 1.0", "share = 1.0\nsource = \"truth\"") + "[depth]\nsource = \"recording\"\n",
    )
    .unwrap();
    let manifest = folder.path().join("bent.csv");
    relcov().args(["manifest", "--config"]).arg(&config).arg("--out").arg(&manifest).assert().success();
    let text = std::fs::read_to_string(&manifest).unwrap();
    assert!(
        text.contains("bent/rgb/1.0.png,bent/rgb/2.0.png,150,148,78,61,")
            && text.contains(",5000,-0.28,0.07,0.0002,0.00002,0\n"),
        "{text}"
    );
    let listed = relcov::recordings::Manifest::load(&manifest).unwrap().recording("bent", None).unwrap();

    for recording in [recording, listed] {
        let rectified = recording.calibration.camera;
        assert!(rectified != camera, "the camera of undistorted images is another");
        let image = recording.read_image(1).unwrap();
        let depth = native_depth(&DepthConfig::Recording {}, &recording, 1, "".as_ref(), &rectified, &image).unwrap();
        assert!(depth.depth_m.iter().all(|depth| *depth > 0.0), "no black border");
        for (index, depth) in depth.depth_m.iter().enumerate() {
            let (u, v) = ((index % 160) as f64, (index / 160) as f64);
            let (grey, metres) = scene(&rectified.backproject(&nalgebra::Vector2::new(u, v), 1.0).xy());
            let found = f64::from(image.bytes[3 * index]);
            assert!((found - grey).abs() <= 2.0, "({u}, {v}): {found}, expected {grey}");
            // Half a pixel aside, at most.
            assert!((f64::from(*depth) - metres).abs() < 0.01, "({u}, {v}): {depth} m, expected {metres}");
        }
    }
}

#[test]
fn one_model_predicts_the_same_for_a_drive_in_any_layout() {
    let drives = Drives::new();
    drives.run("train", &drives.settings("kitti_raw")).args(["--quiet", "--device", "flex"]).assert().success();
    let predict = |folder: &str, measurements: &str, others: &[&str]| {
        let mut command = relcov();
        command.current_dir(drives.folder.path()).args(["predict", "--quiet", "--run", "runs/tiny", "--format", "csv"]);
        command.args(["--frame", "camera", "--drive", folder, "--measurements", measurements]).args(others);
        let output = command.assert().success().get_output().clone();
        let text = String::from_utf8(output.stdout).unwrap();
        let numbers = |line: &str| line.split(',').map(|cell| cell.parse().unwrap()).collect::<Vec<f64>>();
        text.lines().filter(|line| line.starts_with(|c: char| c.is_ascii_digit())).map(numbers).collect::<Vec<_>>()
    };
    let raw = predict(&format!("raw/2020_01_01/{DRIVE}"), "raw/vo/2020_01_01_drive_0001.txt", &[]);
    assert_eq!(raw.len(), FRAMES - 1);
    let (width, height) = SIZE;
    let camera = format!("data.camera={{ width = {width}, height = {height}, fx = 60, fy = 60, cx = 48, cy = 24 }}");
    let odometry = predict("odometry/sequences/07", "odometry/results/vo/07.txt", &[]);
    let tum = predict(
        "tum/desk",
        "tum/desk_vo.txt",
        &[
            "--set",
            &camera,
            "--set",
            "data.camera_from_vehicle=[-0.05, 0, 0, 0.5, -0.5, 0.5, 0.5]",
            // It brings depth maps, which would be taken.
            "--set",
            "depth.source=ground_plane",
        ],
    );
    let euroc = predict("euroc/MH_01_easy", "euroc/MH_01_easy_vo.txt", &[]);
    for (other, name) in [(odometry, "odometry"), (tum, "tum"), (euroc, "euroc")] {
        assert_eq!(raw.len(), other.len(), "{name}");
        for (row, twin) in raw.iter().flatten().zip(other.iter().flatten()) {
            assert!((row - twin).abs() <= 1e-6 * row.abs().max(1e-6), "{name}: {row} and {twin}");
        }
    }
}

#[test]
fn real_samples_give_what_others_counted() {
    let inspect = |config: &str, root: &Path, others: &[&str]| {
        let mut command = relcov();
        command.args(["inspect", "--config", config, "--set"]).arg(format!("data.root={}", root.display()));
        for setting in others {
            command.args(["--set", setting]);
        }
        String::from_utf8(command.assert().success().get_output().stdout.clone()).unwrap()
    };
    if let Some(root) = shared("rgbd") {
        let text = inspect("configs/redkitchen.toml", &root, &[]);
        assert!(text.contains("| train      | redkitchen | 0..500   |        500 |    500 |"), "{text}");
        assert!(text.contains("problems: none"), "{text}");
        let desk = [
            "data.train=[]",
            "data.validation=[]",
            "data.test=[{ drive = \"tum_fr1_desk\", camera = { width = 640, height = 480, fx = 517.3, fy = 516.5, cx = 318.6, cy = 255.3, distortion = [0.2624, -0.9531, -0.0054, 0.0026, 1.1633] } }]",
        ];
        let text = inspect("configs/redkitchen.toml", &root, &[&desk[..3], &["data.gap=1"]].concat());
        assert!(text.contains("| test  | tum_fr1_desk | all    |        613 |      9 |"), "{text}");
        assert!(text.contains("rgb.txt: 604 of its 613 images are not there, the first on line 4"), "{text}");
    }
    if let Some(root) = shared("kitti_odometry") {
        let text = inspect("configs/kitti_03.toml", &root, &[]);
        assert!(text.contains("250 pose pairs; usable with images and depth: 250 ndt"), "{text}");
        assert!(text.contains("problems: none"), "{text}");
    }
}
