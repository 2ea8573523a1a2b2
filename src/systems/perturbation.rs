//! Errors of generated measurements `T̂ = exp(e) T` (the paper's "measurement generation", its future work): of every
//! size and shape, so that a model learns what an error looks like rather than what one system's errors are.

use std::f64::consts::TAU;

use nalgebra::Matrix6;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};

use crate::geometry::Tangent;

/// Sizes are log-uniform over as many powers of ten, the base in the middle.
const DECADES: f64 = 2.0;
/// Each component has a size of its own, down to this share of the common one, log-uniform as well.
const LEAST_SHARE: f64 = 0.1;
/// Share of draws whose components are correlated.
const CORRELATED: f64 = 0.5;
/// Share of draws that are ten times as large.
const FAR: f64 = 0.05;

/// Draws errors; each a pure function of seed, system, drive, frames and draw.
#[derive(Clone, Debug, PartialEq)]
pub struct Perturbation {
    base: [f64; 6],
    /// Seed of each drive, which its name tells whatever drives stand beside it.
    seeds: Vec<[u8; 32]>,
}

impl Perturbation {
    /// Errors around a base, order ρ then φ, m and rad, on drives by their index in the data set.
    pub fn new<'a>(seed: u64, system: &str, base: [f64; 6], drive_names: impl Iterator<Item = &'a str>) -> Self {
        let seed_of = |drive: &str| Sha256::digest(format!("{seed} {system} {drive}")).into();
        Self { base, seeds: drive_names.map(seed_of).collect() }
    }

    /// A draw of the error of a pair: `e = s D(base) D(w) z` with a common size s from a tenth to ten, sizes w of the
    /// components from a tenth to one, and z standard normal; in half of the draws `e = s D(base) Q D(w) z` with random
    /// orthonormal Q, which mixes the components. One draw in twenty is ten times as large, up to a hundred times the
    /// base: far beyond what an alignment finds back from, so that a model learns what that looks like.
    pub fn draw(&self, drive: usize, [source, target]: [usize; 2], draw: usize) -> Tangent {
        let mut random = ChaCha8Rng::from_seed(self.seeds[drive]);
        random.set_stream(((source as u64) << 40) ^ ((target as u64) << 16) ^ draw as u64);
        let mut size = 10f64.powf(DECADES * (random.random_range(0.0..1.0) - 0.5));
        if random.random_range(0.0..1.0) < FAR {
            size *= 10.0;
        }
        let sizes = Tangent::from_fn(|_, _| LEAST_SHARE.powf(random.random_range(0.0..1.0)));
        let mut error = sizes.component_mul(&Tangent::from_fn(|_, _| standard_normal(&mut random)));
        if random.random_range(0.0..1.0) < CORRELATED {
            let gaussian = Matrix6::from_fn(|_, _| standard_normal(&mut random));
            error = gaussian.qr().q() * error;
        }
        size * error.component_mul(&Tangent::from(self.base))
    }
}

/// Box and Muller 1958.
pub(crate) fn standard_normal(random: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random_range(0.0..1.0_f64)).ln()).sqrt();
    radius * (TAU * random.random_range(0.0..1.0_f64)).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    const BASE: [f64; 6] = [0.1, 0.05, 0.02, 1e-3, 2e-3, 4e-3];

    fn perturbation(seed: u64, system: &str, drives: &[&str]) -> Perturbation {
        Perturbation::new(seed, system, BASE, drives.iter().copied())
    }

    #[test]
    fn a_draw_depends_on_seed_system_drive_frames_and_number_alone() {
        let made = perturbation(7, "any", &["monday", "tuesday"]);
        let error = made.draw(0, [5, 6], 2);
        assert_eq!(error, perturbation(7, "any", &["sunday", "monday"]).draw(1, [5, 6], 2));
        for other in [
            made.draw(0, [5, 6], 3),
            made.draw(0, [6, 7], 2),
            made.draw(1, [5, 6], 2),
            made.draw(0, [5, 10], 2),
            perturbation(8, "any", &["monday"]).draw(0, [5, 6], 2),
            perturbation(7, "other", &["monday"]).draw(0, [5, 6], 2),
        ] {
            assert_ne!(error, other);
        }
    }

    #[test]
    fn errors_are_of_every_size_around_the_base_and_have_no_side() {
        let made = perturbation(0, "any", &["monday"]);
        let errors: Vec<Tangent> = (0..4000).map(|source| made.draw(0, [source, source + 1], 0)).collect();
        for c in 0..6 {
            let mut sizes: Vec<f64> = errors.iter().map(|error| (error[c] / BASE[c]).abs()).collect();
            sizes.sort_by(f64::total_cmp);
            let [tenth, median, ninth, largest] = [400, 2000, 3600, 3999].map(|rank| sizes[rank]);
            assert!((0.1..0.5).contains(&median), "component {c}: median {median}");
            assert!(ninth / tenth > 50.0, "component {c}: {tenth} to {ninth}");
            assert!((40.0..600.0).contains(&largest), "component {c}: at most {largest}");
            let positive = errors.iter().filter(|error| error[c] > 0.0).count();
            assert!((1850..2150).contains(&positive), "component {c}: {positive} of 4000 are positive");
        }
    }
}
