//! What is wrong with a recording of any layout: named with file and line, counted, never guessed.
#![cfg(unix)]

use std::path::Path;

use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::pairs::Dataset;

use crate::drives::Drives;

/// Changes a text file of a recording.
fn edit(path: &Path, change: impl FnOnce(String) -> String) {
    let text = std::fs::read_to_string(path).unwrap();
    std::fs::write(path, change(text)).unwrap();
}

#[test]
fn what_is_wrong_with_a_recording_is_named() {
    type Break = fn(&Path);
    let cases: [(&str, &str, Break, &[&str]); 32] = [
        (
            "tum_rgbd",
            "an image twice",
            |at| {
                edit(&at.join("tum/desk/rgb.txt"), |text| {
                    text.replace("rgb/1300000000.066667.png", "rgb/1300000000.033333.png")
                })
            },
            &["rgb.txt, line 5: found `rgb/1300000000.033333.png` again; expected each file once"],
        ),
        (
            "tum_rgbd",
            "lists swapped",
            |at| {
                for (from, to) in [("rgb.txt", "x"), ("depth.txt", "rgb.txt"), ("x", "depth.txt")] {
                    std::fs::rename(at.join("tum/desk").join(from), at.join("tum/desk").join(to)).unwrap();
                }
            },
            &["found 16-bit grey pixels; expected a colour image; are depth maps listed in rgb.txt?"],
        ),
        (
            "tum_rgbd",
            "one list for both",
            |at| {
                std::fs::copy(at.join("tum/desk/rgb.txt"), at.join("tum/desk/depth.txt")).unwrap();
            },
            &["depth.txt: found ", "rgb/1300000000.000000.png; expected files that ", "rgb.txt does not list"],
        ),
        (
            "tum_rgbd",
            "columns of other names",
            |at| edit(&at.join("tum/desk/groundtruth.txt"), |text| "# t x y z q_W q_X q_Y q_Z\n".to_owned() + &text),
            &["groundtruth.txt, line 1", "w the last"],
        ),
        (
            "tum_rgbd",
            "poses of the vehicle",
            |at| {
                edit(&at.join("tum/desk/groundtruth.txt"), |text| {
                    "# t x y z qx qy qz qw, axes: vehicle\n".to_owned() + &text
                })
            },
            &["groundtruth.txt, line 1: found poses in axes `vehicle`; expected those of the colour camera"],
        ),
        (
            "tum_rgbd",
            "a known camera",
            |at| std::fs::rename(at.join("tum/desk"), at.join("tum/fr1_desk")).unwrap(),
            &["`data.camera`: is another than that of the TUM benchmark which the name of `fr1_desk` says"],
        ),
        (
            "tum_rgbd",
            "no camera",
            |at| std::fs::rename(at.join("tum/desk"), at.join("tum/my_fr1ends")).unwrap(),
            &["`data.camera`: nothing tells the camera of `my_fr1ends`, whose name has no word fr1"],
        ),
        (
            "tum_rgbd",
            "normalised intrinsics",
            |_| (),
            &["focal lengths (0.6, 1.2), which see a half space in an image of 96x48"],
        ),
        (
            "kitti_odometry",
            "images of half the size",
            |at| {
                edit(&at.join("odometry/sequences/07/calib.txt"), |text| {
                    text.replace("60 0 48 -3 0 60 24", "120 0 95.5 -6 0 120 47.5")
                })
            },
            &["calib.txt, field `P2`: found a principal point (95.5, 47.5) far from the middle of the image of 96x48"],
        ),
        (
            "kitti_odometry",
            "no projection",
            |at| {
                edit(&at.join("odometry/sequences/07/calib.txt"), |text| {
                    text.replace("60 0 48 -3 0 60 24 0 0 0 1 0", "60 0 48 -3 0 60 24 0 0 0 0 1")
                })
            },
            &["calib.txt, field `P2`: found rows (60 0 48), (0 60 24), (0 0 0)", "(0 0 1)"],
        ),
        ("kitti_odometry", "a short name", |_| (), &["7: no such drive below data.root", "; sequences holds 07"]),
        (
            "kitti_odometry",
            "the folder of sequences",
            |_| (),
            &["`data.root`", "holds the sequences of KITTI odometry"],
        ),
        (
            "kitti_odometry",
            "a second name",
            |at| {
                let sequences = at.join("odometry/sequences");
                std::os::unix::fs::symlink(sequences.join("07"), sequences.join("08")).unwrap();
            },
            &["`data`: `08` is `07` by another name; name it once"],
        ),
        ("kitti_odometry", "ranges that overlap", |_| (), &["`data.test`: 07 frames 8 and 12 are in data.train too"]),
        (
            "tum_rgbd",
            "no list of images",
            |at| std::fs::remove_file(at.join("tum/desk/rgb.txt")).unwrap(),
            &["rgb.txt: found no such file; expected the list of its images"],
        ),
        (
            "tum_rgbd",
            "a list without names",
            |at| edit(&at.join("tum/desk/rgb.txt"), |_| "1300000000.0\n".into()),
            &["rgb.txt, line 1: found `1300000000.0`; expected a time in seconds and the name of a file"],
        ),
        (
            "tum_rgbd",
            "nanoseconds",
            |at| edit(&at.join("tum/desk/rgb.txt"), |text| text.replace("1300000000.000000 ", "1300000000000000000 ")),
            &["rgb.txt, line 3", "nanoseconds are to be divided"],
        ),
        (
            "tum_rgbd",
            "disorder",
            |at| edit(&at.join("tum/desk/rgb.txt"), |text| text.replace("1300000000.033333 ", "1299999999.0 ")),
            &["rgb.txt, line 4", "expected increasing times"],
        ),
        (
            "tum_rgbd",
            "images elsewhere",
            |at| std::fs::remove_dir_all(at.join("tum/desk/rgb")).unwrap(),
            &["rgb.txt: found 24 images, none of which is there"],
        ),
        (
            "tum_rgbd",
            "depth of another clock",
            |at| edit(&at.join("tum/desk/depth.txt"), |text| text.replace("1300000000", "1400000000")),
            &["depth.txt: found 24 depth maps, 1400000000.006000000", "of one clock"],
        ),
        (
            "tum_rgbd",
            "truth of another clock",
            |at| edit(&at.join("tum/desk/groundtruth.txt"), |text| text.replace("130000000", "140000000")),
            &["groundtruth.txt: found 24 poses, 1400000000.002", "expected times of frames, 1300000000"],
        ),
        (
            "tum_rgbd",
            "a truth of other columns",
            |at| {
                edit(&at.join("tum/desk/groundtruth.txt"), |text| {
                    "# timestamp tx ty tz qw qx qy qz\n".to_owned() + &text
                })
            },
            &["groundtruth.txt, line 1", "w the last"],
        ),
        (
            "tum_rgbd",
            "images of another size",
            |at| {
                let camera = image::RgbImage::new(32, 16);
                for entry in std::fs::read_dir(at.join("tum/desk/rgb")).unwrap() {
                    camera.save(entry.unwrap().path()).unwrap();
                }
            },
            &["`data.camera`: is of images of 96x48 pixels, and the first of `desk` has 32x16"],
        ),
        (
            "kitti_odometry",
            "no calibration",
            |at| std::fs::remove_file(at.join("odometry/sequences/07/calib.txt")).unwrap(),
            &["calib.txt"],
        ),
        (
            "kitti_odometry",
            "a camera of another size",
            |at| edit(&at.join("odometry/sequences/07/calib.txt"), |text| text.replace("60 0 48", "700 0 600")),
            &["calib.txt, field `P2`", "expected intrinsics fx, fy, cx, cy at the image's own size"],
        ),
        (
            "kitti_odometry",
            "no camera",
            |at| edit(&at.join("odometry/sequences/07/calib.txt"), |text| text.replace("P2:", "P9:")),
            &["calib.txt", "P2", "no such line"],
        ),
        (
            "kitti_odometry",
            "fewer poses",
            |at| {
                edit(&at.join("odometry/poses/07.txt"), |text| {
                    text.lines().take(20).map(|line| line.to_owned() + "\n").collect()
                })
            },
            &["poses/07.txt: found poses of 20 frames; expected 24 as times.txt has times"],
        ),
        (
            "kitti_odometry",
            "no images",
            |at| std::fs::remove_dir_all(at.join("odometry/sequences/07/image_2")).unwrap(),
            &["sequences/07: no images in image_2 or image_0"],
        ),
        (
            "kitti_odometry",
            "no such sequence",
            |at| std::fs::rename(at.join("odometry/sequences/07"), at.join("odometry/sequences/08")).unwrap(),
            &["07: no such drive below data.root", "sequences/07 (kitti_odometry)"],
        ),
        (
            "kitti_odometry",
            "packets",
            |_| (),
            &["truth.source", "`oxts` is KITTI raw's, and 07 lies in the layout `kitti_odometry`; `recording` takes"],
        ),
        ("kitti_odometry", "a camera", |_| (), &["data.camera", "brings its own calibration"]),
        (
            "kitti_odometry",
            "two layouts",
            |at| std::fs::create_dir_all(at.join("odometry/07/rgb")).unwrap(),
            &["`data.layout`: `07` below", "can be read in 2 layouts; choose: \"kitti_odometry\", \"tum_rgbd\""],
        ),
    ];
    for (layout, name, break_it, words) in cases {
        let drives = Drives::new();
        break_it(drives.folder.path());
        let mut settings = drives.settings(layout);
        match name {
            "normalised intrinsics" => settings
                .push("data.camera={ width = 96, height = 48, fx = 0.6, fy = 1.2, cx = 48, cy = 24 }".to_owned()),
            "a known camera" | "no camera" => {
                let drive = if name == "no camera" { "my_fr1ends" } else { "fr1_desk" };
                settings.iter_mut().for_each(|setting| *setting = setting.replace("\"desk\"", &format!("\"{drive}\"")));
                if name == "no camera" {
                    settings.retain(|setting| !setting.starts_with("data.camera="));
                }
            }
            "a short name" => settings.iter_mut().for_each(|setting| *setting = setting.replace("\"07\"", "\"7\"")),
            "the folder of sequences" => {
                settings[0] = format!("data.root={:?}", drives.path("odometry/sequences").display().to_string());
            }
            "a second name" => settings.push("data.test=[{ drive = \"08\" }]".to_owned()),
            "ranges that overlap" => settings.extend(
                [
                    "data.gap=4",
                    "data.train=[{ drive = \"07\", frames = [0, 10] }]",
                    "data.validation=[]",
                    "data.test=[{ drive = \"07\", frames = [8, 20] }]",
                ]
                .map(str::to_owned),
            ),
            "packets" => settings.push("truth.source=oxts".to_owned()),
            "a camera" => {
                settings.push("data.camera={ width = 9, height = 9, fx = 9, fy = 9, cx = 4, cy = 4 }".to_owned())
            }
            _ => {}
        }
        let output = drives.run("inspect", &settings).assert().get_output().clone();
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{name}: {message}");
        assert!(words.iter().all(|word| message.contains(word)), "{name}: {message}\nexpected: {words:?}");
    }
}

#[test]
fn what_lists_name_and_is_not_there_is_counted() {
    let drives = Drives::new();
    let at = |below: &str| drives.path(&format!("tum/desk/{below}"));
    std::fs::remove_file(at("rgb/1300000000.233333.png")).unwrap();
    std::fs::remove_file(at("depth/1300000000.306000.png")).unwrap();
    std::fs::remove_file(at("depth/1300000000.339333.png")).unwrap();
    edit(&at("depth.txt"), |text| text + "1300000009.000000 depth/1300000009.000000.png\n");
    let mut settings = drives.settings("tum_rgbd");
    settings.push("depth.source=recording".to_owned());
    drives.run("inspect", &settings).assert().success().stdout(
        contains("problems: 3")
            .and(contains("rgb.txt: 1 of its 24 images are not there, the first on line 10\n"))
            .and(contains("depth.txt: 3 of its 25 depth maps are not there, the first on line 10\n"))
            .and(contains("depth.txt: 1 of its 25 depth maps are of no image")),
    );
    // Two pairs lack an image, two others a map.
    let counts = |dataset: &Dataset| dataset.train.pairs_of(0).len();
    assert_eq!(counts(&drives.load(&settings)), 16 - 2 - 2);
    std::fs::remove_file(at("depth.txt")).unwrap();
    drives.run("inspect", &settings).assert().success().stdout(contains("depth.txt: not there; it brings no depth"));
    std::fs::remove_file(at("groundtruth.txt")).unwrap();
    let without = drives.run("inspect", &settings).assert().success().get_output().clone();
    let text = String::from_utf8(without.stdout).unwrap();
    assert!(text.contains("groundtruth.txt: not there; it brings no true poses"), "{text}");
    let message = drives.run("train", &settings).assert().code(1).get_output().clone();
    let message = String::from_utf8(message.stderr).unwrap();
    assert!(message.contains("`vo` measured"), "{message}");
    drives
        .run(
            "inspect",
            &[vec![format!("data.root={:?}", at("").display().to_string())], settings[1..].to_vec()].concat(),
        )
        .assert()
        .code(1)
        .stderr(contains("is a recording itself").and(contains("drive = \"desk\"")));
}

#[test]
fn results_are_not_written_over_the_data() {
    let drives = Drives::new();
    let refused = "would be written over what is read";
    let settings = drives.settings("tum_rgbd");
    let truth = [
        &settings[..],
        &["truth.source=trajectory", "truth.path={drive}_truth.csv", "truth.format=tum", "truth.frame=camera2"]
            .map(str::to_owned),
    ]
    .concat();
    std::fs::copy(drives.path("tum/desk/groundtruth.txt"), drives.path("tum/desk_truth.csv")).unwrap();
    let at = |below: &str| drives.path(below).display().to_string();
    let image = at("tum/desk/rgb/1300000000.000000.png");
    drives
        .run("manifest", &truth)
        .args(["--out", &at("tum/desk_truth.csv")])
        .assert()
        .code(1)
        .stderr(contains(refused));
    drives.run("inspect", &settings).args(["--contact-sheet", &image]).assert().code(1).stderr(contains(refused));
    for table in ["tum/desk/rgb.txt", "tum/desk_vo.txt"] {
        let table = at(table);
        let arguments = ["--baselines-only", "--save-table", &table];
        drives.run("eval", &settings).args(arguments).assert().code(1).stderr(contains(refused));
    }
    // They are all as they were.
    drives.load(&truth);
}
