//! The covariance-prediction network of the paper's Table I.
//!
//! Images in, log-variances out. Knows nothing of poses, datasets or the loss.

mod head;
mod pose_encoder;

use burn::module::{Module, Param};
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::{Dropout, DropoutConfig, Initializer, Linear, LinearConfig, PaddingConfig2d};
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor};

use crate::kernels::{conv2d, linear, relu_dropout};
use pose_encoder::PoseEncoder;

pub use head::Head;

/// Table I: kernel size, stride and outputs of c1…c5.
const CONVOLUTIONS: [(usize, usize, usize); 5] = [(5, 2, 64), (5, 2, 128), (3, 2, 256), (3, 2, 512), (3, 1, 1024)];
/// Table I: outputs of fc1.
const HIDDEN_UNITS: usize = 128;
/// Log-variances, the first outputs of fc2.
const COMPONENTS: usize = 6;

/// He's initialisation (He et al. 2015), which keeps the variance of activations through ReLU layers;
/// Burn draws biases from the same law, where He's are zero.
const HE_UNIFORM: Initializer = Initializer::KaimingUniform { gain: std::f64::consts::SQRT_2, fan_out_only: false };

/// Shape of a [`CovarianceNetwork`].
#[derive(Debug, Clone, PartialEq)]
pub struct CovarianceNetworkConfig {
    /// Channels of the concatenated images: 6 for two colour images.
    pub channels: usize,
    /// Whether the measured pose is an input too.
    pub pose: bool,
    /// What fc2 puts out.
    pub head: Head,
    /// Input height, px.
    pub height: usize,
    /// Input width, px.
    pub width: usize,
    /// Probability of zeroing an output of a convolutional layer in training (paper Section V-A: 0.5).
    pub dropout: f64,
}

/// Maps two images to the six log-variances d of `R = D(exp(d))` (paper Table I, architecture of its reference 7).
///
/// Departures, where the paper is silent: ReLU after every layer but the last, zero padding of half
/// the kernel, dropout after the activation of each convolution, He's initialisation (under that of
/// PyTorch's layers the differences between images fade through seven layers, and learning starts
/// late).
#[derive(Module, Debug)]
pub struct CovarianceNetwork {
    c1: Conv2d,
    c2: Conv2d,
    c3: Conv2d,
    c4: Conv2d,
    c5: Conv2d,
    fc1: Linear,
    fc2: Linear,
    dropout: Dropout,
    pose_encoder: Option<PoseEncoder>,
}

impl CovarianceNetworkConfig {
    /// Builds the network with random weights; the last layer starts as a constant.
    ///
    /// fc2 has zero weights and the bias `initial_log_variance`, so that the first prediction for
    /// every pair is the covariance of the training set.
    pub fn init(&self, initial_log_variance: [f64; COMPONENTS], device: &Device) -> CovarianceNetwork {
        let mut channels = self.channels;
        let [c1, c2, c3, c4, c5] = CONVOLUTIONS.map(|(kernel, stride, outputs)| {
            let inputs = std::mem::replace(&mut channels, outputs);
            let pad = kernel / 2;
            Conv2dConfig::new([inputs, outputs], [kernel, kernel])
                .with_stride([stride, stride])
                .with_padding(PaddingConfig2d::Explicit(pad, pad, pad, pad))
                .with_initializer(HE_UNIFORM)
                .init(device)
        });
        let outputs = self.head.outputs();
        let mut fc2 = LinearConfig::new(HIDDEN_UNITS, outputs).init(device);
        fc2.weight = Param::from_tensor(Tensor::zeros([HIDDEN_UNITS, outputs], device)).set_require_grad(true);
        let mut bias = initial_log_variance.map(|d| d as f32).to_vec();
        bias.resize(outputs, 0.0);
        fc2.bias = Some(Param::from_tensor(Tensor::<1>::from_floats(bias.as_slice(), device)).set_require_grad(true));
        let pose_encoder = self.pose.then(|| PoseEncoder::init(device));
        let features = self.features() + if self.pose { pose_encoder::UNITS } else { 0 };
        CovarianceNetwork {
            c1,
            c2,
            c3,
            c4,
            c5,
            fc1: LinearConfig::new(features, HIDDEN_UNITS).with_initializer(HE_UNIFORM).init(device),
            fc2,
            dropout: DropoutConfig::new(self.dropout).init(),
            pose_encoder,
        }
    }

    /// Values that reach fc1 from the images: outputs of c5 times its height and width.
    pub fn features(&self) -> usize {
        let size = |input: usize| {
            CONVOLUTIONS
                .iter()
                .fold(input, |size, &(kernel, stride, _)| (size + 2 * (kernel / 2) - kernel) / stride + 1)
        };
        let (_, _, outputs) = CONVOLUTIONS[CONVOLUTIONS.len() - 1];
        outputs * size(self.height) * size(self.width)
    }
}

impl CovarianceNetwork {
    /// Predicts covariances.
    ///
    /// # Shapes
    /// - `images`: `[batch, channels, height, width]`
    /// - `motion`: `[batch, 6]`, for a network that was configured with a pose input
    /// - returns: `[batch, 6]`, d; order ρ then φ, ln m² and ln rad²; or `[batch, 21]` as [`Head::Full`] says
    pub fn forward(&self, images: Tensor<4>, motion: Option<Tensor<2>>) -> Tensor<2> {
        let features = self.convolutions().into_iter().fold(images, |images, layer| self.layer(layer, images));
        let features = self.with_pose(features.flatten::<2>(1, 3), motion);
        self.fc2.forward(relu(linear(&self.fc1, features)))
    }

    fn with_pose(&self, features: Tensor<2>, motion: Option<Tensor<2>>) -> Tensor<2> {
        match &self.pose_encoder {
            None => features,
            Some(encoder) => {
                let motion = motion.expect("a network with a pose input is given the pose");
                Tensor::cat(vec![features, encoder.forward(motion)], 1)
            }
        }
    }

    /// The activations of c1…c5, each `[batch, outputs, height, width]`.
    pub fn features(&self, images: Tensor<4>) -> [Tensor<4>; 5] {
        let mut activation = images;
        self.convolutions().map(|layer| {
            activation = self.layer(layer, activation.clone());
            activation.clone()
        })
    }

    fn convolutions(&self) -> [&Conv2d; 5] {
        [&self.c1, &self.c2, &self.c3, &self.c4, &self.c5]
    }

    fn layer(&self, convolution: &Conv2d, images: Tensor<4>) -> Tensor<4> {
        relu_dropout(&self.dropout, conv2d(convolution, images))
    }
}

#[cfg(test)]
mod tests {
    use burn::module::{Module, ModuleVisitor};
    use burn::tensor::Distribution;

    use super::*;

    /// Table I by Burn's own operations.
    fn stock_forward(network: &CovarianceNetwork, images: Tensor<4>) -> Tensor<2> {
        let activate = |images, layer: &Conv2d| network.dropout.forward(relu(layer.forward(images)));
        let features = network.convolutions().into_iter().fold(images, activate);
        network.fc2.forward(relu(network.fc1.forward(features.flatten::<2>(1, 3))))
    }

    struct Gradients<'a> {
        of: &'a burn::tensor::Gradients,
        values: Vec<Vec<f32>>,
    }

    impl ModuleVisitor for Gradients<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let gradient = param.val().grad(self.of).expect("every weight has a gradient");
            self.values.push(gradient.into_data().iter().collect());
        }
    }

    #[test]
    fn kernels_give_the_gradients_of_burns_own_operations() {
        let device = Device::flex().autodiff();
        device.seed(1);
        let head = Head::Diagonal;
        let config = CovarianceNetworkConfig { channels: 6, pose: false, head, height: 64, width: 96, dropout: 0.0 };
        let mut network = config.init([-8.0; 6], &device);
        // fc2 starts at zero, which would hide the gradients of everything before it.
        let weight = Tensor::random([HIDDEN_UNITS, COMPONENTS], Distribution::Normal(0.0, 0.3), &device);
        network.fc2.weight = Param::from_tensor(weight).set_require_grad(true);
        let images = Tensor::random([4, 6, 64, 96], Distribution::Normal(0.0, 1.0), &device.clone().inner());
        let gradients = |output: Tensor<2>| {
            let gradients = output.square().sum().backward();
            let mut visitor = Gradients { of: &gradients, values: Vec::new() };
            network.visit(&mut visitor);
            visitor.values
        };
        let kernels = gradients(network.forward(images.clone(), None));
        let stock = gradients(stock_forward(&network, images));
        assert_eq!(kernels.len(), 14);
        for (index, (kernels, stock)) in kernels.iter().zip(&stock).enumerate() {
            let size = stock.iter().fold(0.0f32, |size, value| size.max(value.abs()));
            let worst = kernels.iter().zip(stock).fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs()));
            assert!(worst <= 1e-5 * size, "tensor {index}: differs by {worst:e}, its largest gradient is {size:e}");
        }
    }
}
