//! The shipped ablations, made small: each renders, trains, is judged, and predicts what it was judged by.

use std::path::Path;

use assert_cmd::Command;
use burn::tensor::Tensor;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::config::Config;
use relcov::device::open_device;
use relcov::evaluation::read_pairs;
use relcov::geometry::ErrorFrame;
use relcov::pairs::{Dataset, PairBatch, PairReader, PairScope, SplitName};
use relcov::synthetic::{Replace, SyntheticSettings, record};
use relcov::warp::Warp;
use relcov::{Measurement, Model, RightView};

const NAMES: [&str; 7] =
    ["full_head", "paper_input", "pose_mlp", "raw_pose_mlp", "reference_7", "stereo", "validity_mask"];

/// Those with evidence.
const EVIDENCE_NAMES: [&str; 6] = [
    "evidence_alone",
    "evidence_diagonal",
    "evidence_full",
    "evidence_without_perturbation",
    "evidence_without_truth",
    "evidence_perturbation_alone",
];

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

/// Trains for two mini-batches on three tiny drives.
fn train(name: &str, folder: &Path, first_system: &str) {
    let drive = |number: usize| format!("{{ drive = \"2026_01_01_drive_{number:04}_sync\" }}");
    let config = format!("configs/ablations/{name}.toml");
    let mut command = relcov();
    command.args(["train", "--quiet", "--device", "flex", "--config", &config]);
    for (key, value) in [
        ("data.root", folder.join("street").display().to_string()),
        ("checkpoints", folder.join("runs").display().to_string()),
        ("data.train", format!("[{}]", drive(1))),
        ("data.validation", format!("[{}]", drive(2))),
        ("data.test", format!("[{}]", drive(3))),
        ("data.synthetic.drives", "3".to_owned()),
        ("data.synthetic.frames", "12".to_owned()),
        ("data.synthetic.size", "[32, 16]".to_owned()),
        ("model.width", "32".to_owned()),
        ("model.height", "16".to_owned()),
        ("training.batch", "8".to_owned()),
        ("training.micro_batch", "4".to_owned()),
        ("training.batches_per_epoch", "2".to_owned()),
        ("training.epochs", "1".to_owned()),
    ] {
        command.args(["--set", &format!("{key}={value}")]);
    }
    let row = format!("| {first_system} ");
    command.assert().success().stdout(contains(row).and(contains("| relcov_uncalibrated |")));
}

/// The library's prediction of the first test pair, recalibrated, is the row of pairs.csv.
fn predict_first_pair(run: &Path) {
    let device = open_device("flex").unwrap();
    let config = Config::load(&run.join("config.toml"), &[]).unwrap();
    let dataset = Dataset::load(&config.pairs(), PairScope::Images).unwrap();
    let pair = &dataset.test.pairs_of(0)[0];
    let sample = PairReader::new(&config.pairs(), &dataset, SplitName::Test).read(pair).unwrap().expect("readable");
    let predicted = Model::load(run, &device)
        .unwrap()
        .predict(&Measurement {
            source_image: (*sample.source_image).clone(),
            target_image: (*sample.target_image).clone(),
            target_depth: (*sample.target_depth).clone(),
            camera: sample.camera,
            source_from_target: sample.source_from_target,
            right: sample.right.as_ref().map(|right| RightView {
                source_image: (*right.source_image).clone(),
                target_image: (*right.target_image).clone(),
                right_from_left: right.right_from_left,
            }),
            camera_from_vehicle: None,
        })
        .unwrap();
    let table = read_pairs(&run.join("pairs.csv"), ErrorFrame::Vehicle).unwrap();
    let judged = table.systems[0].rows[0].covariance.unwrap();
    assert_eq!((table.systems[0].rows[0].source, table.systems[0].rows[0].target), (pair.id.source, pair.id.target));
    let off =
        (predicted.matrix() - judged.matrix()).component_div(&(judged.std_devs() * judged.std_devs().transpose()));
    assert!(off.abs().max() < 1e-4, "{}: {off}", run.display());
    let correlated = config.model.head != relcov::network::Head::Diagonal;
    assert_eq!(!judged.is_diagonal(), correlated, "{}", run.display());
}

#[test]
fn every_ablation_trains_and_stands_in_one_table() {
    let folder = tempfile::tempdir().unwrap();
    for name in NAMES {
        train(name, folder.path(), "vo");
        predict_first_pair(&folder.path().join("runs").join(format!("ablation_{name}")));
    }
    let runs = NAMES.map(|name| folder.path().join("runs").join(format!("ablation_{name}")));
    let output = relcov().arg("report").args(&runs).output().unwrap();
    let stdout = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success() && !stdout.contains("WARNING"), "{stdout}");
    let rows = |system: &str, name: &str| {
        let start = format!("| {system:<6} | {name} ");
        stdout.lines().filter(|line| line.starts_with(&start)).count()
    };
    for name in NAMES {
        // System 2 is judged by all of them, by the one that never learned from it too.
        for system in ["vo", "gnss"] {
            assert!(rows(system, &format!("ablation_{name}")) >= 1, "{system} {name}: {stdout}");
        }
    }
    // All were fitted to the same training pairs: each baseline stands once in each of the two tables.
    assert_eq!(stdout.lines().filter(|line| line.starts_with("| vo     | constant  ")).count(), 2, "{stdout}");

    // Without its factors a run predicts what the network puts out.
    let run = &runs[0];
    let factors = std::fs::read_to_string(run.join("recalibration.json")).unwrap();
    let factors: serde_json::Value = serde_json::from_str(&factors).unwrap();
    assert_eq!(factors["split"], "validation");
    assert_eq!(factors["systems"], serde_json::json!(["vo"]));
    std::fs::write(run.join("recalibration.json"), "{\"factors\": [1, 1, 1, 1, 1, 0]}").unwrap();
    relcov().arg("eval").arg("--run").arg(run).assert().code(1).stderr(contains("recalibration.json"));
}

#[test]
fn every_ablation_of_the_evidence_trains_and_predicts() {
    let folder = tempfile::tempdir().unwrap();
    for name in EVIDENCE_NAMES {
        train(name, folder.path(), if name == "evidence_perturbation_alone" { "perturbation" } else { "vo" });
        predict_first_pair(&folder.path().join("runs").join(format!("ablation_{name}")));
    }
}

#[test]
fn all_four_images_show_what_the_left_target_shows() {
    let folder = tempfile::tempdir().unwrap();
    let config = r#"name = "stereo"
[data]
root = "street"
train = [{ drive = "2026_01_01_drive_0001_sync" }]
validation_fraction = 0.0
test = []
[[systems]]
name = "gnss"
share = 1.0
source = "truth"
[depth]
source = "files"
path = "{date}/{drive}/depth_02/data/{frame}.png"
[model]
width = 192
height = 64
stereo = true
"#;
    let path = folder.path().join("config.toml");
    std::fs::write(&path, config).unwrap();
    let settings = SyntheticSettings {
        drives: 1,
        frames: 3,
        size: [192, 64],
        image_noise: 0.0,
        lidar_steps: 0,
        ..Default::default()
    };
    record(&folder.path().join("street"), &settings, Replace::Never, &mut |_| Ok(())).unwrap();
    let config = Config::load(&path, &[]).unwrap();
    let dataset = Dataset::load(&config.pairs(), PairScope::Images).unwrap();
    let reader = PairReader::new(&config.pairs(), &dataset, SplitName::Train);
    let sample = reader.read(&dataset.train.pairs[1]).unwrap().expect("readable");
    let device = open_device("flex").unwrap();
    let pairs = PairBatch::new(&[sample], &device).images.expect("included");
    let right = pairs.right.clone().expect("stereo");
    // Mean difference from the left target where the warp is valid, grey levels.
    let difference = |image: Tensor<4>, pose: Tensor<3>| -> f64 {
        let warped = Warp.forward(image, pairs.target_depth.clone(), pairs.intrinsics.clone(), pose);
        let off = (warped.image - pairs.target_image.clone()).abs() * warped.valid_mask.clone();
        let (sum, pixels): (f32, f32) = (off.sum().into_scalar(), warped.valid_mask.sum().into_scalar());
        f64::from(255.0 * sum / (3.0 * pixels))
    };
    let unmoved = Tensor::<2>::eye(4, &device).unsqueeze::<3>();
    for (name, image, pose) in [
        ("right target", right.target_image, right.target_from_target),
        ("right source", right.source_image, right.source_from_target),
        ("left source", pairs.source_image.clone(), pairs.source_from_target.clone()),
    ] {
        let (warped, unwarped) = (difference(image.clone(), pose), difference(image, unmoved.clone()));
        assert!(warped < 5.0 && warped < 0.5 * unwarped, "{name}: {warped} warped, {unwarped} as it is");
    }
}
