//! Adam as Burn's optimiser interface wants it: the fused kernel on flex, Burn's own elsewhere.

use burn::optim::{AdamConfig, AdamState, AdaptiveMomentumState, LearningRate, Optimizer};
use burn::tensor::{Device, Tensor};

/// Adam (Kingma and Ba 2015) without weight decay: the same steps and the same record as
/// `burn::optim::Adam`.
#[derive(Clone)]
pub struct Adam {
    beta_1: f32,
    beta_2: f32,
    epsilon: f32,
    stock: burn::optim::Adam,
}

impl Adam {
    /// With the constants of the article and of PyTorch: moments decay by .9 and .999, ε is 1e-8
    /// (Burn's default is 1e-5).
    pub fn new() -> Self {
        let (beta_1, beta_2, epsilon) = (0.9, 0.999, 1e-8);
        let stock = AdamConfig::new().with_beta_1(beta_1).with_beta_2(beta_2).with_epsilon(epsilon).build();
        Self { beta_1, beta_2, epsilon, stock }
    }
}

impl Default for Adam {
    fn default() -> Self {
        Self::new()
    }
}

impl Optimizer for Adam {
    type State<const D: usize> = AdamState<D>;

    fn step<const D: usize>(
        &self,
        learning_rate: LearningRate,
        tensor: Tensor<D>,
        gradient: Tensor<D>,
        state: Option<AdamState<D>>,
    ) -> (Tensor<D>, Option<AdamState<D>>) {
        #[cfg(feature = "flex")]
        if super::flex::takes_without_gradients(&tensor) && super::flex::takes_without_gradients(&gradient) {
            let momentum = state.map(|state| state.momentum).unwrap_or_else(|| {
                AdaptiveMomentumState::new(0, Tensor::zeros_like(&tensor), Tensor::zeros_like(&tensor))
            });
            let time = momentum.time + 1;
            let factors = super::adam::AdamFactors::new(learning_rate, self.beta_1, self.beta_2, self.epsilon, time);
            let moments = [momentum.moment_1, momentum.moment_2];
            let (tensor, [moment_1, moment_2]) = super::flex::adam(tensor, gradient, moments, factors);
            return (tensor, Some(AdamState::new(AdaptiveMomentumState::new(time, moment_1, moment_2))));
        }
        self.stock.step(learning_rate, tensor, gradient, state)
    }

    fn to_device<const D: usize>(state: AdamState<D>, device: &Device) -> AdamState<D> {
        burn::optim::Adam::to_device(state, device)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Distribution;

    use super::*;

    #[test]
    fn steps_are_those_of_burns_adam() {
        let device = Device::flex();
        device.seed(3);
        let random = || Tensor::<2>::random([37, 1003], Distribution::Normal(0.0, 0.1), &device);
        let (ours, start) = (Adam::new(), random());
        let (mut weight, mut stock_weight) = (start.clone(), start);
        let (mut state, mut stock_state) = (None, None);
        for step in 0..20 {
            let gradient = random() * 10f32.powi(step % 5 - 4);
            (weight, state) = ours.step(1e-3, weight, gradient.clone(), state);
            (stock_weight, stock_state) = ours.stock.step(1e-3, stock_weight, gradient, stock_state);
            let difference = (weight.clone() - stock_weight.clone()).abs().max().into_scalar::<f32>();
            assert!(difference < 1e-6, "step {step}: {difference:e}");
        }
        let [moment, stock_moment] = [state, stock_state].map(|state| state.unwrap().momentum);
        assert_eq!(moment.time, stock_moment.time);
        for (ours, stock) in [(moment.moment_1, stock_moment.moment_1), (moment.moment_2, stock_moment.moment_2)] {
            let size = stock.clone().abs().max().into_scalar::<f32>();
            let difference = (ours - stock).abs().max().into_scalar::<f32>();
            assert!(difference <= 1e-6 * size, "{difference:e} of {size:e}");
        }
    }
}
