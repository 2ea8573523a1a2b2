//! What a new user meets first: the program alone, its version, the doctor, sample configurations, and runs that go to
//! the current folder wherever the configuration lies.

use std::path::Path;

use assert_cmd::Command;
use predicates::prelude::*;
use predicates::str::{contains, is_match};

fn relcov(arguments: &[&str]) -> Command {
    let mut command = Command::cargo_bin("relcov").unwrap();
    command.args(arguments).env_remove("RELCOV_DATA_ROOT").env_remove("RUST_LOG");
    command
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn the_program_alone_shows_the_first_steps() {
    for arguments in [&[][..], &["-v"]] {
        relcov(arguments).assert().code(2).stderr(contains("First steps:").and(contains("relcov doctor")));
    }
}

#[test]
fn the_version_tells_what_is_built_in_and_what_is_here() {
    let version = concat!("relcov ", env!("CARGO_PKG_VERSION"), "\n");
    for flag in ["--version", "-V"] {
        relcov(&[flag])
            .assert()
            .success()
            .stdout(predicates::str::starts_with(version).and(contains("features: flex")))
            .stdout(is_match(r"(?m)^instructions: \w+ \(.*portable\)$").unwrap())
            .stdout(is_match(r"(?m)^devices: flex").unwrap());
    }
    relcov(&["--version", "doctor"]).assert().code(2).stderr(contains("stand alone"));
}

#[test]
fn completions_and_man_pages_know_every_command() {
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        relcov(&["--completions", shell]).assert().success().stdout(contains("train-depth"));
    }
    relcov(&["--completions", "tcsh"]).assert().code(2).stderr(contains("bash"));
    let folder = tempfile::tempdir().unwrap();
    let pages = folder.path().join("man");
    relcov(&["--man-pages", text(&pages)]).assert().success();
    for page in ["relcov.1", "relcov-train.1", "relcov-doctor.1"] {
        assert!(std::fs::read_to_string(pages.join(page)).unwrap().contains(".TH"), "{page}");
    }
}

#[test]
fn the_doctor_finds_nothing_wrong_here() {
    let report = relcov(&["doctor", "--device", "flex"]).assert().success();
    let report = String::from_utf8(report.get_output().stdout.clone()).unwrap();
    for topic in ["instructions", "threads", "memory", "disk", "flex", "kernels", "rendering", "alignment", "training"]
    {
        assert!(report.lines().any(|line| line.split_whitespace().nth(1) == Some(topic)), "{topic}: {report}");
    }
    assert!(report.ends_with("nothing is wrong\n"), "{report}");
}

#[test]
fn the_doctor_names_what_is_wrong_with_its_remedy() {
    relcov(&["doctor"])
        .env("RELCOV_INSTRUCTIONS", "mmx")
        .assert()
        .code(1)
        .stdout(contains("!! instructions").and(contains("remedy: unset RELCOV_INSTRUCTIONS")))
        .stderr(contains("wrong"));
    relcov(&["doctor", "--device", "gpu"])
        .assert()
        .code(1)
        .stdout(contains("!! device").and(contains("remedy: name a --device that is ok above")));
    relcov(&["doctor"])
        .env("TMPDIR", "/nonexistent")
        .assert()
        .code(1)
        .stdout(contains("!! trial").and(contains("remedy: point TMPDIR")));
}

#[test]
fn a_backend_that_is_missing_says_the_command_that_builds_it_in() {
    let missing = relcov::device::BACKENDS.into_iter().filter(|(_, built_in)| !built_in).map(|(name, _)| name);
    for name in missing {
        relcov(&["train", "--config", "configs/kitti_sample.toml", "--device", name])
            .assert()
            .code(1)
            .stderr(contains(format!("cargo build --release --features {name} ")));
    }
}

#[test]
fn sample_configurations_are_written_once_and_never_over_others() {
    let folder = tempfile::tempdir().unwrap();
    let (street, config) = (folder.path().join("a/street"), folder.path().join("a/street/configs/synthetic.toml"));
    relcov(&["init", text(&street)]).assert().success().stdout(contains("synthetic.toml"));
    assert_eq!(std::fs::read(&config).unwrap(), std::fs::read("configs/synthetic.toml").unwrap());
    relcov(&["init", text(&street)]).assert().success();

    // One was edited, another is gone.
    std::fs::write(&config, "mine").unwrap();
    std::fs::remove_file(street.join("configs/kitti.toml")).unwrap();
    relcov(&["init", text(&street)]).assert().code(1).stderr(contains("synthetic.toml").and(contains("--force")));
    assert!(!street.join("configs/kitti.toml").exists(), "all or nothing");
    assert_eq!(std::fs::read(&config).unwrap(), b"mine");
    relcov(&["init", text(&street), "--force"]).assert().success();
    assert!(street.join("configs/kitti.toml").exists());
    assert_ne!(std::fs::read(&config).unwrap(), b"mine");

    // A folder where a file belongs is found before anything is written.
    let blocked = folder.path().join("blocked");
    std::fs::create_dir_all(blocked.join("configs/kitti.toml")).unwrap();
    relcov(&["init", text(&blocked)]).assert().code(1).stderr(contains("kitti.toml"));
    assert!(!blocked.join("configs/synthetic.toml").exists());
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    relcov(&["init", text(&file)]).assert().code(1).stderr(contains("file"));
}

/// The program installed, configurations in one folder, the user in another.
#[test]
fn data_lie_beside_the_configuration_and_runs_in_the_current_folder() {
    let folder = tempfile::tempdir().unwrap();
    let [samples, here, elsewhere] = ["samples", "here", "elsewhere"].map(|name| folder.path().join(name));
    [&here, &elsewhere].into_iter().for_each(|folder| std::fs::create_dir(folder).unwrap());
    relcov(&["init", text(&samples)]).assert().success();
    let small = [
        "data.synthetic.frames=12",
        "data.synthetic.size=[32, 16]",
        "model.width=32",
        "model.height=16",
        "training.epochs=2",
        "training.evidence_epochs=1",
        "training.batches_per_epoch=1",
    ];
    let mut train = relcov(&["train", "--config", "../samples/configs/synthetic.toml", "--device", "flex"]);
    small.iter().for_each(|setting| {
        train.args(["--set", setting]);
    });
    train.current_dir(&here).assert().success();
    assert!(samples.join("data/synthetic").is_dir(), "rendered beside the configuration");
    assert!(here.join("checkpoints/synthetic/model.safetensors").is_file(), "a run of whoever is here");
    assert!(!samples.join("checkpoints").exists());
    // A run knows where its data are, from wherever it is looked at.
    relcov(&["eval", "--run", "../here/checkpoints/synthetic"]).current_dir(&elsewhere).assert().success();
    relcov(&["train", "--resume", "../here/checkpoints/synthetic", "--set", "training.epochs=3"])
        .current_dir(&elsewhere)
        .assert()
        .success();
    assert_eq!(std::fs::read_dir(&elsewhere).unwrap().count(), 0, "nothing is left where nothing was asked for");
}
