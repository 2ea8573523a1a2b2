//! Trains the depth network on nothing but images and the true motion between them (GNSS, or any trajectory): depth
//! in metres from the start, without LiDAR and without anyone's weights.
//!
//! In: the configuration's drives. Out: a folder that `depth.weights` can name. Tells its observer what happens and
//! never prints.

mod photometric;
mod reprojection;
mod targets;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use burn::module::Module;
use burn::optim::{GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use super::RunFolder;
use super::saved_state::{damaged, read_records, write_records};
use crate::config::Config;
use crate::depth::monodepth2::{Monodepth2, depth_to_disparity};
use crate::depth::{DepthEstimator, holds_metric_weights, holds_published_weights, require_aspect};
use crate::error::{Error, Result};
use crate::evaluation::read_values;
use crate::files::{read_text, sha256_hex, write_atomically};
use crate::geometry::Pinhole;
use crate::kernels::Adam;
use crate::pairs::SplitName;
use crate::recordings::Recording;
use crate::schedule::{DepthTrainingConfig, rate_factor};
use reprojection::{NEIGHBOURS, ReprojectionLoss, reprojection_loss};
use targets::{TargetBatches, Targets};

const HISTORY: &str = "history.json";
const METRICS: &str = "metrics.csv";
const SAVE_EVERY: Duration = Duration::from_secs(600);

/// Something happened.
#[derive(Clone, Debug)]
pub enum DepthEvent<'a> {
    /// Training begins, or goes on.
    Started {
        /// Mini-batches done before.
        batches_done: usize,
        /// Mini-batches in an epoch.
        batches_per_epoch: usize,
        /// Target images.
        targets: usize,
        /// Photometric loss of the watched targets before the first step.
        initial_loss: f64,
    },
    /// A mini-batch is done.
    Batch {
        /// Epoch, from 1.
        epoch: usize,
        /// Mini-batch in the epoch, from 1.
        batch: usize,
        /// Its loss; none where one of its images cannot be read.
        loss: Option<f64>,
        /// Target images a second.
        targets_per_second: f64,
    },
    /// An epoch is done.
    Epoch {
        /// Its numbers.
        row: &'a DepthEpoch,
        /// Whether its weights are the best so far, and kept.
        best: bool,
    },
}

/// An epoch of depth training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthEpoch {
    /// From 1.
    pub epoch: usize,
    /// Mean loss of its mini-batches.
    pub training_loss: f64,
    /// Photometric loss of the watched targets (validation) after it.
    pub evaluation_loss: f64,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct DepthHistory {
    settings: String,
    batches: usize,
    /// Mini-batches that were learned from.
    steps: usize,
    initial_loss: f64,
    loss_sum: f64,
    loss_count: usize,
    rows: Vec<DepthEpoch>,
}

/// Trains a [`Monodepth2`] and keeps its best weights.
pub struct DepthLearner {
    config: Config,
    device: Device,
    run: RunFolder,
    train: Targets,
    watched: Targets,
    /// Absent only while the optimiser has it.
    network: Option<Monodepth2>,
    optimiser: ModuleOptimizer,
    history: DepthHistory,
    interrupt: Arc<AtomicBool>,
}

impl DepthLearner {
    /// Begins in a folder that holds no run, or replaces the one it holds.
    ///
    /// # Errors
    /// A split has no three images in a row, the images have another aspect than the network, or the folder is taken or
    /// cannot be written.
    pub fn start(config: Config, folder: &Path, device: &Device, replace: bool) -> Result<Self> {
        Self::require_free(folder, replace)?;
        let mut learner = Self::new(config, device, || RunFolder::create(folder, replace))?;
        if replace {
            DepthEstimator::remove_metric(folder)?;
        }
        learner.run.write_config(&learner.config)?;
        learner.history = DepthHistory { settings: learner.settings(), ..DepthHistory::default() };
        learner.history.initial_loss = learner.evaluate()?;
        Ok(learner)
    }

    /// That a training may begin in a folder.
    ///
    /// # Errors
    /// It holds published weights, or a run or weights that are not to be replaced.
    pub fn require_free(folder: &Path, replace: bool) -> Result<()> {
        if holds_published_weights(folder) {
            let problem = "holds published weights; choose another folder with --out, and name it as depth.weights";
            return Err(Error::run(folder, problem));
        }
        if !replace && holds_metric_weights(folder) {
            let problem =
                "holds trained depth weights; go on with --resume, choose another --out, or replace them with --force";
            return Err(Error::run(folder, problem));
        }
        if replace { Ok(()) } else { RunFolder::require_free(folder) }
    }

    /// Goes on where a folder's newest state ended.
    ///
    /// # Errors
    /// The folder holds no state, or it was begun with other settings.
    pub fn resume(config: Config, folder: &Path, device: &Device) -> Result<Self> {
        let run = RunFolder::at(folder);
        let Some(state) = run.states()?.pop() else {
            let problem = "holds no saved state of a depth training; begin one with `relcov train-depth --config …`";
            return Err(Error::run(folder, problem));
        };
        let history: DepthHistory = serde_json::from_str(&read_text(&state.join(HISTORY))?)
            .map_err(|error| damaged(&state, HISTORY, &error))?;
        let mut learner = Self::new(config, device, || run.owned())?;
        if history.settings != learner.settings() {
            return Err(Error::run(
                folder,
                "was begun with other settings or images; a resumed training may change its device, data.root and of depth_training: epochs, learning_rate, schedule",
            ));
        }
        let network = learner.network.take().expect("a new learner has its network");
        let (network, optimiser) = read_records(&state, network, learner.optimiser, history.steps)?;
        (learner.network, learner.optimiser, learner.history) = (Some(network), optimiser, history);
        learner.run.write_config(&learner.config)?;
        Ok(learner)
    }

    fn new(config: Config, device: &Device, open: impl FnOnce() -> Result<RunFolder>) -> Result<Self> {
        let dataset = Targets::load(&config)?;
        let DepthTrainingConfig { width, height, .. } = config.depth_training;
        for Recording { name, calibration, .. } in &dataset.drives {
            let Pinhole { width: full_width, height: full_height, .. } = calibration.camera;
            require_aspect([full_width, full_height], [width, height])
                .map_err(|error| Error::config("depth_training.width", format!("{name}: {error}")))?;
        }
        let train = Targets::new(&config, &dataset, SplitName::Train)?;
        let watched = Targets::new(&config, &dataset, SplitName::Validation)?;
        let run = open()?;
        device.seed(config.seed);
        let DepthTrainingConfig { range_m, initial_depth_m, .. } = config.depth_training;
        let disparity = depth_to_disparity(initial_depth_m, range_m.min, range_m.max);
        let network = Monodepth2::init(disparity, &device.clone().autodiff());
        Ok(Self {
            device: device.clone(),
            run,
            train,
            watched,
            network: Some(network),
            optimiser: Adam::new().into(),
            history: DepthHistory::default(),
            interrupt: Arc::default(),
            config,
        })
    }

    /// Set it to stop after the mini-batch under way; the state is saved.
    pub fn interrupt_flag(&self) -> Arc<AtomicBool> {
        self.interrupt.clone()
    }

    /// The folder of weights.
    pub fn folder(&self) -> &Path {
        self.run.path()
    }

    fn network(&self) -> &Monodepth2 {
        self.network.as_ref().expect("put back by whoever took it")
    }

    fn batches_per_epoch(&self) -> usize {
        let once = self.train.len().div_ceil(self.config.depth_training.batch);
        self.config.depth_training.batches_per_epoch.unwrap_or(once)
    }

    /// Trains until all epochs are done. Returns the best epoch.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after an interrupt, state saved; or images cannot be read, the loss is no longer finite,
    /// or the folder cannot be written.
    pub fn train(&mut self, observer: &mut dyn FnMut(DepthEvent)) -> Result<DepthEpoch> {
        let (per_epoch, epochs) = (self.batches_per_epoch(), self.config.depth_training.epochs);
        let batch = self.config.depth_training.batch;
        observer(DepthEvent::Started {
            batches_done: self.history.batches,
            batches_per_epoch: per_epoch,
            targets: self.train.len(),
            initial_loss: self.history.initial_loss,
        });
        let mut batches = self.train.shuffled(self.config.seed, batch, self.history.batches)?;
        let mut saved = Instant::now();
        while self.history.rows.len() < epochs {
            let epoch = self.history.rows.len() + 1;
            while self.history.batches < epoch * per_epoch {
                let begin = Instant::now();
                let loss = self.learn_batch(&mut batches).map_err(|error| self.saved_before(error))?;
                observer(DepthEvent::Batch {
                    epoch,
                    batch: self.history.batches - (epoch - 1) * per_epoch,
                    loss,
                    targets_per_second: batch as f64 / begin.elapsed().as_secs_f64(),
                });
                if saved.elapsed() > SAVE_EVERY {
                    self.save_state()?;
                    saved = Instant::now();
                }
                self.stop_if_interrupted()?;
            }
            let best = self.finish_epoch(epoch)?;
            saved = Instant::now();
            observer(DepthEvent::Epoch { row: self.history.rows.last().expect("just finished"), best });
            self.stop_if_interrupted()?;
        }
        Ok(self.best().expect("at least one epoch").clone())
    }

    /// One step of Adam on a mini-batch; one with an unreadable image is passed over.
    fn learn_batch(&mut self, batches: &mut TargetBatches) -> Result<Option<f64>> {
        let range_m = self.config.depth_training.range_m;
        let Some(batch) = batches.next(&self.device)? else {
            self.history.batches += 1;
            return Ok(None);
        };
        let ReprojectionLoss { loss, .. } = reprojection_loss(self.network(), range_m, &batch);
        let gradients = GradientsParams::from_grads(loss.backward(), self.network());
        let value = f64::from(loss.into_scalar::<f32>());
        if !value.is_finite() {
            return Err(Error::Training(format!(
                "the loss of mini-batch {} is {value}; the last saved state is kept. Go on from it with --resume and a lower --set depth_training.learning_rate=…",
                self.history.batches + 1
            )));
        }
        let DepthTrainingConfig { learning_rate, schedule, epochs, .. } = self.config.depth_training;
        let share = self.history.batches as f64 / (epochs * self.batches_per_epoch()) as f64;
        let network = self.network.take().expect("put back by the step before");
        self.network = Some(self.optimiser.step(learning_rate * rate_factor(schedule, share), network, gradients));
        self.history.batches += 1;
        self.history.steps += 1;
        self.history.loss_sum += value;
        self.history.loss_count += 1;
        Ok(Some(value))
    }

    /// Judges the weights on the watched targets and keeps the best; whether these are.
    fn finish_epoch(&mut self, epoch: usize) -> Result<bool> {
        let row = DepthEpoch {
            epoch,
            training_loss: self.history.loss_sum / self.history.loss_count.max(1) as f64,
            evaluation_loss: self.evaluate()?,
        };
        let best = self.best().is_none_or(|best| row.evaluation_loss < best.evaluation_loss);
        if best {
            let DepthTrainingConfig { width, height, range_m, .. } = self.config.depth_training;
            DepthEstimator::save_metric(&self.network().valid(), [width, height], range_m, self.run.path())?;
        }
        (self.history.loss_sum, self.history.loss_count) = (0.0, 0);
        self.history.rows.push(row);
        self.save_state()?;
        Ok(best)
    }

    fn best(&self) -> Option<&DepthEpoch> {
        self.history.rows.iter().min_by(|a, b| a.evaluation_loss.total_cmp(&b.evaluation_loss))
    }

    /// Mean photometric loss of the watched targets.
    fn evaluate(&self) -> Result<f64> {
        let network = self.network().valid();
        let batch = self.config.depth_training.batch;
        let mut batches = self.watched.in_order(batch)?;
        let (mut losses, mut targets): (Vec<Tensor<1>>, Vec<f64>) = (Vec::new(), Vec::new());
        for _ in 0..self.watched.len().div_ceil(batch) {
            if let Some(batch) = batches.next(&self.device)? {
                losses.push(reprojection_loss(&network, self.config.depth_training.range_m, &batch).photometric);
                targets.push((batch.target_image.dims()[0] / NEIGHBOURS) as f64);
            }
        }
        if losses.is_empty() {
            return Err(Error::Data("not one watched image can be read".to_owned()));
        }
        let losses = read_values(Tensor::cat(losses, 0))?;
        let sum: f64 = losses.iter().zip(&targets).map(|(loss, targets)| loss * targets).sum();
        let mean = sum / targets.iter().sum::<f64>();
        if !mean.is_finite() {
            return Err(Error::Training(
                "the network's disparities are no longer finite; the last saved state is kept. Go on from it with --resume and a lower --set depth_training.learning_rate=…"
                    .to_owned(),
            ));
        }
        Ok(mean)
    }

    /// Unreadable images end a training but not the work done: the state is saved before the error is returned.
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

    fn save_state(&self) -> Result<()> {
        let name = format!("state-{:09}-{:05}", self.history.batches, self.history.rows.len());
        self.run.keep_state(&name, |folder| {
            write_records(folder, self.network(), &self.optimiser)?;
            let json = serde_json::to_string_pretty(&self.history).expect("a history is JSON");
            write_atomically(&folder.join(HISTORY), json.as_bytes())
        })?;
        let rows = self
            .history
            .rows
            .iter()
            .map(|row| format!("{},{:.6},{:.6}\n", row.epoch, row.training_loss, row.evaluation_loss));
        let csv: String = std::iter::once("epoch,training_loss,evaluation_loss\n".to_owned()).chain(rows).collect();
        write_atomically(&self.run.path().join(METRICS), csv.as_bytes())
    }

    /// A hash of what must stay the same when a training is resumed.
    fn settings(&self) -> String {
        let defaults = DepthTrainingConfig::default();
        let depth_training = DepthTrainingConfig {
            epochs: defaults.epochs,
            learning_rate: defaults.learning_rate,
            schedule: defaults.schedule,
            ..self.config.depth_training.clone()
        };
        let text = toml::to_string(&depth_training).expect("settings are TOML");
        let Self { config, train, watched, .. } = self;
        let identity = format!("{text}{:?}{}{}{}", config.truth, config.seed, train.fingerprint, watched.fingerprint);
        sha256_hex(identity.as_bytes())
    }
}
