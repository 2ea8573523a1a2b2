//! Does σ rank errors? Pairs are left out one by one, those of the largest σ first, and the mean |e| of the
//! rest is followed (Ilg et al. 2018).

/// Mean |e| of the pairs that are left, over that of all, after a share k/N of them was left out; k = 0…N−1.
///
/// Pairs of equal `key` leave in random order: what is followed is the expected value.
pub fn sparsification_curve(key: &[f64], errors: &[f64]) -> Vec<f64> {
    assert_eq!(key.len(), errors.len(), "one key for each error");
    let mut order: Vec<u32> = (0..key.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| key[a as usize].total_cmp(&key[b as usize]));
    // Errors from the smallest key up, each the mean of those that share its key.
    let mut kept: Vec<f64> = order.iter().map(|&index| errors[index as usize].abs()).collect();
    for tie in order.chunk_by(|&a, &b| key[a as usize] == key[b as usize]).scan(0, |first, tie| {
        let range = *first..*first + tie.len();
        *first = range.end;
        Some(range)
    }) {
        let mean = kept[tie.clone()].iter().sum::<f64>() / tie.len() as f64;
        kept[tie].fill(mean);
    }
    let mut sum = 0.0;
    for (index, value) in kept.iter_mut().enumerate() {
        sum += *value;
        *value = sum / (index + 1) as f64;
    }
    let all = kept.last().copied().unwrap_or(1.0);
    kept.into_iter().rev().map(|mean| mean / all).collect()
}

/// Area between the curves by σ and by |e| (AUSE; 0 when σ ranks like the error), and between a random order,
/// which stays at 1, and that by σ (AURG; above 0 when σ helps). `None` when all errors are zero.
pub fn sparsification_areas(sigma: &[f64], errors: &[f64]) -> Option<[f64; 2]> {
    if errors.iter().all(|&error| error == 0.0) {
        return None;
    }
    let sizes: Vec<f64> = errors.iter().map(|error| error.abs()).collect();
    let area = |curve: Vec<f64>| curve.iter().sum::<f64>() / curve.len() as f64;
    let (by_sigma, by_error) = (area(sparsification_curve(sigma, errors)), area(sparsification_curve(&sizes, errors)));
    // An order that gains nothing sums to 1 up to rounding.
    let gain = Some(1.0 - by_sigma).filter(|gain: &f64| gain.abs() > 1e-12).unwrap_or(0.0);
    Some([by_sigma - by_error, gain])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_leave_first() {
        let errors = [1.0, -4.0, 3.0];
        assert_eq!(sparsification_curve(&[0.1, 0.9, 0.5], &errors), [1.0, 0.75, 0.375]);
        assert_eq!(sparsification_areas(&[0.1, 0.9, 0.5], &errors).unwrap()[0], 0.0);
    }

    #[test]
    fn equal_sigmas_are_a_random_order() {
        assert_eq!(sparsification_curve(&[0.2; 3], &[1.0, 4.0, 3.0]), [1.0; 3]);
        let [ause, aurg] = sparsification_areas(&[0.2; 3], &[1.0, 4.0, 3.0]).unwrap();
        assert!(ause > 0.0 && aurg == 0.0);
        assert_eq!(sparsification_areas(&[0.2; 3], &[0.0; 3]), None);
    }
}
