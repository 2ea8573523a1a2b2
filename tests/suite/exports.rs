//! Exports through a reader that was not written here: factrs'. GTSAM, graphslam, ROS and evo are asked by
//! `data_scripts/check_exports.py`.

use factrs::symbols::X;
use factrs::utils::load_g20;
use factrs::variables::{SE3, SO3};
use nalgebra::{UnitQuaternion, Vector6};
use relcov::export::{ExportOptions, Format, G2oRotation, MeasuredMotion, MeasuredMotions};
use relcov::geometry::{Covariance6, ErrorFrame, Pose, Tangent};

#[test]
fn factrs_reads_the_error_that_the_covariance_says() {
    let skew = Pose::exp(&Tangent::new(0.3, -0.2, 0.1, 0.2, 0.1, -0.3));
    let motion = MeasuredMotion {
        source: 0,
        target: 1,
        times: None,
        source_from_target: Pose::exp(&Tangent::new(1.1, 0.05, -0.02, 0.01, -0.02, 0.1)),
        covariance: Covariance6::from_std_devs(&Tangent::new(0.05, 0.02, 0.03, 1e-3, 2e-3, 8e-4)).transported(&skew),
        posterior: None,
        verdict: None,
    };
    let measured = MeasuredMotions {
        system: "vo".to_owned(),
        drive: "lab".to_owned(),
        frame: ErrorFrame::Vehicle,
        motions: vec![motion.clone()],
    };
    let options = ExportOptions { g2o_rotation: G2oRotation::Angle, ..ExportOptions::default() };
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), Format::G2o.render(&measured, &options).unwrap()).unwrap();
    let (graph, mut values) = load_g20(file.path().to_str().unwrap());
    // The reader's prior on the first vertex, and our edge; nothing is wrong at what was measured.
    assert_eq!((graph.len(), values.len()), (2, 2));
    assert!(graph.error(&values) < 1e-20);

    let error = Vector6::new(0.06, -0.01, 0.02, 1e-3, -3e-3, 1e-3);
    let truth = Pose::exp(&-error) * motion.source_from_target;
    let q = UnitQuaternion::from_rotation_matrix(&truth.rotation);
    let t = truth.translation;
    let rotation = SO3::from_xyzw(q.i, q.j, q.k, q.w);
    values.insert_unchecked(X(1), SE3::from_rot_trans(rotation, factrs::linalg::Vector3::new(t.x, t.y, t.z)));
    let (distance, _) = motion.covariance.mahalanobis(&error).unwrap();
    let found = 2.0 * graph.error(&values);
    assert!((found / distance - 1.0).abs() < 1e-6, "{found} against {distance}");
}
