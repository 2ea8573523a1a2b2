//! What is drawn: the numbers of those methods of a system that a figure shows.

use crate::evaluation::{Method, SystemPairs};
use crate::geometry::Covariance6;
use crate::report::comparison::{Comparison, Judged};

/// A method's numbers for one system, ready to draw.
pub(super) struct Series<'a> {
    /// Name in legends.
    pub(super) label: String,
    pub(super) method: Method,
    pub(super) pairs: &'a SystemPairs,
    pub(super) covariances: Vec<Covariance6>,
    /// What they should cover, m and rad.
    pub(super) errors: Vec<[f64; 6]>,
}

impl Series<'_> {
    pub(super) fn sigma(&self, component: usize) -> Vec<f64> {
        self.covariances.iter().map(|covariance| covariance.matrix()[(component, component)].sqrt()).collect()
    }

    pub(super) fn errors(&self, component: usize) -> Vec<f64> {
        self.errors.iter().map(|error| error[component]).collect()
    }
}

/// The methods of a system that a condition keeps.
pub(super) fn series<'a>(comparison: &'a Comparison, system: &str, keep: impl Fn(&Judged) -> bool) -> Vec<Series<'a>> {
    let methods = comparison.methods(system).into_iter().filter(|(_, judged)| keep(judged));
    methods
        .map(|(label, judged)| Series {
            label,
            method: judged.method,
            pairs: judged.pairs(system),
            covariances: judged.covariances(system),
            errors: judged.errors(system),
        })
        .collect()
}

/// Predictions, and the baselines worth comparing them with.
pub(super) fn is_drawn(judged: &Judged) -> bool {
    !matches!(judged.method, Method::Zero | Method::ConstantMad | Method::Uncalibrated | Method::Oracle)
}
