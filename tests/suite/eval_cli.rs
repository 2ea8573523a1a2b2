//! `relcov eval` and `relcov report` on files of predictions: scores, forms of tables, figures, refusals.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
use predicates::str::contains;
use relcov::alignment::NoVerdict;
use relcov::evaluation::{read_pairs, write_pairs};
use relcov::geometry::{ErrorFrame, Posterior, Tangent};
use serde_json::Value;

use crate::support::{shared, write_pairs_csv};

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

/// Judges a made file and keeps the result.
fn judge(folder: &Path, name: &str, seed: u64, frame: &str) -> PathBuf {
    let pairs = folder.join(format!("{name}_pairs.csv"));
    write_pairs_csv(&pairs, 300, seed);
    let result = folder.join(format!("{name}.json"));
    relcov()
        .args(["eval", "--error-frame", frame, "--pairs"])
        .arg(&pairs)
        .arg("--save-results")
        .arg(&result)
        .assert()
        .success();
    result
}

fn read(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn baselines_alone_reach_the_bars_on_drive_0034() {
    // FIELD.md's bars: fitted on the drives that libviso2 measured, judged on 0034; no image is read.
    let Some(kitti) = shared("kitti") else { return };
    let folder = tempfile::tempdir().unwrap();
    let result = folder.path().join("baselines.json");
    relcov()
        .args(["eval", "--baselines-only", "--config", "configs/kitti.toml", "--set"])
        .arg(format!("data.root={}", kitti.display()))
        .arg("--save-results")
        .arg(&result)
        .assert()
        .success()
        .stdout(contains("pairs: 1200 vo, 1223 gnss"));
    let methods = &read(&result)["systems"]["vo"]["methods"];
    for (method, nll, anees) in
        [("constant", -25.472, 0.867), ("constant_mad", -24.721, 1.842), ("log_linear", -26.283, 0.888)]
    {
        let found = |score: &str| methods[method][score].as_f64().unwrap();
        assert!((found("nll") - nll).abs() < 0.03, "{method}: NLL {} against {nll}", found("nll"));
        assert!((found("anees") - anees).abs() < 0.01, "{method}: ANEES {} against {anees}", found("anees"));
        let interval = &methods[method]["anees_interval"];
        let [low, high] = [0, 1].map(|side| interval[side].as_f64().unwrap());
        // Errors of neighbouring frames are correlated: far wider than the 5 % of 1,200 independent pairs.
        assert!(low < found("anees") && found("anees") < high && high - low > 0.1, "{low} {high}");
    }
    assert!(methods["log_linear"]["spearman"][0].as_f64().unwrap() > 0.6);
    assert!(methods["constant"]["spearman"][0].is_null() && methods["zero"]["nll"].is_null());
}

#[test]
fn a_result_is_the_same_every_time() {
    let folder = tempfile::tempdir().unwrap();
    let texts = ["a", "b"].map(|name| {
        let path = judge(folder.path(), name, 1, "vehicle");
        std::fs::read_to_string(path).unwrap().replace("b_pairs", "a_pairs")
    });
    assert_eq!(texts[0], texts[1]);
    let evaluation: Value = serde_json::from_str(&texts[0]).unwrap();
    assert_eq!(evaluation["error_frame"], "vehicle");
    assert_eq!(evaluation["units"][3], "rad");
    assert_eq!(evaluation["systems"]["vo"]["bootstrap"]["seed"], 0);
}

#[test]
fn tables_and_figures_are_written_in_every_form() {
    let folder = tempfile::tempdir().unwrap();
    let result = judge(folder.path(), "mine", 1, "vehicle");
    for (name, expected) in [
        ("table.txt", "| vo     | mine_pairs |"),
        ("table.md", "MDE = median sqrt"),
        ("table.csv", "system,method,run,split,error_frame,pairs,nll [nats]"),
        ("table.tex", "vo & MDE x [m] & "),
    ] {
        let table = folder.path().join("tables").join(name);
        relcov().arg("report").arg(&result).arg("--save-table").arg(&table).assert().success();
        let text = std::fs::read_to_string(&table).unwrap();
        assert!(text.contains(expected), "{name}: {text}");
    }
    let figures = folder.path().join("figures");
    relcov().arg("report").arg(&result).arg("--save-plot").arg(&figures).assert().success();
    for name in [
        "sequence",
        "dispersion_vo",
        "reliability_vo",
        "conditional_vo",
        "coverage_vo",
        "sparsification_vo",
        "nees_vo",
        "speed_vo",
    ] {
        let svg = std::fs::read_to_string(figures.join(format!("{name}.svg"))).unwrap();
        assert!(
            svg.contains("<text")
                && (svg.contains("[m]") || ["nees_vo", "coverage_vo", "sparsification_vo"].contains(&name)),
            "{name}"
        );
        let picture = image::open(figures.join(format!("{name}.png"))).unwrap().into_rgb8();
        let coloured = picture.pixels().filter(|pixel| pixel.0.iter().any(|&level| level < 160)).count();
        assert!(coloured > 2_000, "{name}: {coloured} dark pixels");
    }
    relcov()
        .arg("report")
        .arg(&result)
        .args(["--save-table", "table.doc"])
        .assert()
        .failure()
        .stderr(contains("must end in .txt, .md, .csv or .tex"));
}

#[test]
fn intervals_come_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let result = judge(folder.path(), "mine", 1, "vehicle");
    let stdout = |arguments: &[&str]| {
        let output = relcov().arg("report").arg(&result).args(arguments).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    let intervals = |text: String| -> Vec<usize> {
        text.lines().filter(|line| line.starts_with("| vo ")).map(|line| line.matches('[').count()).collect()
    };
    // Predictions in the first table, predictions and a variance of zero in that of MDE.
    assert_eq!(intervals(stdout(&[])), [0, 0, 0]);
    assert_eq!(intervals(stdout(&["--intervals"])), [2, 8, 6], "NLL and ANEES; six MDE with them, and without");
}

#[test]
fn all_tables_come_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let result = judge(folder.path(), "mine", 1, "vehicle");
    let report = |arguments: &[&str]| relcov().arg("report").arg(&result).args(arguments).assert().success();
    report(&[]).stdout(contains("sees this error?").and(contains("CRPS (proper").not()).and(contains("--full.")));
    report(&["--full"]).stdout(
        contains("sees this error?")
            .and(contains("CRPS (proper"))
            .and(contains("conditional calibration"))
            .and(contains("--full").not()),
    );
}

#[test]
fn corrected_measurements_are_judged_beside_the_measurements() {
    let folder = tempfile::tempdir().unwrap();
    let pairs = folder.path().join("seen.csv");
    write_pairs_csv(&pairs, 300, 1);
    // A model that sees nine tenths of each error, but for two images.
    let mut table = read_pairs(&pairs, ErrorFrame::Vehicle).unwrap();
    for row in &mut table.systems[0].rows {
        let covariance = row.covariance.unwrap().scaled(&[0.01; 6]);
        let posterior = Posterior { mean: 0.9 * Tangent::from(row.error), covariance };
        (row.covariance, row.posterior) = (Some(posterior.second_moment()), Some(posterior));
    }
    for row in &mut table.systems[0].rows[4..6] {
        (row.posterior, row.no_verdict) = (None, Some(NoVerdict::NoTexture));
    }
    write_pairs(&pairs, &table).unwrap();
    let result = folder.path().join("results/seen.json");
    relcov()
        .args(["eval", "--error-frame", "vehicle", "--pairs"])
        .arg(&pairs)
        .arg("--save-results")
        .arg(&result)
        .assert()
        .success()
        .stdout(
            contains("| vo     | seen_corrected |")
                .and(contains("| left of RMS xyz |"))
                .and(contains("no verdict from the images: 2 of 300 vo pairs (no_texture 2)")),
        );
    let methods = &read(&result)["systems"]["vo"]["methods"];
    let left = &methods["seen_corrected"]["rms_ratio"];
    for part in [&left["translation"], &left["rotation"], &left["components"][4]] {
        assert!((0.09..0.25).contains(&part.as_f64().unwrap()), "{left}");
    }
    assert!(methods["seen"]["rms_ratio"].is_null());
    // To be right about what is left says more than to be right about all of it.
    let nll = |method: &str| methods[method]["nll"].as_f64().unwrap();
    assert!(nll("seen_corrected") < nll("seen"), "{} {}", nll("seen_corrected"), nll("seen"));
    // The measurements beside the result give the same covariances again.
    let figures = folder.path().join("figures");
    relcov().arg("report").arg(&result).arg("--save-plot").arg(&figures).assert().success();
    let svg = std::fs::read_to_string(figures.join("conditional_vo.svg")).unwrap();
    assert!(svg.contains("seen_corrected") && svg.contains("geometric mean σ of all"), "{svg}");
}

#[test]
fn bad_predictions_are_named_and_never_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pairs.csv");
    write_pairs_csv(&path, 20, 3);
    let good = std::fs::read_to_string(&path).unwrap();
    let header: Vec<&str> = good.lines().next().unwrap().split(',').collect();
    let column = header.iter().position(|name| *name == "variance_pitch").unwrap();
    for (value, found) in [
        ("NaN", "`variance_pitch` = `NaN`"),
        ("0", "`variance_pitch` = `0`"),
        ("-1e-4", "`variance_pitch` = `-1e-4`"),
        ("", "nothing in column `variance_pitch`"),
    ] {
        let broken: Vec<String> = good
            .lines()
            .enumerate()
            .map(|(index, line)| {
                let mut cells: Vec<&str> = line.split(',').collect();
                if index == 7 {
                    cells[column] = value;
                }
                cells.join(",")
            })
            .collect();
        std::fs::write(&path, broken.join("\n")).unwrap();
        relcov()
            .args(["eval", "--error-frame", "vehicle", "--pairs"])
            .arg(&path)
            .assert()
            .code(1)
            .stderr(contains("line 8").and(contains(found)));
    }
    relcov().args(["eval", "--pairs"]).arg(&path).assert().code(2).stderr(contains("--error-frame"));
    relcov().arg("eval").assert().code(2).stderr(contains("--run"));
}

#[test]
fn options_without_effect_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let pairs = folder.path().join("pairs.csv");
    write_pairs_csv(&pairs, 20, 3);
    let eval = |arguments: &[&str]| {
        let mut command = relcov();
        command.args(["eval", "--error-frame", "vehicle", "--pairs"]).arg(&pairs).args(arguments);
        command.current_dir(folder.path()).assert().code(1)
    };
    eval(&["--set", "model.width=3"]).stderr(contains("change nothing about --pairs"));
    eval(&["--save-table", "a.csv", "--save-results", "a.json"]).stderr(contains("name the table otherwise"));
    eval(&["--save-results", "a.txt"]).stderr(contains("must end in .json"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is written");
    relcov()
        .args(["eval", "--run", "nowhere", "--set", "model.width=3"])
        .assert()
        .code(1)
        .stderr(contains("a trained model keeps its shape"));
    // Errors alone are nothing to judge.
    let text = std::fs::read_to_string(&pairs).unwrap();
    let bare: Vec<String> = text.lines().map(|line| line.rsplitn(7, ',').last().unwrap().to_owned()).collect();
    std::fs::write(&pairs, bare.join("\n")).unwrap();
    eval(&[]).stderr(contains("no predicted variances"));
}

#[test]
fn what_does_not_compare_is_refused_or_pointed_out() {
    let folder = tempfile::tempdir().unwrap();
    let first = judge(folder.path(), "first", 1, "vehicle");
    let camera = judge(folder.path(), "camera", 1, "camera");
    relcov()
        .arg("report")
        .args([&first, &camera])
        .assert()
        .code(1)
        .stderr(contains("`first` is in vehicle axes and `camera` in camera axes"));

    // A pair fewer, of the same drives.
    let pairs = folder.path().join("fewer_pairs.csv");
    let fewer = folder.path().join("fewer.json");
    let text = std::fs::read_to_string(folder.path().join("first_pairs.csv")).unwrap();
    let kept: Vec<&str> = text.lines().enumerate().filter(|(index, _)| *index != 5).map(|(_, line)| line).collect();
    std::fs::write(&pairs, kept.join("\n")).unwrap();
    relcov()
        .args(["eval", "--error-frame", "vehicle", "--pairs"])
        .arg(&pairs)
        .arg("--save-results")
        .arg(&fewer)
        .assert()
        .success();
    for order in [[&first, &fewer], [&fewer, &first]] {
        relcov()
            .arg("report")
            .args(order)
            .assert()
            .code(1)
            .stderr(contains("`fewer` has no prediction for vo drive_a frames 4 and 5, which `first` has"));
    }

    // Other errors for the same pairs compare, but not silently, and nothing is called best.
    let other = judge(folder.path(), "other", 2, "vehicle");
    relcov()
        .arg("report")
        .args([&first, &other])
        .assert()
        .success()
        .stdout(contains("WARNING: `first` and `other` have different errors").and(contains("* |").not()));

    // Every form says so, and the order of arguments does not matter.
    for format in ["csv", "latex"] {
        relcov()
            .arg("report")
            .args([&other, &first, &first])
            .args(["--format", format])
            .assert()
            .success()
            .stderr(contains("warning: `other` and `first` have different errors"));
    }

    // The same measurements judged twice compare, whatever the results are called.
    let twin = folder.path().join("constant.json");
    std::fs::copy(&first, &twin).unwrap();
    std::fs::copy(folder.path().join("first.csv"), folder.path().join("constant.csv")).unwrap();
    let output = relcov().arg("report").args([&first, &twin, &twin, &twin]).output().unwrap();
    let stdout = String::from_utf8(output.stdout).unwrap();
    assert!(!stdout.contains("WARNING"), "{stdout}");
    for name in ["first", "constant (run)", "constant (run) (2)", "constant (run) (3)"] {
        assert!(stdout.contains(&format!("| vo     | {name} ")), "{name}: {stdout}");
    }

    // Scores whose measurements were changed afterwards.
    std::fs::copy(folder.path().join("fewer.csv"), folder.path().join("first.csv")).unwrap();
    relcov().arg("report").arg(&first).assert().code(1).stderr(contains("first.csv: found other measurements"));
    relcov().args(["report", "nowhere"]).assert().code(1).stderr(contains("nowhere: holds no evaluation.json"));
}

use predicates::prelude::PredicateBooleanExt as _;
