//! The stages of a training: evidence alone, then images too, or one of them all along.

use super::rate::rate_factor;
use super::settings::TrainingConfig;
use crate::pairs::Images;

/// What is shown in which mini-batch, and how fast it is learned.
#[derive(Clone, Debug)]
pub(crate) struct Stages {
    training: TrainingConfig,
    /// Mini-batches at the start that show evidence alone.
    alone: usize,
    /// Mini-batches of the whole training.
    all: usize,
    /// What the model looks at in the end.
    images: Images,
}

impl Stages {
    pub fn new(training: &TrainingConfig, batches_per_epoch: usize, images: Images) -> Self {
        let all = training.epochs * batches_per_epoch;
        let mut stages = Self { training: training.clone(), alone: 0, all, images };
        stages.alone = (stages.epochs_alone() * batches_per_epoch).min(all);
        stages
    }

    /// Epochs at the start that show evidence alone, where images join later.
    pub fn epochs_alone(&self) -> usize {
        match self.images {
            Images::Included => self.training.evidence_epochs,
            Images::LeftOut => 0,
        }
    }

    /// Whether images are shown in a mini-batch.
    pub fn images(&self, batch: usize) -> Images {
        if batch < self.alone { Images::LeftOut } else { self.images }
    }

    /// Most pairs of a part of a mini-batch: without images all fit memory.
    pub fn part_size(&self, batch: usize) -> usize {
        match self.images(batch) {
            Images::Included => self.training.micro_batch,
            Images::LeftOut => self.training.batch,
        }
    }

    /// The learning rate of a mini-batch; its schedule is that of the stage.
    pub fn learning_rate(&self, batch: usize) -> f64 {
        let (begin, end) = if batch < self.alone { (0, self.alone) } else { (self.alone, self.all) };
        let share = (batch - begin) as f64 / (end - begin).max(1) as f64;
        let joined = self.training.image_learning_rate.filter(|_| self.images(batch) == Images::Included);
        joined.unwrap_or(self.training.learning_rate) * rate_factor(self.training.schedule, share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::Schedule;

    #[test]
    fn images_join_after_the_epochs_of_evidence_with_a_rate_and_a_schedule_of_their_own() {
        let training = TrainingConfig {
            batch: 48,
            micro_batch: 12,
            epochs: 3,
            evidence_epochs: 2,
            learning_rate: 1e-2,
            image_learning_rate: Some(1e-3),
            schedule: Schedule::Cosine,
            ..TrainingConfig::default()
        };
        let stages = Stages::new(&training, 100, Images::Included);
        assert_eq!([199, 200].map(|batch| stages.images(batch)), [Images::LeftOut, Images::Included]);
        assert_eq!([199, 200].map(|batch| stages.part_size(batch)), [48, 12]);
        assert!((stages.learning_rate(10) - 1e-2).abs() < 1e-12 && stages.learning_rate(199) < 1e-4);
        assert!((stages.learning_rate(205) - 1e-3).abs() < 1e-12 && stages.learning_rate(299) < 1e-5);

        // Evidence alone is one stage, whatever the configuration says of images.
        let stages = Stages::new(&training, 100, Images::LeftOut);
        assert_eq!((stages.images(299), stages.part_size(299)), (Images::LeftOut, 48));
        assert!((stages.learning_rate(15) - 1e-2).abs() < 1e-12 && stages.learning_rate(200) > 1e-3);
    }
}
