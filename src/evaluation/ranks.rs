//! Statistics of ranks.

/// Ranks from 1; equal values share the mean of theirs.
fn ranks(values: &[f64]) -> Vec<f64> {
    assert!(values.iter().all(|value| !value.is_nan()), "NaN has no rank");
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_unstable_by(|&a, &b| values[a].total_cmp(&values[b]));
    let mut ranks = vec![0.0; values.len()];
    let mut before = 0;
    for equal in order.chunk_by(|&a, &b| values[a] == values[b]) {
        let rank = before as f64 + 0.5 * (equal.len() as f64 + 1.0);
        equal.iter().for_each(|&index| ranks[index] = rank);
        before += equal.len();
    }
    ranks
}

/// Pearson's correlation; `None` when a side does not vary.
pub(super) fn correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    // Deviations from the mean, unless they are mere rounding.
    let deviations = |values: &[f64]| -> Option<Vec<f64>> {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let centred: Vec<f64> = values.iter().map(|value| value - mean).collect();
        (product(&centred, &centred) > 1e-24 * product(values, values)).then_some(centred)
    };
    let (a, b) = (deviations(a)?, deviations(b)?);
    Some(product(&a, &b) / (product(&a, &a) * product(&b, &b)).sqrt())
}

/// Spearman's rank correlation; `None` when a side does not vary.
pub(super) fn spearman(a: &[f64], b: &[f64]) -> Option<f64> {
    correlation(&ranks(a), &ranks(b))
}

/// Chance that a value of `high` exceeds one of `low`, ties counting half (area under the ROC curve).
pub(super) fn auroc(high: &[f64], low: &[f64]) -> Option<f64> {
    if high.is_empty() || low.is_empty() {
        return None;
    }
    let ranks = ranks(&[high, low].concat());
    let (n, m) = (high.len() as f64, low.len() as f64);
    let sum: f64 = ranks[..high.len()].iter().sum();
    Some((sum - 0.5 * n * (n + 1.0)) / (n * m))
}

/// Median, the mean of the middle two for an even count; `None` without values.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let (middle, count) = (values.len() / 2, values.len());
    match count {
        0 => None,
        _ if count % 2 == 1 => Some(values[middle]),
        _ => Some(0.5 * (values[middle - 1] + values[middle])),
    }
}

/// Quantile of sorted values, linear between neighbours (numpy's default).
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    let position = share * (sorted.len() - 1) as f64;
    let below = position.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rank_correlation_sees_order_alone_and_shares_ties() {
        assert_eq!(spearman(&[1.0, 2.0, 3.0], &[1.0, 8.0, 27.0]), Some(1.0));
        assert_eq!(spearman(&[1.0, 2.0, 3.0], &[3.0, 2.0, 1.0]), Some(-1.0));
        assert_eq!(spearman(&[1.0, 2.0], &[5.0, 5.0]), None);
        // scipy.stats.spearmanr([1, 2, 2, 4], [1, 3, 2, 2])
        assert!((spearman(&[1.0, 2.0, 2.0, 4.0], &[1.0, 3.0, 2.0, 2.0]).unwrap() - 0.5).abs() < 1e-12);
    }

    #[test]
    fn the_area_under_the_curve_counts_pairs() {
        assert_eq!(auroc(&[3.0, 4.0], &[1.0, 2.0]), Some(1.0));
        assert_eq!(auroc(&[1.0, 3.0], &[2.0, 3.0]), Some(0.375));
        assert_eq!(auroc(&[], &[1.0]), None);
        assert_eq!(median(vec![3.0, 1.0]), Some(2.0));
    }
}
