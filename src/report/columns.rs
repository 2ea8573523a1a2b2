//! Names of columns: plain ones, and those of the six components with their units.

use crate::geometry::Conventions;

pub(super) fn named_columns(names: &[&str]) -> impl Iterator<Item = String> {
    names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>().into_iter()
}

pub(super) fn unit_columns(prefix: &str) -> impl Iterator<Item = String> {
    let named = Conventions::COMPONENTS.iter().zip(Conventions::UNITS);
    named.map(move |(name, unit)| format!("{prefix}{name} [{unit}]")).collect::<Vec<_>>().into_iter()
}
