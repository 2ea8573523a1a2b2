//! Recordings as people keep them: one drive in every layout is the same to all that follows, with its lens or without,
//! and real samples give what others counted. What is wrong with a layout: `layouts_in_trouble`.

use std::fmt::Write as _;
use std::path::Path;

use assert_cmd::Command;
use predicates::str::contains;
use relcov::config::Config;
use relcov::depth::{DepthConfig, native_depth};
use relcov::geometry::{Lens, Pinhole, Pose};
use relcov::pairs::{Dataset, Pair, PairReader, PairScope, SplitName};
use relcov::recordings::{CameraConfig, Opening, Recording, load_kitti_odometry, load_kitti_raw, open_recording};

use crate::drives::{Drives, FRAMES, LAYOUTS};
use crate::support::{DRIVE, SIZE, shared};

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
fn every_layout_is_inspected_trained_on_and_judged() {
    let drives = Drives::new();
    for layout in LAYOUTS {
        let settings = [drives.settings(layout), vec![format!("name={layout}")]].concat();
        let said = format!("({layout})\n");
        drives.run("inspect", &settings).assert().success().stdout(contains(said));
        drives.run("train", &settings).args(["--quiet", "--device", "flex"]).assert().success();
        let run = format!("runs/{layout}");
        let mut eval = relcov();
        eval.current_dir(drives.folder.path()).args(["eval", "--quiet", "--run", &run, "--device", "flex"]);
        eval.assert().success().stdout(contains("| vo     | relcov "));
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
