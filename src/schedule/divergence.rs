//! When to stop: "once we observed diverging train and evaluation losses" (paper Section V-A).

use super::settings::StopConfig;

/// Decides from the two loss curves whether they diverge.
///
/// Both curves are smoothed by a moving mean of `smoothing` epochs. They diverge at the first epoch
/// (not before `min_epochs`) at which
/// - the smoothed evaluation loss was lowest `window` or more epochs ago,
/// - it has risen over that lowest value by more than `tolerance`, and is higher than `window`
///   epochs ago,
/// - while the smoothed training loss has fallen since then.
///
/// An evaluation loss that is merely flat, or rises together with the training loss, is no
/// divergence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DivergenceRule {
    config: StopConfig,
}

impl DivergenceRule {
    /// A rule with the given settings.
    pub fn new(config: StopConfig) -> Self {
        Self { config }
    }

    /// Whether training and evaluation loss diverge at the last epoch of the curves (one value an epoch).
    pub fn diverged(&self, training: &[f64], evaluation: &[f64]) -> bool {
        let StopConfig { enabled, smoothing, window, tolerance, min_epochs } = self.config;
        if !enabled || evaluation.len() < min_epochs.max(smoothing + window) {
            return false;
        }
        let training = moving_mean(training, smoothing);
        let evaluation = moving_mean(evaluation, smoothing);
        let last = evaluation.len() - 1;
        let lowest = (0..=last).min_by(|&a, &b| evaluation[a].total_cmp(&evaluation[b])).expect("not empty");
        last - lowest >= window
            && evaluation[last] > evaluation[lowest] + tolerance
            && evaluation[last] > evaluation[last - window]
            && training[last] < training[lowest]
    }
}

/// Means of `width` neighbouring values.
fn moving_mean(values: &[f64], width: usize) -> Vec<f64> {
    values.windows(width).map(|window| window.iter().sum::<f64>() / width as f64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rule() -> DivergenceRule {
        DivergenceRule::new(StopConfig { enabled: true, smoothing: 3, window: 5, tolerance: 0.05, min_epochs: 10 })
    }

    /// First epoch, counted from 1, at which the rule stops.
    fn stops_at(rule: DivergenceRule, training: impl Fn(f64) -> f64, evaluation: impl Fn(f64) -> f64) -> Option<usize> {
        let curve =
            |f: &dyn Fn(f64) -> f64, epochs: usize| (1..=epochs).map(|epoch| f(epoch as f64)).collect::<Vec<_>>();
        (1..=100).find(|&epochs| rule.diverged(&curve(&training, epochs), &curve(&evaluation, epochs)))
    }

    #[test]
    fn overfitting_stops_soon_after_the_turn() {
        // The evaluation loss turns at epoch 20.
        let epoch =
            stops_at(rule(), |t| -0.1 * t, |t| if t < 20.0 { -0.1 * t } else { -2.0 + 0.05 * (t - 20.0) }).unwrap();
        assert!((24..=29).contains(&epoch), "{epoch}");
    }

    #[test]
    fn two_falling_losses_go_on() {
        assert_eq!(stops_at(rule(), |t| -t.ln(), |t| -0.5 * t.ln()), None);
    }

    #[test]
    fn a_flat_evaluation_loss_goes_on() {
        assert_eq!(stops_at(rule(), |t| -t.ln(), |_| 1.0), None);
    }

    #[test]
    fn losses_that_rise_together_are_no_divergence() {
        assert_eq!(stops_at(rule(), |t| 0.1 * t, |t| 0.1 * t), None);
    }

    #[test]
    fn noise_without_a_trend_goes_on() {
        // Uniform in ±0.05, different in every epoch.
        let noise = |t: f64| 0.1 * (((t * 12.9898).sin() * 43_758.545).rem_euclid(1.0) - 0.5);
        assert_eq!(stops_at(rule(), |t| -t.ln(), move |t| -0.2 * t.ln() + noise(t)), None);
    }

    #[test]
    fn one_bad_epoch_is_smoothed_away() {
        let spike = |t: f64| if t == 30.0 { 0.5 } else { 0.0 };
        assert_eq!(stops_at(rule(), |t| -t.ln(), move |t| -t.ln() + spike(t)), None);
    }

    #[test]
    fn the_rule_is_silent_before_its_epochs_and_when_off() {
        let late = StopConfig { min_epochs: 60, ..rule().config };
        assert_eq!(stops_at(DivergenceRule::new(late), |t| -t, |t| t), Some(60));
        let off = StopConfig { enabled: false, ..rule().config };
        assert_eq!(stops_at(DivergenceRule::new(off), |t| -t, |t| t), None);
    }
}
