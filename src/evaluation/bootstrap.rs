//! Intervals for scores of autocorrelated errors: the circular block bootstrap (Politis and Romano 1992),
//! blocks as long as the errors stay correlated (Politis and White 2004).

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Resamples of each interval.
const REPLICATES: usize = 1000;
/// Seed of their choice.
const SEED: u64 = 0;
/// Probability that an interval stands for.
const LEVEL: f64 = 0.95;

/// How intervals were made.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BootstrapSettings {
    /// Pairs in a block.
    pub block_length: usize,
    /// Resamples.
    pub replicates: usize,
    /// Seed of their choice.
    pub seed: u64,
    /// Probability between the bounds.
    pub level: f64,
}

/// Resamples of the rows of one system. All methods are judged on the same ones, so that differences between
/// them have intervals too.
#[derive(Clone, Debug)]
pub struct Resamples {
    settings: BootstrapSettings,
    rows: usize,
    /// Ranges of rows of each resample, as many rows in all as there are.
    blocks: Vec<Vec<Range<u32>>>,
}

impl Resamples {
    /// Resamples rows that stand in the order of time; `None` for fewer than two.
    ///
    /// After the last row comes the first, and after the last of a drive the first of the next: every row is drawn
    /// equally often, at the price of a few blocks that hold parts of two drives.
    pub fn new(rows: usize, block_length: usize) -> Option<Self> {
        if rows < 2 {
            return None;
        }
        let settings = BootstrapSettings {
            block_length: block_length.clamp(1, rows),
            replicates: REPLICATES,
            seed: SEED,
            level: LEVEL,
        };
        let resample = |replicate: usize| {
            let mut random = ChaCha8Rng::seed_from_u64(settings.seed);
            random.set_stream(replicate as u64);
            let (mut blocks, mut left) = (Vec::new(), rows);
            while left > 0 {
                let start = random.random_range(0..rows);
                let length = settings.block_length.min(left);
                let end = (start + length).min(rows);
                blocks.push(start as u32..end as u32);
                let rest = length - (end - start);
                if rest > 0 {
                    blocks.push(0..rest as u32);
                }
                left -= length;
            }
            blocks
        };
        Some(Self { settings, rows, blocks: (0..settings.replicates).into_par_iter().map(resample).collect() })
    }

    /// How they were made.
    pub fn settings(&self) -> BootstrapSettings {
        self.settings
    }

    /// Interval of the mean of a value of each row.
    pub fn mean_interval(&self, values: &[f64]) -> [f64; 2] {
        assert_eq!(values.len(), self.rows, "a value for each row");
        // Block by block: differences of running sums would drown small values beside one huge one.
        let sum = |block: &Range<u32>| values[block.start as usize..block.end as usize].iter().sum::<f64>();
        let mean = |blocks: &Vec<Range<u32>>| blocks.iter().map(sum).sum::<f64>() / self.rows as f64;
        self.interval(self.blocks.par_iter().map(mean).collect())
    }

    /// Intervals of the medians of several values of each row.
    pub fn median_intervals<const N: usize>(&self, values: &[Vec<f64>; N]) -> [[f64; 2]; N] {
        let orders: [Vec<u32>; N] = values.each_ref().map(|values| {
            let mut order: Vec<u32> = (0..values.len() as u32).collect();
            order.sort_unstable_by(|&a, &b| values[a as usize].total_cmp(&values[b as usize]));
            order
        });
        let middle = [(self.rows - 1) / 2, self.rows / 2];
        let medians: Vec<[f64; N]> = self
            .blocks
            .par_iter()
            .map_init(
                || vec![0_i32; self.rows + 1],
                |counts, blocks| {
                    count_rows(counts, blocks);
                    std::array::from_fn(|n| {
                        let at = |rank: usize| values[n][row_of_rank(&orders[n], counts, rank)];
                        if middle[0] == middle[1] { at(middle[0]) } else { 0.5 * (at(middle[0]) + at(middle[1])) }
                    })
                },
            )
            .collect();
        std::array::from_fn(|n| self.interval(medians.iter().map(|medians| medians[n]).collect()))
    }

    /// The quantiles that leave out as much on each side.
    fn interval(&self, mut values: Vec<f64>) -> [f64; 2] {
        values.sort_unstable_by(f64::total_cmp);
        let outside = 0.5 * (1.0 - self.settings.level);
        [outside, 1.0 - outside].map(|share| super::ranks::quantile(&values, share))
    }
}

/// How often each row is in a resample.
fn count_rows(counts: &mut [i32], blocks: &[Range<u32>]) {
    counts.fill(0);
    for block in blocks {
        counts[block.start as usize] += 1;
        counts[block.end as usize] -= 1;
    }
    let mut sum = 0;
    for count in counts {
        sum += *count;
        *count = sum;
    }
}

/// The row at a place of the sorted resample.
fn row_of_rank(order: &[u32], counts: &[i32], rank: usize) -> usize {
    let mut before = 0;
    for &row in order {
        before += counts[row as usize] as usize;
        if before > rank {
            return row as usize;
        }
    }
    unreachable!("a resample has as many rows as there are")
}

/// Block length at which the circular block bootstrap of the mean is most accurate, estimated from the
/// autocorrelation of the series (Politis and White 2004, corrected by Patton, Politis and White 2009).
pub fn optimal_block_length(series: &[f64]) -> f64 {
    let n = series.len();
    if n < 8 {
        return 1.0;
    }
    let count = n as f64;
    let mean = series.iter().sum::<f64>() / count;
    let centred: Vec<f64> = series.iter().map(|value| value - mean).collect();
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let autocovariance = |lag: usize| product(&centred[lag..], &centred[..n - lag]) / count;
    let variance = autocovariance(0);
    if variance.is_nan() || variance <= 1e-24 * mean * mean {
        return 1.0;
    }
    // Correlation has died away where several lags in a row are insignificant.
    let in_a_row = (count.log10().floor() as usize).max(5);
    let most_lags = (count.sqrt().ceil() as usize + in_a_row).min(n - 1);
    let significant = 2.0 * (count.log10() / count).sqrt();
    let covariances: Vec<f64> = (0..=most_lags).map(autocovariance).collect();
    let insignificant = |lag: usize| (covariances[lag] / variance).abs() < significant;
    let quiet = (1..=most_lags.saturating_sub(in_a_row)).find(|&first| (first..first + in_a_row).all(insignificant));
    let bandwidth = quiet.map_or(most_lags, |first| (2 * first).min(most_lags));
    // The flat-top window: one up to half of the bandwidth, then falling to zero.
    let window = |lag: usize| (2.0 * (1.0 - lag as f64 / bandwidth as f64)).min(1.0);
    let tail = |weight: &dyn Fn(usize) -> f64| -> f64 {
        (1..=bandwidth).map(|lag| 2.0 * window(lag) * weight(lag) * covariances[lag]).sum()
    };
    let (slope, long_run) = (tail(&|lag| lag as f64), variance + tail(&|_| 1.0));
    let length = (2.0 * slope * slope / (4.0 / 3.0 * long_run * long_run)).cbrt() * count.cbrt();
    length.min((3.0 * count.sqrt()).min(count / 3.0).ceil()).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(rows: usize, correlation: f64) -> Vec<f64> {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut value = 0.0;
        (0..rows)
            .map(|_| {
                // A sum of uniform numbers is near enough to a Gaussian.
                let fresh: f64 = (0..12).map(|_| random.random_range(-0.5..0.5)).sum();
                value = correlation * value + (1.0 - correlation * correlation).sqrt() * fresh;
                value
            })
            .collect()
    }

    #[test]
    fn the_interval_of_a_mean_is_that_of_theory() {
        let values = noise(4000, 0.0);
        let resamples = Resamples::new(4000, 1).unwrap();
        let [low, high] = resamples.mean_interval(&values);
        let expected = 2.0 * 1.96 / 4000_f64.sqrt();
        assert!(((high - low) / expected - 1.0).abs() < 0.1, "{} against {expected}", high - low);
        // The median of Gaussian values varies √(π/2) times as much.
        let [[low, high]] = resamples.median_intervals(&[values]);
        assert!(((high - low) / (1.2533 * expected) - 1.0).abs() < 0.15, "{}", high - low);
    }

    #[test]
    fn correlated_errors_have_long_blocks_and_wide_intervals() {
        let (independent, correlated) = (noise(4000, 0.0), noise(4000, 0.9));
        assert!(optimal_block_length(&independent) < 8.0, "{}", optimal_block_length(&independent));
        let length = optimal_block_length(&correlated);
        assert!((30.0..120.0).contains(&length), "{length}");
        let resamples = Resamples::new(4000, length.ceil() as usize).unwrap();
        let [low, high] = resamples.mean_interval(&correlated);
        // Of a mean of an AR(1) process: √((1 + .9) / (1 − .9)) times that of independent values.
        let expected = 19_f64.sqrt() * 2.0 * 1.96 / 4000_f64.sqrt();
        assert!(((high - low) / expected - 1.0).abs() < 0.25, "{} against {expected}", high - low);
    }

    #[test]
    fn every_row_is_drawn_equally_often() {
        let resamples = Resamples::new(40, 8).unwrap();
        let mut counts = [0.0_f64; 40];
        for blocks in &resamples.blocks {
            assert_eq!(blocks.iter().map(Range::len).sum::<usize>(), 40);
            blocks.iter().flat_map(Clone::clone).for_each(|row| counts[row as usize] += 1.0);
        }
        // 1,000 resamples of 5 blocks: a row is in 1,000 of these on average, give or take √(5,000 x .2 x .8).
        assert!(counts.iter().all(|count| (count - 1000.0).abs() < 5.0 * 28.3), "{counts:?}");
        assert_eq!(optimal_block_length(&[1.0; 50]), 1.0);
        assert!(Resamples::new(1, 1).is_none());
    }

    #[test]
    fn one_huge_value_leaves_the_resamples_without_it_alone() {
        let mut values = noise(200, 0.0);
        values[0] = 1e20;
        let [low, _] = Resamples::new(200, 1).unwrap().mean_interval(&values);
        assert!(low.abs() < 1.0 && low != 0.0, "{low}");
    }
}
