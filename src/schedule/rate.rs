//! How the learning rate changes over a training.

use super::settings::Schedule;

/// Share of a training in which the rate of [`Schedule::Cosine`] rises.
const RISE: f64 = 0.05;
/// Factor of its very first step.
const FIRST: f64 = 0.01;

/// Factor of the learning rate when a share (0 to 1) of the training is done.
pub(crate) fn rate_factor(schedule: Schedule, share: f64) -> f64 {
    match schedule {
        Schedule::Constant => 1.0,
        Schedule::Cosine if share < RISE => (share / RISE).max(FIRST),
        Schedule::Cosine => {
            let fallen = (share - RISE) / (1.0 - RISE);
            0.5 * (1.0 + (std::f64::consts::PI * fallen).cos())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cosine_rises_to_one_and_falls_to_zero() {
        let factors: Vec<f64> =
            (0..=1000).map(|step| rate_factor(Schedule::Cosine, f64::from(step) / 1000.0)).collect();
        assert_eq!((factors[0], factors[50]), (FIRST, 1.0));
        assert!(factors[..=50].windows(2).all(|pair| pair[0] <= pair[1]));
        assert!(factors[50..].windows(2).all(|pair| pair[0] > pair[1]));
        assert!((factors[525] - 0.5).abs() < 1e-12 && factors[1000] < 1e-12);
        assert_eq!(rate_factor(Schedule::Constant, 0.3), 1.0);
    }
}
