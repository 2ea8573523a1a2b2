//! Images, depth maps and requests that people reported with other tools, and what is right of each.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{DynamicImage, ImageBuffer, ImageFormat, Luma};
use predicates::prelude::PredicateBooleanExt;
use predicates::str::contains;
use relcov::recordings::{RgbImage, decode_image, read_image};
use serde_json::{Value, json};

use crate::predict_cli::World;
use crate::support::{DRIVE, shared};

fn image_path(frame: usize) -> PathBuf {
    World::get().path().join(format!("2020_01_01/{DRIVE}/image_02/data/{frame:010}.png"))
}

fn jpeg() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image::open(image_path(0)).unwrap().write_to(&mut bytes, ImageFormat::Jpeg).unwrap();
    bytes.into_inner()
}

/// The JPEG with an EXIF segment that holds an orientation alone.
fn turned_jpeg(orientation: u8) -> Vec<u8> {
    let tiff =
        [b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".as_slice(), &[orientation], &[0; 6]].concat();
    let length = (tiff.len() as u16 + 2).to_be_bytes();
    let jpeg = jpeg();
    [&jpeg[..2], &[0xFF, 0xE1], &length, &tiff, &jpeg[2..]].concat()
}

fn request(id: Value) -> Value {
    let image = image_path(0);
    json!({"id": id, "source_image": image, "target_image": image, "intrinsics": [60, 60, 48, 24], "pose": [0, 0, 0.5, 0, 0, 0, 1]})
}

/// The answers to lines of a stream, as text.
fn answers(lines: &[String]) -> Vec<String> {
    let output = World::get().predict(&["--stream"]).write_stdin(lines.join("\n")).output().unwrap();
    let answers: Vec<String> = String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect();
    assert_eq!(answers.len(), lines.len());
    answers
}

fn answer(request: &Value) -> Value {
    serde_json::from_str(&answers(&[request.to_string()])[0]).unwrap()
}

fn refused(request: &Value) -> String {
    let answer = answer(request);
    answer["error"].as_str().unwrap_or_else(|| panic!("{answer}")).to_owned()
}

fn with(field: &str, value: Value) -> Value {
    let mut request = request(json!(1));
    request[field] = value;
    request
}

/// A manifest of one pair of images, the measured motion and depth as given.
fn manifest(folder: &Path, source: &Path, pose: &str, depth: &str) -> String {
    let path = folder.join("pairs.csv");
    let (source, target) = (source.display(), image_path(1).display().to_string());
    let text = format!(
        "system,source,target,source_image,target_image,fx,fy,cx,cy,x,y,z,qx,qy,qz,qw,depth\nvo,0,1,{source},{target},60,60,48,24,{pose},{depth}\nvo,1,2,{target},{target},60,60,48,24,0,0,0.5,0,0,0,1,\n"
    );
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn a_jpeg_that_is_cut_off_is_refused_on_every_road() {
    let whole = jpeg();
    let path = Path::new("photo.jpg");
    let cut = |share: f64| whole[..(whole.len() as f64 * share) as usize].to_vec();
    let zeros = [&cut(0.7)[..], &vec![0; whole.len() - cut(0.7).len()]].concat();
    let folder = tempfile::tempdir().unwrap();
    for bytes in [cut(0.5), cut(0.95), zeros, whole[..whole.len() - 2].to_vec()] {
        let message = decode_image(&bytes, path).unwrap_err().to_string();
        assert!(message.contains("photo.jpg: found a JPEG that is cut off"), "{message}");
        let message = refused(&with("source_image", json!({"base64": STANDARD.encode(&bytes)})));
        assert!(message.contains("field `source_image`: found a JPEG that is cut off"), "{message}");
        let file = folder.path().join("cut.jpg");
        std::fs::write(&file, &bytes).unwrap();
        assert!(read_image(&file).is_err());
        let pairs = manifest(folder.path(), &file, "0,0,0.5,0,0,0,1", "");
        let left_out = contains("cut.jpg: found a JPEG that is cut off").and(contains("1 covariances"));
        World::get().predict(&["--manifest", &pairs]).assert().success().stderr(left_out);
    }
    // What follows its end is no part of it.
    let padded = [&whole[..], &[0; 512]].concat();
    assert_eq!(decode_image(&padded, path).unwrap(), decode_image(&whole, path).unwrap());
}

#[test]
fn real_jpegs_are_whole_and_their_halves_are_not() {
    let Some(folder) = shared("kitti/2011_09_30/2011_09_30_drive_0028_sync/image_02/data") else { return };
    for entry in std::fs::read_dir(folder).unwrap() {
        let bytes = std::fs::read(entry.unwrap().path()).unwrap();
        let image = decode_image(&bytes, Path::new("real.jpg")).unwrap();
        assert_eq!((image.width, image.height), (1226, 370));
        assert!(decode_image(&bytes[..bytes.len() / 2], Path::new("real.jpg")).is_err());
    }
}

#[test]
fn pixels_are_those_that_are_stored_and_an_orientation_is_said_once() {
    let stored = decode_image(&jpeg(), Path::new("plain.jpg")).unwrap();
    for orientation in [3, 6, 8] {
        let turned = decode_image(&turned_jpeg(orientation), Path::new("turned.jpg")).unwrap();
        assert_eq!(turned, stored);
    }
    let turned = json!({"base64": STANDARD.encode(turned_jpeg(6))});
    let lines: Vec<String> = (0..3).map(|_| with("source_image", turned.clone()).to_string()).collect();
    let output = World::get().predict(&["--stream"]).write_stdin(lines.join("\n")).output().unwrap();
    let warnings = String::from_utf8(output.stderr).unwrap();
    assert_eq!(warnings.matches("its EXIF orientation (6) is not followed").count(), 1, "{warnings}");
}

#[test]
fn a_depth_map_of_another_aspect_is_refused_on_every_road() {
    let folder = tempfile::tempdir().unwrap();
    let depth = |name: &str, width: u32, height: u32| {
        let path = folder.path().join(name);
        let map: ImageBuffer<Luma<u16>, Vec<u16>> = ImageBuffer::from_pixel(width, height, Luma([5 * 256]));
        DynamicImage::ImageLuma16(map).save(&path).unwrap();
        path
    };
    let (swapped, half) = (depth("swapped.png", 48, 96), depth("half.png", 48, 24));
    assert!(answer(&with("depth", json!(half)))["error"].is_null());
    let words = "found a depth map of 48x96 pixels for an image of 96x48; expected one of the image's aspect";
    assert!(refused(&with("depth", json!(swapped))).contains(words));
    let text =
        std::fs::read_to_string(manifest(folder.path(), &image_path(0), "0,0,0.5,0,0,0,1", "swapped.png")).unwrap();
    let second = text.lines().nth(2).unwrap();
    let path = folder.path().join("pairs.csv");
    std::fs::write(&path, text.replace(second, &format!("{second}half.png"))).unwrap();
    let stderr = contains("swapped.png: ").and(contains(words)).and(contains("1 covariances"));
    World::get().predict(&["--manifest", &path.display().to_string()]).assert().success().stderr(stderr);
    // From Rust, and so from Python.
    let device = relcov::device::open_device("flex").unwrap();
    let model = relcov::Model::load(World::get().path().join("runs/tiny"), &device).unwrap();
    let image = RgbImage { width: 96, height: 48, bytes: vec![99; 3 * 96 * 48] };
    let map =
        |width: usize, height: usize| relcov::depth::DepthMap { width, height, depth_m: vec![5.0; width * height] };
    let judge = |target_depth| {
        model.judge(&relcov::Measurement {
            source_image: image.clone(),
            target_image: image.clone(),
            target_depth,
            camera: relcov::geometry::Pinhole { fx: 60.0, fy: 60.0, cx: 48.0, cy: 24.0, width: 96, height: 48 },
            source_from_target: relcov::geometry::Pose::identity(),
            right: None,
            camera_from_vehicle: None,
        })
    };
    assert!(judge(map(48, 96)).unwrap_err().to_string().contains(words));
    assert!(judge(map(32, 16)).is_ok() && judge(map(192, 96)).is_ok());
}

#[test]
fn a_pose_that_turns_the_camera_round_is_no_road_to_a_black_image() {
    let world = World::get();
    let round = "0,0,1,0,1,0,0";
    let words = "by its pose and depth the source image shows nothing of the target";
    assert!(refused(&with("pose", json!([0, 0, 1, 0, 1, 0, 0]))).contains(words));
    let folder = tempfile::tempdir().unwrap();
    let pairs = manifest(folder.path(), &image_path(0), round, "");
    let left_out = contains(words)
        .and(contains("1 covariances"))
        .and(contains("1 pairs are left out; the first: sequence, vo, frames 0 and 1: "));
    world.predict(&["--manifest", &pairs]).assert().success().stderr(left_out);
    let drive = world.path().join("2020_01_01").join(DRIVE).display().to_string();
    let measured = folder.path().join("back.csv");
    std::fs::write(&measured, "0,1,0,0,1,0,1,0,0\n1,2,0,0,1,0,0,0,1\n").unwrap();
    let measured = measured.display().to_string();
    world.predict(&["--drive", &drive, "--measurements", &measured]).assert().success().stderr(
        contains("1 pairs are left out; the first: 2020_01_01_drive_0001_sync, back, frames 0 and 1: ")
            .and(contains(words))
            .and(contains("1 covariances")),
    );
}

#[test]
fn an_id_comes_back_as_it_was_sent() {
    let ids = ["18446744073709551617", "18446744073709551618", "-7", "1.10", "1e400", "\"a\\u00e9\\n\"", "null"];
    let lines: Vec<String> = ids.iter().map(|id| request(json!("ID")).to_string().replace("\"ID\"", id)).collect();
    for (answer, id) in answers(&lines).iter().zip(ids) {
        assert!(answer.starts_with(&format!("{{\"id\":{id},")), "{answer}");
        assert!(answer.contains("\"covariance\""), "{answer}");
    }
}

#[test]
fn what_json_has_no_number_for_is_named_and_the_id_comes_back() {
    let line = include_str!("../data/cases/nan.jsonl").trim().to_owned();
    let infinite = line.replace("frame-17", "a \\\"NaN, nan").replace("NaN, NaN, NaN, NaN]", "-Infinity, 1, 2, 3]");
    let cut = request(json!(9)).to_string();
    let cut = cut[..cut.len() / 2].to_owned();
    let answers = answers(&[line, infinite, cut, "{\"x\": NaN".to_owned()]);
    let words = "no request: `NaN` is no JSON number";
    assert!(answers[0].starts_with("{\"id\":\"frame-17\",\"error\":") && answers[0].contains(words), "{}", answers[0]);
    assert!(answers[1].starts_with("{\"id\":\"a \\\"NaN, nan\",\"error\":"), "{}", answers[1]);
    assert!(answers[2].starts_with("{\"id\":9,\"error\":\"no request: EOF"), "{}", answers[2]);
    assert!(answers[3].starts_with("{\"id\":null,"), "{}", answers[3]);
}

#[test]
fn base64_is_taken_as_encoders_write_it() {
    let png = std::fs::read(image_path(0)).unwrap();
    let encoded = STANDARD.encode(&png);
    let lines: String =
        encoded.as_bytes().chunks(76).map(|line| format!("{}\r\n", std::str::from_utf8(line).unwrap())).collect();
    let url = format!("data:image/png;base64,{encoded}");
    let expected = answer(&with("source_image", json!({"base64": encoded})))["covariance"].clone();
    assert!(expected.is_array());
    for content in [json!({"base64": lines}), json!({"base64": url}), json!(url)] {
        assert_eq!(answer(&with("source_image", content))["covariance"], expected);
    }
    let long = "iVBORw0KGgo".repeat(400_000);
    for (content, words) in [
        (json!(long), "4400000 bytes are no path; base64 is written {\"base64\": \"…\"}"),
        (json!(encoded[..300]), "…`; expected a file, or {\"base64\": \"…\"}"),
        (json!("data:image/png,%89PNG"), "expected base64, alone or in a data URL"),
        (json!({"base64": "!".repeat(5_000_000)}), "Invalid symbol"),
        (json!({"base64": [1, 2]}), "invalid type: sequence"),
    ] {
        let message = refused(&with("source_image", content));
        assert!(message.contains(words) && message.chars().count() < 250, "{message}");
    }
    assert!(refused(&with("pose", json!(long))).chars().count() < 200);
    assert!(refused(&with(&long, json!(1))).chars().count() < 200);
}
