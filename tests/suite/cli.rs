//! The program as a user meets it: help, errors, a whole run, Ctrl-C and resume.

use std::path::{Path, PathBuf};
use std::time::Duration;

use assert_cmd::Command;
use predicates::prelude::*;
use predicates::str::contains;

use crate::support::{DRIVE, shared, write_config, write_drive};

fn relcov() -> Command {
    let mut command = Command::cargo_bin("relcov").unwrap();
    command.env_remove("RELCOV_DATA_ROOT").env_remove("RUST_LOG").timeout(Duration::from_secs(1800));
    command
}

/// A made drive with its configuration, in a folder of its own.
struct Made {
    folder: tempfile::TempDir,
    config: PathBuf,
}

impl Made {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_drive(&folder.path().join("data"), 24);
        let config = write_config(folder.path(), &folder.path().join("data"));
        Self { folder, config }
    }

    fn path(&self, relative: &str) -> PathBuf {
        self.folder.path().join(relative)
    }

    fn drive(&self, relative: &str) -> PathBuf {
        self.path("data/2020_01_01").join(DRIVE).join(relative)
    }

    fn train(&self, settings: &[&str]) -> Command {
        let mut command = relcov();
        command.arg("train").arg("--config").arg(&self.config);
        settings.iter().for_each(|setting| {
            command.arg("--set").arg(setting);
        });
        command
    }

    fn inspect(&self) -> Command {
        let mut command = relcov();
        command.arg("inspect").arg("--config").arg(&self.config);
        command
    }
}

fn read(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn every_help_ends_with_examples() {
    for command in ["train", "eval", "inspect", "synth"] {
        relcov().args([command, "--help"]).assert().success().stdout(contains("Examples:"));
    }
    relcov().arg("--help").assert().success().stdout(contains("Examples:"));
}

#[test]
fn wrong_usage_exits_with_2() {
    relcov().arg("trian").assert().code(2).stderr(contains("train"));
    relcov().arg("train").assert().code(2).stderr(contains("--config"));
    relcov().args(["eval", "--run", "x", "--split", "dev"]).assert().code(2).stderr(contains("validation"));
}

#[test]
fn a_run_trains_evaluates_and_leaves_a_whole_folder() {
    let made = Made::new();
    let table = contains("MDE").and(contains("vehicle")).and(contains("x [m]")).and(contains("yaw [rad]"));
    made.train(&[])
        .assert()
        .success()
        .stdout(table.and(contains("relcov")).and(contains("zero")).and(contains("constant")));
    let run = made.path("runs/tiny");
    for file in [
        "config.toml",
        "manifest.json",
        "metrics.csv",
        "losses.svg",
        "model.safetensors",
        "evaluation.json",
        "pairs.csv",
    ] {
        assert!(run.join(file).is_file(), "{file}");
    }
    let leftovers = std::fs::read_dir(&run)
        .unwrap()
        .filter(|entry| entry.as_ref().unwrap().file_name().to_string_lossy().starts_with('.'));
    assert_eq!(leftovers.count(), 0, "nothing half-written stays");

    let evaluation: serde_json::Value = serde_json::from_str(&read(run.join("evaluation.json"))).unwrap();
    assert_eq!(evaluation["schema"], 1);
    assert_eq!(evaluation["error_frame"], "vehicle");
    assert_eq!(evaluation["systems"]["vo"]["pairs"], 3);
    assert_eq!(evaluation["systems"]["gnss"]["methods"]["zero"]["mde"][0], 0.0);
    assert!(evaluation["systems"]["gnss"]["methods"]["relcov"]["nll"].is_null());
    assert_eq!(read(run.join("pairs.csv")).lines().count(), 1 + 6);
    assert_eq!(read(run.join("metrics.csv")).lines().count(), 1 + 2);

    // The same again by itself, and the other splits.
    let first = read(run.join("evaluation.json"));
    relcov().arg("eval").arg("--run").arg(&run).assert().success();
    assert_eq!(first, read(run.join("evaluation.json")));
    relcov()
        .arg("eval")
        .arg("--run")
        .arg(&run)
        .args(["--split", "validation"])
        .assert()
        .success()
        .stdout(contains("validation"));
}

/// One program, backends swapped by `--device` alone: a run of one is judged, and goes on, on another.
#[test]
fn a_run_moves_between_backends() {
    let made = Made::new();
    made.train(&["training.epochs=1"]).assert().success();
    let run = made.path("runs/tiny");
    let nll = |device: &str| {
        relcov().arg("eval").arg("--run").arg(&run).args(["--device", device]).assert().success();
        let evaluation: serde_json::Value = serde_json::from_str(&read(run.join("evaluation.json"))).unwrap();
        assert_eq!(evaluation["device"], device);
        evaluation["systems"]["vo"]["methods"]["relcov"]["nll"].as_f64().unwrap()
    };
    let flex = nll("flex");
    let others: Vec<&str> =
        ["ndarray", "wgpu"].into_iter().filter(|name| crate::support::device(name).is_some()).collect();
    for device in &others {
        let other = nll(device);
        assert!((other - flex).abs() < 1e-3 * flex.abs(), "{device}: {other}, flex: {flex}");
    }
    for (device, epochs) in others.into_iter().zip(2..) {
        let mut resume = relcov();
        resume.arg("train").arg("--resume").arg(&run).args(["--set", &format!("training.epochs={epochs}")]);
        resume.args(["--device", device]).assert().success().stderr(contains(format!("device: {device}")));
    }
}

#[test]
fn the_same_seed_gives_the_same_run() {
    let made = Made::new();
    made.train(&["name=a"]).assert().success();
    made.train(&["name=b"]).assert().success();
    made.train(&["name=c", "seed=1"]).assert().success();
    let losses = |name: &str| losses(&made.path(&format!("runs/{name}")));
    assert_eq!(losses("a"), losses("b"));
    assert_ne!(losses("a"), losses("c"));
}

/// The loss columns of `metrics.csv`.
fn losses(run: &Path) -> Vec<Vec<f64>> {
    let text = read(run.join("metrics.csv"));
    text.lines()
        .skip(1)
        .map(|row| row.split(',').skip(2).take(4).map(|value| value.parse().unwrap()).collect())
        .collect()
}

#[test]
fn training_learns_the_pairs_it_sees() {
    // In a process of its own: other tests would draw from the random numbers of its weights.
    let made = Made::new();
    made.train(&[
        "model.dropout=0.0",
        "training.learning_rate=3e-4",
        "training.batches_per_epoch=40",
        "training.epochs=4",
    ])
    .assert()
    .success();
    // Sixteen pairs of each system are learned by heart, beyond the constant that training starts at.
    let losses = losses(&made.path("runs/tiny"));
    let (first, last) = (losses[0][0], losses[3][0]);
    assert!(last < first - 2.0, "vo: {first} to {last}");
}

#[test]
#[cfg(unix)]
fn an_interrupted_run_resumes_to_the_same_result() {
    let made = Made::new();
    let settings = ["training.epochs=3", "training.batches_per_epoch=40"];
    made.train(&[&settings[..], &["name=unbroken"]].concat()).assert().success();

    let program = assert_cmd::cargo::cargo_bin("relcov");
    let mut child = std::process::Command::new(program)
        .arg("train")
        .arg("--config")
        .arg(&made.config)
        .args(settings.iter().chain(&["name=broken"]).flat_map(|setting| ["--set", setting]))
        .stderr(std::process::Stdio::piped())
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let run = made.path("runs/broken");
    // Once the first epoch is saved, in the middle of the second.
    while !run.join("metrics.csv").exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(Duration::from_millis(5));
    }
    std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(130), "{message}");
    assert!(message.contains("--resume"), "{message}");

    relcov().arg("train").arg("--resume").arg(&run).assert().success();
    let (unbroken, broken) = (losses(&made.path("runs/unbroken")), losses(&run));
    assert_eq!((unbroken.len(), broken.len()), (3, 3));
    for (a, b) in unbroken.iter().flatten().zip(broken.iter().flatten()) {
        assert!((a - b).abs() <= 1e-6 * a.abs(), "{a} against {b}");
    }
    let evaluation = |name: &str| -> serde_json::Value {
        let text = read(made.path(&format!("runs/{name}/evaluation.json")));
        serde_json::from_str::<serde_json::Value>(&text).unwrap()["systems"]["vo"]["methods"]["relcov"]["nll"].clone()
    };
    let (a, b) = (evaluation("unbroken").as_f64().unwrap(), evaluation("broken").as_f64().unwrap());
    assert!((a - b).abs() <= 1e-6 * a.abs(), "{a} against {b}");
}

#[test]
fn bad_input_is_named_and_exits_with_1() {
    let oxts = "oxts/data/0000000002.txt";
    let calibration = "data/2020_01_01/calib_cam_to_cam.txt";
    let odometry = "vo/2020_01_01_drive_0001.txt";
    type Case<'a> = (&'a str, &'a dyn Fn(&Made), &'a [&'a str]);
    let cases: [Case; 12] = [
        (
            "missing file",
            &|made| std::fs::remove_file(made.path(calibration)).unwrap(),
            &["calib_cam_to_cam.txt", "cannot read"],
        ),
        (
            "short packet",
            &|made| std::fs::write(made.drive(oxts), "49 8 115").unwrap(),
            &["0000000002.txt, line 1", "3 values", "30"],
        ),
        ("NaN packet", &|made| edit(&made.drive(oxts), "115", "nan"), &["0000000002.txt, line 1", "`nan`"]),
        (
            "missing key",
            &|made| edit(&made.path(calibration), "P_rect_02", "P_rect_09"),
            &["calib_cam_to_cam.txt", "P_rect_02"],
        ),
        (
            "short key",
            &|made| edit(&made.path(calibration), "R_rect_00: 1 0 0", "R_rect_00: 1 0"),
            &["line 2", "8 numbers"],
        ),
        ("no rotation", &|made| edit(&made.path(calibration), "R_rect_00: 1", "R_rect_00: 2"), &["line 2", "rotation"]),
        (
            "short pose",
            &|made| edit_file(&made.path("data").join(odometry), |text| text.replacen("1.000000000000e0 ", "", 1)),
            &["line 1", "11 numbers"],
        ),
        (
            "word in pose",
            &|made| edit_file(&made.path("data").join(odometry), |text| text.replacen("1.000", "one", 1)),
            &["line 1", "finite number"],
        ),
        (
            "twin frames",
            &|made| std::fs::write(made.drive("image_02/data/3.png"), "").unwrap(),
            &["a second file of frame 3"],
        ),
        ("twin keys", &|made| edit(&made.path(calibration), "R_rect_00", "S_rect_02"), &["line 3", "again"]),
        (
            "huge frame",
            &|made| std::fs::write(made.drive("oxts/data/18446744073709551615.txt"), "").unwrap(),
            &["frame index 18446744073709551615"],
        ),
        (
            "drive name",
            &|made| edit(&made.config, DRIVE, "2020_01_01_drive_0009_sync"),
            &["no such drive", "data.root"],
        ),
    ];
    for (name, break_it, words) in cases {
        let made = Made::new();
        break_it(&made);
        let output = made.inspect().assert().code(1).get_output().clone();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(words.iter().all(|word| message.contains(word)), "{name}: {message}");
        assert!(!message.contains("panicked"), "{name}: {message}");
    }
}

fn edit(path: &Path, from: &str, to: &str) {
    edit_file(path, |text| text.replace(from, to));
}

fn edit_file(path: &Path, change: impl Fn(&str) -> String) {
    let text = read(path);
    let changed = change(&text);
    assert_ne!(text, changed, "the edit changes nothing");
    std::fs::write(path, changed).unwrap();
}

#[test]
fn a_configuration_error_names_its_key() {
    let made = Made::new();
    for (setting, words) in [
        ("training.bacth=8", &["bacth"][..]),
        ("training.batch=9", &["systems.0.share", "training.batch ="]),
        ("model.dropout=1.5", &["model.dropout", "1.5"]),
        ("systems.0.share=0.5", &["shares sum to 0.75"]),
        ("data.error_frame=body", &["body", "vehicle"]),
        ("model.width=big", &["width"]),
        ("name=../up", &["name", "folder"]),
        ("depth.source=sonar", &["sonar"]),
        ("systems.1.colour=red", &["colour"]),
        ("systems.0.pth=x", &["pth"]),
        ("nonsense", &["key=value"]),
        ("training.watch_system=radar", &["radar"]),
        ("depth.camera_height_m=-1", &["depth.camera_height_m"]),
        ("training.prefetch=100000000000", &["training.prefetch", "1024"]),
        ("systems.0.name=a,b", &["systems.0.name", "column"]),
        ("systems.7.share=1", &["list of 2"]),
        ("device=flex:", &["flex:"]),
        ("device=tpu", &["tpu", "auto | flex"]),
    ] {
        let output = made.train(&[setting]).assert().code(1).get_output().clone();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(words.iter().all(|word| message.contains(word)), "{setting}: {message}");
    }
    edit(&made.config, "[training]", "[training]\nepcohs = 3");
    made.inspect().assert().code(1).stderr(contains("epcohs").and(contains("line")));
    std::fs::write(&made.config, "name = [").unwrap();
    made.inspect().assert().code(1).stderr(contains("line 1"));
    relcov().args(["inspect", "--config", "no/such.toml"]).assert().code(1).stderr(contains("no/such.toml"));
}

#[test]
fn unknown_instructions_are_named_before_anything_is_read() {
    let made = Made::new();
    for device in ["flex", "auto"] {
        let mut train = made.train(&[]);
        let found = train.args(["--device", device]).env("RELCOV_INSTRUCTIONS", "mmx").assert().code(1);
        found.stderr(contains("RELCOV_INSTRUCTIONS").and(contains("`mmx`")).and(contains("portable")));
    }
}

#[test]
fn an_empty_split_says_what_is_missing() {
    let made = Made::new();
    made.train(&["data.test=[]"]).assert().code(1).stderr(contains("`data.test`: lists no drive"));
    made.train(&["systems.0.path=nowhere/{drive}.txt"])
        .assert()
        .code(1)
        .stderr(contains("nowhere").and(contains("`vo`")));
    made.train(&["depth.source=lidar"]).assert().code(1).stderr(contains("none of the pairs of `vo` has depth"));
}

#[test]
fn a_damaged_run_folder_is_explained() {
    let made = Made::new();
    relcov().args(["eval", "--run", "no/such/run"]).assert().code(1).stderr(contains("no such folder"));
    relcov().arg("eval").arg("--run").arg(made.folder.path()).assert().code(1).stderr(contains("manifest.json"));
    made.train(&["training.epochs=1"]).assert().success();
    let run = made.path("runs/tiny");
    let eval = || {
        let mut command = relcov();
        command.arg("eval").arg("--run").arg(&run);
        command
    };
    made.train(&[]).assert().code(1).stderr(contains("--resume").and(contains("--force")));

    let manifest = run.join("manifest.json");
    let whole = read(&manifest);
    std::fs::write(&manifest, whole.replace("\"error_frame\": \"vehicle\"", "\"error_frame\": \"camera\"")).unwrap();
    eval().assert().code(1).stderr(contains("data.error_frame").and(contains("camera")));
    std::fs::write(&manifest, whole.replace("log(measured * truth^-1), left", "log(truth^-1 * measured), right"))
        .unwrap();
    eval().assert().code(1).stderr(contains("other conventions"));
    std::fs::write(&manifest, whole.replace("\"width\": 32", "\"width\": 64")).unwrap();
    eval().assert().code(1).stderr(contains("model.safetensors").and(contains("64x16")));
    std::fs::write(&manifest, &whole[..whole.len() / 2]).unwrap();
    eval().assert().code(1).stderr(contains("manifest.json"));
    std::fs::write(&manifest, &whole).unwrap();

    let model = run.join("model.safetensors");
    let bytes = std::fs::read(&model).unwrap();
    std::fs::write(&model, &bytes[..bytes.len() / 2]).unwrap();
    eval().assert().code(1).stderr(contains("model.safetensors").and(contains("panicked").not()));
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_stderr_costs_no_run() {
    let made = Made::new();
    let program = assert_cmd::cargo::cargo_bin("relcov");
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut command = std::process::Command::new(program);
    command.arg("train").arg("--config").arg(&made.config).stderr(full).stdout(std::process::Stdio::null());
    assert_eq!(command.status().unwrap().code(), Some(0));
}

#[test]
fn an_unreadable_test_frame_is_left_out_and_counted() {
    let made = Made::new();
    made.train(&["training.epochs=1"]).assert().success();
    std::fs::write(made.drive("image_02/data/0000000023.png"), "no image").unwrap();
    let run = made.path("runs/tiny");
    let eval = |limit: &str| {
        let mut command = relcov();
        command.arg("eval").arg("--run").arg(&run).arg("--set").arg(format!("data.max_bad_fraction={limit}"));
        command
    };
    made.train(&["name=other", "data.test=[]"]).assert().code(1);
    assert!(!made.path("runs/other").exists(), "an empty test split is found before training");
    eval("0.5").assert().success().stderr(contains("0000000023.png")).stdout(contains("2 vo"));
    eval("0.01").assert().code(1).stderr(contains("max_bad_fraction"));
}

#[test]
fn the_real_sample_trains_end_to_end() {
    let Some(root) = shared("kitti") else { return };
    let folder = tempfile::tempdir().unwrap();
    relcov()
        .args(["train", "--config", "configs/kitti_sample.toml", "--device", "flex", "--set", "training.epochs=1"])
        .args(["--set", "training.batches_per_epoch=2", "--set", "model.width=96", "--set", "model.height=32"])
        .arg("--set")
        .arg(format!("data.root={}", root.display()))
        .arg("--set")
        .arg(format!("checkpoints={}", folder.path().display()))
        .assert()
        .success()
        .stdout(contains("9 vo, 9 gnss"));
    relcov()
        .arg("eval")
        .arg("--run")
        .arg(folder.path().join("kitti_sample"))
        .args(["--set", "depth.source=lidar", "--device", if cfg!(feature = "ndarray") { "ndarray" } else { "flex" }])
        .assert()
        .success()
        .stdout(contains("9 vo, 9 gnss"));
}

#[test]
fn the_shipped_configurations_load() {
    let files = ["configs", "configs/ablations"].map(|folder| std::fs::read_dir(folder).unwrap());
    for path in files.into_iter().flatten().map(|entry| entry.unwrap().path()).filter(|path| path.is_file()) {
        relcov::config::Config::load(&path, &[]).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }
}
