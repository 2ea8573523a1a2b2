//! ReLU and dropout in one pass, with a generator whose numbers depend on place and seed alone.

use pulp::Simd;
use rayon::prelude::*;

use super::instructions::{Instructions, Kernel};

/// Counters advanced at once.
const LANES: usize = 16;
/// Values that one call of the generator decides: eight 16-bit numbers for each counter.
const GROUP: usize = 8 * LANES;
/// Values of a task.
const TASK: usize = 128 * GROUP;

/// Which share of values to zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DropoutRate {
    /// Numbers below it, of 2¹⁶, drop a value.
    threshold: u32,
}

impl DropoutRate {
    /// Rounds the probability to a multiple of 2⁻¹⁶.
    pub fn new(probability: f64) -> Self {
        assert!((0.0..1.0).contains(&probability), "dropout probability {probability} lies in [0, 1)");
        Self { threshold: ((probability * 65536.0).round() as u32).min(65535) }
    }

    /// What kept values are multiplied with, so that their expectation stays.
    pub fn scale(&self) -> f32 {
        (65536.0 / f64::from(65536 - self.threshold)) as f32
    }
}

/// ReLU, then dropout, in place: `x ← max(x, 0) / (1 − p)` with probability 1 − p, else 0.
///
/// Whether a value is kept depends on its index and the seed alone (Philox4x32-10; Salmon et al.,
/// "Parallel random numbers: as easy as 1, 2, 3", 2011), so results repeat on any number of threads.
/// NaN stays NaN where it is kept.
pub(super) fn relu_dropout(instructions: Instructions, values: &mut [f32], rate: DropoutRate, seed: u64) {
    values.par_chunks_mut(TASK).enumerate().for_each(|(task, values)| {
        instructions.run(ReluDropout { values, rate, seed, counter: (task * TASK / 8) as u64 });
    });
}

/// Gradient of [`relu_dropout`]: `gradient ← gradient / (1 − p)` where `output` is not 0, else 0.
pub(super) fn relu_dropout_gradient(
    instructions: Instructions,
    output: &[f32],
    gradient: &mut [f32],
    rate: DropoutRate,
) {
    assert_eq!(output.len(), gradient.len(), "ReLU's output and its gradient");
    gradient.par_chunks_mut(TASK).zip(output.par_chunks(TASK)).for_each(|(gradient, output)| {
        instructions.run(ReluDropoutGradient { output, gradient, rate });
    });
}

struct ReluDropout<'a> {
    values: &'a mut [f32],
    rate: DropoutRate,
    seed: u64,
    counter: u64,
}

impl Kernel for ReluDropout<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { values, rate, seed, counter } = self;
        let (threshold, scale) = (rate.threshold, rate.scale());
        if threshold == 0 {
            values.iter_mut().for_each(|value| *value = relu(*value));
            return;
        }
        for (group, values) in values.chunks_mut(GROUP).enumerate() {
            let words = philox(counter + (group * LANES) as u64, seed);
            for (word, values) in words.iter().zip(values.chunks_mut(2 * LANES)) {
                let (low, high) = values.split_at_mut(LANES.min(values.len()));
                for (value, word) in low.iter_mut().zip(word) {
                    *value = if word & 0xFFFF >= threshold { relu(*value) * scale } else { 0.0 };
                }
                for (value, word) in high.iter_mut().zip(word) {
                    *value = if word >> 16 >= threshold { relu(*value) * scale } else { 0.0 };
                }
            }
        }
    }
}

/// `max(x, 0)` that keeps NaN, so that a broken step is seen.
#[inline(always)]
pub(super) fn relu(value: f32) -> f32 {
    if value <= 0.0 { 0.0 } else { value }
}

struct ReluDropoutGradient<'a> {
    output: &'a [f32],
    gradient: &'a mut [f32],
    rate: DropoutRate,
}

impl Kernel for ReluDropoutGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let scale = self.rate.scale();
        for (gradient, &output) in self.gradient.iter_mut().zip(self.output) {
            *gradient = if output == 0.0 { 0.0 } else { *gradient * scale };
        }
    }
}

/// Philox4x32-10 at `LANES` counters from `counter` on: four words for each.
#[inline(always)]
fn philox(counter: u64, key: u64) -> [[u32; LANES]; 4] {
    const MULTIPLIERS: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
    const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
    let (low, high) = counters(counter);
    let mut words = [low, high, [0; LANES], [0; LANES]];
    let mut key = [key as u32, (key >> 32) as u32];
    for _ in 0..10 {
        let [a, b, c, d] = &mut words;
        for (((a, b), c), d) in a.iter_mut().zip(b).zip(c).zip(d) {
            let first = u64::from(MULTIPLIERS[0]) * u64::from(*a);
            let second = u64::from(MULTIPLIERS[1]) * u64::from(*c);
            (*a, *b) = ((second >> 32) as u32 ^ *b ^ key[0], second as u32);
            (*c, *d) = ((first >> 32) as u32 ^ *d ^ key[1], first as u32);
        }
        key = [key[0].wrapping_add(WEYL[0]), key[1].wrapping_add(WEYL[1])];
    }
    words
}

/// Low and high words of consecutive counters.
#[inline(always)]
fn counters(first: u64) -> ([u32; LANES], [u32; LANES]) {
    let counter = |lane: usize| first + lane as u64;
    (std::array::from_fn(|lane| counter(lane) as u32), std::array::from_fn(|lane| (counter(lane) >> 32) as u32))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Known answers of Random123 1.14, `kat_vectors`, philox4x32-10.
    #[test]
    fn philox_gives_its_authors_numbers() {
        let at = |counter, key| philox(counter, key).map(|word| word[0]);
        assert_eq!(at(0, 0), [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]);
    }

    #[test]
    fn dropout_keeps_the_share_asked_for_and_the_mean() {
        for probability in [0.1, 0.5, 0.8] {
            let rate = DropoutRate::new(probability);
            let mut values = vec![1.0f32; 1_000_000];
            relu_dropout(Instructions::current(), &mut values, rate, 7);
            let kept = values.iter().filter(|&&value| value != 0.0).count() as f64 / 1e6;
            // Four standard deviations of a binomial share.
            let bound = 4.0 * (probability * (1.0 - probability) / 1e6).sqrt();
            assert!((kept - (1.0 - probability)).abs() < bound, "{probability}: kept {kept}");
            assert!(values.iter().all(|&value| value == 0.0 || (value - rate.scale()).abs() < 1e-6));
        }
    }

    /// Neighbours, images of a batch and seeds are independent: each pair of bits agrees half the time.
    #[test]
    fn dropout_is_independent_over_places_and_seeds() {
        let kept = |seed| {
            let mut values = vec![1.0f32; 1 << 20];
            relu_dropout(Instructions::current(), &mut values, DropoutRate::new(0.5), seed);
            values.iter().map(|&value| value != 0.0).collect::<Vec<_>>()
        };
        let (first, second) = (kept(1), kept(2));
        let bound = 4.0 * 0.5 / (first.len() as f64).sqrt();
        for lag in [1, 2, 7, 8, 16, 32, 128, 320, 1 << 14] {
            let equal = first.iter().zip(&first[lag..]).filter(|(a, b)| a == b).count();
            let share = equal as f64 / (first.len() - lag) as f64;
            assert!((share - 0.5).abs() < bound, "lag {lag}: {share}");
        }
        let share = first.iter().zip(&second).filter(|(a, b)| a == b).count() as f64 / first.len() as f64;
        assert!((share - 0.5).abs() < bound, "seeds: {share}");
    }

    #[test]
    fn every_instruction_set_and_thread_count_drops_the_same_values() {
        let values: Vec<f32> = (0..100_003).map(|index| (index as f32 * 0.37).sin()).collect();
        let run = |instructions, threads: usize| {
            let mut values = values.clone();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| relu_dropout(instructions, &mut values, DropoutRate::new(0.3), 99));
            values
        };
        let reference = run(Instructions::Portable, 1);
        for instructions in Instructions::available() {
            for threads in [1, 3] {
                assert_eq!(run(instructions, threads), reference, "{} on {threads} threads", instructions.name());
            }
        }
    }

    #[test]
    fn gradient_flows_where_values_were_kept_and_positive() {
        let mut values: Vec<f32> = (0..1000).map(|index| (index as f32 * 0.7).cos()).collect();
        let inputs = values.clone();
        let rate = DropoutRate::new(0.5);
        relu_dropout(Instructions::current(), &mut values, rate, 3);
        let mut gradient = vec![1.0; 1000];
        relu_dropout_gradient(Instructions::current(), &values, &mut gradient, rate);
        for ((&input, &output), &gradient) in inputs.iter().zip(&values).zip(&gradient) {
            let expected = if output == 0.0 { 0.0 } else { output / input };
            assert!((gradient - expected).abs() < 1e-5);
            assert!(input > 0.0 || output == 0.0);
        }
    }

    #[test]
    fn not_a_number_is_not_hidden() {
        let mut values = vec![f32::NAN; 64];
        relu_dropout(Instructions::current(), &mut values, DropoutRate::new(0.0), 0);
        assert!(values.iter().all(|value| value.is_nan()));
    }
}
