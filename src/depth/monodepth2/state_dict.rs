//! Weights from the files that the authors of Monodepth2 publish: PyTorch state dicts, read as data. Nothing in a
//! `.pth` file is ever executed.

use std::path::{Path, PathBuf};

use burn::module::Param;
use burn::nn::conv::Conv2d;
use burn::tensor::{Device, Tensor, TensorData};
use pytorch_reader::{DType, PickleValue, PytorchError, PytorchReader};

use super::decoder::Stage;
use super::encoder::BasicBlock;
use super::{MOST_SIZE, Monodepth2, SIZE_STEP, is_input_size};
use crate::error::{Error, Place, Result};

/// The encoder's file in a folder of weights.
pub const ENCODER_FILE: &str = "encoder.pth";
/// The decoder's.
pub const DECODER_FILE: &str = "depth.pth";

/// Epsilon of PyTorch's batch norms.
const NORM_EPSILON: f32 = 1e-5;

/// A network with the weights of `encoder.pth` and `depth.pth`.
pub struct PublishedWeights {
    /// The network, batch norms folded in.
    pub network: Monodepth2,
    /// Input width that it was trained with, px.
    pub width: usize,
    /// Input height, px.
    pub height: usize,
    /// Whether stereo pairs took part in its training: then its depths are in units of 5.4 m.
    pub stereo: bool,
}

impl PublishedWeights {
    /// Reads both files of a folder.
    ///
    /// # Errors
    /// A file is missing, no state dict, cut off, or of another architecture; the message names the key.
    pub fn load(folder: &Path, device: &Device) -> Result<Self> {
        let encoder = StateDict::open(folder.join(ENCODER_FILE), device)?;
        let decoder = StateDict::open(folder.join(DECODER_FILE), device)?;
        let mut network = Monodepth2::init(0.5, device);
        encoder.load_normalised("encoder.conv1", "encoder.bn1", &mut network.encoder.conv1)?;
        for (index, block) in network.encoder.blocks.iter_mut().enumerate() {
            let BasicBlock { conv1, conv2, downsample } = block;
            let name = format!("encoder.layer{}.{}", index / 2 + 1, index % 2);
            encoder.load_normalised(&format!("{name}.conv1"), &format!("{name}.bn1"), conv1)?;
            encoder.load_normalised(&format!("{name}.conv2"), &format!("{name}.bn2"), conv2)?;
            if let Some(downsample) = downsample {
                let name = format!("{name}.downsample");
                encoder.load_normalised(&format!("{name}.0"), &format!("{name}.1"), downsample)?;
            }
        }
        for (index, Stage { before, after }) in network.decoder.stages.iter_mut().enumerate() {
            decoder.load_biased(&format!("decoder.{}.conv.conv", 2 * index), before)?;
            decoder.load_biased(&format!("decoder.{}.conv.conv", 2 * index + 1), after)?;
        }
        let first_head = 2 * network.decoder.stages.len();
        for (scale, head) in network.decoder.heads.iter_mut().enumerate() {
            decoder.load_biased(&format!("decoder.{}.conv", first_head + scale), head)?;
        }
        Ok(Self {
            network,
            width: encoder.size("width")?,
            height: encoder.size("height")?,
            stereo: matches!(encoder.scalars.get("use_stereo"), Some(PickleValue::Bool(true))),
        })
    }
}

/// The tensors and scalars of one file.
struct StateDict {
    path: PathBuf,
    tensors: PytorchReader,
    scalars: std::collections::HashMap<String, PickleValue>,
    device: Device,
}

impl StateDict {
    fn open(path: PathBuf, device: &Device) -> Result<Self> {
        const EXPECTED: &str = "a PyTorch state dict as Monodepth2 publishes it (encoder.pth, depth.pth)";
        let unusable = |error: PytorchError| match error {
            PytorchError::Io(reason) if reason.raw_os_error().is_some() => Error::io("read", &path)(reason),
            error => Error::malformed(&path, Place::Whole, error.to_string(), EXPECTED),
        };
        let tensors = PytorchReader::new(&path).map_err(unusable)?;
        let PickleValue::Dict(scalars) = PytorchReader::read_pickle_data(&path, None).map_err(unusable)? else {
            return Err(Error::malformed(&path, Place::Whole, "a pickle that is no dictionary", EXPECTED));
        };
        if tensors.is_empty() {
            return Err(Error::malformed(&path, Place::Whole, "no tensor", EXPECTED));
        }
        Ok(Self { path, tensors, scalars, device: device.clone() })
    }

    /// A convolution and the batch norm behind it, as one convolution.
    fn load_normalised(&self, convolution: &str, norm: &str, layer: &mut Conv2d) -> Result<()> {
        let [outputs, inputs, rows, columns] = layer.weight.dims();
        let mut weight = self.floats(&format!("{convolution}.weight"), &[outputs, inputs, rows, columns])?;
        let of_norm = |name: &str| self.floats(&format!("{norm}.{name}"), &[outputs]);
        let (gain, bias) = (of_norm("weight")?, of_norm("bias")?);
        let (mean, variance) = (of_norm("running_mean")?, of_norm("running_var")?);
        let mut folded = Vec::with_capacity(outputs);
        for (output, weights) in weight.chunks_exact_mut(inputs * rows * columns).enumerate() {
            let factor = gain[output] / (variance[output] + NORM_EPSILON).sqrt();
            weights.iter_mut().for_each(|weight| *weight *= factor);
            folded.push(bias[output] - mean[output] * factor);
        }
        self.assign(convolution, layer, weight, folded)
    }

    /// A convolution with a bias of its own.
    fn load_biased(&self, name: &str, layer: &mut Conv2d) -> Result<()> {
        let shape = layer.weight.dims();
        let weight = self.floats(&format!("{name}.weight"), &shape)?;
        let bias = self.floats(&format!("{name}.bias"), &shape[..1])?;
        self.assign(name, layer, weight, bias)
    }

    fn assign(&self, name: &str, layer: &mut Conv2d, weight: Vec<f32>, bias: Vec<f32>) -> Result<()> {
        if weight.iter().chain(&bias).any(|value| !value.is_finite()) {
            let found = "weights that are not finite, by themselves or with their batch norm";
            return Err(Error::malformed(&self.path, Place::Field(name.to_owned()), found, "a trained network"));
        }
        let (shape, outputs) = (layer.weight.dims(), bias.len());
        layer.weight = Param::from_tensor(Tensor::from_data(TensorData::new(weight, shape), &self.device));
        layer.bias = Some(Param::from_tensor(Tensor::from_data(TensorData::new(bias, [outputs]), &self.device)));
        Ok(())
    }

    fn floats(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let wrong = |found: String| {
            let expected = format!("32-bit floats of shape {shape:?}, as in Monodepth2 with a ResNet-18 encoder");
            Error::malformed(&self.path, Place::Field(key.to_owned()), found, expected)
        };
        let tensor = self.tensors.get(key).ok_or_else(|| wrong("no such key".to_owned()))?;
        if tensor.shape() != shape || tensor.dtype() != DType::F32 {
            return Err(wrong(format!("{:?} of shape {:?}", tensor.dtype(), tensor.shape())));
        }
        let bytes = tensor.read().map_err(|error| wrong(error.to_string()))?;
        let (values, _) = bytes.as_chunks::<4>();
        Ok(values.iter().map(|&value| f32::from_ne_bytes(value)).collect())
    }

    fn size(&self, key: &str) -> Result<usize> {
        let wrong = |found: String| {
            let expected = format!("the input's size, a multiple of {SIZE_STEP} from {} to {MOST_SIZE}", 2 * SIZE_STEP);
            Error::malformed(&self.path, Place::Field(key.to_owned()), found, expected)
        };
        match self.scalars.get(key) {
            Some(&PickleValue::Int(size)) if usize::try_from(size).is_ok_and(is_input_size) => Ok(size as usize),
            Some(value) => Err(wrong(format!("{value:?}"))),
            None => Err(wrong("no such key".to_owned())),
        }
    }
}
