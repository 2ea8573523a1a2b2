//! Adam in one pass over weights, gradients and moments.

use pulp::Simd;
use rayon::prelude::*;

use super::instructions::{Instructions, Kernel};

/// Values of a task.
const TASK: usize = 1 << 14;

/// Factors of one step (Kingma and Ba 2015, the order of computation given at the end of its Section 2).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct AdamFactors {
    beta_1: f32,
    beta_2: f32,
    step_size: f32,
    epsilon: f32,
}

impl AdamFactors {
    /// Factors of the `time`-th step, counted from 1.
    pub fn new(learning_rate: f64, beta_1: f32, beta_2: f32, epsilon: f32, time: usize) -> Self {
        let time = time as i32;
        let correction = (1.0 - beta_2.powi(time)).sqrt();
        let step_size = learning_rate * f64::from(correction / (1.0 - beta_1.powi(time)));
        Self { beta_1, beta_2, step_size: step_size as f32, epsilon: epsilon * correction }
    }
}

/// One step in place: `m ← β₁m + (1−β₁)g`, `v ← β₂v + (1−β₂)g²`, `w ← w − α m / (√v + ε)`.
pub(super) fn adam(
    instructions: Instructions,
    factors: AdamFactors,
    weights: &mut [f32],
    gradients: &[f32],
    moments_1: &mut [f32],
    moments_2: &mut [f32],
) {
    let len = weights.len();
    assert!(gradients.len() == len && moments_1.len() == len && moments_2.len() == len, "Adam: one of each a weight");
    weights
        .par_chunks_mut(TASK)
        .zip(gradients.par_chunks(TASK))
        .zip(moments_1.par_chunks_mut(TASK))
        .zip(moments_2.par_chunks_mut(TASK))
        .for_each(|(((weights, gradients), moments_1), moments_2)| {
            instructions.run(Step { factors, weights, gradients, moments_1, moments_2 });
        });
}

struct Step<'a> {
    factors: AdamFactors,
    weights: &'a mut [f32],
    gradients: &'a [f32],
    moments_1: &'a mut [f32],
    moments_2: &'a mut [f32],
}

impl Kernel for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Self { factors: AdamFactors { beta_1, beta_2, step_size, epsilon }, .. } = self;
        let places = self.weights.iter_mut().zip(self.gradients).zip(self.moments_1).zip(self.moments_2);
        for (((weight, &gradient), moment_1), moment_2) in places {
            *moment_1 = beta_1 * *moment_1 + (1.0 - beta_1) * gradient;
            *moment_2 = beta_2 * *moment_2 + (1.0 - beta_2) * (gradient * gradient);
            *weight -= step_size * *moment_1 / (moment_2.sqrt() + epsilon);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_takes_the_step_of_the_article() {
        let (rate, beta_1, beta_2, epsilon) = (1e-3, 0.9, 0.999, 1e-8);
        let value = |index: usize, scale: f64| (index as f64 * 0.7).sin() * scale;
        for instructions in Instructions::available() {
            let len = TASK + 5;
            let start = |scale: f64| (0..len).map(|index| value(index, scale) as f32).collect::<Vec<f32>>();
            let (mut weights, gradients) = (start(1.0), start(0.3));
            let (mut moments_1, mut moments_2) = (vec![0.0; len], vec![0.0; len]);
            for time in 1..=3 {
                let factors = AdamFactors::new(rate, beta_1, beta_2, epsilon, time);
                adam(instructions, factors, &mut weights, &gradients, &mut moments_1, &mut moments_2);
            }
            for (index, &weight) in weights.iter().enumerate() {
                // With a constant gradient the corrected moments are g and g² at every step.
                let gradient = f64::from(gradients[index]);
                let expected = value(index, 1.0) - 3.0 * rate * gradient / (gradient.abs() + f64::from(epsilon));
                assert!((f64::from(weight) - expected).abs() < 1e-6, "{}: {weight}, {expected}", instructions.name());
            }
        }
    }
}
