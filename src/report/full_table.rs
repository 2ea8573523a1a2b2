//! The scores of every method in one wide table, for programs.

use super::columns::named_columns;
use super::comparison::{Comparison, Judged};
use super::table::{Cell, Table};
use crate::evaluation::Metrics;
use crate::geometry::Conventions;

/// A score of a method as a whole.
type JointScore = (&'static str, fn(&Metrics) -> Option<f64>);

const JOINT: [JointScore; 15] = [
    ("nll [nats]", |metrics| metrics.nll),
    ("nll_low", |metrics| Some(metrics.nll_interval?[0])),
    ("nll_high", |metrics| Some(metrics.nll_interval?[1])),
    ("nll_over_constant", |metrics| Some(metrics.nll_over_constant?.mean)),
    ("nll_over_constant_low", |metrics| Some(metrics.nll_over_constant?.interval[0])),
    ("nll_over_constant_high", |metrics| Some(metrics.nll_over_constant?.interval[1])),
    ("anees", |metrics| metrics.anees),
    ("anees_low", |metrics| Some(metrics.anees_interval?[0])),
    ("anees_high", |metrics| Some(metrics.anees_interval?[1])),
    ("nees_below_95", |metrics| metrics.nees_below_95),
    ("anees_least_bin", |metrics| Some(metrics.conditional.as_ref()?.joint.extremes()[0])),
    ("anees_largest_bin", |metrics| Some(metrics.conditional.as_ref()?.joint.extremes()[1])),
    ("rms_ratio_translation", |metrics| metrics.rms_ratio?.translation),
    ("rms_ratio_rotation", |metrics| metrics.rms_ratio?.rotation),
    ("at_floor", |metrics| metrics.at_floor),
];

/// A score of each component, and whether it has the component's unit.
type ComponentScore = (&'static str, Unit, fn(&Metrics) -> Option<[Option<f64>; 6]>);

#[derive(Clone, Copy, PartialEq)]
enum Unit {
    OfComponent,
    None,
}

const BY_COMPONENT: [ComponentScore; 18] = [
    ("mde", Unit::OfComponent, |metrics| Some(metrics.mde.map(Some))),
    ("mde_low", Unit::OfComponent, |metrics| Some(metrics.mde_interval?[0].map(Some))),
    ("mde_high", Unit::OfComponent, |metrics| Some(metrics.mde_interval?[1].map(Some))),
    ("de_25", Unit::OfComponent, |metrics| Some(metrics.de_quartiles[0].map(Some))),
    ("de_75", Unit::OfComponent, |metrics| Some(metrics.de_quartiles[2].map(Some))),
    ("crps", Unit::OfComponent, |metrics| Some(metrics.crps?.map(Some))),
    ("mean_sigma", Unit::OfComponent, |metrics| Some(metrics.sharpness.map(Some))),
    ("nll", Unit::None, |metrics| Some(metrics.nll_by_component?.map(Some))),
    ("zms", Unit::None, |metrics| Some(metrics.zms?.map(Some))),
    ("within_1_sigma", Unit::None, |metrics| Some(metrics.coverage?[0].map(Some))),
    ("within_2_sigma", Unit::None, |metrics| Some(metrics.coverage?[1].map(Some))),
    ("within_3_sigma", Unit::None, |metrics| Some(metrics.coverage?[2].map(Some))),
    ("ence", Unit::None, |metrics| Some(metrics.ence?.map(Some))),
    ("ause", Unit::None, |metrics| Some(metrics.ause)),
    ("aurg", Unit::None, |metrics| Some(metrics.aurg)),
    ("spearman", Unit::None, |metrics| Some(metrics.spearman)),
    ("rms_ratio", Unit::None, |metrics| Some(metrics.rms_ratio?.components)),
    ("true_sigma_ratio", Unit::None, |metrics| Some(metrics.against_true.as_ref()?.median_sigma_ratio.map(Some))),
];

/// One row for each system and method.
pub(super) fn full_table(comparison: &Comparison) -> Table {
    let names = ["system", "method", "run", "split", "error_frame", "pairs"];
    let mut header: Vec<String> = named_columns(&names).collect();
    header.extend(JOINT.map(|(name, _)| name.to_owned()));
    for (name, unit, _) in BY_COMPONENT {
        let components = Conventions::COMPONENTS.iter().zip(Conventions::UNITS);
        header.extend(components.map(|(component, metre_or_radian)| match unit {
            Unit::OfComponent => format!("{name}_{component} [{metre_or_radian}]"),
            Unit::None => format!("{name}_{component}"),
        }));
    }
    let mut rows = Vec::new();
    for system in comparison.systems() {
        for (name, Judged { entry, metrics, .. }) in comparison.methods(system) {
            let origin = &entry.evaluation.origin;
            let pairs = entry.evaluation.systems.get(system).map_or(0, |system| system.pairs).to_string();
            let frame = entry.evaluation.error_frame.name();
            let mut row: Vec<Cell> = [system, &name, &origin.run, &origin.split, frame, &pairs].map(Cell::name).into();
            row.extend(JOINT.map(|(_, score)| number(score(metrics))));
            row.extend(BY_COMPONENT.iter().flat_map(|(_, _, score)| score(metrics).unwrap_or([None; 6]).map(number)));
            rows.push(row);
        }
    }
    Table { title: "all scores".to_owned(), header, names: names.len(), rows }
}

fn number(value: Option<f64>) -> Cell {
    Cell { text: value.map_or(String::new(), |value| value.to_string()), value, best: false }
}
