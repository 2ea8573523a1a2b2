//! Real data: what the loaders make of KITTI raw, against counts and statistics found by others.

use nalgebra::Vector6;
use relcov::config::Config;
use relcov::pairs::{Dataset, PairScope, Split, SplitName};

use crate::support::shared;

/// The full seven drives of the paper, poses only.
fn dataset(overrides: &[&str]) -> Option<Dataset> {
    let root = shared("kitti")?;
    let mut settings = vec![format!("data.root={:?}", root.display().to_string())];
    settings.extend(overrides.iter().map(|text| (*text).to_owned()));
    let config = Config::load("configs/kitti.toml".as_ref(), &settings).unwrap();
    Some(Dataset::load(&config.pairs(), PairScope::Poses).unwrap())
}

fn rms(split: &Split, system: usize) -> Vector6<f64> {
    split.mean_squared_error(system).map(f64::sqrt)
}

#[test]
fn the_seven_drives_hold_the_papers_pairs() {
    let Some(dataset) = dataset(&[]) else { return };
    let pose_pairs =
        |name| dataset.coverage.iter().filter(|part| part.split == name).map(|part| part.pose_pairs).sum::<usize>();
    assert_eq!(pose_pairs(SplitName::Train), 12_016);
    assert_eq!(pose_pairs(SplitName::Test), 1_223);
    assert!(dataset.drives.iter().all(|drive| drive.problems.is_empty()));
}

#[test]
fn libviso2_errs_on_drive_0034_as_measured_elsewhere() {
    let Some(dataset) = dataset(&[]) else { return };
    let errors = &dataset.test.pairs[dataset.test.systems[0].clone()];
    assert_eq!(errors.len(), 1_200);
    let expected_rms = [0.0398, 0.0081, 0.0087, 7.1e-4, 6.5e-4, 7.7e-4];
    let expected_mde = [0.0331, 0.0038, 0.0047, 4.3e-4, 3.7e-4, 2.6e-4];
    let rows: Vec<[f64; 6]> = errors.iter().map(|pair| pair.error.into()).collect();
    let nothing = relcov::geometry::Covariance6::from_variances(&Vector6::zeros());
    let zero = relcov::evaluation::evaluate(&vec![nothing; rows.len()], &rows, None).unwrap();
    let found = rms(&dataset.test, 0);
    for component in 0..6 {
        let (value, expected) = (found[component], expected_rms[component]);
        assert!((value / expected - 1.0).abs() <= 0.03, "RMS {component}: {value} against {expected}");
        let (value, expected) = (zero.mde[component], expected_mde[component]);
        assert!((value / expected - 1.0).abs() <= 0.03, "MDE {component}: {value} against {expected}");
    }
}

#[test]
fn the_truth_as_a_system_has_exactly_no_error() {
    let Some(dataset) = dataset(&[]) else { return };
    assert_eq!(rms(&dataset.test, 1), Vector6::zeros());
    assert_eq!(rms(&dataset.train, 1), Vector6::zeros());
}

#[test]
fn oxts_agrees_with_the_odometry_poses_within_its_jitter() {
    let settings = [
        r#"truth={ source = "trajectory", path = "odometry_poses/{sequence}.txt" }"#,
        r#"systems=[{ name = "oxts", share = 1.0, source = "oxts" }]"#,
        "data.validation_fraction=0.0",
    ];
    let Some(dataset) = dataset(&settings) else { return };
    // kitti/README.md: 3 to 7 cm along the driving direction, nothing to speak of across it.
    for split in [&dataset.train, &dataset.test] {
        let rms = rms(split, 0);
        assert!((0.03..=0.07).contains(&rms[0]), "forward {}", rms[0]);
        assert!(rms[1] < 0.02 && rms[2] < 0.02, "lateral {}, vertical {}", rms[1], rms[2]);
        assert!(rms.fixed_rows::<3>(3).max() < 2e-3, "rotation {rms}");
    }
    assert_eq!(dataset.test.pairs.len(), 1_200);
}

#[test]
fn the_error_frame_turns_the_axes() {
    let (Some(vehicle), Some(camera), Some(world)) =
        (dataset(&[]), dataset(&["data.error_frame=camera"]), dataset(&["data.error_frame=world"]))
    else {
        return;
    };
    let first = |dataset: &Dataset| dataset.test.pairs[0].error;
    let (vehicle, camera, world) = (first(&vehicle), first(&camera), first(&world));
    // Vehicle x forward, y left, z up; camera x right, y down, z forward: rotations turn, whatever the lever arm.
    let rotation = |error: Vector6<f64>| error.fixed_rows::<3>(3).into_owned();
    let (v, c) = (rotation(vehicle), rotation(camera));
    let turned = nalgebra::Vector3::new(-v.y, -v.z, v.x);
    assert!((turned - c).norm() < 0.05 * v.norm(), "{v} against {c}");
    let dataset = dataset(&[]).expect("it was there before");
    let pair = &dataset.test.pairs[0];
    let world_from_vehicle = dataset.drives[pair.id.drive].poses[&pair.id.source].rotation;
    assert!(world_from_vehicle.angle() > 0.1, "the vehicle does not head east, so the axes differ");
    for part in [0, 3] {
        let turned = world_from_vehicle * vehicle.fixed_rows::<3>(part);
        assert!((turned - world.fixed_rows::<3>(part)).norm() < 1e-9, "{turned} against {world}");
    }
}
