//! The synthetic world as a user meets it: `relcov synth`, configurations that render their own data,
//! contact sheets.

use std::path::{Path, PathBuf};
use std::time::Duration;

use assert_cmd::Command;
use predicates::prelude::*;
use predicates::str::contains;

fn relcov(arguments: &[&str]) -> Command {
    let mut command = Command::cargo_bin("relcov").unwrap();
    command.env_remove("RELCOV_DATA_ROOT").env_remove("RUST_LOG").timeout(Duration::from_secs(600));
    command.args(arguments);
    command
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

const TINY: [&str; 10] =
    ["--drives", "1", "--frames", "3", "--size", "32x16", "--lidar-steps", "8", "--vo-landmarks", "20"];

#[test]
fn synth_renders_continues_and_refuses_to_overwrite() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("street");
    let synth = |more: &[&str]| {
        let mut command = relcov(&["synth", "--out", text(&out)]);
        command.args(TINY).args(more);
        command
    };
    synth(&[]).assert().success().stdout(contains("street")).stderr(contains("3 frames (1 x 3), 32x16"));
    synth(&[]).assert().success().stderr(contains("made").not());
    synth(&["--seed", "3"]).assert().code(1).stderr(contains("seed = 0 there, 3 wanted").and(contains("--force")));
    let first_image = out.join("2026_01_01/2026_01_01_drive_0001_sync/image_02/data/0000000000.png");
    let before = std::fs::read(&first_image).unwrap();
    synth(&["--seed", "3", "--force"]).assert().success().stderr(contains("made"));
    assert_ne!(before, std::fs::read(&first_image).unwrap());
    synth(&["--image-noise", "-1"]).assert().code(2);
    synth(&["--image-noise=-1", "--force"])
        .assert()
        .code(1)
        .stderr(contains("image_noise").and(contains("between 0 and 64")));
    relcov(&["synth", "--out", text(&out), "--size", "512"]).assert().code(2).stderr(contains("512x160"));
    std::fs::write(folder.path().join("file"), "").unwrap();
    relcov(&["synth", "--out", text(&folder.path().join("file/below"))]).assert().code(1).stderr(contains("below"));
}

/// A configuration that renders its own data, small enough to train in seconds.
fn write_config(folder: &Path) -> PathBuf {
    let drive = |number: usize| format!("{{ drive = \"2026_01_01_drive_{number:04}_sync\" }}");
    let (train, validation, test) = (drive(1), drive(2), drive(3));
    let system = |name: &str, frame: &str| {
        format!(
            "[[systems]]\nname = \"{name}\"\nshare = 0.25\nsource = \"relative\"\npath = \"measurements/{name}/{{drive}}.csv\"\nframe = \"{frame}\"\n"
        )
    };
    let (vo, wheel, icp) = (system("vo", "camera2"), system("wheel", "vehicle"), system("icp", "vehicle"));
    let config = format!(
        r#"name = "tiny"
checkpoints = "runs"
device = "flex"
[data]
root = "street"
train = [{train}]
validation = [{validation}]
test = [{test}]
[data.synthetic]
drives = 3
frames = 12
size = [32, 16]
lidar_steps = 0
{vo}{wheel}{icp}
[[systems]]
name = "gnss"
share = 0.25
source = "truth"
[depth]
source = "files"
path = "{{date}}/{{drive}}/depth_02/data/{{frame}}.png"
[model]
width = 32
height = 16
[training]
batch = 8
micro_batch = 8
epochs = 2
batches_per_epoch = 2
schedule = "cosine"
"#
    );
    let path = folder.join("config.toml");
    std::fs::write(&path, config).unwrap();
    path
}

#[test]
fn training_renders_its_data_and_judges_by_the_true_covariances() {
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    let elsewhere = folder.path().join("recorded");
    // The variable points at recorded data, among which nothing is rendered.
    let output =
        relcov(&["train", "--full", "--config", text(&config)]).env("RELCOV_DATA_ROOT", &elsewhere).output().unwrap();
    let (stdout, stderr) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(output.status.success(), "{stderr}");
    assert!(stderr.contains("made a synthetic data set") && !elsewhere.exists(), "{stderr}");
    for method in ["relcov", "zero", "constant", "log_linear", "oracle", "oracle_diagonal"] {
        let rows = stdout.lines().filter(|line| line.starts_with("| vo ") && line.contains(&format!(" {method} ")));
        assert!(rows.count() >= 1, "{method}: {stdout}");
    }
    assert!(
        stdout.contains("against the true covariance") && stdout.contains("AUROC") && stdout.contains("injected pose"),
        "{stdout}"
    );

    let json = std::fs::read_to_string(folder.path().join("runs/tiny/evaluation.json")).unwrap();
    let evaluation: serde_json::Value = serde_json::from_str(&json).unwrap();
    let vo = &evaluation["systems"]["vo"]["methods"];
    // Eleven pairs with their true covariance: calibrated within wide limits.
    let anees = vo["oracle"]["anees"].as_f64().unwrap();
    assert!((0.4..1.9).contains(&anees), "{anees}");
    assert!(vo["relcov"]["against_true"]["median_sigma_ratio"][0].as_f64().unwrap() > 0.0);
    assert!(vo["constant"]["against_true"]["log_sigma_correlation"][0].is_null());
    assert_eq!(evaluation["separation"]["systems"][1], "gnss");
    assert!(evaluation["separation"]["auroc"].is_number());
    assert!(evaluation["perturbation_response"]["spearman"].is_number());
    assert!(evaluation["systems"]["gnss"]["methods"]["oracle"].is_null());

    // The data are there now, and must be what the configuration asks for.
    relcov(&["inspect", "--config", text(&config)]).assert().success().stderr(contains("rendering").not());
    relcov(&["inspect", "--config", text(&config), "--set", "data.synthetic.seed=4"])
        .assert()
        .code(1)
        .stderr(contains("relcov synth --config"));
    relcov(&["train", "--config", text(&config), "--set", "data.synthetic.seed=4", "--set", "name=other"])
        .assert()
        .code(1)
        .stderr(contains("data.root").and(contains("seed = 0 there, 4 wanted")));
}

#[test]
fn a_contact_sheet_shows_every_system_of_a_few_pairs() {
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    let sheet = folder.path().join("sheet.png");
    let inspect = ["inspect", "--config", text(&config)];
    relcov(&inspect).assert().code(1).stderr(contains("not rendered yet").and(contains("relcov synth --config")));
    relcov(&["synth", "--config", text(&config)]).assert().success();
    relcov(&["inspect", "--config", text(&config), "--contact-sheet", text(&sheet), "--pairs", "2"])
        .assert()
        .success()
        .stdout(contains("columns: source | target").and(contains("row 8:")).and(contains("row 9:").not()));
    let picture = image::open(&sheet).unwrap();
    // Six pictures of 32x16, enlarged eight times, and the gaps between them.
    assert_eq!((picture.width(), picture.height()), (6 * 260 + 4, 8 * 132 + 4));
    relcov(&["inspect", "--config", text(&config), "--contact-sheet", "no/such/folder/sheet.png"])
        .assert()
        .code(1)
        .stderr(contains("no/such/folder"));
}
