//! Measurements that leave something to compare, or nothing, and what models with evidence say of both.

use approx::assert_relative_eq;
use base64::Engine;
use nalgebra::Matrix6;
use serde_json::{Value, json};

use super::*;
use crate::alignment::NoVerdict;
use crate::depth::encode_depth_png;
use crate::export::{Perturbation, Poses};
use crate::network::ImageNetwork;

const CAMERA: Pinhole = Pinhole { fx: 40.0, fy: 40.0, cx: 31.5, cy: 15.5, width: 64, height: 32 };
/// ln m² and ln rad² of the prior.
const PRIOR: [f64; 6] = [-7.0, -7.0, -7.0, -7.5, -7.5, -7.5];
const WALL_M: f32 = 8.0;

/// A model that looks at evidence alone and has learned nothing.
fn seeing() -> Model {
    let architecture = Architecture {
        evidence: EvidenceInput::Alignment,
        network: ImageNetwork::None,
        head: Head::Posterior,
        ..Architecture::paper(CAMERA.width, CAMERA.height)
    };
    Model::untrained(architecture, ErrorFrame::Vehicle, PRIOR, &Device::flex())
}

/// A picture on a wall across the optical axis, seen from `shift_px` further to the left.
fn wall(shift_px: f64) -> RgbImage {
    let pixel = |column: usize, row: usize| {
        let (u, v) = (column as f64 + shift_px, row as f64);
        let waves = (0.35 * u).sin() * (0.4 * v).cos() + 0.6 * (0.17 * u + 0.3 * v).sin() + 0.4 * (0.6 * v).cos();
        (127.0 + 55.0 * waves).round() as u8
    };
    let pixels = (0..CAMERA.height).flat_map(|row| (0..CAMERA.width).map(move |column| pixel(column, row)));
    RgbImage { width: CAMERA.width, height: CAMERA.height, bytes: pixels.flat_map(|value| [value; 3]).collect() }
}

fn depth(depth_m: f32) -> DepthMap {
    DepthMap { width: CAMERA.width, height: CAMERA.height, depth_m: vec![depth_m; CAMERA.width * CAMERA.height] }
}

/// Two pixels to the right along the wall.
fn truth() -> Pose {
    Pose::exp(&Tangent::new(2.0 * f64::from(WALL_M) / CAMERA.fx, 0.0, 0.0, 0.0, 0.0, 0.0))
}

/// A measurement that is wrong by e, axes of the camera.
fn measured_with(error: &Tangent) -> Measurement {
    Measurement {
        source_image: wall(0.0),
        target_image: wall(2.0),
        target_depth: depth(WALL_M),
        camera: CAMERA,
        source_from_target: Pose::exp(error) * truth(),
        right: None,
        camera_from_vehicle: None,
    }
}

/// A turn about the optical axis, which the picture shows well.
fn turned() -> Measurement {
    measured_with(&Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.02))
}

fn of_one_grey(grey: u8) -> RgbImage {
    RgbImage { bytes: vec![grey; 3 * CAMERA.width * CAMERA.height], ..wall(0.0) }
}

/// Measurements of which the images show nothing, and why.
fn blind() -> Vec<(Measurement, NoVerdict)> {
    let (behind, beside) =
        (Tangent::new(0.0, 0.0, -1000.0, 0.0, 0.0, 0.0), Tangent::new(1000.0, 0.0, 0.0, 0.0, 0.0, 0.0));
    let mut sparse = depth(0.0);
    // One pixel in a hundred is known.
    sparse.depth_m.iter_mut().step_by(100).for_each(|depth_m| *depth_m = WALL_M);
    vec![
        (Measurement { target_depth: depth(0.0), ..turned() }, NoVerdict::NoDepth),
        (Measurement { target_depth: sparse, ..turned() }, NoVerdict::NoDepth),
        (Measurement { target_image: of_one_grey(0), ..turned() }, NoVerdict::NoTexture),
        (
            Measurement { source_image: of_one_grey(200), target_image: of_one_grey(200), ..turned() },
            NoVerdict::NoTexture,
        ),
        (measured_with(&behind), NoVerdict::NoOverlap),
        (measured_with(&beside), NoVerdict::NoOverlap),
    ]
}

#[test]
fn a_measurement_that_leaves_nothing_to_compare_is_refused() {
    let device = Device::flex();
    let model = Model::untrained(Architecture::paper(32, 16), ErrorFrame::Vehicle, [-4.0; 6], &device);
    let measurement = |depth_m: f32| Measurement {
        source_image: of_one_grey(128),
        target_image: of_one_grey(128),
        target_depth: DepthMap { width: 4, height: 2, depth_m: vec![depth_m; 8] },
        source_from_target: Pose::identity(),
        ..turned()
    };
    let judgement = model.judge(&measurement(5.0)).unwrap();
    assert_eq!((judgement.posterior, judgement.corrected_source_from_target, judgement.verdict()), (None, None, None));
    let message = model.predict(&measurement(0.0)).unwrap_err().to_string();
    assert!(message.contains("not one pixel"), "{message}");
    // The camera turned round: what it saw before is behind it.
    let round = Pose::exp(&Tangent::new(0.0, 0.0, 0.0, 0.0, std::f64::consts::PI, 0.0));
    let turned = Measurement { source_from_target: round, ..measurement(5.0) };
    let message = model.predict(&turned).unwrap_err().to_string();
    assert!(message.contains("shows nothing of the target"), "{message}");
}

#[test]
fn the_visible_error_is_taken_away_in_the_cameras_axes() {
    let model = seeing();
    let measurement = turned();
    for camera_from_vehicle in [camera_axes_from_vehicle(), Pose::exp(&Tangent::new(1.0, 0.5, -2.0, 0.4, -1.0, 0.7))] {
        let measurement = Measurement { camera_from_vehicle: Some(camera_from_vehicle), ..measurement.clone() };
        let judgement = model.judge(&measurement).unwrap();
        assert_eq!(judgement.verdict(), Some(Verdict::Given));
        let posterior = judgement.posterior.unwrap();
        assert_relative_eq!(judgement.covariance.matrix(), posterior.second_moment().matrix(), epsilon = 1e-15);
        // μ is said in axes of the vehicle: its turn is about the optical axis there.
        let in_camera = posterior.transported(&camera_from_vehicle).mean;
        assert!((in_camera[5] - 0.02).abs() < 4e-3, "{in_camera}");
        let corrected = judgement.corrected_source_from_target.unwrap();
        let in_vehicle =
            posterior.correct(&measurement.source_from_target.conjugated_by(&camera_from_vehicle.inverse()));
        assert_relative_eq!(
            corrected.matrix(),
            in_vehicle.conjugated_by(&camera_from_vehicle).matrix(),
            epsilon = 1e-12
        );
        let (before, after) = (measurement.source_from_target, corrected);
        let turn = |pose: &Pose| Pose::error(pose, &truth())[5].abs();
        assert!(turn(&after) < 0.2 * turn(&before), "{} of {}", turn(&after), turn(&before));
    }
}

#[test]
fn what_shows_nothing_gets_the_priors_covariance_and_the_reason() {
    let model = seeing();
    let (measurements, reasons): (Vec<_>, Vec<_>) = blind().into_iter().unzip();
    let prior = Covariance6::from_log_variances(&Tangent::from(PRIOR));
    for (judgement, (measurement, reason)) in
        model.judge_batch(&measurements).unwrap().iter().zip(measurements.iter().zip(reasons))
    {
        assert_eq!(judgement.verdict(), Some(Verdict::Withheld(reason)));
        let posterior = judgement.posterior.unwrap();
        assert_eq!((posterior.mean, posterior.covariance), (Tangent::zeros(), judgement.covariance));
        assert_relative_eq!(judgement.covariance.matrix(), prior.matrix(), max_relative = 1e-5);
        assert_eq!(judgement.corrected_source_from_target, Some(measurement.source_from_target));
    }
}

fn png(image: &RgbImage) -> Value {
    let picture = image::RgbImage::from_raw(image.width as u32, image.height as u32, image.bytes.clone()).unwrap();
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    base64_of(bytes.get_ref())
}

fn base64_of(bytes: &[u8]) -> Value {
    json!({ "base64": base64::engine::general_purpose::STANDARD.encode(bytes) })
}

fn request(measurement: &Measurement) -> Value {
    let matrix = measurement.source_from_target.matrix().transpose();
    json!({
        "id": 1,
        "source_image": png(&measurement.source_image),
        "target_image": png(&measurement.target_image),
        "intrinsics": [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
        "pose": matrix.as_slice(),
        "depth": base64_of(&encode_depth_png(&measurement.target_depth)),
    })
}

fn answer(stream: &Stream, request: &Value) -> Value {
    serde_json::from_str(&stream.answer(&request.to_string())).unwrap()
}

fn matrix(answer: &Value, field: &str) -> Matrix6<f64> {
    let rows: Vec<Vec<f64>> = serde_json::from_value(answer[field].clone()).unwrap_or_else(|_| panic!("{answer}"));
    Matrix6::from_row_slice(&rows.concat())
}

/// Position and quaternion.
fn numbers(pose: &Value) -> Vec<f64> {
    ["translation", "quaternion_xyzw"]
        .iter()
        .flat_map(|field| serde_json::from_value::<Vec<f64>>(pose[field].clone()).unwrap())
        .collect()
}

#[test]
fn a_stream_says_what_the_images_show_in_the_axes_and_on_the_side_that_were_asked_for() {
    let model = seeing();
    let measurement = turned();
    let judgement = model.judge(&measurement).unwrap();
    let (posterior, corrected) = (judgement.posterior.unwrap(), judgement.corrected_source_from_target.unwrap());
    let vehicle_from_camera = camera_axes_from_vehicle().inverse();
    for frame in [ErrorFrame::Vehicle, ErrorFrame::Camera] {
        let axes = if frame == ErrorFrame::Vehicle { Pose::identity() } else { vehicle_from_camera.inverse() };
        let left = posterior.transported(&axes);
        let pose = corrected.conjugated_by(&(axes * vehicle_from_camera));
        for side in [Perturbation::Left, Perturbation::Right] {
            let settings = StreamSettings { frame: Some(frame), perturbation: Some(side), ..StreamSettings::default() };
            let found = answer(&Stream::new(&model, &settings).unwrap(), &request(&measurement));
            let expected = match side {
                Perturbation::Left => left.covariance,
                Perturbation::Right => left.covariance.right_of(&pose),
            };
            let tolerance = 1e-12 * expected.matrix().abs().max();
            assert_relative_eq!(&matrix(&found, "corrected_covariance"), expected.matrix(), epsilon = tolerance);
            assert_eq!((found["verdict"].as_str(), found.get("reason"), found.get("pose")), (Some("ok"), None, None));
            if side == Perturbation::Left {
                let correction: Vec<f64> = serde_json::from_value(found["correction"].clone()).unwrap();
                assert_relative_eq!(Tangent::from_vec(correction), left.mean, epsilon = 1e-14);
            }
            let stated = numbers(&found["corrected_pose"]);
            assert!((pose.translation - nalgebra::Vector3::from_column_slice(&stated[..3])).norm() < 1e-12);

            let settings = StreamSettings { poses: Poses::Corrected, ..settings };
            let alone = answer(&Stream::new(&model, &settings).unwrap(), &request(&measurement));
            assert_eq!(
                (&alone["pose"], &alone["covariance"]),
                (&found["corrected_pose"], &found["corrected_covariance"])
            );
            assert_eq!((alone["corrected"].as_bool(), alone.get("correction")), (Some(true), None));
        }
    }
}

#[test]
fn a_stream_answers_what_shows_nothing_and_refuses_what_is_malformed() {
    let model = seeing();
    let prior = Covariance6::from_log_variances(&Tangent::from(PRIOR));
    for poses in [Poses::Measured, Poses::Corrected] {
        let stream = Stream::new(&model, &StreamSettings { poses, ..StreamSettings::default() }).unwrap();
        for (measurement, reason) in blind() {
            let found = answer(&stream, &request(&measurement));
            assert_eq!(
                (found["verdict"].as_str(), found["reason"].as_str()),
                (Some(reason.name()), Some(reason.reason()))
            );
            assert_relative_eq!(&matrix(&found, "covariance"), prior.matrix(), max_relative = 1e-5, epsilon = 1e-12);
        }
        for (field, value) in
            [("pose", json!([1, 2])), ("depth", png(&wall(0.0))), ("intrinsics", json!([-1, 1, 1, 1]))]
        {
            let mut malformed = request(&turned());
            malformed[field] = value;
            let found = answer(&stream, &malformed);
            assert!(found["error"].is_string() && found.get("verdict").is_none(), "{found}");
        }
    }
}

#[test]
fn corrected_poses_need_a_model_that_predicts_errors() {
    let model = Model::untrained(Architecture::paper(32, 16), ErrorFrame::Vehicle, [-4.0; 6], &Device::flex());
    let settings = StreamSettings { poses: Poses::Corrected, ..StreamSettings::default() };
    let problem = Stream::new(&model, &settings).err().unwrap().to_string();
    assert!(problem.contains("does not predict the error itself"), "{problem}");
    let found = answer(&Stream::new(&model, &StreamSettings::default()).unwrap(), &request(&turned()));
    for absent in ["verdict", "reason", "correction", "corrected_pose", "corrected_covariance", "corrected", "pose"] {
        assert!(found.get(absent).is_none() && found["error"].is_null(), "{found}");
    }
}
