//! What would change nothing, count twice, or destroy what is read is refused, with the word that says what to do.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;

use crate::predict_cli::World;
use crate::support::{DRIVE, write_config, write_drive, write_pairs_csv};

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

fn drive() -> PathBuf {
    World::get().path().join("2020_01_01").join(DRIVE)
}

fn vo() -> PathBuf {
    World::get().path().join("vo/2020_01_01_drive_0001.txt")
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

#[test]
fn options_of_another_road_are_refused() {
    let world = World::get();
    let (drive, vo, manifest) = (text(&drive()), text(&vo()), world.manifest());
    let of_drive = ["--drive", &drive, "--measurements", &vo];
    let pose = "0,0,0,0,0,0,1";
    for arguments in [
        vec!["--manifest", &manifest, "--measurements", &vo],
        vec!["--manifest", &manifest, "--measurement-format", "tum"],
        vec!["--stream", "--measurements", &vo],
        vec!["--stream", "--camera-from-vehicle", pose],
        [&of_drive[..], &["--camera-from-vehicle", pose]].concat(),
    ] {
        world.predict(&arguments).assert().code(2).stderr(contains("cannot be used with"));
    }
    for arguments in [
        vec!["eval", "--run", "r", "--error-frame", "world"],
        vec!["eval", "--pairs", "p.csv", "--error-frame", "vehicle", "--recalibrate"],
        vec!["eval", "--baselines-only", "--config", "c.toml", "--fit", "p.csv", "--error-frame", "world"],
        vec!["fuse", "--run", "r", "--config", "c.toml", "--truth", "t.txt"],
        vec!["fuse", "--run", "r", "--config", "c.toml", "--constant", "vo=1,1,1,1,1,1"],
        vec!["fuse", "--odometry", "vo=vo.csv", "--fixes", "f.csv", "--seed", "9"],
        vec!["depth", "--config", "c.toml", "--compare", "lidar", "--truth", "x.png"],
        vec!["synth", "--out", "o", "--set", "name=x"],
    ] {
        relcov().args(&arguments).assert().code(2).stderr(contains("cannot be used with"));
    }
}

#[test]
fn settings_that_the_data_replace_are_refused() {
    let world = World::get();
    let (drive, vo, manifest) = (text(&drive()), text(&vo()), world.manifest());
    for key in ["data.root=/nowhere", "data.test=[]", "truth.source=manifest", "systems.0.path=x", "name=bla", "seed=7"]
    {
        for road in [vec!["--drive", &drive, "--measurements", &vo], vec!["--manifest", &manifest], vec!["--stream"]] {
            let refused = contains(key.split('=').next().unwrap()).and(contains("changes nothing about"));
            world.predict(&[&road[..], &["--set", key]].concat()).assert().code(1).stderr(refused);
        }
    }
    world.predict(&["--manifest", &manifest, "--set", "depth.camera_height_m=1.5"]).assert().success();
}

#[test]
fn a_configuration_says_nothing_in_vain() {
    let folder = tempfile::tempdir().unwrap();
    write_drive(folder.path(), 24);
    let config = write_config(folder.path(), folder.path());
    let good = std::fs::read_to_string(&config).unwrap();
    for (text, words) in [
        (format!("{good}\n[truth]\nsource = \"oxts\"\npath = \"truth.txt\"\n"), "unknown field `path`"),
        (
            good.replace("vo/{drive}.txt", "vo/{drvie}.txt"),
            "unknown slot `{drvie}`; there are {drive}, {date}, {sequence}",
        ),
        (
            good.replace("vo/{drive}.txt", "vo.txt").replacen(DRIVE, "2020_01_01_drive_0002_sync", 1),
            "is one file for 2 drives; name it by {drive}",
        ),
        (format!("{good}\n[depth]\nsource = \"files\"\npath = \"{{drive}}/0.png\"\n"), "is one map for all frames"),
    ] {
        std::fs::write(&config, text).unwrap();
        relcov().args(["inspect", "--config"]).arg(&config).assert().code(1).stderr(contains(words));
    }
}

#[test]
fn what_is_read_is_never_written_over() {
    let world = World::get();
    let folder = tempfile::tempdir().unwrap();
    let copy = |path: &Path| {
        let to = folder.path().join(path.file_name().unwrap());
        std::fs::copy(path, &to).unwrap();
        text(&to)
    };
    let kept = |path: &str, command: &mut Command| {
        let before = std::fs::read(path).unwrap();
        command
            .assert()
            .code(1)
            .stderr(contains("would be written over what is read").or(contains("must end in .png")));
        assert_eq!(std::fs::read(path).unwrap(), before);
    };
    let (drive, measured, manifest) = (text(&drive()), copy(&vo()), text(&world.path().join("written_over.csv")));
    std::fs::copy(world.manifest(), &manifest).unwrap();
    kept(&measured, &mut world.predict(&["--drive", &drive, "--measurements", &measured, "--out", &measured]));
    kept(&manifest, &mut world.predict(&["--manifest", &manifest, "--out", &manifest]));
    // Below, files are copies: what is not refused is destroyed.
    let own = tempfile::tempdir().unwrap();
    write_drive(own.path(), 6);
    let date = own.path().join("2020_01_01");
    let (own_drive, own_vo) = (date.join(DRIVE), own.path().join("vo/2020_01_01_drive_0001.txt"));
    for file in ["image_02/data/0000000003.png", "oxts/data/0000000000.txt", "../calib_cam_to_cam.txt"] {
        let file = text(&own_drive.join(file));
        kept(
            &file,
            world.predict(&["--drive", &text(&own_drive), "--measurements", &text(&own_vo)]).args(["--out", &file]),
        );
    }
    let model = text(&world.path().join("runs/tiny/manifest.json"));
    kept(&model, &mut world.predict(&["--system", "vo", "--out", &model]));
    let odometry = folder.path().join("vo.csv");
    std::fs::write(&odometry, "0,1,1,0,0,0,0,0,1\n").unwrap();
    let fuse = ["fuse", "--odometry", &format!("vo={}", text(&odometry)), "--constant", "vo=1,1,1,1,1,1", "--out"];
    kept(&text(&odometry), relcov().args(fuse).arg(&odometry));
    let pairs = folder.path().join("mine.csv");
    write_pairs_csv(&pairs, 20, 3);
    let eval = ["eval", "--error-frame", "vehicle", "--pairs"];
    kept(&text(&pairs), relcov().args(eval).arg(&pairs).arg("--save-table").arg(&pairs));
    relcov().args(eval).arg(&pairs).arg("--fit").arg(&pairs).assert().success().stderr(contains("judged on"));
    let run = text(&world.path().join("runs/tiny"));
    kept(&model, relcov().args(["eval", "--run", &run, "--save-results", &model]));
    let config = write_config(folder.path(), world.path());
    kept(&text(&config), relcov().args(["inspect", "--config"]).arg(&config).arg("--contact-sheet").arg(&config));
    let result = text(&world.path().join("runs/tiny/evaluation.json"));
    kept(&result, relcov().arg("report").arg(world.path().join("runs/tiny")).args(["--html", &result]));
    world
        .predict(&["--system", "vo", "--out", &text(&folder.path().join("{sytem}.jsonl"))])
        .assert()
        .code(1)
        .stderr(contains("unknown slot `{sytem}`; there are {system}, {drive}"));
}

#[test]
fn nothing_counts_twice_in_a_fusion() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, content: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        text(&path)
    };
    let row = "0,1,1,0,0,0,0,0,1\n";
    let (vo, wheel) = (write("vo.csv", row), write("wheel.csv", row));
    let world = write("world.csv", &format!("# frame world, perturbation left\n{row}"));
    let fuse = |odometry: &[String]| {
        let mut command = relcov();
        command.arg("fuse");
        odometry.iter().for_each(|system| _ = command.args(["--odometry", system]));
        let names: BTreeSet<&str> = odometry.iter().filter_map(|system| system.split('=').next()).collect();
        names.iter().for_each(|name| _ = command.args(["--constant", &format!("{name}=1,1,1,1,1,1")]));
        command
    };
    fuse(&[format!("vo={vo}"), format!("wheel={wheel}")]).assert().success();
    for (odometry, words) in [
        (vec![format!("vo={vo}"), format!("vo={wheel}")], "is a system that is there already"),
        (vec![format!("vo={vo}"), format!("wheel={vo}")], "is a file that is there already"),
        (vec![format!("vo={world}")], "axes of the world, which turn"),
    ] {
        fuse(&odometry).assert().code(1).stderr(contains(words));
    }
}

#[test]
fn a_manifest_is_about_its_own_images() {
    let world = World::get();
    let folder = tempfile::tempdir().unwrap();
    let root = text(world.path());
    let good =
        std::fs::read_to_string(world.manifest()).unwrap().replace("2020_01_01/", &format!("{root}/2020_01_01/"));
    let path = folder.path().join("pairs.csv");
    let predict = |manifest: String| {
        std::fs::write(&path, manifest).unwrap();
        world.predict(&["--manifest", &text(&path)])
    };
    let elsewhere = good.replace(",60.0,60.0,48.0,24.0,", ",60.0,60.0,480.0,24.0,");
    let outside = contains("found a principal point (480, 24) outside the image of 96x48; expected intrinsics");
    predict(elsewhere).assert().code(1).stderr(outside);
    let mut lines = good.lines().map(str::to_owned);
    let header = lines.next().unwrap() + ",depth\n";
    let rows: String =
        lines.enumerate().map(|(index, row)| format!("{row},{}\n", if index == 0 { "1.png" } else { "" })).collect();
    predict(header.clone() + &rows).assert().code(1).stderr(contains("rows with a depth map and rows without"));
    let rows = rows.replace(",1.png\n", ",nowhere.png\n").replace(",\n", ",nowhere.png\n");
    predict(header + &rows).assert().code(1).stderr(contains("has depth: not found: ").and(contains("nowhere.png")));
}
