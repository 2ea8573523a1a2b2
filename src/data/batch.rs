//! The only door from the CPU to a device: f64 poses and 8-bit images become f32 tensors here.

use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::Matrix4;

use super::reader::PairSample;
use crate::geometry::Pose;

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
    /// `[batch, 6]`, `log ⁱT̂ᵢ₊₁`; order ρ then φ, axes of the colour camera, m and rad.
    pub motion: Tensor<2>,
    /// `[batch, 6]`, e; order ρ then φ, m and rad.
    pub error: Tensor<2>,
    /// What the right camera saw, where every sample has it.
    pub right: Option<RightBatch>,
}

/// The right camera's part of a [`PairBatch`], with where the left target's points lie in it.
#[derive(Clone, Debug)]
pub struct RightBatch {
    /// `[batch, 3, height, width]`, right image of time i, 0…1.
    pub source_image: Tensor<4>,
    /// `[batch, 3, height, width]`, right image of time i+1, 0…1.
    pub target_image: Tensor<4>,
    /// `[batch, 4, 4]`, left target into right source by the measured pose, m.
    pub source_from_target: Tensor<3>,
    /// `[batch, 4, 4]`, left target into right target by the calibration, m.
    pub target_from_target: Tensor<3>,
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
    motion: Vec<f32>,
    error: Vec<f32>,
    right: Option<RightNumbers>,
}

#[derive(Clone, Debug, Default)]
struct RightNumbers {
    source_image: Vec<f32>,
    target_image: Vec<f32>,
    source_from_target: Vec<f32>,
    target_from_target: Vec<f32>,
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
            motion: Vec::new(),
            error: Vec::new(),
            right: samples.iter().all(|sample| sample.right.is_some()).then(RightNumbers::default),
        };
        for sample in samples {
            assert_eq!((sample.target_image.width, sample.target_image.height), (width, height), "one size in a batch");
            sample.source_image.extend_planar(&mut numbers.source_image);
            sample.target_image.extend_planar(&mut numbers.target_image);
            numbers.target_depth.extend_from_slice(&sample.target_depth.depth_m);
            let camera = &sample.camera;
            numbers.intrinsics.extend([camera.fx, camera.fy, camera.cx, camera.cy].map(|value| value as f32));
            extend_rows(&mut numbers.source_from_target, &sample.source_from_target);
            numbers.motion.extend(sample.source_from_target.log().iter().map(|&value| value as f32));
            if let (Some(right), Some(images)) = (&mut numbers.right, &sample.right) {
                images.source_image.extend_planar(&mut right.source_image);
                images.target_image.extend_planar(&mut right.target_image);
                extend_rows(&mut right.source_from_target, &(images.right_from_left * sample.source_from_target));
                extend_rows(&mut right.target_from_target, &images.right_from_left);
            }
            numbers.error.extend(sample.error.iter().map(|&value| value as f32));
        }
        numbers
    }

    /// Moves the numbers to a device.
    pub fn upload(self, device: &Device) -> PairBatch {
        let [batch, height, width] = self.size;
        let tensor =
            |values: Vec<f32>, shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(values, shape), device);
        let poses = |values: Vec<f32>| Tensor::<3>::from_data(TensorData::new(values, [batch, 4, 4]), device);
        let vectors = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [batch, 6]), device);
        let right = self.right.map(|right| RightBatch {
            source_image: tensor(right.source_image, [batch, 3, height, width]),
            target_image: tensor(right.target_image, [batch, 3, height, width]),
            source_from_target: poses(right.source_from_target),
            target_from_target: poses(right.target_from_target),
        });
        PairBatch {
            source_image: tensor(self.source_image, [batch, 3, height, width]),
            target_image: tensor(self.target_image, [batch, 3, height, width]),
            target_depth: tensor(self.target_depth, [batch, 1, height, width]),
            intrinsics: Tensor::from_data(TensorData::new(self.intrinsics, [batch, 4]), device),
            source_from_target: poses(self.source_from_target),
            motion: vectors(self.motion),
            error: vectors(self.error),
            right,
        }
    }
}

/// A 4x4 matrix, row-major.
fn extend_rows(numbers: &mut Vec<f32>, pose: &Pose) {
    let rows: Matrix4<f64> = pose.matrix().transpose();
    numbers.extend(rows.iter().map(|&value| value as f32));
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
