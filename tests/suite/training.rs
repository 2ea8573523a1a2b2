//! Training end to end on a made drive: gradients of micro-batches, exact resume, bad frames.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use burn::module::Module;
use burn::optim::GradientsAccumulator;
use burn::tensor::Tensor;
use relcov::config::Config;
use relcov::device::open_device;
use relcov::error::Error;
use relcov::model::{Architecture, InputBasis, MicroBatch};
use relcov::pairs::{Dataset, PairBatch, PairReader, PairSample, PairScope, SplitName};
use relcov::training::{Event, Learner, RunFolder};

use crate::support::{write_config, write_drive};

struct Made {
    folder: tempfile::TempDir,
}

impl Made {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_drive(&folder.path().join("data"), 24);
        write_config(folder.path(), &folder.path().join("data"));
        Self { folder }
    }

    fn config(&self, overrides: &[&str]) -> Config {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        Config::load(&self.folder.path().join("config.toml"), &overrides).unwrap()
    }

    fn dataset(&self, config: &Config) -> Arc<Dataset> {
        Arc::new(Dataset::load(&config.pairs(), PairScope::Images).unwrap())
    }
}

#[test]
fn micro_batches_give_the_gradient_of_the_whole_batch() {
    let made = Made::new();
    let config = made.config(&[]);
    let dataset = made.dataset(&config);
    let reader = PairReader::new(&config.pairs(), &dataset, SplitName::Train);
    let samples: Vec<PairSample> =
        dataset.train.pairs.iter().take(8).map(|pair| reader.read(pair).unwrap().expect("readable")).collect();
    let device = open_device("flex").unwrap();
    let architecture = Architecture { input: InputBasis::Residual, dropout: 0.0, ..Architecture::paper(32, 16) };
    let model = crate::support::with_formula_weights(architecture.init([-6.0; 6], &device.clone().autodiff()));

    let gradient = |parts: usize| {
        let mut accumulator = GradientsAccumulator::new();
        for part in samples.chunks(samples.len() / parts) {
            let pairs = PairBatch::new(part, &device);
            let batch = MicroBatch { pairs, weight: 1.0 / samples.len() as f32, corrected_share: 0.5 };
            accumulator.accumulate(&model, model.step(&batch).1);
        }
        let mut all = Flatten { gradients: accumulator.grads(), values: Vec::new() };
        model.visit(&mut all);
        all.values
    };
    let (whole, parts) = (gradient(1), gradient(4));
    let scale = whole.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    let off = whole.iter().zip(&parts).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(scale > 0.0 && off <= 1e-5 * scale, "off by {off:e} of {scale:e}");
}

struct Flatten {
    gradients: burn::optim::GradientsParams,
    values: Vec<f64>,
}

impl burn::module::ModuleVisitor for Flatten {
    fn visit_float<const D: usize>(&mut self, param: &burn::module::Param<Tensor<D>>) {
        let gradient = self.gradients.get::<D>(param.id).expect("a gradient");
        self.values.extend(gradient.into_data().iter::<f64>());
    }
}

#[test]
fn unreadable_frames_are_substituted_until_they_are_too_many() {
    let made = Made::new();
    let image = |frame: usize| {
        let drive = made.folder.path().join("data/2020_01_01").join(crate::support::DRIVE);
        drive.join(format!("image_02/data/{frame:010}.png"))
    };
    let whole = std::fs::read(image(3)).unwrap();
    std::fs::write(image(3), &whole[..whole.len() / 2]).unwrap();

    let tolerant = made.config(&["data.max_bad_fraction=0.2", "training.epochs=1"]);
    let dataset = made.dataset(&tolerant);
    let device = open_device("flex").unwrap();
    let mut learner = Learner::start(tolerant, dataset, &device, false).unwrap();
    learner.train(&mut |_| {}).unwrap();
    let bad = learner.bad_frames();
    assert_eq!((bad.len(), bad[0].frame), (1, 3));
    assert!(bad[0].problem.contains("0000000003.png"), "{}", bad[0].problem);

    let strict = made.config(&["name=strict"]);
    let dataset = made.dataset(&strict);
    let error = Learner::start(strict, dataset, &device, false).unwrap().train(&mut |_| {}).unwrap_err();
    assert!(error.to_string().contains("data.max_bad_fraction"), "{error}");
}

#[test]
fn a_run_refuses_other_data_and_other_models() {
    let made = Made::new();
    let device = open_device("flex").unwrap();
    let config = made.config(&["training.epochs=1"]);
    let folder = config.run_folder();
    Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap().train(&mut |_| {}).unwrap();

    let again = Learner::start(config.clone(), made.dataset(&config), &device, false).err().unwrap();
    assert!(again.to_string().contains("--resume"), "{again}");
    for setting in [
        "model.input=pair",
        "data.train.0.frames=[0, 15]",
        "training.batch=16",
        "training.batches_per_epoch=1",
        "seed=1",
        "depth.camera_height_m=1.5",
    ] {
        let other = made.config(&[setting]);
        let run = RunFolder::open(&folder).unwrap();
        let error = Learner::resume(other.clone(), made.dataset(&other), &device, run).err().unwrap();
        assert!(error.to_string().contains("other settings"), "{setting}: {error}");
    }
    let image = made.folder.path().join("data/vo/2020_01_01_drive_0001.txt");
    let moved = std::fs::read_to_string(&image).unwrap().replacen("1.0000", "1.0004", 40);
    std::fs::write(&image, moved).unwrap();
    let error = Learner::resume(config.clone(), made.dataset(&config), &device, RunFolder::open(&folder).unwrap());
    assert!(error.err().unwrap().to_string().contains("other data"));
}

#[test]
fn a_run_resumes_with_more_epochs_whatever_its_floors() {
    // Errors of many sizes: floors with digits that a text format may round.
    for last in [11, 12, 13, 14, 15, 16] {
        let made = Made::new();
        let frames = format!("data.train.0.frames=[0, {last}]");
        let device = open_device("flex").unwrap();
        let config = made.config(&[&frames, "training.epochs=1", "training.batches_per_epoch=1"]);
        let folder = config.run_folder();
        Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap().train(&mut |_| {}).unwrap();
        let longer = made.config(&[&frames, "training.epochs=2", "training.batches_per_epoch=1"]);
        let run = RunFolder::open(&folder).unwrap();
        let manifest = std::fs::read(folder.join("manifest.json")).unwrap();
        let mut learner = Learner::resume(longer.clone(), made.dataset(&longer), &device, run).unwrap();
        let outcome = learner.train(&mut |_| {}).unwrap();
        assert_eq!(manifest, std::fs::read(folder.join("manifest.json")).unwrap());
        assert_eq!(outcome.epochs, 2);
    }
}

#[test]
fn a_split_that_shares_pairs_with_training_is_refused() {
    let made = Made::new();
    for split in ["validation", "test"] {
        let config = made.config(&[&format!("data.{split}.0.frames=[15, 18]")]);
        let message = Dataset::load(&config.pairs(), PairScope::Images).err().unwrap().to_string();
        assert!(message.contains(&format!("data.{split}")) && message.contains("frames 15 and 16"), "{message}");
    }
}

#[test]
fn held_out_pairs_share_no_image_with_training_pairs() {
    let made = Made::new();
    let config = made.config(&["data.validation=[]", "data.validation_fraction=0.25"]);
    let dataset = made.dataset(&config);
    let frames = |split: &relcov::pairs::Split| -> std::collections::BTreeSet<usize> {
        split.pairs.iter().flat_map(|pair| [pair.id.source, pair.id.target]).collect()
    };
    // Of the 16 pairs 0…15, four are held out, and the one before them goes.
    assert_eq!((dataset.train.systems[0].len(), dataset.validation.systems[0].len()), (11, 4));
    assert!(frames(&dataset.train).is_disjoint(&frames(&dataset.validation)));
}

#[test]
fn a_watched_split_that_cannot_be_read_is_an_error() {
    let made = Made::new();
    for frame in 16..20 {
        let drive = made.folder.path().join("data/2020_01_01").join(crate::support::DRIVE);
        std::fs::write(drive.join(format!("image_02/data/{frame:010}.png")), "broken").unwrap();
    }
    let config = made.config(&["data.max_bad_fraction=1.0"]);
    let device = open_device("flex").unwrap();
    let error = Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap().train(&mut |_| {});
    assert!(error.unwrap_err().to_string().contains("not one watched pair"));
    assert!(config.run_folder().join("state-000000002-00000").is_dir(), "what was learned is saved");
}

#[test]
fn a_run_stopped_by_bad_frames_before_its_first_step_resumes() {
    let made = Made::new();
    let drive = made.folder.path().join("data/2020_01_01").join(crate::support::DRIVE);
    let path = drive.join("image_02/data/0000000003.png");
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(&path, "broken").unwrap();
    let device = open_device("flex").unwrap();
    // One mini-batch of all pairs, so that the first one meets the bad frame.
    let config = made.config(&["training.batch=64", "training.batches_per_epoch=1", "training.epochs=1"]);
    let folder = config.run_folder();
    let error = Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap().train(&mut |_| {});
    assert!(error.unwrap_err().to_string().contains("max_bad_fraction"));
    std::fs::write(&path, whole).unwrap();
    let run = RunFolder::open(&folder).unwrap();
    let outcome = Learner::resume(config.clone(), made.dataset(&config), &device, run).unwrap().train(&mut |_| {});
    assert_eq!(outcome.unwrap().epochs, 1);
}

#[test]
fn an_interrupt_in_the_evaluation_resumes_to_it() {
    let made = Made::new();
    let device = open_device("flex").unwrap();
    let config = made.config(&["training.epochs=1"]);
    let mut learner = Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap();
    let flag = learner.interrupt_flag();
    let outcome = learner.train(&mut |event| match event {
        Event::Evaluation { .. } => flag.store(true, Ordering::Relaxed),
        Event::Epoch { .. } => panic!("the evaluation was interrupted"),
        _ => {}
    });
    assert!(matches!(outcome, Err(Error::Interrupted)));
    // Two of them would overwrite each other's states.
    let run = RunFolder::open(&config.run_folder()).unwrap();
    let second = Learner::resume(config.clone(), made.dataset(&config), &device, run.clone());
    assert!(second.err().unwrap().to_string().contains("is being trained already"));
    drop(learner);

    let mut learner = Learner::resume(config.clone(), made.dataset(&config), &device, run).unwrap();
    let mut epochs = 0;
    let outcome = learner.train(&mut |event| match event {
        Event::Batch { .. } => panic!("all mini-batches were learned before"),
        Event::Epoch { .. } => epochs += 1,
        _ => {}
    });
    assert_eq!((outcome.unwrap().epochs, epochs), (1, 1));
}

/// The same motion written as every kind of measurement file, in the axes of each body.
#[test]
fn every_road_of_a_measurement_leads_to_the_same_pairs() {
    let made = Made::new();
    let data = made.folder.path().join("data");
    let reference = made.dataset(&made.config(&[]));
    let calibration = &reference.drives[0].calibration;
    let camera_from_vehicle = calibration.camera_from_vehicle;
    // The made drive's camera 0 sits beside camera 2.
    assert!(calibration.camera_from_camera0.translation.x < -0.01);
    let trajectory = std::fs::read_to_string(data.join("vo/2020_01_01_drive_0001.txt")).unwrap();
    let trajectory = relcov::recordings::parse_kitti_trajectory(&trajectory, "vo".as_ref(), 0).unwrap();

    let mut timestamps = String::new();
    let (mut tum, mut relative) = (String::new(), "source,target,x,y,z,qx,qy,qz,qw\n".to_owned());
    let row = |pose: &relcov::geometry::Pose| {
        let q = nalgebra::UnitQuaternion::from_rotation_matrix(&pose.rotation);
        let t = pose.translation;
        [t.x, t.y, t.z, q.i, q.j, q.k, q.w].map(|value| format!("{value:.15}"))
    };
    let vehicle_from_camera0 = camera_from_vehicle.inverse() * calibration.camera_from_camera0;
    for (&frame, world_from_camera0) in &trajectory {
        timestamps += &format!("2020-01-01 00:00:{:05.2}\n", 0.1 * frame as f64);
        let world_from_vehicle = world_from_camera0.conjugated_by(&vehicle_from_camera0);
        tum += &format!("{:.3} {}\n", 1_577_836_800.0 + 0.1 * frame as f64, row(&world_from_vehicle).join(" "));
        if let Some(world_from_next) = trajectory.get(&(frame + 1)) {
            let motion = world_from_camera0.inverse() * *world_from_next;
            let in_camera2 = motion.conjugated_by(&calibration.camera_from_camera0);
            relative += &format!("{frame},{},{}\n", frame + 1, row(&in_camera2).join(","));
        }
    }
    std::fs::write(data.join("2020_01_01").join(crate::support::DRIVE).join("oxts/timestamps.txt"), timestamps)
        .unwrap();
    std::fs::write(data.join("vo/tum.txt"), tum).unwrap();
    std::fs::write(data.join("vo/relative.csv"), relative).unwrap();

    for source in [
        r#"{ name = "vo", share = 0.75, source = "trajectory", path = "vo/tum.txt", format = "tum", frame = "vehicle" }"#,
        r#"{ name = "vo", share = 0.75, source = "relative", path = "vo/relative.csv", frame = "camera2" }"#,
    ] {
        let systems = format!(r#"systems=[{source}, {{ name = "gnss", share = 0.25, source = "truth" }}]"#);
        let dataset = made.dataset(&made.config(&[&systems]));
        assert_eq!(dataset.train.pairs.len(), reference.train.pairs.len(), "{source}");
        for (a, b) in dataset.train.pairs.iter().zip(&reference.train.pairs) {
            assert!((a.error - b.error).norm() < 1e-8, "{source}: {} against {}", a.error, b.error);
            let off = (a.source_from_target.matrix() - b.source_from_target.matrix()).norm();
            assert!(off < 1e-8, "{source}: the warp's pose is off by {off}");
        }
    }
}

#[test]
fn the_pose_of_the_warp_is_that_of_camera_2() {
    let made = Made::new();
    let dataset = made.dataset(&made.config(&[]));
    // The truth drives 1 m forward without turning: in camera axes along z, wherever the camera sits.
    let truth = &dataset.train.pairs[dataset.train.systems[1].start];
    let expected = nalgebra::Vector3::new(0.0, 0.0, 1.0);
    assert!((truth.source_from_target.translation - expected).norm() < 1e-3, "{:?}", truth.source_from_target);
    // Camera 0 sees a yaw φ about its own y axis; camera 2, l to its right, also moves by (I − R) l.
    let measured = &dataset.train.pairs[1];
    let camera_from_camera0 = dataset.drives[0].calibration.camera_from_camera0;
    let offset = camera_from_camera0.translation;
    let in_camera0 = measured.source_from_target.conjugated_by(&camera_from_camera0.inverse());
    let rotation = measured.source_from_target.rotation;
    let by_hand = in_camera0.translation + offset - rotation * offset;
    assert!((measured.source_from_target.translation - by_hand).norm() < 1e-12);
    let text = std::fs::read_to_string(made.folder.path().join("data/vo/2020_01_01_drive_0001.txt")).unwrap();
    let file = relcov::recordings::parse_kitti_trajectory(&text, "vo".as_ref(), 0).unwrap();
    let from_file = file[&1].inverse() * file[&2];
    assert!((from_file.matrix() - in_camera0.matrix()).norm() < 1e-12);
}

#[test]
fn an_interrupt_saves_the_mini_batch_and_says_so() {
    let made = Made::new();
    let device = open_device("flex").unwrap();
    let config = made.config(&[]);
    let folder = config.run_folder();
    let mut learner = Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap();
    let flag = learner.interrupt_flag();
    let error = learner.train(&mut |event| {
        if matches!(event, Event::Batch { .. }) {
            flag.store(true, Ordering::Relaxed);
        }
    });
    assert!(matches!(error, Err(Error::Interrupted)));
    assert!(folder.join("state-000000001-00000/history.json").is_file());
    assert!(!folder.join("model.safetensors").exists());
}

/// Earlier versions had c1…c5 in the network itself.
#[test]
fn a_run_of_an_earlier_version_loads() {
    let made = Made::new();
    let device = open_device("flex").unwrap();
    let config = made.config(&["training.epochs=1", "training.batches_per_epoch=1"]);
    Learner::start(config.clone(), made.dataset(&config), &device, false).unwrap().train(&mut |_| {}).unwrap();
    let path = config.run_folder().join("model.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let (_, metadata) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    let renamed: Vec<(String, safetensors::tensor::TensorView)> =
        file.tensors().into_iter().map(|(name, view)| (name.replace(".convolutions.", "."), view)).collect();
    assert_eq!(renamed.iter().filter(|(name, _)| name.starts_with("network.c")).count(), 10, "c1…c5");
    let old = safetensors::serialize(renamed, metadata.metadata().clone()).unwrap();
    let run = RunFolder::open(&config.run_folder()).unwrap();
    let manifest = run.manifest().unwrap();
    let activations = || -> Vec<f32> {
        let model = run.load_model(&manifest, &device).unwrap();
        let (height, width) = (manifest.architecture.height, manifest.architecture.width);
        let [.., c5] = model.network().features(Tensor::ones([1, 6, height, width], &device));
        c5.into_data().iter().collect()
    };
    let expected = activations();
    std::fs::write(&path, old).unwrap();
    assert_eq!(activations(), expected);
}
