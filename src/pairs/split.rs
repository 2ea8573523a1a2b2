//! The pairs of one role, system by system.

use std::ops::Range;

use nalgebra::Vector6;

use super::pair::Pair;

/// A role of pairs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SplitName {
    /// Learned from.
    Train,
    /// Watched during training.
    Validation,
    /// Evaluated at the end.
    Test,
}

impl SplitName {
    /// Name as in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }
}

/// The pairs of one role, system by system.
#[derive(Clone, Debug)]
pub struct Split {
    /// Its role.
    pub name: SplitName,
    /// Its pairs, ordered by system, drive and frame.
    pub pairs: Vec<Pair>,
    /// Each system's range of `pairs`.
    pub systems: Vec<Range<usize>>,
}

impl Split {
    /// Sorts pairs by system; `systems` is how many there are.
    pub(super) fn new(name: SplitName, mut pairs: Vec<Pair>, systems: usize) -> Self {
        pairs.sort_by_key(|pair| (pair.system, pair.id));
        pairs.dedup_by_key(|pair| (pair.system, pair.id));
        let start = |system| pairs.partition_point(|pair: &Pair| pair.system < system);
        let ranges = (0..systems).map(|system| start(system)..start(system + 1)).collect();
        Self { name, systems: ranges, pairs }
    }

    /// The pairs of some systems alone; others are there and have none.
    pub fn of_systems(&self, wanted: impl Fn(usize) -> bool) -> Self {
        let pairs = self.pairs.iter().filter(|pair| wanted(pair.system)).cloned().collect();
        Self::new(self.name, pairs, self.systems.len())
    }

    /// The pairs of one system.
    pub fn pairs_of(&self, system: usize) -> &[Pair] {
        &self.pairs[self.systems[system].clone()]
    }

    /// Mean of e² over one system's pairs, m² and rad².
    pub fn mean_squared_error(&self, system: usize) -> Vector6<f64> {
        let pairs = self.pairs_of(system);
        let sum: Vector6<f64> = pairs.iter().map(|pair| pair.error.component_mul(&pair.error)).sum();
        sum / pairs.len().max(1) as f64
    }
}
