//! Mixing systems into mini-batches: exact shares in every batch (paper Section V-B.2), pairs of
//! each system drawn independently, every draw a pure function of seed and batch number, so that a
//! resumed run sees what an unbroken one would.

use std::ops::Range;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// Purpose of the random stream that orders pairs within a batch; smaller ones are systems.
const ORDER_IN_BATCH: usize = (1 << 24) - 1;

/// The pairs of one mini-batch, in random order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BatchPlan {
    /// Its pairs.
    pub pairs: Vec<PlannedPair>,
}

/// A pair of a mini-batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlannedPair {
    /// Index into the split.
    pub pair: usize,
    /// How many times every pair of its system was seen before.
    pub pass: usize,
}

/// Draws mini-batches from several systems.
#[derive(Clone, Debug)]
pub struct Mixer {
    seed: u64,
    systems: Vec<MixedSystem>,
}

#[derive(Clone, Debug)]
struct MixedSystem {
    /// Its pairs in the split.
    pairs: Range<usize>,
    per_batch: usize,
    /// The shuffled pairs of one pass over the system, kept while batches stay in that pass.
    pass: Option<(usize, Vec<usize>)>,
}

impl Mixer {
    /// `systems` gives each system's range of pairs and its exact count in a batch.
    pub fn new(seed: u64, systems: impl IntoIterator<Item = (Range<usize>, usize)>) -> Self {
        let systems: Vec<_> =
            systems.into_iter().map(|(pairs, per_batch)| MixedSystem { pairs, per_batch, pass: None }).collect();
        assert!(systems.iter().all(|system| !system.pairs.is_empty()), "every system has pairs");
        Self { seed, systems }
    }

    /// The pairs of batch `batch`, counted from 0 over the whole training.
    pub fn plan(&mut self, batch: usize) -> BatchPlan {
        let mut pairs = Vec::new();
        for (index, system) in self.systems.iter_mut().enumerate() {
            for draw in batch * system.per_batch..(batch + 1) * system.per_batch {
                pairs.push(system.pair(self.seed, index, draw));
            }
        }
        pairs.shuffle(&mut stream(self.seed, ORDER_IN_BATCH, batch));
        BatchPlan { pairs }
    }
}

impl MixedSystem {
    /// The pair of a draw: passes over the system follow one another, each in its own order.
    fn pair(&mut self, seed: u64, system: usize, draw: usize) -> PlannedPair {
        let pass = draw / self.pairs.len();
        if self.pass.as_ref().is_none_or(|(current, _)| *current != pass) {
            let mut order: Vec<usize> = self.pairs.clone().collect();
            order.shuffle(&mut stream(seed, system, pass));
            self.pass = Some((pass, order));
        }
        let (_, order) = self.pass.as_ref().expect("just set");
        PlannedPair { pair: order[draw % self.pairs.len()], pass }
    }
}

/// An independent random stream for every purpose and index.
fn stream(seed: u64, purpose: usize, index: usize) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(((purpose as u64) << 40) | index as u64);
    random
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mixer() -> Mixer {
        Mixer::new(3, [(0..100, 63), (100..130, 21)])
    }

    #[test]
    fn every_batch_holds_the_exact_shares() {
        let mut mixer = mixer();
        for batch in 0..20 {
            let pairs: Vec<usize> = mixer.plan(batch).pairs.iter().map(|planned| planned.pair).collect();
            assert_eq!(pairs.iter().filter(|&&pair| pair < 100).count(), 63);
            assert_eq!(pairs.iter().filter(|&&pair| pair >= 100).count(), 21);
        }
    }

    #[test]
    fn a_pass_shows_every_pair_once() {
        let mut mixer = mixer();
        let planned = (0..100).flat_map(|batch| mixer.plan(batch).pairs).filter(|planned| planned.pair < 100);
        let mut passes = vec![Vec::new(); 100];
        planned.for_each(|planned| passes[planned.pair].push(planned.pass));
        // Within a batch the order is random.
        passes.iter_mut().for_each(|passes| passes.sort_unstable());
        assert!(passes.iter().all(|passes| passes.iter().copied().eq(0..63)));
    }

    #[test]
    fn a_batch_does_not_depend_on_those_drawn_before() {
        let mut unbroken = mixer();
        let last = (0..10).map(|batch| unbroken.plan(batch)).last().unwrap();
        assert_eq!(mixer().plan(9), last);
        assert_ne!(mixer().plan(8), last);
    }

    #[test]
    fn systems_are_shuffled_independently() {
        let mut mixer = Mixer::new(0, [(0..50, 50), (50..100, 50)]);
        let mut system_one = mixer.systems[0].clone();
        let mut system_two = mixer.systems[1].clone();
        let one: Vec<_> = (0..50).map(|draw| system_one.pair(0, 0, draw).pair).collect();
        let two: Vec<_> = (0..50).map(|draw| system_two.pair(0, 1, draw).pair - 50).collect();
        assert_ne!(one, two);
        assert_eq!(mixer.plan(0).pairs.len(), 100);
    }
}
