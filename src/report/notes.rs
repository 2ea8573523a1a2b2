//! What stands around the tables: what was evaluated, and how to read it.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::comparison::{Comparison, Entry};
use super::summary::UNSEEN;
use super::table::three_digits;
use crate::alignment::NoVerdict;
use crate::evaluation::Method;

/// Frame, order, side and what was evaluated: stands above every table.
pub(super) fn preface(comparison: &Comparison) -> String {
    let first = &comparison.entries[0].evaluation;
    let pairs: Vec<String> = first.systems.iter().map(|(name, system)| format!("{} {name}", system.pairs)).collect();
    format!(
        "split {}, pairs: {}\nerror frame: {} ({}); e = {}\n",
        first.origin.split,
        pairs.join(", "),
        first.error_frame.name(),
        first.error_frame.axes(),
        first.error
    )
}

/// How to read the tables.
///
/// `mark` is what the best values bear.
pub(super) fn notes(comparison: &Comparison, mark: &str) -> Vec<String> {
    let mut notes = vec![
        "MDE = median sqrt|R - e^2| alone is an improper score (a prediction of zero can win it): read it with NLL (lower is better), CRPS (lower is better) and ANEES (1 is calibrated).".to_owned(),
    ];
    let has = |method: Method| {
        let systems = comparison.systems();
        systems.iter().any(|system| comparison.methods(system).iter().any(|(_, judged)| judged.method == method))
    };
    if comparison.is_fair() {
        notes.push(format!("{mark}: best of those that compete, which a variance of zero and an oracle do not; nor is there anything to win against a system that is the truth."));
    }
    if has(Method::Corrected) {
        notes.push("corrected: measurements without the part of their error that was predicted, judged on what is left of it; they do not compete.".to_owned());
    }
    if has(Method::Oracle) {
        notes.push("oracle: the system's true covariance; it knows the scene and not the realised error, which the warp shows, so a model may beat it.".to_owned());
    }
    let unseen =
        |entry: &Entry| entry.evaluation.systems.iter().any(|(system, _)| entry.learned_from(system) == Some(false));
    if comparison.entries.iter().any(unseen) {
        notes.push(format!("{}: the model did not learn from that system.", UNSEEN.trim()));
    }
    for entry in &comparison.entries {
        if let Some(recalibration) = &entry.evaluation.origin.recalibration {
            let factors = recalibration.factors.map(three_digits).join(" ");
            notes.push(format!(
                "{}: variances times {factors} (x … yaw), fitted to {} pairs of split {}; uncalibrated: without.",
                entry.name, recalibration.pairs, recalibration.split
            ));
        }
        notes.extend(no_verdict_note(entry));
    }
    if let Some((system, settings)) =
        comparison.entries[0].evaluation.systems.iter().find_map(|(name, system)| Some((name, system.bootstrap?)))
    {
        notes.push(format!(
            "intervals: {:.0} %, circular block bootstrap, blocks of {} pairs ({system}), {} resamples, seed {}.",
            100.0 * settings.level,
            settings.block_length,
            settings.replicates,
            settings.seed
        ));
    }
    notes
}

/// Pairs of which the images said nothing, by system and reason.
fn no_verdict_note(entry: &Entry) -> Option<String> {
    let counts = entry.table.systems.iter().filter_map(|system| {
        let mut counts: BTreeMap<NoVerdict, usize> = BTreeMap::new();
        system.rows.iter().filter_map(|row| row.no_verdict).for_each(|reason| *counts.entry(reason).or_default() += 1);
        let mut reasons: Vec<(NoVerdict, usize)> = counts.into_iter().collect();
        reasons.sort_by_key(|&(_, count)| Reverse(count));
        let lost: usize = reasons.iter().map(|(_, count)| count).sum();
        let reasons: Vec<String> = reasons.iter().map(|(reason, count)| format!("{} {count}", reason.name())).collect();
        let (pairs, name) = (system.rows.len(), &system.name);
        (lost > 0).then(|| format!("{lost} of {pairs} {name} pairs ({})", reasons.join(", ")))
    });
    let counts: Vec<String> = counts.collect();
    let name = &entry.name;
    (!counts.is_empty()).then(|| {
        format!(
            "{name}: no verdict from the images: {}; their covariance is what is expected without them.",
            counts.join(", ")
        )
    })
}

/// What the table of separation says, in a line for each entry.
pub(super) fn separation_notes(comparison: &Comparison) -> Vec<String> {
    let note = |entry: &Entry| {
        let separation = entry.evaluation.separation.as_ref().map(|found| {
            format!("{} told apart by trace R on the same images: AUROC {:.3}", found.systems.join(" / "), found.auroc)
        });
        let response = entry.evaluation.perturbation_response.as_ref().and_then(|found| found.spearman);
        let response =
            response.map(|value| format!("rank correlation of σ with the size of an injected pose: {value:.2}"));
        let found: Vec<String> = separation.into_iter().chain(response).collect();
        (!found.is_empty()).then(|| format!("{}: {}.", entry.name, found.join("; ")))
    };
    comparison.entries.iter().filter_map(note).collect()
}
