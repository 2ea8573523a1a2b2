//! Training end to end on a made drive: gradients of micro-batches, exact resume, bad frames.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use burn::module::Module;
use burn::optim::GradientsAccumulator;
use burn::tensor::Tensor;
use burn::train::TrainStep;
use relcov::config::Config;
use relcov::data::{Dataset, PairBatch, PairReader, PairSample, PairScope};
use relcov::device::open_device;
use relcov::error::Error;
use relcov::model::{Architecture, InputBasis, MicroBatch};
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
        Arc::new(Dataset::load(config, PairScope::Images).unwrap())
    }
}

#[test]
fn micro_batches_give_the_gradient_of_the_whole_batch() {
    let made = Made::new();
    let config = made.config(&[]);
    let dataset = made.dataset(&config);
    let reader = PairReader::new(&config, &dataset);
    let samples: Vec<PairSample> =
        dataset.train.pairs.iter().take(8).map(|pair| reader.read(pair).unwrap().expect("readable")).collect();
    let device = open_device("flex").unwrap();
    let architecture =
        Architecture { width: 32, height: 16, input: InputBasis::Residual, dropout: 0.0, log_variance_floor: None };
    let model = crate::support::with_formula_weights(architecture.init([-6.0; 6], &device.clone().autodiff()));

    let gradient = |parts: usize| {
        let mut accumulator = GradientsAccumulator::new();
        for part in samples.chunks(samples.len() / parts) {
            let batch = MicroBatch { pairs: PairBatch::new(part, &device), weight: 1.0 / samples.len() as f32 };
            accumulator.accumulate(&model, TrainStep::step(&model, batch).grads);
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
    let bad = learner.reader().bad_frames();
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
    for (setting, word) in [("model.input=pair", "another model"), ("data.train.0.frames=[0, 15]", "other data")] {
        let other = made.config(&[setting]);
        let run = RunFolder::open(&folder).unwrap();
        let error = Learner::resume(other.clone(), made.dataset(&other), &device, run).err().unwrap();
        assert!(error.to_string().contains(word), "{error}");
    }
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
    assert!(folder.join("state-000000001/history.json").is_file());
    assert!(!folder.join("model.safetensors").exists());
}
