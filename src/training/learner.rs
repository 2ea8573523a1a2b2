//! The learner: mini-batches of several systems, Adam, evaluation after each epoch, and a stop when
//! training and evaluation loss diverge (paper Section V-A).
//!
//! Built on Burn's training interfaces (gradient accumulation, optimisers and their records) with
//! a loop of its own, because a run must resume in the middle of an epoch to the same result.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use burn::module::Module;
use burn::optim::{GradientsAccumulator, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::events::{Event, Outcome, StopReason};
use super::history::History;
use super::manifest::Manifest;
use super::run_folder::RunFolder;
use super::setup::{constant_loss, describe, watched_split, watched_system};
use crate::config::Config;
use crate::error::{Error, Result};
use crate::evaluation::{Prediction, Recalibration, mean_loss, predict_split, read_values, share_at_floor};
use crate::kernels::Adam;
use crate::model::{Architecture, CovarianceModel, MicroBatch};
use crate::pairs::{
    BadFrame, BatchLoader, Choice, Dataset, Images, LoadedBatch, PairReader, Request, Split, SplitName,
};
use crate::schedule::{DivergenceRule, Stages};
use crate::systems::{Mixer, PlannedPair};

/// Longest time between two saved states, so that a killed run loses little.
const SAVE_EVERY: Duration = Duration::from_secs(600);

/// Trains a [`CovarianceModel`] and keeps its best state in a run folder.
pub struct Learner {
    config: Config,
    dataset: Arc<Dataset>,
    reader: Arc<PairReader>,
    watched_reader: Arc<PairReader>,
    device: Device,
    architecture: Architecture,
    run: RunFolder,
    /// Absent only while the optimiser or the loading of a state has it: nobody else may hold the weights
    /// that a step changes in place.
    model: Option<CovarianceModel>,
    optimiser: ModuleOptimizer,
    history: History,
    constant_loss: Vec<Option<f64>>,
    interrupt: Arc<AtomicBool>,
}

impl Learner {
    /// Begins a run: builds the model and writes the run folder's description.
    ///
    /// # Errors
    /// A split is empty, or the folder holds a run already or cannot be written.
    pub fn start(config: Config, dataset: Arc<Dataset>, device: &Device, replace: bool) -> Result<Self> {
        dataset.require(SplitName::Train)?;
        let config = config.with_generated_sizes(&dataset.generated_sizes);
        let manifest = describe(&config, &dataset, device);
        let learner = Self::new(config, dataset, &manifest, device, |path| RunFolder::create(path, replace))?;
        learner.run.write_config(&learner.config)?;
        learner.run.write_manifest(&manifest)?;
        Ok(learner)
    }

    /// Continues a run from its newest state.
    ///
    /// # Errors
    /// The folder holds no state, or was made from other data or for another architecture.
    pub fn resume(config: Config, dataset: Arc<Dataset>, device: &Device, run: RunFolder) -> Result<Self> {
        dataset.require(SplitName::Train)?;
        let config = config.with_generated_sizes(&dataset.generated_sizes);
        let manifest = run.manifest()?;
        if manifest.experiment_fingerprint != config.experiment_fingerprint() {
            return Err(Error::run(
                run.path(),
                "was started with other settings; a resumed run may change its device, data.root, data.max_bad_fraction, data.cache_mb, and of training: epochs, stop, learning_rate, image_learning_rate, schedule, micro_batch, loader_threads, prefetch, prefetch_mb; start a new run for others",
            ));
        }
        if manifest.data_fingerprint != dataset.fingerprint() {
            return Err(Error::run(
                run.path(),
                "was started with other data (pairs or errors differ); give it the same data, or start a new run",
            ));
        }
        let mut learner = Self::new(config, dataset, &manifest, device, |_| run.owned())?;
        let model = learner.model.take().expect("a new learner has its model");
        let (model, optimiser, history) =
            learner.run.load_state(model, learner.optimiser, learner.config.systems.len())?;
        (learner.model, learner.optimiser, learner.history) = (Some(model), optimiser, history);
        learner.run.write_config(&learner.config)?;
        Ok(learner)
    }

    fn new(
        config: Config,
        dataset: Arc<Dataset>,
        manifest: &Manifest,
        device: &Device,
        open: impl FnOnce(&std::path::Path) -> Result<RunFolder>,
    ) -> Result<Self> {
        let watched = watched_split(&config);
        let system = watched_system(&config);
        if dataset.split(watched).systems[system].is_empty() {
            dataset.require(watched)?;
        }
        let run = open(&config.run_folder())?;
        device.seed(config.seed);
        let model = manifest.architecture.init(manifest.initial_log_variance, &device.clone().autodiff());
        let optimiser = Adam::new().into();
        Ok(Self {
            reader: Arc::new(PairReader::new(&config.pairs(), &dataset, SplitName::Train)),
            watched_reader: Arc::new(PairReader::new(&config.pairs(), &dataset, watched)),
            constant_loss: constant_loss(&dataset, watched, manifest),
            device: device.clone(),
            history: History::new(config.systems.len()),
            architecture: manifest.architecture.clone(),
            interrupt: Arc::default(),
            config,
            dataset,
            run,
            model: Some(model),
            optimiser,
        })
    }

    /// Set it to stop after the mini-batch under way; the state is saved.
    pub fn interrupt_flag(&self) -> Arc<AtomicBool> {
        self.interrupt.clone()
    }

    /// The run folder.
    pub fn run(&self) -> &RunFolder {
        &self.run
    }

    fn model(&self) -> &CovarianceModel {
        self.model.as_ref().expect("put back by whoever took it")
    }

    /// Frames that could not be read so far, of the training pairs and the watched ones.
    pub fn bad_frames(&self) -> Vec<BadFrame> {
        let mut bad_frames = self.reader.bad_frames();
        bad_frames.extend(self.watched_reader.bad_frames());
        bad_frames
    }

    /// Pairs that were left out so far because their source shows nothing of the target, each described.
    pub fn blind_pairs(&self) -> Vec<String> {
        [&self.reader, &self.watched_reader].iter().flat_map(|reader| reader.blind_pairs()).collect()
    }

    /// Mini-batches in an epoch.
    pub fn batches_per_epoch(&self) -> usize {
        let once = self.dataset.train.systems[0].len().div_ceil(self.config.pairs_per_batch()[0]);
        self.config.training.batches_per_epoch.unwrap_or(once)
    }

    /// Trains until the losses diverge or all epochs are done.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after an interrupt, state saved; or data cannot be read, the loss is no
    /// longer finite, or the run folder cannot be written.
    pub fn train(&mut self, observer: &mut dyn FnMut(Event)) -> Result<Outcome> {
        let batches_per_epoch = self.batches_per_epoch();
        observer(Event::Started {
            batches_done: self.history.batches,
            batches_per_epoch,
            parameters: self.model().num_params(),
            constant_loss: &self.constant_loss,
        });
        let mut loader = self.spawn_loader()?;
        let mut saved = Instant::now();
        loop {
            if let Some(reason) = self.stop_reason() {
                let best_epoch = self.history.best_epoch.expect("at least one epoch");
                self.recalibrate(observer)?;
                return Ok(Outcome { reason, epochs: self.history.rows.len(), best_epoch });
            }
            let epoch = self.history.rows.len() + 1;
            while self.history.batches < self.history.epoch_start + batches_per_epoch {
                let loss = self.learn_batch(&mut loader).map_err(|error| self.saved_before(error))?;
                observer(Event::Batch {
                    epoch,
                    batch: self.history.batches - self.history.epoch_start,
                    pairs_per_second: self.history.pairs_per_second(),
                    loss,
                });
                if saved.elapsed() > SAVE_EVERY {
                    self.save_state()?;
                    saved = Instant::now();
                }
                self.stop_if_interrupted()?;
            }
            let best = self.finish_epoch(observer).map_err(|error| self.saved_before(error))?;
            saved = Instant::now();
            observer(Event::Epoch { row: self.history.rows.last().expect("just finished"), best });
            self.stop_if_interrupted()?;
        }
    }

    /// Unreadable data end a run but not the work done: the state is saved before the error is returned.
    fn saved_before(&self, error: Error) -> Error {
        if matches!(error, Error::Data(_))
            && let Err(unsaved) = self.save_state()
        {
            tracing::warn!("the state could not be saved: {unsaved}");
        }
        error
    }

    fn stop_if_interrupted(&self) -> Result<()> {
        if self.interrupt.load(Ordering::Relaxed) {
            self.save_state()?;
            return Err(Error::Interrupted);
        }
        Ok(())
    }

    /// One step of Adam on the mean loss of a mini-batch, taken in micro-batches.
    fn learn_batch(&mut self, loader: &mut BatchLoader) -> Result<f64> {
        let begin = Instant::now();
        let (seed, batch, stages) = (self.config.seed, self.history.batches, self.stages());
        let size = self.config.training.batch;
        let mut gradients = GradientsAccumulator::new();
        let mut losses: Vec<Tensor<1>> = Vec::new();
        let mut learned: Vec<usize> = Vec::new();
        for part in 0..size.div_ceil(stages.part_size(batch)) {
            let LoadedBatch { pairs, numbers, .. } = loader.next_batch()?;
            let numbers = numbers.expect("training pairs are substituted, never left out");
            // Dropout is a function of seed, batch and part, so that a resumed run repeats it.
            self.device.seed(step_seed(seed, batch, part));
            let corrected_share = self.config.training.corrected_share;
            let weight = 1.0 / size as f32;
            let part = MicroBatch { pairs: numbers.upload(&self.device), weight, corrected_share };
            let (loss, of_part) = self.model().step(&part);
            gradients.accumulate(self.model(), of_part);
            losses.push(loss);
            learned.extend(pairs);
        }
        let losses = read_values(Tensor::cat(losses, 0))?;
        let mean = losses.iter().sum::<f64>() / size as f64;
        if !mean.is_finite() {
            return Err(Error::Training(format!(
                "the loss of mini-batch {} is {mean}; the last saved state is kept. Go on from it with --resume and a lower --set training.learning_rate=…, or start a new run with model.min_log_variance",
                batch + 1
            )));
        }
        let learning_rate = stages.learning_rate(batch);
        let model = self.model.take().expect("put back by the step before");
        self.model = Some(self.optimiser.step(learning_rate, model, gradients.grads()));
        for (pair, loss) in learned.into_iter().zip(losses) {
            self.history.add(self.dataset.train.pairs[pair].system, loss);
        }
        self.history.batches += 1;
        self.history.seconds += begin.elapsed().as_secs_f64();
        Ok(mean)
    }

    /// Evaluates, keeps the best model, saves the state; whether this epoch is the best.
    fn finish_epoch(&mut self, observer: &mut dyn FnMut(Event)) -> Result<bool> {
        let predictions = self.predict_watched(observer)?;
        let floor = self.architecture.floor_of_covariances();
        let at_floor = floor.map_or(0.0, |floor| share_at_floor(predictions.iter().map(|row| &row.covariance), &floor));
        let systems = self.config.systems.len();
        let share = self.config.training.corrected_share;
        if mean_loss(&predictions, watched_system(&self.config), share).is_none() {
            let unreadable = self.watched_reader.bad_frames().into_iter();
            let described = unreadable.map(|bad| format!("{} frame {}: {}", bad.drive, bad.frame, bad.problem));
            let first = described.chain(self.watched_reader.blind_pairs()).next().unwrap_or_default();
            return Err(Error::Data(format!("not one watched pair can be used; {first}")));
        }
        let losses = (0..systems).map(|system| mean_loss(&predictions, system, share)).collect();
        self.history.finish_epoch(losses, at_floor);

        let watched = self.history.evaluation_losses(watched_system(&self.config));
        let (newest, earlier) = watched.split_last().expect("the watched system has pairs");
        let best = earlier.iter().all(|loss| newest < loss);
        if best {
            self.run.save_model(&self.model().valid())?;
            self.history.best_epoch = Some(self.history.rows.len());
        }
        self.save_state()?;
        Ok(best)
    }

    /// Predictions of the watched split; an interrupt ends them, and a resumed run makes them anew.
    fn predict_watched(&self, observer: &mut dyn FnMut(Event)) -> Result<Vec<Prediction>> {
        // Before images have a say they need not be looked at.
        let images = self.stages().images(self.history.batches.saturating_sub(1));
        let split = self.dataset.split(watched_split(&self.config));
        let learned = |system: usize| self.config.systems[system].share > 0.0;
        self.predict(&self.model().valid(), &split.of_systems(learned), images, &self.watched_reader, observer)
    }

    /// Fits the factors on variances of the best model to the validation split, where there is one.
    fn recalibrate(&self, observer: &mut dyn FnMut(Event)) -> Result<()> {
        if self.dataset.validation.pairs.is_empty() {
            return Ok(());
        }
        let model = self.run.load_model(&self.run.manifest()?, &self.device)?;
        let reader = match watched_split(&self.config) {
            SplitName::Validation => self.watched_reader.clone(),
            _ => Arc::new(PairReader::new(&self.config.pairs(), &self.dataset, SplitName::Validation)),
        };
        let learned = |system: usize| self.config.systems[system].share > 0.0;
        let split = self.dataset.validation.of_systems(learned);
        let predictions = self.predict(&model, &split, self.architecture.images(), &reader, observer)?;
        let learned = self.config.systems.iter().filter(|system| system.share > 0.0);
        let learned: Vec<&str> = learned.map(|system| system.name.as_str()).collect();
        let split = SplitName::Validation.name();
        match Recalibration::fit(&predictions, &self.dataset.systems, &learned, split) {
            Some(recalibration) => self.run.write_recalibration(&recalibration),
            None => Ok(()),
        }
    }

    fn predict(
        &self,
        model: &CovarianceModel,
        split: &Split,
        images: Images,
        reader: &Arc<PairReader>,
        observer: &mut dyn FnMut(Event),
    ) -> Result<Vec<Prediction>> {
        let pairs = split.pairs.len();
        let mut progress = |done| {
            observer(Event::Evaluation { done, pairs });
            self.stop_if_interrupted()
        };
        predict_split(model, reader, split, images, &self.config.training.loading(), &self.device, &mut progress)
    }

    fn stop_reason(&self) -> Option<StopReason> {
        let system = watched_system(&self.config);
        let rule = DivergenceRule::new(self.config.training.stop);
        // Losses before images joined are of another stage, which its own epochs end.
        let (training, evaluation) = (self.history.training_losses(system), self.history.evaluation_losses(system));
        let first = self.stages().epochs_alone().min(training.len());
        if rule.diverged(&training[first..], &evaluation[first..]) {
            return Some(StopReason::Diverged);
        }
        (self.history.rows.len() >= self.config.training.epochs).then_some(StopReason::AllEpochs)
    }

    fn save_state(&self) -> Result<()> {
        self.run.save_state(self.model(), &self.optimiser, &self.history, &self.dataset.systems)
    }

    fn stages(&self) -> Stages {
        Stages::new(&self.config.training, self.batches_per_epoch(), self.architecture.images())
    }

    /// Reads all mini-batches that are still to come, part by part.
    fn spawn_loader(&self) -> Result<BatchLoader> {
        let split = &self.dataset.train;
        let ranges = split.systems.clone();
        let counts = self.config.pairs_per_batch();
        let mut mixer = Mixer::new(self.config.seed, ranges.clone().into_iter().zip(counts));
        let systems: Vec<usize> = split.pairs.iter().map(|pair| pair.system).collect();
        let stages = self.stages();
        let requests = (self.history.batches..).flat_map(move |batch| {
            let images = stages.images(batch);
            let choice = |PlannedPair { pair, pass }| Choice {
                pair,
                draw: Some(pass),
                substitutes: Some(ranges[systems[pair]].clone()),
            };
            let choices: Vec<Choice> = mixer.plan(batch).pairs.into_iter().map(choice).collect();
            choices
                .chunks(stages.part_size(batch))
                .map(|choices| Request { choices: choices.to_vec(), images })
                .collect::<Vec<_>>()
        });
        BatchLoader::spawn(
            self.reader.clone(),
            Arc::new(split.pairs.clone()),
            requests,
            &self.config.training.loading(),
        )
    }
}

/// Seed of dropout in one part of one mini-batch.
fn step_seed(seed: u64, batch: usize, part: usize) -> u64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(batch as u64);
    random.set_word_pos(2 * part as u128);
    random.next_u64()
}
