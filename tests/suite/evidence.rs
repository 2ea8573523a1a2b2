//! Evidence on rendered drives: what alignment sees, generated measurements, and runs that learn from both.

use std::path::Path;
use std::sync::OnceLock;
use std::sync::atomic::Ordering;

use relcov::alignment::NoVerdict;
use relcov::config::Config;
use relcov::depth::DepthMap;
use relcov::device::open_device;
use relcov::error::Error;
use relcov::geometry::{Pose, Tangent};
use relcov::pairs::{Dataset, Pair, PairReader, PairScope, SplitName};
use relcov::recordings::RgbImage;
use relcov::synthetic::{Replace, SyntheticSettings, record};
use relcov::training::{Event, Learner, RunFolder};
use relcov::{Judgement, Measurement, Model};

const CONFIG: &str = r#"
name = "evidence"
checkpoints = "runs"
[data]
root = "street"
train = [{ drive = "2026_01_01_drive_0001_sync" }]
validation = [{ drive = "2026_01_01_drive_0002_sync", frames = [0, 12] }]
test = [{ drive = "2026_01_01_drive_0002_sync", frames = [13, 24] }]
[[systems]]
name = "vo"
share = 0.25
source = "relative"
path = "measurements/vo/{drive}.csv"
frame = "camera2"
[[systems]]
name = "perturbation"
share = 0.75
source = "perturbation"
[depth]
source = "files"
path = "{date}/{drive}/depth_02/data/{frame}.png"
[model]
width = 192
height = 64
evidence = "alignment"
network = "none"
head = "posterior"
[training]
batch = 8
micro_batch = 4
learning_rate = 1e-3
epochs = 3
batches_per_epoch = 3
"#;

/// Two short drives, rendered once.
fn street() -> &'static Path {
    static STREET: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = STREET.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let settings = SyntheticSettings {
            drives: 2,
            frames: 26,
            size: [192, 64],
            lidar_steps: 0,
            vo_pixel_noise: 1.0,
            vo_landmarks: 30,
            ..SyntheticSettings::default()
        };
        record(&folder.path().join("street"), &settings, Replace::Never, &mut |_| Ok(())).unwrap();
        folder
    });
    folder.path()
}

fn config(runs: &Path, overrides: &[&str]) -> Config {
    let path = runs.join("config.toml");
    std::fs::write(&path, CONFIG).unwrap();
    let overrides: Vec<String> = overrides
        .iter()
        .map(|text| (*text).to_owned())
        .chain([format!("data.root={}", street().join("street").display())])
        .collect();
    Config::load(&path, &overrides).unwrap()
}

fn dataset(config: &Config) -> std::sync::Arc<Dataset> {
    std::sync::Arc::new(Dataset::load(&config.pairs(), PairScope::Images).unwrap())
}

#[test]
fn alignment_sees_the_error_of_a_rendered_pair() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), &[]);
    let dataset = dataset(&config);
    let reader = PairReader::new(&config.pairs(), &dataset, SplitName::Train);
    let unit = Tangent::new(1.0, 0.6, -0.8, 0.1, 0.08, -0.1);
    let sizes = [1e-3, 1e-2, 1e-1];
    let mut offs = sizes.map(|_| Vec::new());
    for pair in dataset.train.pairs_of(1).iter().step_by(3) {
        let sample = reader.read(pair).unwrap().unwrap();
        let camera_from_errors = pair.errors_from_camera.inverse();
        let truth = Pose::exp(&-pair.error).conjugated_by(&camera_from_errors) * pair.source_from_target;
        let estimate = |error: &Tangent| {
            let source_from_target = Pose::exp(error).conjugated_by(&camera_from_errors) * truth;
            let wrong = relcov::pairs::PairSample { source_from_target, ..sample.clone() };
            let evidence = wrong.align(&pair.errors_from_camera);
            assert_eq!(evidence.no_verdict, None);
            evidence.finest().error
        };
        // What is seen of a measurement without error: the rest that depth, light and moving cars leave.
        let rest = estimate(&Tangent::zeros());
        for (size, offs) in sizes.iter().zip(&mut offs) {
            let error = *size * unit;
            offs.push((estimate(&error) - rest - error).component_div(&unit).abs().max());
        }
    }
    for (size, mut offs) in sizes.into_iter().zip(offs) {
        offs.sort_by(f64::total_cmp);
        let (median, worst) = (offs[offs.len() / 2], offs[offs.len() - 1]);
        assert!(median < 3e-4 + 0.05 * size, "size {size}: off by {median} in the median of {} pairs", offs.len());
        // A car that moves may be taken for still from one start and not from the other.
        assert!(worst < 2e-3 + 0.3 * size, "size {size}: off by {worst}");
    }
}

#[test]
fn generated_measurements_are_wrong_by_their_stated_error() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), &[]);
    let dataset = dataset(&config);
    let again = self::dataset(&config);
    for (pair, twin) in dataset.train.pairs_of(1).iter().zip(again.train.pairs_of(1)) {
        assert_eq!(pair, twin, "a pure function of the seed");
        assert_eq!(pair.measured(None), (pair.source_from_target, pair.error));
        let truth = |(measured, error): (Pose, Tangent)| {
            let in_errors = measured.conjugated_by(&pair.errors_from_camera);
            Pose::exp(&-error) * in_errors
        };
        let stored = truth(pair.measured(None));
        let draws: Vec<(Pose, Tangent)> = (0..3).map(|draw| pair.measured(Some(draw))).collect();
        assert!((draws[0].1 - pair.error).norm() < 1e-12 && draws[1].1 != draws[2].1, "anew in every pass");
        for draw in draws {
            // Wrong by its error about the same truth.
            assert!((truth(draw).matrix() - stored.matrix()).norm() < 1e-9);
        }
        let motion = pair.source_from_target.conjugated_by(&pair.errors_from_camera).log();
        assert!((motion - pair.motion).norm() < 1e-12, "errors are in axes of the vehicle here");
    }
    // Of a measured system every draw is the measurement.
    let measured: &Pair = &dataset.train.pairs_of(0)[0];
    assert_eq!(measured.measured(Some(2)), (measured.source_from_target, measured.error));
}

/// Losses of every mini-batch and epoch.
fn train(mut learner: Learner, until: Option<usize>) -> (Vec<f64>, Result<(), Error>) {
    let flag = learner.interrupt_flag();
    let mut losses = Vec::new();
    let outcome = learner.train(&mut |event| match event {
        Event::Batch { loss, .. } => {
            losses.push(loss);
            if Some(losses.len()) == until {
                flag.store(true, Ordering::Relaxed);
            }
        }
        Event::Epoch { row, .. } => losses.extend(row.training_loss.iter().chain(&row.evaluation_loss).flatten()),
        _ => {}
    });
    (losses, outcome.map(|_| ()))
}

#[test]
fn a_run_with_generated_measurements_resumes_to_the_same_losses() {
    // In a process of its own: other tests would draw from the random numbers of its weights and its dropout.
    const ALONE: &str = "RELCOV_TEST_ALONE";
    if std::env::var_os(ALONE).is_none() {
        let mut command = std::process::Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", "evidence::a_run_with_generated_measurements_resumes_to_the_same_losses"]);
        let output = command.env(ALONE, "1").output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && text.contains("1 passed"), "{text}");
        return;
    }
    let device = open_device("flex").unwrap();
    for overrides in [
        vec![],
        // Evidence alone for an epoch, then with images.
        vec!["model.network=table_one", "training.evidence_epochs=1", "training.schedule=cosine"],
    ] {
        let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let unbroken = config(whole.path(), &overrides);
        let (expected, outcome) =
            train(Learner::start(unbroken.clone(), dataset(&unbroken), &device, false).unwrap(), None);
        outcome.unwrap();
        let broken = config(parts.path(), &overrides);
        let (mut losses, outcome) =
            train(Learner::start(broken.clone(), dataset(&broken), &device, false).unwrap(), Some(2));
        assert!(matches!(outcome, Err(Error::Interrupted)));
        let run = RunFolder::open(&broken.run_folder()).unwrap();
        let (rest, outcome) = train(Learner::resume(broken.clone(), dataset(&broken), &device, run).unwrap(), None);
        outcome.unwrap();
        losses.extend(rest);
        assert_eq!(losses, expected);
    }
}

#[test]
fn a_measurement_that_shows_nothing_gets_the_priors_covariance_and_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), &["training.epochs=1"]);
    let dataset = dataset(&config);
    let device = open_device("flex").unwrap();
    let (_, outcome) = train(Learner::start(config.clone(), dataset.clone(), &device, false).unwrap(), None);
    outcome.unwrap();
    let model = Model::load(config.run_folder(), &device).unwrap();
    let pair = &dataset.test.pairs_of(0)[0];
    let sample = PairReader::new(&config.pairs(), &dataset, SplitName::Test).read(pair).unwrap().unwrap();
    let whole = Measurement {
        source_image: (*sample.source_image).clone(),
        target_image: (*sample.target_image).clone(),
        target_depth: (*sample.target_depth).clone(),
        camera: sample.camera,
        source_from_target: sample.source_from_target,
        right: None,
        camera_from_vehicle: None,
    };
    let Judgement { covariance, posterior, evidence, .. } = model.judge(&whole).unwrap();
    let posterior = posterior.expect("a posterior head");
    assert_eq!(evidence.unwrap().no_verdict, None);
    assert!((posterior.second_moment().matrix() - covariance.matrix()).norm() < 1e-12 && posterior.mean.norm() > 0.0);

    let flat = |level: u8| RgbImage { bytes: vec![level; 3 * 192 * 64], ..whole.source_image.clone() };
    let depth = |keep: &dyn Fn(usize) -> bool| DepthMap {
        depth_m: whole.target_depth.depth_m.iter().enumerate().map(|(k, &d)| if keep(k) { d } else { 0.0 }).collect(),
        ..whole.target_depth.clone()
    };
    let moved = |x: f64| Pose::exp(&Tangent::new(0.0, 0.0, x, 0.0, 0.0, 0.0)) * whole.source_from_target;
    for (measurement, reason) in [
        (Measurement { source_image: flat(0), target_image: flat(0), ..whole.clone() }, NoVerdict::NoTexture),
        (Measurement { target_image: flat(128), ..whole.clone() }, NoVerdict::NoTexture),
        (Measurement { target_depth: depth(&|_| false), ..whole.clone() }, NoVerdict::NoDepth),
        (Measurement { target_depth: depth(&|k| k % 100 == 0), ..whole.clone() }, NoVerdict::NoDepth),
        (Measurement { source_from_target: moved(-1000.0), ..whole.clone() }, NoVerdict::NoOverlap),
    ] {
        let Judgement { covariance, posterior, evidence, .. } = model.judge(&measurement).unwrap();
        let posterior = posterior.unwrap();
        assert_eq!(evidence.unwrap().no_verdict, Some(reason));
        assert_eq!(posterior.mean, Tangent::zeros());
        assert!(covariance.is_diagonal() && covariance.is_positive() && covariance == posterior.covariance);
    }
}
