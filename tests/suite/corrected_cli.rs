//! Corrected measurements from the command line, of a model that predicts the error itself, on a rendered street: the
//! same in every format, in a stream and in a fused trajectory; nearer to the truth; and where images show nothing.

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use assert_cmd::Command;
use base64::Engine;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::depth::{DepthMap, write_depth_png};
use relcov::geometry::{Pose, Tangent};
use relcov::recordings::load_kitti_raw;
use relcov::systems::parse_relative_poses;
use serde_json::{Value, json};

const FRAMES: usize = 16;
const CONFIG: &str = r#"name = "seen"
checkpoints = "runs"
device = "flex"
[data]
root = "data"
train = [{ drive = "2026_01_01_drive_0001_sync" }]
validation = [{ drive = "2026_01_01_drive_0002_sync" }]
test = [{ drive = "2026_01_01_drive_0003_sync" }]
[[systems]]
name = "vo"
share = 1.0
source = "relative"
path = "measurements/vo/{drive}.csv"
frame = "camera2"
[depth]
source = "files"
path = "{date}/{drive}/depth_02/data/{frame}.png"
[model]
width = 128
height = 64
evidence = "alignment"
network = "none"
head = "posterior"
[training]
batch = 8
micro_batch = 8
epochs = 2
batches_per_epoch = 4
"#;

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

/// A street with a model, once for all tests. One image of its last drive, which is in no split, is black.
struct World {
    folder: tempfile::TempDir,
}

impl World {
    fn get() -> &'static Self {
        static WORLD: OnceLock<World> = OnceLock::new();
        WORLD.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            let (data, frames) = (folder.path().join("data"), FRAMES.to_string());
            let size = ["--drives", "4", "--frames", &frames, "--size", "128x64", "--lidar-steps", "0", "--quiet"];
            relcov().args(["synth", "--out"]).arg(&data).args(size).assert().success();
            let config = folder.path().join("config.toml");
            std::fs::write(&config, CONFIG).unwrap();
            relcov().args(["train", "--quiet", "--config"]).arg(&config).assert().success();
            let world = Self { folder };
            black().save(world.image(4, 5)).unwrap();
            world
        })
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    fn drive(&self, number: usize) -> PathBuf {
        self.path().join(format!("data/2026_01_01/2026_01_01_drive_{number:04}_sync"))
    }

    fn image(&self, drive: usize, frame: usize) -> PathBuf {
        self.drive(drive).join(format!("image_02/data/{frame:010}.png"))
    }

    fn predict(&self, arguments: &[&str]) -> Command {
        let mut command = relcov();
        command.args(["predict", "--run"]).arg(self.path().join("runs/seen")).args(arguments);
        command
    }

    fn text(&self, arguments: &[&str]) -> String {
        let output = self.predict(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    }

    fn lines(&self, arguments: &[&str]) -> Vec<Value> {
        self.text(arguments).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    fn answers(&self, arguments: &[&str], requests: &[Value]) -> Vec<Value> {
        let requests: Vec<String> = requests.iter().map(Value::to_string).collect();
        let arguments = [&["--stream"], arguments].concat();
        let output = self.predict(&arguments).write_stdin(requests.join("\n")).output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    /// A request for a pair of the test drive, whose line in axes of the camera is given.
    fn request(&self, in_camera: &Value) -> Value {
        let camera =
            load_kitti_raw(&self.path().join("data"), "2026_01_01_drive_0003_sync").unwrap().calibration.camera;
        let [source, target] = ["source", "target"].map(|end| in_camera[end].as_u64().unwrap() as usize);
        let pose = &in_camera["pose"];
        let numbers = ["translation", "quaternion_xyzw"].map(|part| pose[part].as_array().unwrap().clone()).concat();
        json!({
            "id": source,
            "source_image": self.image(3, source),
            "target_image": self.image(3, target),
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "pose": numbers,
            "depth": self.drive(3).join(format!("depth_02/data/{target:010}.png")),
        })
    }
}

fn black() -> image::RgbImage {
    image::RgbImage::new(128, 64)
}

fn entries(value: &Value) -> Vec<f64> {
    match value {
        Value::Number(number) => vec![number.as_f64().unwrap()],
        Value::Array(list) => list.iter().flat_map(entries).collect(),
        // Of a pose: position, then quaternion.
        _ => ["translation", "quaternion_xyzw"].iter().flat_map(|part| entries(&value[part])).collect(),
    }
}

fn pose(value: &Value) -> Pose {
    let [x, y, z, qx, qy, qz, qw]: [f64; 7] = entries(value).try_into().unwrap_or_else(|_| panic!("{value}"));
    let quaternion = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(qw, qx, qy, qz));
    Pose::new(quaternion.to_rotation_matrix(), nalgebra::Vector3::new(x, y, z))
}

/// Whether numbers agree to a relative difference.
fn agree(a: &Value, b: &Value, tolerance: f64) -> bool {
    let (a, b) = (entries(a), entries(b));
    let size = a.iter().fold(0.0_f64, |size, value| size.max(value.abs()));
    a.len() == b.len() && a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= tolerance * size)
}

#[test]
fn corrected_measurements_are_what_the_lines_say_beside_the_measured_ones() {
    let world = World::get();
    for axes in [&[][..], &["--frame", "camera"], &["--perturbation", "right"], &["--floor", "1e-5,1e-7"]] {
        let with = |more: &[&str]| world.lines(&[axes, more].concat());
        let (both, corrected) = (with(&[]), with(&["--corrected"]));
        assert_eq!((both.len(), corrected.len()), (FRAMES - 1, FRAMES - 1));
        for (both, corrected) in both.iter().zip(&corrected) {
            assert_eq!(
                (&corrected["pose"], &corrected["covariance"]),
                (&both["corrected_pose"], &both["corrected_covariance"])
            );
            assert_eq!((&corrected["verdict"], &corrected["corrected"]), (&both["verdict"], &json!(true)));
            assert!(corrected.get("correction").is_none() && both.get("corrected").is_none());
        }
    }
    // The correction is one motion, whichever axes it is said in.
    let (vehicle, camera) = (world.lines(&[]), world.lines(&["--frame", "camera"]));
    let camera_from_vehicle = load_kitti_raw(&world.path().join("data"), "2026_01_01_drive_0003_sync")
        .unwrap()
        .calibration
        .camera_from_vehicle;
    for (vehicle, camera) in vehicle.iter().zip(&camera) {
        let expected = pose(&vehicle["corrected_pose"]).conjugated_by(&camera_from_vehicle);
        assert!((pose(&camera["corrected_pose"]).matrix() - expected.matrix()).norm() < 1e-9);
    }
}

#[test]
fn relative_poses_and_trajectories_hold_the_corrected_motions() {
    let world = World::get();
    let corrected = world.lines(&["--corrected"]);
    let text = world.text(&["--format", "csv", "--corrected"]);
    assert!(text.lines().next().unwrap().contains("corrected by the error that the images show"));
    let read = parse_relative_poses(&text, Path::new("csv")).unwrap();
    let mut chained = Pose::identity();
    for (read, line) in read.iter().zip(&corrected) {
        assert!((read.source_from_target.matrix() - pose(&line["pose"]).matrix()).norm() < 1e-12);
        let covariance: Vec<f64> = read.covariance.unwrap().matrix().iter().copied().collect();
        assert!(agree(&json!(covariance), &line["covariance"], 1e-12));
        chained = chained * pose(&line["pose"]);
    }
    let text = world.text(&["--format", "tum", "--corrected"]);
    let last: Vec<f64> = text.lines().last().unwrap().split(' ').map(|word| word.parse().unwrap()).collect();
    assert!((chained.translation - nalgebra::Vector3::from_column_slice(&last[1..4])).norm() < 1e-9);
    for format in ["kitti", "g2o", "gtsam", "ros"] {
        let [as_it_is, corrected] =
            [&[][..], &["--corrected"]].map(|more| world.text(&[&["--format", format], more].concat()));
        assert_eq!(as_it_is.lines().count(), corrected.lines().count());
        assert_ne!(as_it_is, corrected, "{format}");
    }
}

#[test]
fn corrected_measurements_are_nearer_to_the_truth() {
    let world = World::get();
    let truth = load_kitti_raw(&world.path().join("data"), "2026_01_01_drive_0003_sync").unwrap().poses;
    let (mut before, mut after) = (Tangent::zeros(), Tangent::zeros());
    for line in world.lines(&[]) {
        let [source, target] = ["source", "target"].map(|end| line[end].as_u64().unwrap() as usize);
        let true_motion = truth[&source].inverse() * truth[&target];
        for (sum, field) in [(&mut before, "pose"), (&mut after, "corrected_pose")] {
            *sum += Pose::error(&pose(&line[field]), &true_motion).map(|error| error * error);
        }
    }
    // Rotations show best; nothing gets worse.
    for component in 0..6 {
        let left = (after[component] / before[component]).sqrt();
        assert!(left < if component < 3 { 1.0 } else { 0.7 }, "component {component}: {left} of the error is left");
    }
}

#[test]
fn a_stream_gives_the_corrections_of_the_data_set() {
    let world = World::get();
    let (vehicle, camera) = (world.lines(&[]), world.lines(&["--frame", "camera"]));
    let requests: Vec<Value> = camera.iter().map(|line| world.request(line)).collect();
    for (arguments, expected) in [(&[][..], &vehicle), (&["--frame", "camera"], &camera)] {
        for (answer, line) in world.answers(arguments, &requests).iter().zip(expected) {
            assert_eq!((&answer["id"], &answer["verdict"]), (&line["source"], &line["verdict"]), "{answer}");
            for field in ["covariance", "correction", "corrected_pose", "corrected_covariance"] {
                assert!(agree(&answer[field], &line[field], 1e-6), "{field}: {answer}\n{line}");
            }
        }
    }
    for (answer, line) in world.answers(&["--corrected"], &requests).iter().zip(&vehicle) {
        assert!(agree(&answer["pose"], &line["corrected_pose"], 1e-6), "{answer}\n{line}");
        assert!(agree(&answer["covariance"], &line["corrected_covariance"], 1e-6), "{answer}\n{line}");
    }
}

#[test]
fn a_stream_of_pairs_that_show_nothing_is_answered() {
    let world = World::get();
    let line = world.lines(&["--frame", "camera"]).swap_remove(0);
    let good = world.request(&line);
    let changed = |changes: &[(&str, Value)]| {
        let mut request = good.clone();
        changes.iter().for_each(|(field, value)| request[*field] = value.clone());
        request
    };
    let map = |name: &str, known: usize| {
        let depth_m = (0..128 * 64).map(|pixel| if pixel % 100 < known { 8.0 } else { 0.0 }).collect();
        let path = world.path().join(name);
        write_depth_png(&path, &DepthMap { width: 128, height: 64, depth_m }).unwrap();
        json!(path)
    };
    let mut png = Cursor::new(Vec::new());
    black().write_to(&mut png, image::ImageFormat::Png).unwrap();
    let black = json!({ "base64": base64::engine::general_purpose::STANDARD.encode(png.get_ref()) });
    let far = json!([0, 0, -1000, 0, 0, 0, 1]);
    let cases = [
        (changed(&[("depth", map("unknown.png", 0))]), "no_depth"),
        (changed(&[("depth", map("sparse.png", 1))]), "no_depth"),
        (changed(&[("source_image", black.clone())]), "no_texture"),
        (changed(&[("source_image", black.clone()), ("target_image", black)]), "no_texture"),
        (changed(&[("pose", far)]), "no_overlap"),
        (good.clone(), "ok"),
    ];
    let requests: Vec<Value> = cases.iter().map(|(request, _)| request.clone()).collect();
    let answers = world.answers(&[], &requests);
    for (answer, (_, verdict)) in answers.iter().zip(&cases) {
        assert_eq!(answer["verdict"], *verdict, "{answer}");
        if *verdict != "ok" {
            assert!(answer["reason"].as_str().is_some_and(|reason| !reason.is_empty()), "{answer}");
            assert!(entries(&answer["correction"]).iter().all(|value| *value == 0.0), "{answer}");
            assert_eq!(answer["covariance"], answer["corrected_covariance"]);
            assert!(entries(&answer["std_devs"]).iter().all(|sigma| sigma.is_finite() && *sigma > 0.0), "{answer}");
        }
    }
    assert_eq!(answers.len(), cases.len());
    let wrong = world.answers(&[], &[changed(&[("pose", json!([1, 2, 3]))])]);
    assert!(wrong[0]["error"].is_string() && wrong[0].get("verdict").is_none(), "{}", wrong[0]);
}

#[test]
fn pairs_without_a_verdict_are_counted_and_written_as_they_are() {
    let world = World::get();
    let drive = world.drive(4).display().to_string();
    let measurements = world.path().join("data/measurements/vo/2026_01_01_drive_0004.csv").display().to_string();
    let arguments =
        ["--drive", &drive, "--measurements", &measurements, "--measurement-frame", "camera2", "--format", "jsonl"];
    let counted = contains("2 got no verdict from the images (no_texture 2)");
    world
        .predict(&arguments)
        .assert()
        .success()
        .stderr(counted.and(contains("with the covariance that is expected without them")));
    let corrected = [&arguments[..], &["--corrected"]].concat();
    world.predict(&corrected).assert().success().stderr(contains("are written as they are"));
    let (as_they_are, corrected) = (world.lines(&arguments), world.lines(&corrected));
    for (as_it_is, corrected) in as_they_are.iter().zip(&corrected) {
        let black = as_it_is["source"] == 5 || as_it_is["target"] == 5;
        assert_eq!(as_it_is["verdict"] == "no_texture", black, "{as_it_is}");
        assert_eq!(as_it_is["pose"] == corrected["pose"] && as_it_is["covariance"] == corrected["covariance"], black);
    }
}

#[test]
fn corrected_motions_are_fused_beside_the_measured_ones() {
    let world = World::get();
    let output = relcov()
        .args(["fuse", "--quiet", "--run"])
        .arg(world.path().join("runs/seen"))
        .args(["--simulate-fixes", "5,0.02"])
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    let rpe = |method: &str| -> f64 {
        let row = text.lines().find(|line| line.split('|').any(|cell| cell.trim() == method));
        let row = row.unwrap_or_else(|| panic!("{method}: {text}"));
        row.split('|').map(str::trim).nth(6).unwrap().trim_end_matches('*').parse().unwrap()
    };
    for method in ["relcov", "relcov_uncalibrated", "constant", "constant_full", "constant_mad", "oracle"] {
        assert!(rpe("relcov_corrected") < rpe(method), "{method}: {text}");
    }
}
