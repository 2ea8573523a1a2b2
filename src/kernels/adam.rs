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
