//! The rendered world, read as any recorded data set is.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::Vector2;
use relcov::config::Config;
use relcov::depth::{project_scan, read_depth_png, read_scan};
use relcov::geometry::Pose;
use relcov::pairs::{Dataset, PairScope};
use relcov::recordings::{load_kitti_raw, read_image};
use relcov::synthetic::{RecordingProgress, Replace, SYSTEMS, SyntheticSettings, is_rendered, record};
use relcov::systems::parse_relative_poses;
use relcov::warp::Warp;
use sha2::{Digest, Sha256};

const DRIVE: &str = "2026_01_01_drive_0001_sync";

/// Without noise, at the size of the small experiment.
fn plain(frames: usize) -> SyntheticSettings {
    SyntheticSettings { drives: 1, frames, size: [192, 64], image_noise: 0.0, lidar_steps: 360, ..Default::default() }
}

fn rendered(settings: &SyntheticSettings) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    assert!(record(folder.path(), settings, Replace::Never, &mut |_| Ok(())).unwrap());
    folder
}

fn frame_file(root: &Path, sensor: &str, frame: usize, extension: &str) -> PathBuf {
    root.join(format!("2026_01_01/{DRIVE}/{sensor}/data/{frame:010}.{extension}"))
}

/// All files below a folder with their bytes.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    drop(files.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap()))
                }
            }
        }
    }
    files
}

fn planar(path: &Path) -> Vec<f32> {
    let mut planes = Vec::new();
    read_image(path).unwrap().extend_planar(&mut planes);
    planes
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn warping_by_true_depth_and_pose_reproduces_the_next_image() {
    let folder = rendered(&plain(24));
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    let camera = drive.calibration.camera;
    let vehicle_from_camera = drive.calibration.camera_from_vehicle.inverse();
    let world_from_camera = |frame: usize| drive.poses[&frame] * vehicle_from_camera;
    let device = Device::flex();
    let (width, height) = (camera.width, camera.height);
    let depth_of = |frame| read_depth_png(&frame_file(folder.path(), "depth_02", frame, "png")).unwrap();
    let image_of = |frame| planar(&frame_file(folder.path(), "image_02", frame, "png"));
    let (mut warped_differences, mut raw_differences) = (Vec::new(), Vec::new());
    for source in 0..23 {
        let (source_depth, target_depth) = (depth_of(source), depth_of(source + 1));
        let (source_image, target_image) = (image_of(source), image_of(source + 1));
        let source_from_target = world_from_camera(source).inverse() * world_from_camera(source + 1);
        let tensor4 = |values: Vec<f32>, channels: usize| {
            Tensor::<4>::from_data(TensorData::new(values, [1, channels, height, width]), &device)
        };
        let matrix: Vec<f32> = source_from_target.matrix().transpose().iter().map(|&value| value as f32).collect();
        let warped = Warp.forward(
            tensor4(source_image.clone(), 3),
            tensor4(target_depth.depth_m.clone(), 1),
            Tensor::from_floats([[camera.fx as f32, camera.fy as f32, camera.cx as f32, camera.cy as f32]], &device),
            Tensor::from_data(TensorData::new(matrix, [1, 4, 4]), &device),
        );
        let warped_image: Vec<f32> = warped.image.into_data().iter().collect();
        let valid: Vec<f32> = warped.valid_mask.into_data().iter().collect();
        let known =
            target_depth.depth_m.iter().zip(&valid).enumerate().filter(|(_, (depth, valid))| **depth * **valid > 0.0);
        for (pixel, (&depth, _)) in known {
            let depth = f64::from(depth);
            // What is hidden in the source, or moved by itself, has another depth there.
            let place = Vector2::new((pixel % width) as f64, (pixel / width) as f64);
            let point = source_from_target.transform_point(&camera.backproject(&place, depth));
            let seen_at = camera.project(&point).unwrap();
            let (u, v) = (seen_at.x.round() as usize, seen_at.y.round() as usize);
            let seen_depth = f64::from(source_depth.depth_m[v.min(height - 1) * width + u.min(width - 1)]);
            if (seen_depth - point.z).abs() > 0.03 * point.z {
                continue;
            }
            for channel in 0..3 {
                let index = channel * width * height + pixel;
                let difference = |image: &[f32]| f64::from((image[index] - target_image[index]).abs()) * 255.0;
                warped_differences.push(difference(&warped_image));
                raw_differences.push(difference(&source_image));
            }
        }
    }
    let (warped, raw) = (median(warped_differences.clone()), median(raw_differences));
    assert!(warped_differences.len() > 300_000);
    assert!(warped <= 2.0 && warped < 0.5 * raw, "{warped} grey levels warped, {raw} without");
}

#[test]
fn lidar_and_depth_agree() {
    let folder = rendered(&plain(3));
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    let points = read_scan(&drive.scans[&2]).unwrap();
    assert!(points.len() > 8_000);
    let projected = project_scan(&points, &drive.calibration.camera_from_velodyne, &drive.calibration.camera);
    let depth = read_depth_png(&frame_file(folder.path(), "depth_02", 2, "png")).unwrap();
    let known = projected.depth_m.iter().zip(&depth.depth_m).filter(|&(&lidar, &depth)| lidar > 0.0 && depth > 0.0);
    let errors: Vec<f64> = known.map(|(lidar, depth)| f64::from((lidar - depth).abs() / depth)).collect();
    assert!(errors.len() > 1_500, "{}", errors.len());
    assert!(median(errors.clone()) < 0.02, "{}", median(errors));
}

#[test]
fn left_and_right_images_agree_by_disparity() {
    let folder = rendered(&plain(3));
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    let camera = drive.calibration.camera;
    // P_rect_03 − P_rect_02, in metres: the readers of pairs never need it.
    let calibration = std::fs::read_to_string(folder.path().join("2026_01_01/calib_cam_to_cam.txt")).unwrap();
    let offset = |key: &str| -> f64 {
        let line = calibration.lines().find(|line| line.starts_with(key)).unwrap();
        line.split_whitespace().nth(4).unwrap().parse::<f64>().unwrap() / camera.fx
    };
    let baseline_m = offset("P_rect_02") - offset("P_rect_03");
    assert!((baseline_m - 0.54).abs() < 0.01);
    let (left, right) = (planar(&drive.images[&1]), planar(&drive.right_images[&1]));
    let depth = read_depth_png(&frame_file(folder.path(), "depth_02", 1, "png")).unwrap();
    let mut differences = (Vec::new(), Vec::new());
    for (pixel, depth) in depth.depth_m.iter().enumerate().filter(|(_, depth)| **depth > 0.0) {
        let (u, v) = (pixel % camera.width, pixel / camera.width);
        let seen_at = u as f64 - camera.fx * baseline_m / f64::from(*depth);
        if seen_at < 0.0 {
            continue;
        }
        let (first, share) = (seen_at.floor() as usize, seen_at.fract() as f32);
        let at = |u: usize| right[v * camera.width + u.min(camera.width - 1)];
        let sampled = at(first) * (1.0 - share) + at(first + 1) * share;
        differences.0.push(f64::from((sampled - left[pixel]).abs()) * 255.0);
        differences.1.push(f64::from((right[pixel] - left[pixel]).abs()) * 255.0);
    }
    let (shifted, unshifted) = (median(differences.0), median(differences.1));
    assert!(shifted <= 2.0 && shifted < 0.5 * unshifted, "{shifted} and {unshifted} grey levels");
}

#[test]
fn packets_return_the_poses_the_measurements_were_made_from() {
    let settings = plain(40);
    let folder = rendered(&settings);
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    assert_eq!((drive.images.len(), drive.right_images.len(), drive.scans.len(), drive.poses.len()), (40, 40, 40, 40));
    assert!(drive.problems.is_empty() && drive.times.len() == 40);
    // With hardly any pixel noise the visual odometry's error is far below a millimetre.
    let exact =
        SyntheticSettings { size: [640, 200], vo_pixel_noise: 1e-3, vo_landmarks: 192, lidar_steps: 0, ..settings };
    let exact_folder = rendered(&exact);
    let path = exact_folder.path().join("measurements/vo/2026_01_01_drive_0001.csv");
    let measured = parse_relative_poses(&std::fs::read_to_string(&path).unwrap(), &path).unwrap();
    assert_eq!(measured.len(), 39);
    for pose in &measured {
        let motion = drive.poses[&pose.source].inverse() * drive.poses[&pose.target];
        let truth = motion.conjugated_by(&drive.calibration.camera_from_vehicle);
        let error = Pose::error(&pose.source_from_target, &truth);
        assert!(error.fixed_rows::<3>(0).norm() < 1e-3 && error.fixed_rows::<3>(3).norm() < 1e-5, "{error}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads_and_after_an_interruption() {
    let settings = SyntheticSettings { drives: 2, frames: 6, size: [64, 32], lidar_steps: 40, ..Default::default() };
    let whole = contents(rendered(&settings).path());
    assert_eq!(whole.keys().filter(|path| path.extension().is_some_and(|extension| extension == "bin")).count(), 12);

    let single = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let alone = single.install(|| contents(rendered(&settings).path()));
    assert!(whole == alone, "other bytes on one thread");

    let folder = tempfile::tempdir().unwrap();
    let mut stop_in_second_drive = |recording: RecordingProgress| match recording.done > 6 {
        true => Err(relcov::Error::Interrupted),
        false => Ok(()),
    };
    assert!(single.install(|| record(folder.path(), &settings, Replace::Never, &mut stop_in_second_drive)).is_err());
    assert!(contents(folder.path()).len() < whole.len());
    assert!(record(folder.path(), &settings, Replace::Never, &mut |_| Ok(())).unwrap());
    assert!(whole == contents(folder.path()), "other bytes after an interruption");
    assert!(!record(folder.path(), &settings, Replace::Never, &mut |_| Ok(())).unwrap(), "rendered again");

    let other = SyntheticSettings { seed: 1, ..settings };
    assert!(whole != contents(rendered(&other).path()));
}

#[test]
fn other_data_are_never_overwritten() {
    let settings = SyntheticSettings { drives: 1, frames: 2, size: [32, 16], lidar_steps: 8, ..Default::default() };
    let folder = rendered(&settings);
    let before = contents(folder.path());
    let other = SyntheticSettings { seed: 5, ..settings.clone() };
    let message = record(folder.path(), &other, Replace::Never, &mut |_| Ok(())).unwrap_err().to_string();
    assert!(message.contains("seed = 0 there, 5 wanted") && message.contains("--force"), "{message}");
    assert_eq!(before, contents(folder.path()));
    assert!(record(folder.path(), &other, Replace::Synthetic, &mut |_| Ok(())).unwrap());
    assert_ne!(before, contents(folder.path()));

    let foreign = tempfile::tempdir().unwrap();
    std::fs::write(foreign.path().join("thesis.txt"), "work of years").unwrap();
    for replace in [Replace::Never, Replace::Synthetic] {
        let message = record(foreign.path(), &settings, replace, &mut |_| Ok(())).unwrap_err().to_string();
        assert!(message.contains("no synthetic data set"), "{message}");
    }
    assert_eq!(contents(foreign.path()).len(), 1);
}

#[test]
fn every_measurement_states_its_covariance_and_its_errors_fit_it() {
    let folder = rendered(&SyntheticSettings { frames: 300, lidar_steps: 0, ..plain(300) });
    let drive = load_kitti_raw(folder.path(), DRIVE).unwrap();
    for system in SYSTEMS {
        let path = folder.path().join(format!("measurements/{system}/2026_01_01_drive_0001.csv"));
        let measured = parse_relative_poses(&std::fs::read_to_string(&path).unwrap(), &path).unwrap();
        let mut distances = 0.0;
        for pose in &measured {
            let motion = drive.poses[&pose.source].inverse() * drive.poses[&pose.target];
            let truth =
                if system == "vo" { motion.conjugated_by(&drive.calibration.camera_from_vehicle) } else { motion };
            let error = Pose::error(&pose.source_from_target, &truth);
            let factor = pose.covariance.unwrap().matrix().cholesky().unwrap();
            distances += error.dot(&factor.solve(&error));
        }
        // χ² at 99.9 %, nearly normal with so many degrees of freedom.
        let degrees = 6.0 * measured.len() as f64;
        assert!((distances - degrees).abs() < 3.291 * (2.0 * degrees).sqrt(), "{system}: {distances} of {degrees}");
    }
}

#[test]
fn true_covariances_fit_the_errors_in_every_error_frame() {
    let folder = rendered(&SyntheticSettings { drives: 3, lidar_steps: 0, vo_pixel_noise: 0.3, ..plain(150) });
    for frame in ["vehicle", "camera", "world"] {
        let config = folder.path().join("config.toml");
        let drive = |number: usize| format!("[{{ drive = \"2026_01_01_drive_{number:04}_sync\" }}]");
        let systems: String = [("vo", "camera2"), ("icp", "vehicle")]
            .map(|(name, body)| {
                format!("[[systems]]\nname = \"{name}\"\nshare = 0.5\nsource = \"relative\"\npath = \"measurements/{name}/{{drive}}.csv\"\nframe = \"{body}\"\n")
            })
            .concat();
        let (train, validation, test) = (drive(1), drive(2), drive(3));
        let text = format!(
            "name = \"frames\"\n[data]\nroot = \".\"\nerror_frame = \"{frame}\"\ntrain = {train}\nvalidation = {validation}\ntest = {test}\n{systems}"
        );
        std::fs::write(&config, text).unwrap();
        let dataset = Dataset::load(&Config::load(&config, &[]).unwrap().pairs(), PairScope::Poses).unwrap();
        assert_eq!(dataset.simulated, [true, true]);
        for (system, name) in ["vo", "icp"].into_iter().enumerate() {
            let splits = [&dataset.train, &dataset.validation, &dataset.test];
            let pairs: Vec<_> = splits.iter().flat_map(|split| &split.pairs[split.systems[system].clone()]).collect();
            assert_eq!(pairs.len(), 3 * 149);
            let distances: f64 = pairs
                .iter()
                .map(|pair| {
                    pair.error.dot(&pair.stated_covariance.unwrap().matrix().cholesky().unwrap().solve(&pair.error))
                })
                .sum();
            let degrees = 6.0 * pairs.len() as f64;
            assert!(
                (distances - degrees).abs() < 3.291 * (2.0 * degrees).sqrt(),
                "{name} in {frame} axes: {distances} of {degrees}"
            );
        }
    }
}

#[test]
fn the_bytes_are_those_of_every_other_machine() {
    let settings = SyntheticSettings { drives: 1, frames: 4, size: [48, 32], lidar_steps: 16, ..Default::default() };
    let mut hash = Sha256::new();
    for (path, bytes) in contents(rendered(&settings).path()) {
        hash.update(path.to_string_lossy().as_bytes());
        hash.update(bytes);
    }
    let found: String = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    // Another image means another version of the world: raise VERSION in src/synthetic/folder.rs.
    assert_eq!(found, "310606941f932989d348432c25bed08b9295608aaefe47157e69d7931ebfa1b3");
}

#[test]
fn a_folder_being_rendered_is_refused_and_a_broken_manifest_left_alone() {
    let settings = SyntheticSettings { drives: 1, frames: 2, size: [32, 16], lidar_steps: 8, ..Default::default() };
    let folder = tempfile::tempdir().unwrap();
    let mut inside = None;
    record(folder.path(), &settings, Replace::Never, &mut |_| {
        let second = record(folder.path(), &settings, Replace::Never, &mut |_| Ok(()));
        inside = Some(second.unwrap_err().to_string());
        Ok(())
    })
    .unwrap();
    assert!(inside.unwrap().contains("another relcov is rendering"));

    std::fs::write(folder.path().join("synthetic.json"), "{ \"version\":").unwrap();
    let before = contents(folder.path());
    for replace in [Replace::Never, Replace::Synthetic] {
        let message = record(folder.path(), &settings, replace, &mut |_| Ok(())).unwrap_err().to_string();
        assert!(message.contains("synthetic.json") && message.contains("Remove"), "{message}");
    }
    assert_eq!(before, contents(folder.path()));
}

#[test]
fn replacing_removes_what_was_rendered_and_nothing_else() {
    let settings = SyntheticSettings { drives: 2, frames: 2, size: [32, 16], lidar_steps: 8, ..Default::default() };
    let folder = rendered(&settings);
    let own = folder.path().join("measurements/my_system/2026_01_01_drive_0001.csv");
    std::fs::create_dir_all(own.parent().unwrap()).unwrap();
    std::fs::write(&own, "mine").unwrap();
    let missing = frame_file(folder.path(), "image_03", 1, "png");
    std::fs::remove_file(&missing).unwrap();
    let smaller = SyntheticSettings { drives: 1, ..settings.clone() };
    std::fs::write(folder.path().join("measurements/vo/2026_01_01_drive_0001_mine.csv"), "mine").unwrap();
    // Interrupted at once: the folder counts as incomplete, not as whole.
    assert!(record(folder.path(), &smaller, Replace::Synthetic, &mut |_| Err(relcov::Error::Interrupted)).is_err());
    assert!(!is_rendered(folder.path(), &settings) && !is_rendered(folder.path(), &smaller));
    assert!(record(folder.path(), &smaller, Replace::Never, &mut |_| Ok(())).unwrap());
    assert!(is_rendered(folder.path(), &smaller) && missing.exists());
    assert_eq!(std::fs::read_to_string(&own).unwrap(), "mine");
    assert!(folder.path().join("measurements/vo/2026_01_01_drive_0001_mine.csv").exists());
    assert!(!folder.path().join("2026_01_01/2026_01_01_drive_0002_sync").exists());
}

#[test]
fn streets_are_rich_and_poor_the_car_turns_and_stops() {
    let folder = rendered(&SyntheticSettings { drives: 3, size: [96, 32], lidar_steps: 0, ..plain(300) });
    let (mut speeds, mut turns, mut sigmas) = (Vec::new(), 0, Vec::new());
    for drive in 1..=3 {
        let name = format!("2026_01_01_drive_{drive:04}");
        let poses = load_kitti_raw(folder.path(), &format!("{name}_sync")).unwrap().poses;
        let steps = (0..299).map(|frame| (poses[&frame].inverse() * poses[&(frame + 1)]).log());
        for step in steps {
            speeds.push(10.0 * step.fixed_rows::<3>(0).norm());
            turns += usize::from(step[5].abs() > 0.01);
        }
        let path = folder.path().join(format!("measurements/vo/{name}.csv"));
        let measured = parse_relative_poses(&std::fs::read_to_string(&path).unwrap(), &path).unwrap();
        sigmas.extend(measured.iter().map(|pose| pose.covariance.unwrap().std_devs()[2]));
    }
    assert!(speeds.iter().all(|&speed| speed <= 20.5));
    let share = |condition: &dyn Fn(f64) -> bool| speeds.iter().filter(|&&speed| condition(speed)).count();
    assert!(share(&|speed| speed < 0.05) >= 20, "the car never stops");
    assert!(share(&|speed| speed > 8.0) > 200, "the car never drives fast");
    assert!(turns > 50, "the car never turns");
    sigmas.sort_by(f64::total_cmp);
    let (good, bad) = (sigmas[sigmas.len() / 20], sigmas[sigmas.len() * 19 / 20]);
    assert!(bad > 2.0 * good, "the visual odometry is as good everywhere: {good} m and {bad} m");
}

#[test]
fn motion_blur_spreads_what_moves() {
    let sharp = rendered(&plain(12));
    let blurred = rendered(&SyntheticSettings { shutter_s: 0.05, ..plain(12) });
    let detail = |root: &Path| -> f64 {
        let image = planar(&frame_file(root, "image_02", 11, "png"));
        image.windows(2).map(|pair| f64::from((pair[1] - pair[0]).abs())).sum()
    };
    assert!(detail(blurred.path()) < 0.95 * detail(sharp.path()));
    let depth = |root: &Path| std::fs::read(frame_file(root, "depth_02", 11, "png")).unwrap();
    assert_eq!(depth(sharp.path()), depth(blurred.path()));
}
