//! Two motions to export, and what every format has in common.

use clap::ValueEnum;

use super::*;
use crate::geometry::{Covariance6, ErrorFrame, Pose, Posterior, Tangent};
use crate::time::Time;

/// Two motions with full covariances.
pub(super) fn measured() -> MeasuredMotions {
    let time = |frame: usize| Time::from_nanoseconds(1_403_636_579_763_555_584 + 50_000_000 * frame as i64);
    let motion = |source: usize, tangent: Tangent| {
        let skewed = Pose::exp(&Tangent::new(0.3, -0.2, 0.1, 0.2, 0.1, -0.3));
        let std_devs = Tangent::new(0.05, 0.02, 0.03, 1e-3, 2e-3, 8e-4);
        MeasuredMotion {
            source,
            target: source + 1,
            times: Some([source, source + 1].map(time)),
            source_from_target: Pose::exp(&tangent),
            covariance: Covariance6::from_std_devs(&std_devs).transported(&skewed),
            posterior: None,
            verdict: None,
        }
    };
    let motions = vec![
        motion(4, Tangent::new(1.1, 0.05, -0.02, 0.01, -0.02, 0.1)),
        motion(5, Tangent::new(1.0, -0.03, 0.02, -0.01, 0.02, -0.2)),
    ];
    MeasuredMotions { system: "vo".to_owned(), drive: "drive".to_owned(), frame: ErrorFrame::Vehicle, motions }
}

/// The same, of which the images show a part of the error.
pub(super) fn seen() -> MeasuredMotions {
    let mut seen = measured();
    for (motion, share) in seen.motions.iter_mut().zip([1.0, -0.5]) {
        let mean = share * Tangent::new(0.06, -0.03, 0.02, 2e-3, -1e-3, 3e-3);
        let posterior = Posterior { mean, covariance: motion.covariance };
        (motion.covariance, motion.posterior) = (posterior.second_moment(), Some(posterior));
        motion.verdict = Some(Verdict::Given);
    }
    seen
}

#[test]
fn every_format_writes_the_corrected_motions_as_it_writes_measured_ones() {
    let corrected = ExportOptions { poses: Poses::Corrected, ..ExportOptions::default() };
    let by_hand = seen().corrected().unwrap();
    for format in Format::value_variants() {
        let text = format.render(&seen(), &corrected).unwrap();
        let expected = format.render(&by_hand, &ExportOptions::default()).unwrap();
        // What says that they are corrected is all that differs.
        let plain = text.replace(corrected.remark(), "").replace("\"corrected\":true,", "");
        assert_eq!(plain, expected, "{}", format.name());
        assert_ne!(text, format.render(&seen(), &ExportOptions::default()).unwrap());
        let problem = format.render(&measured(), &corrected).unwrap_err().to_string();
        assert!(problem.contains("does not predict the error itself"), "{problem}");
    }
}

#[test]
fn options_that_a_format_cannot_honour_are_refused() {
    let left = ExportOptions { perturbation: Some(Perturbation::Left), ..ExportOptions::default() };
    let right = ExportOptions { perturbation: Some(Perturbation::Right), ..ExportOptions::default() };
    for format in [Format::G2o, Format::Gtsam] {
        assert!(format.check(&right).is_ok());
        assert!(format.check(&left).unwrap_err().to_string().contains("right perturbation"));
    }
    assert!(Format::Ros.check(&right).unwrap_err().to_string().contains("fixed axes"));
    let angle = ExportOptions { g2o_rotation: G2oRotation::Angle, ..ExportOptions::default() };
    assert!(Format::G2o.check(&angle).is_ok() && Format::Csv.check(&angle).is_err());
    let bad = ExportOptions { floor: Some([f64::NAN, 0.0]), ..ExportOptions::default() };
    assert!(Format::Ros.check(&bad).is_err());
}

#[test]
fn motions_in_axes_that_turn_are_not_joined() {
    let measured = MeasuredMotions { frame: ErrorFrame::World, ..measured() };
    for (format, joins) in [(Format::Tum, true), (Format::G2o, true), (Format::Gtsam, true), (Format::Ros, false)] {
        let rendered = format.render(&measured, &ExportOptions::default());
        assert_eq!(rendered.is_err_and(|error| error.to_string().contains("axes of the world turn")), joins);
    }
}

#[test]
fn a_floor_lifts_what_lies_below_it_and_nothing_else() {
    let mut measured = measured();
    measured.motions[0].covariance = Covariance6::from_variances(&Tangent::new(0.0, 1.0, 1.0, 0.0, 1.0, 1.0));
    let lifted = measured.motions[0].covariance_on(Perturbation::Left, Some([1e-4, 1e-6])).variance();
    assert_eq!(lifted, Tangent::new(1e-4, 1.0, 1.0, 1e-6, 1.0, 1.0));
}
