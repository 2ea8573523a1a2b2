//! Does the model tell an accurate system from an inaccurate one on the same images? The paper's claim.

use std::collections::HashSet;

use serde::{Deserialize, Serialize};

use super::pair_table::{PairRow, PairTable};
use super::ranks::{auroc, median};
use crate::geometry::Covariance6;

/// Predictions for two systems on the same images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Separation {
    /// The first system, and the one without error.
    pub systems: [String; 2],
    /// Median σ of the first over median σ of the second.
    pub median_sigma_ratio: [f64; 6],
    /// Chance that trace R of the first exceeds that of the second, over all pairs of predictions.
    pub auroc: f64,
}

/// The first system beside the first one that is the truth itself, on pairs that both have.
pub fn separation(table: &PairTable) -> Option<Separation> {
    let (first, others) = table.systems.split_first()?;
    let truth = others.iter().find(|system| system.is_truth())?;
    let keys = |rows: &[PairRow]| rows.iter().map(PairRow::key).collect::<HashSet<_>>();
    let shared: HashSet<_> = keys(&first.rows).intersection(&keys(&truth.rows)).cloned().collect();
    let [first_covariances, truth_covariances] = [first, truth].map(|system| {
        let rows = system.rows.iter().filter(|row| shared.contains(&row.key()));
        rows.map(|row| row.covariance).collect::<Option<Vec<Covariance6>>>()
    });
    let (first_covariances, truth_covariances) = (first_covariances?, truth_covariances?);
    let median_sigma = |rows: &[Covariance6], c: usize| median(rows.iter().map(|row| row.std_devs()[c]).collect());
    let traces = |rows: &[Covariance6]| rows.iter().map(|row| row.matrix().trace()).collect::<Vec<f64>>();
    let auroc = auroc(&traces(&first_covariances), &traces(&truth_covariances))?;
    let mut ratios = [0.0; 6];
    for (c, ratio) in ratios.iter_mut().enumerate() {
        *ratio = median_sigma(&first_covariances, c)? / median_sigma(&truth_covariances, c)?;
    }
    Some(Separation { systems: [first, truth].map(|system| system.name.clone()), median_sigma_ratio: ratios, auroc })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::SystemPairs;
    use crate::evaluation::pair_table::made_row as row;
    use crate::geometry::ErrorFrame;

    #[test]
    fn systems_are_told_apart_on_the_images_they_share() {
        let system = |name: &str, rows| SystemPairs { name: name.to_owned(), simulated: false, rows };
        let vo = system("vo", (0..4).map(|frame| row(frame, 0.1, 0.04)).collect());
        // A pair that only one of them measured counts for neither.
        let gnss = system("gnss", (0..4).map(|frame| row(frame, 0.0, 0.01)).chain([row(9, 0.0, 100.0)]).collect());
        let mut table = PairTable { error_frame: ErrorFrame::Vehicle, systems: vec![vo, gnss] };
        let found = separation(&table).unwrap();
        assert_eq!((found.systems, found.auroc), (["vo", "gnss"].map(str::to_owned), 1.0));
        assert!(found.median_sigma_ratio.iter().all(|ratio| (ratio - 2.0).abs() < 1e-12));
        // Without a system that is the truth there is nothing to tell apart.
        table.systems.pop();
        assert!(separation(&table).is_none());
    }
}
