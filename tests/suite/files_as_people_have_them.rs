//! Times, names, links and folders that people reported with other tools, and what is right of each.
#![cfg(unix)]

use std::ffi::OsStr;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::recordings::load_kitti_raw;
use serde_json::Value;

use crate::predict_cli::World;
use crate::support::{DRIVE, write_config, write_drive};

/// EuRoC's stamps: a double of seconds is off by up to 119 ns.
const STAMPS: [i64; 3] = [1_403_636_579_763_555_584, 1_403_636_579_813_555_456, 1_403_636_579_863_555_584];

fn seconds(stamp: i64) -> String {
    format!("{}.{:09}", stamp / 1_000_000_000, stamp % 1_000_000_000)
}

/// A copy of the made drive below a folder, and its measurements.
fn drive_below(root: &Path) -> (PathBuf, PathBuf) {
    write_drive(root, 24);
    (root.join("2020_01_01").join(DRIVE), root.join("vo/2020_01_01_drive_0001.txt"))
}

fn predict_drive(drive: &Path, measurements: &Path, more: &[&str]) -> Command {
    let mut command = World::get().predict(&["--drive"]);
    command.arg(drive).arg("--measurements").arg(measurements).args(more);
    command
}

fn stdout(mut command: Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Stamps of ROS messages, nanoseconds.
fn ros_stamps(text: &str) -> Vec<i64> {
    let stamp = |line: &str| {
        let message: Value = serde_json::from_str(line).unwrap();
        let part = |name: &str| message["header"]["stamp"][name].as_i64().unwrap();
        part("sec") * 1_000_000_000 + part("nanosec")
    };
    text.lines().map(stamp).collect()
}

#[test]
fn a_stamp_is_the_images_own_to_the_nanosecond() {
    let folder = tempfile::tempdir().unwrap();
    let (drive, vo) = drive_below(folder.path());
    let times: String = STAMPS.map(|stamp| seconds(stamp) + "\n").concat();
    std::fs::write(drive.join("image_02/timestamps.txt"), times).unwrap();
    let first_two: String =
        std::fs::read_to_string(&vo).unwrap().lines().take(3).map(|row| format!("{row}\n")).collect();
    let framed: String = first_two.lines().enumerate().map(|(frame, row)| format!("{frame} {row}\n")).collect();
    std::fs::write(&vo, framed).unwrap();
    assert_eq!(ros_stamps(&stdout(predict_drive(&drive, &vo, &["--format", "ros"]))), STAMPS[1..]);
    let tum = stdout(predict_drive(&drive, &vo, &["--format", "tum", "--covariance", "none"]));
    let rows: Vec<&str> = tum.lines().skip(1).map(|row| row.split(' ').next().unwrap()).collect();
    assert_eq!(rows, STAMPS.map(seconds));
    let line = stdout(predict_drive(&drive, &vo, &[]));
    assert!(line.contains(&format!("\"times_ns\":[{},{}]", STAMPS[0], STAMPS[1])), "{line}");
    // What was written is read again, each row the pose of its own frame.
    let back = folder.path().join("back.TUM");
    std::fs::write(&back, tum).unwrap();
    let vehicle = ["--measurement-frame", "vehicle"];
    assert_eq!(stdout(predict_drive(&drive, &back, &vehicle)).lines().count(), 2);
    // Its axes are those that its first line states.
    let other = contains("line 1: found motions in axes `vehicle`; expected those of `camera0`");
    predict_drive(&drive, &back, &[]).assert().code(1).stderr(other);
}

#[test]
fn the_times_of_a_manifest_reach_ros_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(World::get().manifest()).unwrap();
    let root = World::get().path().display();
    let mut lines = text.lines().map(|line| line.replace("2020_01_01/", &format!("{root}/2020_01_01/")));
    let header = lines.next().unwrap() + ",source_time,target_time\n";
    let rows: String = lines
        .take(2)
        .zip(STAMPS.windows(2))
        .map(|(row, pair)| format!("{row},{},{}\n", seconds(pair[0]), seconds(pair[1])))
        .collect();
    let path = folder.path().join("pairs.csv");
    std::fs::write(&path, header + &rows).unwrap();
    let manifest = path.display().to_string();
    assert_eq!(ros_stamps(&stdout(World::get().predict(&["--manifest", &manifest, "--format", "ros"]))), STAMPS[1..]);
}

#[test]
fn times_that_a_drive_does_not_have_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let (drive, vo) = drive_below(folder.path());
    let tum = folder.path().join("vo.tum");
    std::fs::write(&tum, "1317386459.4 0 0 0 0 0 0 1\n1317386459.5 0 0 1 0 0 0 1\n").unwrap();
    let unknown = || contains("the times of its frames are not known").and(contains("image_02/timestamps.txt"));
    predict_drive(&drive, &tum, &[]).assert().code(1).stderr(unknown());
    let warned = contains("23 of 23 motions have no times (image_02/timestamps.txt").and(contains("stamps are 0"));
    predict_drive(&drive, &vo, &["--format", "ros"]).assert().success().stderr(warned);
    // Those of the ISO are read.
    let iso = "2011-09-30T12:40:59.400000001Z\n2011-09-30T14:40:59.500000001+02:00\n2011-09-30 12:40:59.6\nyesterday\n";
    let whole = iso.to_owned() + &"\n".repeat(19) + "tomorrow\n";
    std::fs::write(drive.join("image_02/timestamps.txt"), whole).unwrap();
    let known = load_kitti_raw(folder.path(), DRIVE).unwrap();
    let times: Vec<i64> = known.times.values().map(|time| time.nanoseconds()).collect();
    assert_eq!(times, [1_317_386_459_400_000_001, 1_317_386_459_500_000_001, 1_317_386_459_600_000_000]);
    let unreadable = contains("2 problems with its times; the first: ")
        .and(contains("line 4: found `yesterday`; expected a time like 2011-09-30 12:40:59.409"));
    predict_drive(&drive, &tum, &[]).assert().success().stderr(unreadable);
    // Some motions have times now, and the others none.
    let some = contains("21 of 23 motions have no times").and(contains("their stamps are 0"));
    predict_drive(&drive, &vo, &["--format", "ros"]).assert().success().stderr(some);
    let refused = contains("frame 3 has no time, and others have");
    predict_drive(&drive, &vo, &["--format", "tum"]).assert().code(1).stderr(refused);
}

#[test]
fn a_cut_drive_has_the_times_of_its_own_frames() {
    let folder = tempfile::tempdir().unwrap();
    let (drive, vo) = drive_below(folder.path());
    for (sensor, extension) in [("image_02", "png"), ("oxts", "txt")] {
        for frame in (0..10).chain(20..24) {
            std::fs::remove_file(drive.join(format!("{sensor}/data/{frame:010}.{extension}"))).unwrap();
        }
    }
    let times: String = (0..10).map(|k| seconds(STAMPS[0] + k * 100_000_000) + "\n").collect();
    std::fs::write(drive.join("image_02/timestamps.txt"), times).unwrap();
    let stamps = |vo: &Path| ros_stamps(&stdout(predict_drive(&drive, vo, &["--format", "ros"])));
    let expected: Vec<i64> = (1..10).map(|k| STAMPS[0] + k * 100_000_000).collect();
    // Ten rows are those ten frames; with their frames before them they are as well.
    let rows: Vec<String> =
        std::fs::read_to_string(&vo).unwrap().lines().skip(10).take(10).map(str::to_owned).collect();
    std::fs::write(&vo, rows.join("\n")).unwrap();
    assert_eq!(stamps(&vo), expected);
    let framed: Vec<String> = rows.iter().zip(10..).map(|(row, frame)| format!("{frame} {row}")).collect();
    std::fs::write(&vo, framed.join("\n")).unwrap();
    assert_eq!(stamps(&vo), expected);
}

#[test]
fn a_link_and_capital_letters_have_their_own_names() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    std::fs::create_dir(&store).unwrap();
    let (drive, _) = drive_below(folder.path());
    // As DVC and git-annex keep files: under their hashes.
    let hash = store.join("MD5-s120--d41d8cd98f00b204");
    std::fs::write(&hash, "source,target,x,y,z,qx,qy,qz,qw\n0,1,0,0,1,0,0,0,1\n").unwrap();
    let linked = folder.path().join("vo.csv");
    symlink(&hash, &linked).unwrap();
    let line = stdout(predict_drive(&drive, &linked, &[]));
    assert!(line.starts_with("{\"system\":\"vo\","), "{line}");
    let capital = folder.path().join("VO.CSV");
    std::fs::copy(&hash, &capital).unwrap();
    assert!(stdout(predict_drive(&drive, &capital, &[])).starts_with("{\"system\":\"VO\","));
    // The drive's folder lies in the store, its date folder does not.
    std::fs::rename(&drive, store.join("annexed")).unwrap();
    symlink(store.join("annexed"), &drive).unwrap();
    assert!(stdout(predict_drive(&drive, &linked, &[])).contains(DRIVE));
    // A link of another name leads to the drive.
    let shortcut = folder.path().join("today");
    symlink(folder.path().join("2020_01_01"), folder.path().join("date")).unwrap();
    std::fs::remove_file(&drive).unwrap();
    std::fs::rename(store.join("annexed"), &drive).unwrap();
    symlink(&drive, &shortcut).unwrap();
    assert!(stdout(predict_drive(&shortcut, &linked, &[])).contains(DRIVE));
    predict_drive(&store, &linked, &[]).assert().code(1).stderr(contains("expected ROOT/DATE/DRIVE of KITTI raw"));
}

#[test]
fn a_path_that_is_no_utf8_is_that_path() {
    let folder = tempfile::tempdir().unwrap();
    let (drive, vo) = drive_below(folder.path());
    let strange = folder.path().join(OsStr::from_bytes(b"d\xe9p\xf4t"));
    std::fs::create_dir(&strange).unwrap();
    let measurements = strange.join("vo.txt");
    std::fs::copy(&vo, &measurements).unwrap();
    let mut command = predict_drive(&drive, &measurements, &["--format", "csv", "--out"]);
    command.arg(strange.join("{system}.csv")).assert().success();
    assert!(strange.join("vo.csv").is_file());
    let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names.len(), 3, "{names:?}");
    // Configurations hold text.
    let config = write_config(&strange, folder.path());
    let mut inspect = Command::cargo_bin("relcov").unwrap();
    inspect.args(["inspect", "--config"]).arg(config).assert().code(1).stderr(contains("the path is no UTF-8"));
}

#[test]
fn a_run_can_be_read_by_others_and_a_killed_save_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    write_drive(folder.path(), 24);
    let config = write_config(folder.path(), folder.path());
    let train = |more: &[&OsStr]| {
        let mut command = Command::cargo_bin("relcov").unwrap();
        command.args(["train", "--quiet"]).args(more);
        command
    };
    train(&[OsStr::new("--config"), config.as_os_str()]).assert().success();
    let run = folder.path().join("runs/tiny");
    std::fs::write(folder.path().join("plain"), "").unwrap();
    let mode = |path: &Path| path.metadata().unwrap().permissions().mode() & 0o777;
    let umask = mode(&folder.path().join("plain"));
    let mut files = vec![run.clone()];
    let mut seen = 0;
    while let Some(path) = files.pop() {
        if path.is_dir() {
            files.extend(std::fs::read_dir(path).unwrap().map(|entry| entry.unwrap().path()));
        } else {
            assert_eq!(mode(&path), umask, "{}", path.display());
            seen += 1;
        }
    }
    assert!(seen > 8, "{seen} files");

    let left = [".model.safetensors.partial.x1Y2z3.tmp", ".tmpAbCdEf", ".evaluation.json.Q1w2E3.partial"];
    let leave = || {
        left.iter().for_each(|name| std::fs::write(run.join(name), "half").unwrap());
        std::fs::create_dir(run.join(".state-000000009-00009.partial")).unwrap();
    };
    let is_clean = || {
        std::fs::read_dir(&run).unwrap().all(|entry| {
            let name = entry.unwrap().file_name().into_string().unwrap();
            !name.starts_with(".tmp") && !name.contains(".partial")
        })
    };
    let resume = [OsStr::new("--resume"), run.as_os_str(), OsStr::new("--set"), OsStr::new("training.epochs=3")];
    leave();
    train(&resume).assert().success();
    assert!(is_clean());
    // Whoever reads it removes what is old: somebody may be at work on the rest.
    let eval = || Command::cargo_bin("relcov").unwrap().args(["eval", "--quiet", "--run"]).arg(&run).assert().success();
    leave();
    eval();
    assert!(!is_clean());
    let long_ago = std::time::SystemTime::now() - std::time::Duration::from_secs(3600);
    for name in left {
        std::fs::File::options().write(true).open(run.join(name)).unwrap().set_modified(long_ago).unwrap();
    }
    std::fs::remove_dir(run.join(".state-000000009-00009.partial")).unwrap();
    eval();
    assert!(is_clean());
    let training = relcov::training::RunFolder::at(&run).owned().unwrap();
    train(&resume).assert().code(1).stderr(contains("is being trained already"));
    drop(training);
    train(&resume).assert().success();
}
