//! Recordings as people keep them: one drive in every layout is the same to all that follows, real samples give what
//! others counted, and what is wrong with a layout is named.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use nalgebra::UnitQuaternion;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::config::Config;
use relcov::geometry::Pose;
use relcov::pairs::{Dataset, Pair, PairScope};
use relcov::recordings::{Recording, load_kitti_raw, parse_kitti_trajectory};

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

/// One drive in the layouts of KITTI raw, KITTI odometry and TUM RGB-D, each with a configuration.
struct Drives {
    folder: tempfile::TempDir,
}

impl Drives {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_drive(&folder.path().join("raw"), FRAMES);
        let drives = Self { folder };
        let recording = load_kitti_raw(&drives.path("raw"), DRIVE).unwrap();
        let odometry = std::fs::read_to_string(drives.path("raw/vo/2020_01_01_drive_0001.txt")).unwrap();
        drives.write_odometry(&recording, &odometry);
        drives.write_tum(&recording, &odometry);
        write_config(drives.folder.path(), &drives.path("raw"));
        drives
    }

    fn path(&self, below: &str) -> PathBuf {
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
        let calibration = format!("P0: {}\nP2: {}\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n", projection(0), projection(-3));
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

    /// The configuration of KITTI raw with what is other in a layout.
    fn settings(&self, layout: &str) -> Vec<String> {
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
            other => panic!("{other}"),
        };
        let root = format!("data.root={:?}", self.path(root).display().to_string());
        [root].into_iter().chain(splits(drive)).chain(others).collect()
    }

    fn load(&self, settings: &[String]) -> Dataset {
        let config = Config::load(&self.path("config.toml"), settings).unwrap();
        Dataset::load(&config.pairs(), PairScope::Images).unwrap()
    }

    /// The program with the configuration of a layout.
    fn run(&self, command: &str, settings: &[String]) -> Command {
        let mut program = relcov();
        program.args([command, "--config"]).arg(self.path("config.toml"));
        settings.iter().for_each(|setting| drop(program.args(["--set", setting])));
        program.current_dir(self.folder.path());
        program
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
    for layout in ["kitti_odometry", "tum_rgbd"] {
        assert_same(&raw, &drives.load(&drives.settings(layout)), layout);
        let named = [drives.settings(layout), vec![format!("data.layout={layout}")]].concat();
        assert_same(&raw, &drives.load(&named), layout);
    }
}

#[test]
fn pairs_are_as_many_frames_apart_as_asked_for() {
    let drives = Drives::new();
    for layout in ["kitti_raw", "kitti_odometry", "tum_rgbd"] {
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
    for layout in ["kitti_raw", "kitti_odometry", "tum_rgbd"] {
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
            let far = (pair.true_source_from_target().matrix() - twin.true_source_from_target().matrix()).norm();
            assert!(far < 1e-9, "{layout}: {far}");
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
        &["--set", &camera, "--set", "data.camera_from_vehicle=[-0.05, 0, 0, 0.5, -0.5, 0.5, 0.5]"],
    );
    for (other, name) in [(odometry, "odometry"), (tum, "tum")] {
        assert_eq!(raw.len(), other.len(), "{name}");
        for (row, twin) in raw.iter().flatten().zip(other.iter().flatten()) {
            assert!((row - twin).abs() <= 1e-6 * row.abs().max(1e-6), "{name}: {row} and {twin}");
        }
    }
}

/// Changes a text file of a recording.
fn edit(path: &Path, change: impl FnOnce(String) -> String) {
    let text = std::fs::read_to_string(path).unwrap();
    std::fs::write(path, change(text)).unwrap();
}

#[test]
fn what_is_wrong_with_a_recording_is_named() {
    type Break = fn(&Path);
    let cases: [(&str, &str, Break, &[&str]); 18] = [
        (
            "tum_rgbd",
            "no list of images",
            |at| std::fs::remove_file(at.join("tum/desk/rgb.txt")).unwrap(),
            &["rgb.txt: found no such file; expected the list of its images"],
        ),
        (
            "tum_rgbd",
            "a list without names",
            |at| edit(&at.join("tum/desk/rgb.txt"), |_| "1300000000.0\n".into()),
            &["rgb.txt, line 1: found `1300000000.0`; expected a time in seconds and the name of a file"],
        ),
        (
            "tum_rgbd",
            "nanoseconds",
            |at| edit(&at.join("tum/desk/rgb.txt"), |text| text.replace("1300000000.000000 ", "1300000000000000000 ")),
            &["rgb.txt, line 3", "nanoseconds are to be divided"],
        ),
        (
            "tum_rgbd",
            "disorder",
            |at| edit(&at.join("tum/desk/rgb.txt"), |text| text.replace("1300000000.033333 ", "1299999999.0 ")),
            &["rgb.txt, line 4", "expected increasing times"],
        ),
        (
            "tum_rgbd",
            "images elsewhere",
            |at| std::fs::remove_dir_all(at.join("tum/desk/rgb")).unwrap(),
            &["rgb.txt: found 24 images, none of which is there"],
        ),
        (
            "tum_rgbd",
            "depth of another clock",
            |at| edit(&at.join("tum/desk/depth.txt"), |text| text.replace("1300000000", "1400000000")),
            &["depth.txt: found 24 depth maps, 1400000000.006000000", "of one clock"],
        ),
        (
            "tum_rgbd",
            "truth of another clock",
            |at| edit(&at.join("tum/desk/groundtruth.txt"), |text| text.replace("130000000", "140000000")),
            &["groundtruth.txt: found 24 poses, 1400000000.002", "expected times of frames, 1300000000"],
        ),
        (
            "tum_rgbd",
            "a truth of other columns",
            |at| {
                edit(&at.join("tum/desk/groundtruth.txt"), |text| {
                    "# timestamp tx ty tz qw qx qy qz\n".to_owned() + &text
                })
            },
            &["groundtruth.txt, line 1", "w the last"],
        ),
        (
            "tum_rgbd",
            "images of another size",
            |at| {
                let camera = image::RgbImage::new(32, 16);
                for entry in std::fs::read_dir(at.join("tum/desk/rgb")).unwrap() {
                    camera.save(entry.unwrap().path()).unwrap();
                }
            },
            &["`data.camera`: is of images of 96x48 pixels, and those of `desk` have 32x16"],
        ),
        (
            "kitti_odometry",
            "no calibration",
            |at| std::fs::remove_file(at.join("odometry/sequences/07/calib.txt")).unwrap(),
            &["calib.txt"],
        ),
        (
            "kitti_odometry",
            "a camera of another size",
            |at| edit(&at.join("odometry/sequences/07/calib.txt"), |text| text.replace("60 0 48", "700 0 600")),
            &["calib.txt, field `P2`", "expected intrinsics fx, fy, cx, cy at the image's own size"],
        ),
        (
            "kitti_odometry",
            "no camera",
            |at| edit(&at.join("odometry/sequences/07/calib.txt"), |text| text.replace("P2:", "P9:")),
            &["calib.txt", "P2", "no such line"],
        ),
        (
            "kitti_odometry",
            "fewer poses",
            |at| {
                edit(&at.join("odometry/poses/07.txt"), |text| {
                    text.lines().take(20).map(|line| line.to_owned() + "\n").collect()
                })
            },
            &["poses/07.txt: found poses of 20 frames; expected 24 as times.txt has lines"],
        ),
        (
            "kitti_odometry",
            "no images",
            |at| std::fs::remove_dir_all(at.join("odometry/sequences/07/image_2")).unwrap(),
            &["sequences/07: no images in image_2 or image_0"],
        ),
        (
            "kitti_odometry",
            "no such sequence",
            |at| std::fs::rename(at.join("odometry/sequences/07"), at.join("odometry/sequences/08")).unwrap(),
            &["07: no such drive below data.root", "sequences/07 (kitti_odometry)"],
        ),
        (
            "kitti_odometry",
            "packets",
            |_| (),
            &["truth.source", "`oxts` is KITTI raw's, and 07 lies in the layout `kitti_odometry`; `recording` takes"],
        ),
        ("kitti_odometry", "a camera", |_| (), &["data.camera", "brings its own calibration"]),
        (
            "kitti_odometry",
            "two layouts",
            |at| std::fs::create_dir_all(at.join("odometry/07/rgb")).unwrap(),
            &["`data.layout`: `07` below", "can be read in 2 layouts; choose: \"kitti_odometry\", \"tum_rgbd\""],
        ),
    ];
    for (layout, name, break_it, words) in cases {
        let drives = Drives::new();
        break_it(drives.folder.path());
        let mut settings = drives.settings(layout);
        match name {
            "packets" => settings.push("truth.source=oxts".to_owned()),
            "a camera" => {
                settings.push("data.camera={ width = 9, height = 9, fx = 9, fy = 9, cx = 4, cy = 4 }".to_owned())
            }
            _ => {}
        }
        let output = drives.run("inspect", &settings).assert().get_output().clone();
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{name}: {message}");
        assert!(words.iter().all(|word| message.contains(word)), "{name}: {message}\nexpected: {words:?}");
    }
}

#[test]
fn what_lists_name_and_is_not_there_is_counted() {
    let drives = Drives::new();
    let at = |below: &str| drives.path(&format!("tum/desk/{below}"));
    std::fs::remove_file(at("rgb/1300000000.233333.png")).unwrap();
    std::fs::remove_file(at("depth/1300000000.306000.png")).unwrap();
    std::fs::remove_file(at("depth/1300000000.339333.png")).unwrap();
    edit(&at("depth.txt"), |text| text + "1300000009.000000 depth/1300000009.000000.png\n");
    let mut settings = drives.settings("tum_rgbd");
    settings.push("depth.source=recording".to_owned());
    drives.run("inspect", &settings).assert().success().stdout(
        contains("problems: 3")
            .and(contains("rgb.txt: 1 of its 24 images are not there, the first on line 10\n"))
            .and(contains("depth.txt: 3 of its 25 depth maps are not there, the first on line 10\n"))
            .and(contains("depth.txt: 1 of its 25 depth maps are of no image")),
    );
    // Two pairs lack an image, two others a map.
    let counts = |dataset: &Dataset| dataset.train.pairs_of(0).len();
    assert_eq!(counts(&drives.load(&settings)), 16 - 2 - 2);
    std::fs::remove_file(at("depth.txt")).unwrap();
    drives.run("inspect", &settings).assert().success().stdout(contains("depth.txt: not there; it brings no depth"));
    std::fs::remove_file(at("groundtruth.txt")).unwrap();
    let without = drives.run("inspect", &settings).assert().success().get_output().clone();
    let text = String::from_utf8(without.stdout).unwrap();
    assert!(text.contains("groundtruth.txt: not there; it brings no true poses"), "{text}");
    let message = drives.run("train", &settings).assert().code(1).get_output().clone();
    let message = String::from_utf8(message.stderr).unwrap();
    assert!(message.contains("`vo` measured"), "{message}");
    drives
        .run(
            "inspect",
            &[vec![format!("data.root={:?}", at("").display().to_string())], settings[1..].to_vec()].concat(),
        )
        .assert()
        .code(1)
        .stderr(contains("is a recording itself").and(contains("drive = \"desk\"")));
}

#[test]
fn real_samples_give_what_others_counted() {
    let inspect = |config: &str, root: &Path, others: &[&str]| {
        let mut command = relcov();
        command.args(["inspect", "--config", config, "--set"]).arg(format!("data.root={}", root.display()));
        others.iter().for_each(|setting| drop(command.args(["--set", setting])));
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
