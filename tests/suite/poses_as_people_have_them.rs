//! Files of poses that people reported with other tools, and what is right of each: read as what they say, or refused by
//! name.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::fusion::parse_fixes;
use relcov::recordings::{load_kitti_raw, parse_kitti_trajectory};
use relcov::systems::{format_relative_pose, parse_relative_poses, relative_pose_header};

use crate::predict_cli::World;
use crate::support::{DRIVE, shared, write_drive};

const CONSTANT: &str = "vo=.02,.02,.02,.002,.002,.002";

fn relcov() -> Command {
    Command::cargo_bin("relcov").unwrap()
}

fn fuse(path: &Path, more: &[&str]) -> Command {
    let mut command = relcov();
    command.args(["fuse", "--odometry", &format!("vo={}", path.display())]).args(more);
    command
}

/// A small input that was reported, and its text.
fn case(name: &str) -> (PathBuf, String) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/cases").join(name);
    let text = std::fs::read_to_string(&path).unwrap();
    (path, text)
}

#[test]
fn a_quaternion_with_w_first_is_no_half_turn() {
    let (path, text) = case("qw.csv");
    let poses = parse_relative_poses(&text, &path).unwrap();
    let pose = poses[0].source_from_target;
    assert_eq!(pose.rotation.angle(), 0.0);
    assert_eq!(pose.translation.as_slice(), [1.0, 0.0, 0.0]);
    assert_eq!(poses[0].covariance.unwrap().variance().as_slice(), [1e-4; 6]);
}

#[test]
fn a_header_that_numpy_comments_out_is_a_header() {
    // numpy.savetxt("vo.csv", rows, delimiter=",", header="source,target,x,y,z,qw,qx,qy,qz")
    let text = "# source,target,x,y,z,qw,qx,qy,qz\n0.0,1.0,1.0,0.0,0.0,1.0,0.0,0.0,0.0\n";
    let poses = parse_relative_poses(text, Path::new("vo.csv")).unwrap();
    assert_eq!(poses[0].source_from_target.rotation.angle(), 0.0);
}

#[test]
fn latitudes_are_no_metres() {
    let (path, text) = case("latlon.csv");
    let message = parse_fixes(&text, &path).unwrap_err().to_string();
    assert!(message.contains("line 1: found an unknown column `lat`; expected frame,x,y,z"), "{message}");
}

#[test]
fn covariances_with_rotations_first_are_taken_by_name_or_refused() {
    let names: Vec<String> = (0..36).map(|k| format!("c{}{}", k / 6, k % 6)).collect();
    let pose = "source,target,x,y,z,qx,qy,qz,qw";
    // φ before ρ: entry (0, 0) of the file is entry (3, 3) of a covariance.
    let rotation_first: Vec<&str> = (0..36).map(|k| &*names[(k / 6 + 3) % 6 * 6 + (k % 6 + 3) % 6]).collect();
    let entry = |k: usize| if k.is_multiple_of(7) { (k / 7 + 1) as f64 * 1e-2 } else { 0.0 };
    let entries: Vec<String> = (0..36).map(|k| entry(k).to_string()).collect();
    let row = format!("0,1,1,0,0,0,0,0,1,{}\n", entries.join(","));
    let read = |header: String| parse_relative_poses(&format!("{header}\n{row}"), Path::new("cov.csv"));
    let variance = |header: String| read(header).unwrap()[0].covariance.unwrap().variance();
    assert_eq!(variance(format!("{pose},{}", names.join(","))).as_slice(), [0.01, 0.02, 0.03, 0.04, 0.05, 0.06]);
    let moved = variance(format!("{pose},{}", rotation_first.join(",")));
    assert_eq!(moved.as_slice(), [0.04, 0.05, 0.06, 0.01, 0.02, 0.03]);
    let named = format!("{pose},{}", names.join(",")).replace("c00", "cov_rx_rx");
    let message = read(named).unwrap_err().to_string();
    assert!(message.contains("an unknown column `cov_rx_rx`"), "{message}");
}

#[test]
fn an_empty_cell_does_not_move_the_others() {
    let (path, text) = case("cell.csv");
    let message = parse_relative_poses(&text, &path).unwrap_err().to_string();
    assert!(message.contains("line 1: found an unknown column `t`"), "{message}");
    let text = text.replace(",t,", ",").replace("12.5,", "");
    let message = parse_relative_poses(&text, &path).unwrap_err().to_string();
    assert!(message.contains("line 2: found nothing in column `z`; expected a finite number"), "{message}");
}

#[test]
fn a_truth_of_rows_is_that_of_the_frames_that_were_measured() {
    let Some(path) = shared("kitti/odometry_poses/08.txt") else { return };
    let poses = parse_kitti_trajectory(&std::fs::read_to_string(&path).unwrap(), &path, 1100).unwrap();
    let mut odometry = relative_pose_header();
    for source in 1100..1100 + poses.len() - 1 {
        odometry += &format_relative_pose(&relcov::systems::RelativePose {
            source,
            target: source + 1,
            source_from_target: poses[&source].inverse() * poses[&(source + 1)],
            covariance: Some(relcov::Covariance6::from_std_devs(&relcov::geometry::Tangent::repeat(0.01))),
        });
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("vo.csv");
    std::fs::write(&file, &odometry).unwrap();
    let truth = path.display().to_string();
    let out = folder.path().join("fused.tum").display().to_string();
    let table = fuse(&file, &["--truth", &truth, "--out", &out]).output().unwrap();
    let table = String::from_utf8(table.stdout).unwrap();
    let row = table.lines().find(|line| line.contains("given")).unwrap_or_else(|| panic!("{table}"));
    let ate: f64 = row.split('|').map(str::trim).nth(3).unwrap().trim_end_matches('*').parse().unwrap();
    assert!(ate < 1e-3, "{table}");
    // Frames that the odometry does not have cannot be guessed.
    let cut: String = odometry.lines().take(101).fold(String::new(), |text, line| text + line + "\n");
    std::fs::write(&file, cut).unwrap();
    let found = "4071 rows without frames, which would be 0 … 4070";
    fuse(&file, &["--truth", &truth, "--out", &out]).assert().code(1).stderr(contains(found));
}

#[test]
fn rows_of_an_odometry_sequence_are_frames_of_its_drive() {
    // Against OXTS they differ by its jitter, 3 to 7 cm; 1,100 frames off by metres.
    let Some(root) = shared("kitti") else { return };
    let config = tempfile::NamedTempFile::with_suffix(".toml").unwrap();
    let text = format!(
        r#"name = "rows"
[data]
root = {:?}
train = [{{ drive = "2011_09_30_drive_0033_sync" }}]
test = [{{ drive = "2011_09_30_drive_0028_sync" }}]
[[systems]]
name = "poses"
share = 1.0
source = "trajectory"
path = {:?}
"#,
        root.display().to_string(),
        "odometry_poses/{sequence}.txt",
    );
    let eval = |text: &str| {
        std::fs::write(config.path(), text).unwrap();
        let results = tempfile::tempdir().unwrap();
        let json = results.path().join("scores.json");
        relcov()
            .args(["eval", "--baselines-only", "--config"])
            .arg(config.path())
            .arg("--save-results")
            .arg(&json)
            .assert()
            .success();
        let pairs = std::fs::read_to_string(json.with_extension("csv")).unwrap();
        let column = pairs.lines().next().unwrap().split(',').position(|name| name == "error_x").unwrap();
        let errors = pairs.lines().skip(1).map(|row| row.split(',').nth(column).unwrap().parse::<f64>().unwrap());
        let squares: Vec<f64> = errors.map(|error| error * error).collect();
        ((squares.iter().sum::<f64>() / squares.len() as f64).sqrt(), squares.len())
    };
    let (by_name, pairs) = eval(&text);
    assert!(pairs == 4070 && (0.02..0.08).contains(&by_name), "{by_name} over {pairs}");
    // The same file under a name that does not say which sequence it is.
    let renamed = tempfile::tempdir().unwrap();
    for (drive, sequence) in [("0028", "08"), ("0033", "09")] {
        let name = renamed.path().join(format!("2011_09_30_drive_{drive}.txt"));
        std::fs::copy(root.join(format!("odometry_poses/{sequence}.txt")), name).unwrap();
    }
    let template = renamed.path().join("{drive}.txt").display().to_string();
    assert_eq!(eval(&text.replace("odometry_poses/{sequence}.txt", &template)), (by_name, pairs));
}

#[test]
fn a_packet_before_the_first_fix_does_not_stretch_the_drive() {
    let folder = tempfile::tempdir().unwrap();
    write_drive(folder.path(), 8);
    let packets = folder.path().join(format!("2020_01_01/{DRIVE}/oxts/data"));
    let path = packets.join("0000000000.txt");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut words: Vec<&str> = text.split(' ').collect();
    (words[0], words[1]) = ("0", "0");
    std::fs::write(&path, words.join(" ")).unwrap();
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    assert!(
        drive.problems[0].contains("0000000000.txt, line 1: found latitude 0, longitude 0"),
        "{:?}",
        drive.problems
    );
    assert_eq!(drive.poses.keys().copied().collect::<Vec<_>>(), (1..8).collect::<Vec<_>>());
    let step = drive.poses[&1].inverse() * drive.poses[&2];
    // write_drive moves a metre a frame.
    assert!((step.translation.norm() - 1.0).abs() < 1e-4, "{}", step.translation.norm());
}

#[test]
fn a_drive_may_cross_the_date_line() {
    let folder = tempfile::tempdir().unwrap();
    write_drive(folder.path(), 4);
    let packets = folder.path().join(format!("2020_01_01/{DRIVE}/oxts/data"));
    for frame in 0..4 {
        // East along latitude 60, where a degree of longitude is 55.66 km: a metre is 1.7966e-5 degrees.
        let longitude = 180.0 + (frame as f64 - 1.5) * 1.796_630_57e-5;
        let longitude = if longitude > 180.0 { longitude - 360.0 } else { longitude };
        let mut packet = vec!["0".to_owned(); 30];
        (packet[0], packet[1]) = ("60".to_owned(), format!("{longitude:.15}"));
        std::fs::write(packets.join(format!("{frame:010}.txt")), packet.join(" ")).unwrap();
    }
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    for frame in 0..3 {
        let step = drive.poses[&frame].inverse() * drive.poses[&(frame + 1)];
        assert!((step.translation.x - 1.0).abs() < 1e-6, "{}", step.translation);
    }
}

#[test]
fn a_straight_road_does_not_say_how_it_is_rolled() {
    let ((line, _), (fixes, _)) = (case("line.csv"), case("fixes.csv"));
    let fixes = fixes.display().to_string();
    fuse(&line, &["--fixes", &fixes]).assert().code(1).stderr(contains("rotation is known to"));
    // With an attitude that places it, it is fused: positions by those of the fixes.
    let folder = tempfile::tempdir().unwrap();
    let placed = folder.path().join("placed.csv");
    std::fs::write(&placed, "frame,x,y,z,std_x,std_y,std_z,qx,qy,qz,qw,std_roll,std_pitch,std_yaw\n0,0,0,0.2,.5,.5,.5,0,0,0,1,.1,.1,.1\n2,2,0.3,0,.5,.5,.5,,,,,,,\n").unwrap();
    fuse(&line, &["--fixes", &placed.display().to_string()]).assert().success();
}

#[test]
fn keyframes_are_measured_from_one_to_the_next() {
    let (gap, _) = case("gap.txt");
    let world = World::get();
    let drive = world.path().join("2020_01_01").join(DRIVE).display().to_string();
    let lines = world.lines(&["--drive", &drive, "--measurements", &gap.display().to_string(), "--frame", "camera"]);
    let pairs: Vec<[u64; 2]> =
        lines.iter().map(|line| [&line["source"], &line["target"]].map(|frame| frame.as_u64().unwrap())).collect();
    assert_eq!(pairs, [[0, 1], [1, 3], [3, 6], [6, 9]]);
    for (line, metres) in lines.iter().zip([1.0, 2.0, 3.0, 3.0]) {
        let z = line["pose"]["translation"][2].as_f64().unwrap();
        assert!((z - metres).abs() < 1e-9, "{line}");
    }
}

#[test]
fn a_remark_that_speaks_of_a_frame_is_a_remark() {
    let (path, text) = case("remark.csv");
    assert_eq!(parse_relative_poses(&text, &path).unwrap().len(), 1);
    fuse(&path, &["--constant", CONSTANT]).assert().success();
    let folder = tempfile::tempdir().unwrap();
    let blank = folder.path().join("blank.csv");
    std::fs::write(&blank, format!("\n   \n{text}")).unwrap();
    fuse(&blank, &["--constant", CONSTANT]).assert().success();
}

#[test]
fn a_covariance_that_was_computed_in_f32_is_symmetrised() {
    let (path, text) = case("f32.csv");
    let covariance = parse_relative_poses(&text, &path).unwrap()[0].covariance.unwrap();
    // The mean of the two entries of the file.
    let expected = 0.5 * (-0.009280296042561531 + -0.009280296973884106);
    assert_eq!((covariance.matrix()[(0, 2)], covariance.matrix()[(2, 0)]), (expected, expected));
    fuse(&path, &[]).assert().success();
    let mut words: Vec<String> = text.trim().split(',').map(str::to_owned).collect();
    words[9 + 1] = "0.01".to_owned();
    let message = parse_relative_poses(&words.join(","), &path).unwrap_err().to_string();
    assert!(message.contains("entries (0, 1) and (1, 0) differ by 3.0e-2"), "{message}");
    assert!(message.contains("write 0.5 (C + Cᵀ)"), "{message}");
}

#[test]
fn covariances_that_are_replaced_are_not_looked_at() {
    let (path, _) = case("minus1.csv");
    fuse(&path, &["--constant", CONSTANT]).assert().success();
    fuse(&path, &[]).assert().code(1).stderr(contains("line 1: found the variance (0, 0) is -1.0e0"));
}

#[test]
fn frames_without_images_are_named_on_both_sides() {
    let world = World::get();
    let drive = world.path().join("2020_01_01").join(DRIVE).display().to_string();
    let row = "1 0 0 0 0 1 0 0 0 0 1 0";
    let file = world.path().join("elsewhere.txt");
    let predict = |text: String| {
        std::fs::write(&file, text).unwrap();
        world.predict(&["--drive", &drive, "--measurements", &file.display().to_string()])
    };
    let rows = (100..105).fold(String::new(), |mut text, frame| {
        writeln!(text, "{frame} {row}").unwrap();
        text
    });
    let sides = format!(
        "no pair of `elsewhere` in {DRIVE} has all it needs: `elsewhere` measured frames 100 … 104, images are of frames 0 … 23"
    );
    predict(rows).assert().code(1).stderr(contains(sides).and(contains("data.test").not()));
    predict(String::new())
        .assert()
        .code(1)
        .stderr(contains("elsewhere.txt: found no row; expected 12 numbers a frame"));
    predict(format!("{row}\n")).assert().code(1).stderr(contains("`elsewhere` measured no frames"));
}

#[test]
fn a_byte_order_mark_is_no_character_and_other_encodings_have_names() {
    let ((bom, _), (truth, _)) = (case("bom.txt"), case("truth.txt"));
    let text = std::fs::read_to_string(&bom).unwrap();
    assert_eq!(parse_kitti_trajectory(&text, &bom, 0).unwrap().len(), 2);
    let folder = tempfile::tempdir().unwrap();
    let odometry = folder.path().join("vo.csv");
    std::fs::write(&odometry, "\u{feff}source,target,x,y,z,qx,qy,qz,qw\r\n0,1,1,0,0,0,0,0,1\r\n").unwrap();
    for path in [&bom, &truth] {
        fuse(&odometry, &["--constant", CONSTANT, "--truth", &path.display().to_string()]).assert().success();
    }
    let utf16: Vec<u8> =
        std::iter::once(0xFEFF_u16).chain("0,1,1,0,0,0,0,0,1\n".encode_utf16()).flat_map(u16::to_le_bytes).collect();
    for (bytes, words) in [
        (utf16, "vo.csv: found UTF-16 text; expected text in UTF-8"),
        (b"# Stra\xdfe\n0,1,1,0,0,0,0,0,1\n".to_vec(), "vo.csv, line 1: found byte 0xDF, which is no UTF-8: Latin-1"),
    ] {
        std::fs::write(&odometry, bytes).unwrap();
        fuse(&odometry, &["--constant", CONSTANT]).assert().code(1).stderr(contains(words));
    }
}

#[test]
fn a_stamp_of_nanoseconds_is_no_frame() {
    let (path, _) = case("ns.csv");
    let words = "line 1: found frame `1403636579763555584`; expected at most 1000000000; a time? number the frames";
    fuse(&path, &["--constant", CONSTANT]).assert().code(1).stderr(contains(words));
}
