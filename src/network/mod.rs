//! The covariance-prediction network: the convolutions and layers of the paper's Table I, and what joins them.
//!
//! Images, pose and evidence in, numbers of a head out. Knows nothing of datasets or the loss.

mod convolutions;
mod evidence_encoder;
mod head;
mod initialisation;
mod pose_encoder;
mod posterior;

use burn::module::{Module, Param};
use burn::nn::{Linear, LinearConfig};
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::kernels::linear;
use convolutions::Convolutions;
use evidence_encoder::EvidenceEncoder;
use initialisation::HE_UNIFORM;
use pose_encoder::PoseEncoder;

pub use head::{Head, posterior};
pub(crate) use posterior::{EvidenceTensors, PosteriorTensors};

/// Table I: outputs of fc1.
const HIDDEN_UNITS: usize = 128;
/// Log-variances, the first outputs of fc2.
const COMPONENTS: usize = 6;

/// Which network looks at the images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageNetwork {
    /// c1…c5 of Table I (the paper).
    #[default]
    TableOne,
    /// None: the evidence alone is the model, some ten thousand weights.
    None,
}

/// Shape of a [`CovarianceNetwork`].
#[derive(Debug, Clone, PartialEq)]
pub struct CovarianceNetworkConfig {
    /// What looks at the images.
    pub network: ImageNetwork,
    /// Channels of the concatenated images: 6 for two colour images.
    pub channels: usize,
    /// Whether the measured pose is an input too; only beside images.
    pub pose: bool,
    /// Features of the evidence of a pair, where it is an input.
    pub evidence: Option<usize>,
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
/// late). Beyond the paper: evidence of a pair may join fc1, or take the place of the images.
#[derive(Module, Debug)]
pub struct CovarianceNetwork {
    convolutions: Option<Convolutions>,
    fc1: Option<Linear>,
    fc2: Linear,
    pose_encoder: Option<PoseEncoder>,
    evidence_encoder: Option<EvidenceEncoder>,
}

impl CovarianceNetworkConfig {
    /// Table I for images of this size, as the paper has it.
    pub fn table_one(channels: usize, height: usize, width: usize) -> Self {
        Self {
            network: ImageNetwork::TableOne,
            channels,
            pose: false,
            evidence: None,
            head: Head::Diagonal,
            height,
            width,
            dropout: 0.5,
        }
    }

    /// Builds the network with random weights; the last layer starts as a constant.
    ///
    /// fc2 has zero weights and the bias that stands for `initial_log_variance`, so that
    /// the first prediction for every pair is the covariance of the training set. Beside evidence, images start without
    /// a say: fc1 is zero.
    pub fn init(&self, initial_log_variance: [f64; COMPONENTS], device: &Device) -> CovarianceNetwork {
        let with_images = self.network == ImageNetwork::TableOne;
        assert!(with_images || self.evidence.is_some(), "a network sees images, evidence or both");
        assert!(with_images || !self.pose, "a pose stands beside images");
        let outputs = self.head.outputs();
        let mut fc2 = LinearConfig::new(HIDDEN_UNITS, outputs).init(device);
        fc2.weight = zeros([HIDDEN_UNITS, outputs], device);
        let bias: Vec<f32> = self.head.initial_outputs(initial_log_variance);
        fc2.bias = Some(Param::from_tensor(Tensor::<1>::from_floats(bias.as_slice(), device)).set_require_grad(true));
        let convolutions = with_images.then(|| Convolutions::init(self.channels, self.dropout, device));
        let pose_encoder = self.pose.then(|| PoseEncoder::init(device));
        let fc1 = with_images.then(|| {
            let features = self.features() + if self.pose { pose_encoder::UNITS } else { 0 };
            let mut fc1 = LinearConfig::new(features, HIDDEN_UNITS).with_initializer(HE_UNIFORM).init(device);
            if self.evidence.is_some() {
                fc1.weight = zeros([features, HIDDEN_UNITS], device);
                fc1.bias = Some(zeros([HIDDEN_UNITS], device));
            }
            fc1
        });
        let evidence_encoder = self.evidence.map(|features| EvidenceEncoder::init(features, HIDDEN_UNITS, device));
        CovarianceNetwork { convolutions, fc1, fc2, pose_encoder, evidence_encoder }
    }

    /// Values that reach fc1 from the images: outputs of c5 times its height and width.
    pub fn features(&self) -> usize {
        convolutions::features(self.height, self.width)
    }
}

/// Weights that start at zero.
fn zeros<const D: usize>(shape: [usize; D], device: &Device) -> Param<Tensor<D>> {
    Param::from_tensor(Tensor::zeros(shape, device)).set_require_grad(true)
}

/// What a [`CovarianceNetwork`] sees of a batch; as it was configured.
#[derive(Clone, Debug, Default)]
pub struct NetworkInput {
    /// `[batch, channels, height, width]`. A network that has evidence may be shown that alone: before its images had
    /// a say they change nothing.
    pub images: Option<Tensor<4>>,
    /// `[batch, 6]`, the measured motion, about 1 in size.
    pub motion: Option<Tensor<2>>,
    /// `[batch, features]`, of the evidence, about 1 in size.
    pub evidence: Option<Tensor<2>>,
}

impl CovarianceNetwork {
    /// Predicts covariances.
    ///
    /// # Shapes
    /// - returns: `[batch, 6]`, d; order ρ then φ, ln m² and ln rad²; or as [`Head`] says
    pub fn forward(&self, input: NetworkInput) -> Tensor<2> {
        let NetworkInput { images, motion, evidence } = input;
        let seen = images.map(|images| self.look(images, motion));
        let known = self
            .evidence_encoder
            .as_ref()
            .map(|encoder| encoder.forward(evidence.expect("a network with evidence is given it")));
        let hidden = match (seen, known) {
            (Some(seen), Some(known)) => seen + known,
            (Some(one), None) | (None, Some(one)) => one,
            (None, None) => panic!("a network is given images, evidence or both"),
        };
        self.fc2.forward(relu(hidden))
    }

    /// c1…c5 and fc1, before its activation.
    fn look(&self, images: Tensor<4>, motion: Option<Tensor<2>>) -> Tensor<2> {
        let (Some(convolutions), Some(fc1)) = (&self.convolutions, &self.fc1) else {
            panic!("a network without Table I is shown no images");
        };
        let features = convolutions.forward(images).flatten::<2>(1, 3);
        linear(fc1, self.with_pose(features, motion))
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
        self.convolutions.as_ref().expect("a network that sees images").activations(images)
    }
}

#[cfg(test)]
mod tests {
    use burn::module::{ModuleMapper, ModuleVisitor};
    use burn::nn::conv::Conv2d;
    use burn::tensor::TensorData;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Table I by Burn's own operations.
    fn stock_forward(network: &CovarianceNetwork, images: Tensor<4>) -> Tensor<2> {
        let convolutions = network.convolutions.as_ref().unwrap();
        let activate = |images, layer: &Conv2d| relu(layer.forward(images));
        let features = convolutions.layers().into_iter().fold(images, activate);
        let fc1 = network.fc1.as_ref().unwrap();
        network.fc2.forward(relu(fc1.forward(features.flatten::<2>(1, 3))))
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

    /// Weights and images, the same in every run.
    struct OwnNumbers(ChaCha8Rng);

    impl OwnNumbers {
        /// Uniform numbers of this standard deviation.
        fn tensor<const D: usize>(&mut self, shape: [usize; D], std_dev: f32, device: &Device) -> Tensor<D> {
            let bound = std_dev * 3.0f32.sqrt();
            let values = (0..shape.iter().product()).map(|_| self.0.random_range(-bound..bound)).collect::<Vec<f32>>();
            Tensor::from_data(TensorData::new(values, shape), device)
        }
    }

    impl ModuleMapper for OwnNumbers {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            let tensor = param.val();
            let shape: [usize; D] = tensor.dims();
            // Burn keeps linear weights as [in, out], convolutions as [out, in, height, width].
            let inputs: usize = if D == 2 { shape[0] } else { shape[1..].iter().product() };
            let std_dev = if D == 1 { 0.01 } else { (2.0 / inputs as f32).sqrt() };
            Param::from_tensor(self.tensor(shape, std_dev, &tensor.device())).set_require_grad(true)
        }
    }

    #[test]
    fn kernels_give_the_gradients_of_burns_own_operations() {
        let device = Device::flex().autodiff();
        let config = CovarianceNetworkConfig { dropout: 0.0, ..CovarianceNetworkConfig::table_one(6, 64, 96) };
        // Of its own numbers: those of the device depend on what other tests draw meanwhile, and where a unit comes to lie
        // within rounding of a ReLU's kink, each way has a gradient of its own.
        let mut numbers = OwnNumbers(ChaCha8Rng::seed_from_u64(1));
        let network = config.init([-8.0; 6], &device).map(&mut numbers);
        let images = numbers.tensor([4, 6, 64, 96], 1.0, &device.clone().inner());
        let gradients = |output: Tensor<2>| {
            let gradients = output.square().sum().backward();
            let mut visitor = Gradients { of: &gradients, values: Vec::new() };
            network.visit(&mut visitor);
            visitor.values
        };
        let kernels =
            gradients(network.forward(NetworkInput { images: Some(images.clone()), ..NetworkInput::default() }));
        let stock = gradients(stock_forward(&network, images));
        assert_eq!(kernels.len(), 14);
        for (index, (kernels, stock)) in kernels.iter().zip(&stock).enumerate() {
            let size = stock.iter().fold(0.0f32, |size, value| size.max(value.abs()));
            let worst = kernels.iter().zip(stock).fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs()));
            assert!(worst <= 1e-5 * size, "tensor {index}: differs by {worst:e}, its largest gradient is {size:e}");
        }
    }
}
