//! `relcov predict`: a drive, a manifest and a stream give the same covariances; garbage gets an answer; what cannot be
//! done is said before the work.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::OnceLock;

use assert_cmd::Command;
use base64::Engine;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::geometry::{Covariance6, Pose};
use relcov::recordings::{Calibration, load_kitti_raw, parse_kitti_trajectory};
use relcov::systems::parse_relative_poses;
use serde_json::{Value, json};

use crate::support::{DRIVE, write_config, write_drive};

const FRAMES: usize = 24;

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

/// The made drive with a model trained on it, once for all tests.
pub struct World {
    folder: tempfile::TempDir,
}

impl World {
    pub fn get() -> &'static Self {
        static WORLD: OnceLock<World> = OnceLock::new();
        WORLD.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            write_drive(folder.path(), FRAMES);
            let config = write_config(folder.path(), folder.path());
            let full = ["--set", "model.head=full", "--set", "training.learning_rate=1e-3"];
            relcov().args(["train", "--quiet", "--config"]).arg(&config).args(full).assert().success();
            write_manifest(&folder.path().join("pairs.csv"), folder.path());
            World { folder }
        })
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    pub fn predict(&self, arguments: &[&str]) -> Command {
        let mut command = relcov();
        command.args(["predict", "--run"]).arg(self.path().join("runs/tiny")).args(arguments);
        command
    }

    pub fn lines(&self, arguments: &[&str]) -> Vec<Value> {
        let output = self.predict(arguments).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let text = String::from_utf8(output.stdout).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    pub fn of_drive(&self) -> [String; 4] {
        let drive = self.path().join("2020_01_01").join(DRIVE).display().to_string();
        let measurements = self.path().join("vo/2020_01_01_drive_0001.txt").display().to_string();
        ["--drive".to_owned(), drive, "--measurements".to_owned(), measurements]
    }

    pub fn manifest(&self) -> String {
        self.path().join("pairs.csv").display().to_string()
    }
}

/// Measured motions of the drive in axes of camera 2, and its calibration.
fn measured(root: &Path) -> (Vec<Pose>, Calibration) {
    let drive = load_kitti_raw(root, DRIVE).unwrap();
    let path = root.join("vo/2020_01_01_drive_0001.txt");
    let poses = parse_kitti_trajectory(&std::fs::read_to_string(&path).unwrap(), &path, 0).unwrap();
    let camera_from_camera0 = drive.calibration.camera_from_camera0;
    let motion = |frame: usize| (poses[&frame].inverse() * poses[&(frame + 1)]).conjugated_by(&camera_from_camera0);
    ((0..FRAMES - 1).map(motion).collect(), drive.calibration)
}

fn numbers(pose: &Pose) -> [f64; 7] {
    let quaternion = nalgebra::UnitQuaternion::from_rotation_matrix(&pose.rotation);
    let (t, q) = (pose.translation, quaternion.coords);
    [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
}

fn write_manifest(path: &Path, root: &Path) {
    let (motions, calibration) = measured(root);
    let camera = calibration.camera;
    let truth = load_kitti_raw(root, DRIVE).unwrap().poses;
    let mut text = "system,sequence,source,target,source_image,target_image,fx,fy,cx,cy,x,y,z,qx,qy,qz,qw,true_x,true_y,true_z,true_qx,true_qy,true_qz,true_qw\n".to_owned();
    for (source, motion) in motions.iter().enumerate() {
        let image = |frame: usize| format!("2020_01_01/{DRIVE}/image_02/data/{frame:010}.png");
        let target = source + 1;
        let true_motion = (truth[&source].inverse() * truth[&target]).conjugated_by(&calibration.camera_from_vehicle);
        let values = [camera.fx, camera.fy, camera.cx, camera.cy].into_iter();
        let values: Vec<String> =
            values.chain(numbers(motion)).chain(numbers(&true_motion)).map(|value| format!("{value:?}")).collect();
        text += &format!("vo,lab,{source},{target},{},{},{}\n", image(source), image(target), values.join(","));
    }
    std::fs::write(path, text).unwrap();
}

fn covariance(line: &Value) -> Covariance6 {
    let rows = line["covariance"].as_array().unwrap_or_else(|| panic!("{line}"));
    let entries: Vec<f64> = rows.iter().flat_map(|row| row.as_array().unwrap()).map(|e| e.as_f64().unwrap()).collect();
    Covariance6::from_matrix(nalgebra::Matrix6::from_row_slice(&entries)).unwrap()
}

/// Largest difference of two covariances in units of standard deviations.
fn difference(a: &Covariance6, b: &Covariance6) -> f64 {
    let sigma = a.std_devs();
    let scaled = (a.matrix() - b.matrix()).component_div(&(sigma * sigma.transpose()));
    scaled.abs().max()
}

#[test]
fn a_drive_a_manifest_and_a_stream_agree() {
    let world = World::get();
    let (motions, calibration) = measured(world.path());
    let drive_arguments = world.of_drive();
    let drive_arguments: Vec<&str> = drive_arguments.iter().map(String::as_str).collect();
    let of_drive = world.lines(&drive_arguments);
    assert_eq!(of_drive.len(), FRAMES - 1);
    assert_eq!((of_drive[0]["frame"].as_str(), of_drive[0]["perturbation"].as_str()), (Some("vehicle"), Some("left")));

    let vehicle = numbers(&calibration.camera_from_vehicle);
    let camera_from_vehicle = format!("data.camera_from_vehicle={vehicle:?}");
    let manifest = world.manifest();
    // A manifest's configuration may say where its vehicle is.
    let config = world.path().join("manifest.toml");
    std::fs::write(&config, manifest_config(&manifest)).unwrap();
    let config = config.display().to_string();
    let of_manifest =
        world.lines(&["--config", &config, "--system", "vo", "--set", &camera_from_vehicle, "--split", "test"]);
    let given = vehicle.map(|number| number.to_string()).join(",");
    let direct = world.lines(&["--manifest", &manifest, "--camera-from-vehicle", &given]);
    assert_eq!(direct.len(), FRAMES - 1);
    for (line, expected) in direct.iter().zip(&of_drive) {
        assert!(difference(&covariance(expected), &covariance(line)) < 1e-6, "{line}");
    }

    let image = |frame: usize| world.path().join(format!("2020_01_01/{DRIVE}/image_02/data/{frame:010}.png"));
    let camera = calibration.camera;
    let request = |source: usize| {
        let encoded = base64::engine::general_purpose::STANDARD.encode(std::fs::read(image(source)).unwrap());
        let mut motion = motions[source].matrix().transpose().as_slice().to_vec();
        motion.truncate(if source.is_multiple_of(2) { 16 } else { 12 });
        json!({
            "id": source,
            "source_image": {"base64": encoded},
            "target_image": image(source + 1),
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "pose": motion,
            "camera_from_vehicle": vehicle,
        })
        .to_string()
    };
    let requests: Vec<String> = (0..FRAMES - 1).map(request).collect();
    let output = world.predict(&["--stream"]).write_stdin(requests.join("\n")).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let streamed: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(streamed.len(), FRAMES - 1, "{text}");
    for (source, answer) in streamed.iter().enumerate() {
        assert_eq!(answer["id"].as_u64(), Some(source as u64));
        let expected = covariance(&of_drive[source]);
        assert!(difference(&expected, &covariance(answer)) < 1e-6, "{answer}");
    }
    for line in &of_manifest {
        let expected = covariance(&of_drive[line["source"].as_u64().unwrap() as usize]);
        assert!(difference(&expected, &covariance(line)) < 1e-6, "{line}");
    }
    assert_eq!(of_manifest.len(), 4);
}

fn manifest_config(manifest: &str) -> String {
    format!(
        r#"name = "own"
checkpoints = "own_runs"
device = "flex"
[data]
manifest = {manifest:?}
train = [{{ drive = "lab", frames = [0, 16] }}]
validation = [{{ drive = "lab", frames = [16, 20] }}]
test = [{{ drive = "lab", frames = [19, 23] }}]
[truth]
source = "manifest"
[[systems]]
name = "vo"
share = 0.75
source = "manifest"
[[systems]]
name = "truth"
share = 0.25
source = "truth"
[model]
width = 32
height = 16
[training]
batch = 8
micro_batch = 4
epochs = 2
batches_per_epoch = 2
"#
    )
}

#[test]
fn a_manifest_trains_and_predicts() {
    let world = World::get();
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("own.toml");
    let text = manifest_config(&world.manifest()).replace("frames = [19, 23]", "frames = [20, 23]");
    std::fs::write(&config, text).unwrap();
    relcov().args(["train", "--quiet", "--config"]).arg(&config).assert().success().stdout(contains("| vo "));
    let inspected = relcov().args(["inspect", "--config"]).arg(&config).output().unwrap();
    let inspected = String::from_utf8(inspected.stdout).unwrap();
    assert!(inspected.contains("problems: none"), "{inspected}");
    let run = folder.path().join("own_runs/own");
    let out = folder.path().join("out/{system}_{drive}.csv");
    relcov()
        .args(["predict", "--run"])
        .arg(&run)
        .args(["--manifest", &world.manifest(), "--format", "csv", "--out"])
        .arg(&out)
        .assert()
        .success()
        .stderr(contains("23 covariances"));
    let path = folder.path().join("out/vo_lab.csv");
    let poses = parse_relative_poses(&std::fs::read_to_string(&path).unwrap(), &path).unwrap();
    assert_eq!(poses.len(), FRAMES - 1);
    assert!(poses.iter().all(|pose| pose.covariance.unwrap().is_positive()));
}

#[test]
fn sides_axes_and_floors_are_what_was_asked_for() {
    let world = World::get();
    let arguments = world.of_drive();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let with = |more: &[&str]| world.lines(&[&arguments[..], more].concat());
    let (left, right, camera) = (with(&[]), with(&["--perturbation", "right"]), with(&["--frame", "camera"]));
    let floored = with(&["--floor", "2,3"]);
    let (motions, calibration) = measured(world.path());
    for source in 0..FRAMES - 1 {
        let covariance_left = covariance(&left[source]);
        let motion = motions[source].conjugated_by(&calibration.camera_from_vehicle.inverse());
        assert!(difference(&covariance_left.right_of(&motion), &covariance(&right[source])) < 1e-9);
        let in_camera = covariance_left.transported(&calibration.camera_from_vehicle);
        assert!(difference(&in_camera, &covariance(&camera[source])) < 1e-9);
        assert_eq!(covariance(&floored[source]).variance()[5], 3.0);
    }
}

#[test]
fn a_stream_of_garbage_goes_on() {
    let world = World::get();
    let image = world.path().join(format!("2020_01_01/{DRIVE}/image_02/data/0000000000.png"));
    let good = json!({"id": 1, "source_image": image, "target_image": image, "intrinsics": [60, 60, 48, 24], "pose": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5]]});
    let changed = |field: &str, value: Value| {
        let mut request = good.clone();
        request[field] = value;
        request.to_string()
    };
    let cases = [
        ("garbage".to_owned(), "no request: expected value"),
        ("[1, 2]".to_owned(), "no request: invalid type: integer"),
        ("{\"id\": 9}".to_owned(), "missing field `source_image`"),
        (format!("{{\"id\": [{}0]}}", "{\"\":0},".repeat(1000)), "an id: a number, or text"),
        (changed("id", json!("x".repeat(2000))), "an id of 2000 bytes"),
        (changed("source_image", json!("nowhere.png")), "nowhere.png"),
        (changed("source_image", json!("/dev/zero")), "no regular file"),
        (changed("source_image", json!({"base64": "!!"})), "field `source_image`"),
        (changed("source_image", json!({"base64": "aGVsbG8="})), "field `source_image`"),
        (changed("source_image", json!({"path": "a.png"})), "unknown field `path`, expected `base64`"),
        (changed("source_image", json!(7)), "an image or depth map: a path"),
        (changed("intrinsics", json!([60, 60, 48])), "an array of length 4"),
        (changed("intrinsics", json!([-60, 60, 48, 24])), "focal lengths positive"),
        (changed("pose", json!([0, 0, 1, 0, 0, 0, 2])), "length 2"),
        (changed("pose", json!([0, 0, 1e9, 0, 0, 0, 1])), "field `pose`: found a translation"),
        (changed("pose", json!([[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])), "field `pose`: found |RᵀR"),
        (changed("pose", json!([1, 2, 3])), "field `pose`: found 3 numbers"),
        (changed("pose", json!(vec![1; 1000])), "a pose: 7 numbers"),
        (changed("pose", json!("forward")), "a pose: 7 numbers"),
        (changed("pose_frame", json!("boat")), "`camera` or `vehicle`"),
        (changed("depth", json!(image)), "16-bit grey PNG"),
        (changed("posé", json!(1)), "unknown field `posé`"),
    ];
    let mut process = std::process::Command::new(assert_cmd::cargo::cargo_bin("relcov"))
        .args(["predict", "--stream", "--run"])
        .arg(world.path().join("runs/tiny"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut requests = process.stdin.take().unwrap();
    let mut answers = BufReader::new(process.stdout.take().unwrap());
    // One by one: each answer comes before the next request is sent.
    let mut ask = |request: &[u8]| {
        requests.write_all(request).unwrap();
        requests.write_all(b"\n").unwrap();
        requests.flush().unwrap();
        let mut line = String::new();
        answers.read_line(&mut line).unwrap();
        serde_json::from_str::<Value>(&line).unwrap_or_else(|error| panic!("{error}: {line}"))
    };
    for (request, expected) in cases {
        let answer = ask(request.as_bytes());
        let error = answer["error"].as_str().unwrap_or_else(|| panic!("{request}: {answer}"));
        assert!(error.contains(expected), "{error}\nexpected: {expected}");
        let answer = ask(good.to_string().as_bytes());
        assert!(answer["error"].is_null() && answer["id"] == 1, "{answer}");
    }
    assert!(ask(b"\xff\xfe")["error"].as_str().unwrap().contains("UTF-8"));
    drop(requests);
    assert!(process.wait().unwrap().success());
}

#[test]
fn what_cannot_be_done_is_said() {
    let world = World::get();
    let drive = world.of_drive();
    let drive: Vec<&str> = drive.iter().map(String::as_str).collect();
    let manifest = world.manifest();
    let broken = world.path().join("broken.csv");
    std::fs::write(&broken, std::fs::read_to_string(&manifest).unwrap().replace("vo,lab,3,4", "vo,lab,3,three"))
        .unwrap();
    let broken = broken.display().to_string();
    for (arguments, expected) in [
        (vec!["--manifest", "nowhere.csv"], "nowhere.csv: cannot read"),
        (vec!["--manifest", &broken], "line 5: found frame `three`; expected a whole number"),
        (vec!["--drive", "nowhere", "--measurements", "vo.txt"], "--measurements vo.txt: no such file"),
        (vec!["--format", "gtsam", "--perturbation", "left"], "right perturbation"),
        (vec!["--format", "csv", "--covariance", "none"], "--covariance is for tum and kitti"),
        (vec!["--format", "g2o"], "there are 2 of them"),
        (vec!["--format", "csv", "--out", "{drive}.csv"], "there are 2 of them for one output"),
        (vec!["--system", "vo", "--out", "src"], "src: found a folder"),
        (vec!["--format", "tum", "--system", "vo", "--frame", "world"], "axes of the world turn"),
        (vec!["--system", "lidar"], "the data have vo, gnss"),
        (vec!["--set", "model.width=64"], "keeps its shape"),
        (vec!["--stream", "--frame", "world"], "single measurements do not know the world"),
        (vec!["--stream", "--format", "g2o"], "leave --format out"),
        (vec!["--corrected", "--system", "lidar"], "does not predict the error itself"),
        (vec!["--corrected", "--stream"], "does not predict the error itself"),
    ] {
        world.predict(&arguments).assert().code(1).stderr(contains(expected));
    }
    world.predict(&["--floor", "little"]).assert().code(2).stderr(contains("`little` is no variance"));
    relcov().args(["predict", "--run", "nowhere"]).assert().code(1).stderr(contains("no such folder"));

    // Nothing half-written, and the other pairs are predicted when an image is broken.
    let copy = tempfile::tempdir().unwrap();
    write_drive(copy.path(), FRAMES);
    let image = copy.path().join(format!("2020_01_01/{DRIVE}/image_02/data/0000000005.png"));
    std::fs::write(&image, &std::fs::read(&image).unwrap()[..200]).unwrap();
    let folder = copy.path().join("2020_01_01").join(DRIVE);
    let moved = PathBuf::from(drive[3]);
    let (folder, moved) = (folder.display().to_string(), moved.display().to_string());
    let broken = ["--drive", &folder, "--measurements", &moved];
    world.predict(&broken).assert().success().stderr(contains("21 covariances").and(contains("2 could not be used")));
    let out = copy.path().join("trajectory.tum");
    let out_text = out.display().to_string();
    let tum = [&broken[..], &["--format", "tum", "--out", &out_text]].concat();
    world.predict(&tum).assert().code(1).stderr(contains("no motion from frame 4 to 6"));
    assert!(!out.exists());
}

#[test]
fn a_model_needs_its_configuration_only_for_depth_that_is_not_given() {
    let world = World::get();
    let run = tempfile::tempdir().unwrap();
    for file in ["manifest.json", "model.safetensors"] {
        std::fs::copy(world.path().join("runs/tiny").join(file), run.path().join(file)).unwrap();
    }
    let device = relcov::device::open_device("flex").unwrap();
    let model = relcov::Model::load(run.path(), &device).unwrap();
    let image = relcov::recordings::RgbImage { width: 64, height: 32, bytes: vec![128; 3 * 64 * 32] };
    let camera = relcov::geometry::Pinhole { fx: 40.0, fy: 40.0, cx: 31.5, cy: 15.5, width: 64, height: 32 };
    let message = model.live_depth().estimate(&image, &camera).unwrap_err().to_string();
    assert!(message.contains("config.toml"), "{message}");
    let target_depth = relcov::depth::ground_plane_depth(&camera, 1.65, None, 80.0);
    let source_from_target = Pose::identity();
    let (source_image, target_image) = (image.clone(), image);
    let (right, camera_from_vehicle) = (None, None);
    let measurement = relcov::Measurement {
        source_image,
        target_image,
        target_depth,
        camera,
        source_from_target,
        right,
        camera_from_vehicle,
    };
    assert!(model.predict(&measurement).unwrap().is_positive());
}
