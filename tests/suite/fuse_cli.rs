//! `relcov fuse` from the command line: files, a model, and real odometry.

use std::path::Path;

use assert_cmd::Command;
use predicates::str::contains;
use relcov::geometry::{Covariance6, Pose, Tangent};
use relcov::systems::{RelativePose, format_relative_pose, relative_pose_header};

use crate::support::{shared, write_config, write_drive};

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

/// A circle of 24 steps, its true poses, and odometry with a constant yaw error.
fn write_circle(folder: &Path) {
    let step = Pose::exp(&Tangent::new(1.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::TAU / 24.0));
    let biased = Pose::exp(&Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.01)) * step;
    let (mut pose, mut truth) = (Pose::identity(), String::new());
    let mut odometry = relative_pose_header();
    for frame in 0..25 {
        let m = pose.matrix();
        let row: Vec<String> = (0..12).map(|k| format!("{:e}", m[(k / 4, k % 4)])).collect();
        truth += &format!("{frame} {}\n", row.join(" "));
        pose = pose * step;
        let covariance = Covariance6::from_std_devs(&Tangent::new(0.01, 0.01, 0.01, 1e-3, 1e-3, 0.01));
        odometry += &format_relative_pose(&RelativePose {
            source: frame,
            target: frame + 1,
            source_from_target: biased,
            covariance: Some(covariance),
        });
    }
    std::fs::write(folder.join("truth.txt"), truth).unwrap();
    std::fs::write(folder.join("vo.csv"), odometry).unwrap();
}

fn column(text: &str, row: &str, column: usize) -> f64 {
    let line = text.lines().find(|line| line.contains(row)).unwrap_or_else(|| panic!("{row}: {text}"));
    line.split('|').map(str::trim).nth(column).unwrap().trim_end_matches('*').parse().unwrap()
}

#[test]
fn fixes_correct_what_odometry_cannot_know() {
    let folder = tempfile::tempdir().unwrap();
    write_circle(folder.path());
    let odometry = format!("vo={}", folder.path().join("vo.csv").display());
    let run = |more: &[&str]| {
        let out = folder.path().join("fused/fused.tum");
        let output = relcov()
            .args(["fuse", "--odometry", &odometry, "--truth"])
            .arg(folder.path().join("truth.txt"))
            .arg("--out")
            .arg(&out)
            .args(more)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let trajectory = std::fs::read_to_string(&out).unwrap();
        let rows: Vec<Vec<f64>> = trajectory
            .lines()
            .filter(|line| !line.starts_with('#'))
            .map(|line| line.split(' ').map(|word| word.parse().unwrap()).collect())
            .collect();
        (column(&String::from_utf8(output.stdout).unwrap(), "given", 3), rows)
    };
    let (without, rows) = run(&[]);
    assert_eq!((rows.len(), rows[0].len()), (26, 8 + 36));
    let (with, fixed_rows) = run(&["--simulate-fixes", "6,0.02"]);
    assert!(without > 0.3 && with < 0.2 * without, "{with} against {without}");
    // And the covariance says so: that of the last position, along x.
    assert!(fixed_rows[24][8] < 0.2 * rows[24][8]);

    let fixes = folder.path().join("fixes.csv");
    std::fs::write(&fixes, "frame,x,y,z,std_x,std_y,std_z\n0,0,0,0,.02,.02,.02\n").unwrap();
    let base = ["fuse", "--odometry", &odometry];
    // A file may say whose motions it holds.
    let text = std::fs::read_to_string(folder.path().join("vo.csv")).unwrap();
    for (name, frame) in [("vo.csv", "camera"), ("wheel.csv", "vehicle")] {
        std::fs::write(folder.path().join(name), format!("# frame {frame}, perturbation left\n{text}")).unwrap();
    }
    let other_body = format!("wheel={}", folder.path().join("wheel.csv").display());
    for (more, expected) in [
        (vec!["--fixes", fixes.to_str().unwrap()], "1 positions without an attitude"),
        (vec!["--fixes", "nowhere.csv"], "nowhere.csv: cannot read"),
        (vec!["--constant", "vo=1,2"], "six standard deviations"),
        (vec!["--constant", "wheel=1,1,1,1,1,1"], "no --odometry wheel"),
        (vec!["--constant", "vo=1e-160,1e-160,1e-160,1e-160,1e-160,1e-160"], "six standard deviations above zero"),
        (vec!["--odometry", &other_body], "different bodies: camera and vehicle"),
        (vec!["--simulate-fixes", "5,1"], "needs --truth"),
        (vec!["--odometry", "wheel=nowhere.csv"], "nowhere.csv: cannot read"),
    ] {
        relcov().args(base).args(more).assert().code(1).stderr(contains(expected));
    }
    relcov().args(base).args(["--simulate-fixes", "5"]).assert().code(2).stderr(contains("is not N,STD"));
}

#[test]
fn a_model_and_its_baselines_are_set_side_by_side() {
    let folder = tempfile::tempdir().unwrap();
    write_drive(folder.path(), 24);
    let config = write_config(folder.path(), folder.path());
    relcov().args(["train", "--quiet", "--config"]).arg(&config).assert().success();
    let plot = folder.path().join("fused.png");
    let output = relcov()
        .args(["fuse", "--run"])
        .arg(folder.path().join("runs/tiny"))
        .args(["--simulate-fixes", "2,0.1", "--draws", "2", "--save-plot"])
        .arg(&plot)
        .arg("--out")
        .arg(folder.path().join("fused"))
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    for method in ["relcov ", "relcov_uncalibrated", "constant ", "log_linear"] {
        assert!(column(&text, method, 3) < 0.5, "{text}");
    }
    assert!(!text.contains("gnss") && image::open(plot).is_ok());
    assert!(folder.path().join("fused").read_dir().unwrap().count() >= 4);
    relcov()
        .args(["fuse", "--run"])
        .arg(folder.path().join("runs/tiny"))
        .args(["--system", "gnss"])
        .assert()
        .code(1)
        .stderr(contains("is the truth itself"));
}

#[test]
fn real_odometry_is_fused_with_fixes_around_the_real_truth() {
    let Some(kitti) = shared("kitti") else { return };
    let output = relcov()
        .args(["fuse", "--quiet", "--baselines-only", "--config", "configs/kitti.toml", "--set"])
        .arg(format!("data.root={}", kitti.display()))
        .args(["--simulate-fixes", "50,0.5"])
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    // libviso2 on a kilometre: 11 m off without fixes; half a metre of noise in each fix.
    assert!(column(&text, "log_linear", 3) < 1.2, "{text}");
    assert!((0.2..5.0).contains(&column(&text, "log_linear", 7)), "{text}");
}
