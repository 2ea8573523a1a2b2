//! Random numbers that are the same on every machine: ChaCha streams and functions of `libm`, never
//! the platform's.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What a stream of random numbers is for; every purpose and index has a stream of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// The seed of a drive.
    Recording,
    /// Bends of the road.
    Road,
    /// How the car drives.
    Motion,
    /// What stands beside the road, block by block.
    Street,
    /// The camera's exposure.
    Exposure,
    /// LiDAR noise, frame by frame.
    Lidar,
    /// Choice of landmarks, frame by frame.
    Landmarks,
    /// Errors of simulated fixes.
    Fixes,
    /// Errors of a system, pair by pair.
    Errors(u8),
}

impl Purpose {
    fn number(self) -> u64 {
        match self {
            Self::Recording => 0,
            Self::Road => 1,
            Self::Motion => 2,
            Self::Street => 3,
            Self::Exposure => 5,
            Self::Lidar => 6,
            Self::Landmarks => 7,
            Self::Fixes => 8,
            Self::Errors(system) => 16 + u64::from(system),
        }
    }
}

/// A stream of random numbers.
#[derive(Clone, Debug)]
pub(crate) struct Random(ChaCha8Rng);

impl Random {
    pub(crate) fn new(seed: u64, purpose: Purpose, index: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(purpose.number() << 48 | index & 0xffff_ffff_ffff);
        Self(generator)
    }

    /// 64 random bits.
    pub(super) fn bits(&mut self) -> u64 {
        self.0.next_u64()
    }

    /// Uniform in [0, 1).
    pub(super) fn uniform(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform in [low, high).
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// True with this probability.
    pub(super) fn chance(&mut self, probability: f64) -> bool {
        self.uniform() < probability
    }

    /// Standard normal (Box and Muller 1958).
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * libm::log(1.0 - self.uniform())).sqrt();
        radius * libm::cos(std::f64::consts::TAU * self.uniform())
    }
}

/// A well-mixed function of a number (the finaliser of SplitMix64, Steele et al. 2014).
pub(super) fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

/// A uniform number in [0, 1) that belongs to a key.
pub(super) fn uniform_of(key: u64) -> f64 {
    (mix(key) >> 11) as f64 / (1_u64 << 53) as f64
}

/// A smooth random function of a real number: mean 0, within ±1, wavelength about 2.
pub(super) fn smooth(seed: u64, position: f64) -> f64 {
    let cell = position.floor();
    let fraction = position - cell;
    let at = |cell: f64| 2.0 * uniform_of(seed ^ mix(cell as i64 as u64)) - 1.0;
    let blend = fraction * fraction * (3.0 - 2.0 * fraction);
    at(cell) * (1.0 - blend) + at(cell + 1.0) * blend
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_mean_zero_and_variance_one() {
        let mut random = Random::new(1, Purpose::Lidar, 0);
        let values: Vec<f64> = (0..100_000).map(|_| random.normal()).collect();
        let mean = values.iter().sum::<f64>() / 1e5;
        let variance = values.iter().map(|value| value * value).sum::<f64>() / 1e5;
        // Three standard errors.
        assert!(mean.abs() < 3.0 / 1e5_f64.sqrt() && (variance - 1.0).abs() < 3.0 * (2.0 / 1e5_f64).sqrt());
    }

    #[test]
    fn streams_differ_by_seed_purpose_and_index() {
        let first = |seed, purpose, index| Random::new(seed, purpose, index).bits();
        let base = first(1, Purpose::Road, 0);
        assert_eq!(base, first(1, Purpose::Road, 0));
        for other in [first(2, Purpose::Road, 0), first(1, Purpose::Street, 0), first(1, Purpose::Road, 1)] {
            assert_ne!(base, other);
        }
    }
}
