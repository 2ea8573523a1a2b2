//! The only door from the CPU to a device: f64 poses and 8-bit images become f32 tensors here.

use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::Matrix4;

use super::reader::PairSample;

/// Pairs on a device.
#[derive(Clone, Debug)]
pub struct PairBatch {
    /// `[batch, 3, height, width]`, I_i, 0…1.
    pub source_image: Tensor<4>,
    /// `[batch, 3, height, width]`, I_{i+1}, 0…1.
    pub target_image: Tensor<4>,
    /// `[batch, 1, height, width]`, m; 0 = unknown.
    pub target_depth: Tensor<4>,
    /// `[batch, 4]`, fx, fy, cx, cy, px.
    pub intrinsics: Tensor<2>,
    /// `[batch, 4, 4]`, measured `ⁱT̂ᵢ₊₁`, axes of the colour camera, m.
    pub source_from_target: Tensor<3>,
    /// `[batch, 6]`, e; order ρ then φ, m and rad.
    pub error: Tensor<2>,
}

/// The numbers of a [`PairBatch`], still on the CPU.
#[derive(Clone, Debug)]
pub struct PairNumbers {
    size: [usize; 3],
    source_image: Vec<f32>,
    target_image: Vec<f32>,
    target_depth: Vec<f32>,
    intrinsics: Vec<f32>,
    source_from_target: Vec<f32>,
    error: Vec<f32>,
}

impl PairNumbers {
    /// Lays samples out plane by plane. All have the same size.
    pub fn new(samples: &[PairSample]) -> Self {
        let camera = &samples.first().expect("a batch holds at least one pair").camera;
        let (width, height) = (camera.width, camera.height);
        let pixels = samples.len() * width * height;
        let mut numbers = Self {
            size: [samples.len(), height, width],
            source_image: Vec::with_capacity(3 * pixels),
            target_image: Vec::with_capacity(3 * pixels),
            target_depth: Vec::with_capacity(pixels),
            intrinsics: Vec::new(),
            source_from_target: Vec::new(),
            error: Vec::new(),
        };
        for sample in samples {
            assert_eq!((sample.target_image.width, sample.target_image.height), (width, height), "one size in a batch");
            sample.source_image.extend_planar(&mut numbers.source_image);
            sample.target_image.extend_planar(&mut numbers.target_image);
            numbers.target_depth.extend_from_slice(&sample.target_depth.depth_m);
            let camera = &sample.camera;
            numbers.intrinsics.extend([camera.fx, camera.fy, camera.cx, camera.cy].map(|value| value as f32));
            let rows: Matrix4<f64> = sample.source_from_target.matrix().transpose();
            numbers.source_from_target.extend(rows.iter().map(|&value| value as f32));
            numbers.error.extend(sample.error.iter().map(|&value| value as f32));
        }
        numbers
    }

    /// Moves the numbers to a device.
    pub fn upload(self, device: &Device) -> PairBatch {
        let [batch, height, width] = self.size;
        let tensor =
            |values: Vec<f32>, shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(values, shape), device);
        PairBatch {
            source_image: tensor(self.source_image, [batch, 3, height, width]),
            target_image: tensor(self.target_image, [batch, 3, height, width]),
            target_depth: tensor(self.target_depth, [batch, 1, height, width]),
            intrinsics: Tensor::from_data(TensorData::new(self.intrinsics, [batch, 4]), device),
            source_from_target: Tensor::from_data(TensorData::new(self.source_from_target, [batch, 4, 4]), device),
            error: Tensor::from_data(TensorData::new(self.error, [batch, 6]), device),
        }
    }
}

impl PairBatch {
    /// Samples on a device. All have the same size; at least one.
    pub fn new(samples: &[PairSample], device: &Device) -> Self {
        PairNumbers::new(samples).upload(device)
    }

    /// Number of pairs.
    pub fn len(&self) -> usize {
        self.error.dims()[0]
    }

    /// Never: a batch holds at least one pair.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
