//! The only door from the CPU to a device: f64 poses and 8-bit images become f32 tensors here.

use burn::tensor::{Device, Tensor, TensorData};
use nalgebra::Matrix4;

use super::reader::PairSample;
use crate::alignment::{FEATURES, features};
use crate::geometry::{Pose, Tangent};

/// Pairs on a device.
#[derive(Clone, Debug)]
pub struct PairBatch {
    /// What the cameras saw, unless it was left out.
    pub images: Option<ImageBatch>,
    /// `[batch, 6]`, `log ⁱT̂ᵢ₊₁`; order ρ then φ, axes of the colour camera, m and rad.
    pub motion: Tensor<2>,
    /// `[batch, 6]`, e; order ρ then φ, m and rad.
    pub error: Tensor<2>,
    /// What direct alignment says, where every sample has it.
    pub evidence: Option<EvidenceBatch>,
}

/// The images of a [`PairBatch`], with all that the warp needs.
#[derive(Clone, Debug)]
pub struct ImageBatch {
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
    /// What the right camera saw, where every sample has it.
    pub right: Option<RightBatch>,
}

/// The evidence of a [`PairBatch`], in axes of the errors.
#[derive(Clone, Debug)]
pub struct EvidenceBatch {
    /// `[batch, FEATURES]`, [`crate::alignment::features`].
    pub features: Tensor<2>,
    /// `[batch, 6]`, ê; order ρ then φ, m and rad. Zero without a verdict.
    pub estimate: Tensor<2>,
    /// `[batch, 6, 6]`, Λ, 1/m² and 1/rad². Zero without a verdict.
    pub information: Tensor<3>,
}

/// Whether images go along.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Images {
    /// They do.
    Included,
    /// Evidence alone is looked at.
    LeftOut,
}

/// The right camera's part of an [`ImageBatch`], with where the left target's points lie in it.
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
    batch: usize,
    images: Option<ImageNumbers>,
    motion: Vec<f32>,
    error: Vec<f32>,
    evidence: Option<EvidenceNumbers>,
}

#[derive(Clone, Debug, Default)]
struct ImageNumbers {
    /// Height and width.
    size: [usize; 2],
    source_image: Vec<f32>,
    target_image: Vec<f32>,
    target_depth: Vec<f32>,
    intrinsics: Vec<f32>,
    source_from_target: Vec<f32>,
    right: Option<RightNumbers>,
}

#[derive(Clone, Debug, Default)]
struct RightNumbers {
    source_image: Vec<f32>,
    target_image: Vec<f32>,
    source_from_target: Vec<f32>,
    target_from_target: Vec<f32>,
}

#[derive(Clone, Debug, Default)]
struct EvidenceNumbers {
    features: Vec<f32>,
    estimate: Vec<f32>,
    information: Vec<f32>,
}

impl PairNumbers {
    /// Lays samples out plane by plane. All have the same size.
    pub fn new(samples: &[PairSample], images: Images) -> Self {
        assert!(!samples.is_empty(), "a batch holds at least one pair");
        let numbers = |tangent: &Tangent| tangent.map(|value| value as f32).as_slice().to_vec();
        Self {
            batch: samples.len(),
            images: (images == Images::Included).then(|| ImageNumbers::new(samples)),
            motion: samples.iter().flat_map(|sample| numbers(&sample.source_from_target.log())).collect(),
            error: samples.iter().flat_map(|sample| numbers(&sample.error)).collect(),
            evidence: EvidenceNumbers::new(samples),
        }
    }

    /// Moves the numbers to a device.
    pub fn upload(self, device: &Device) -> PairBatch {
        let batch = self.batch;
        let vectors = |values: Vec<f32>| matrix(values, [batch, 6], device);
        PairBatch {
            images: self.images.map(|images| images.upload(batch, device)),
            motion: vectors(self.motion),
            error: vectors(self.error),
            evidence: self.evidence.map(|evidence| EvidenceBatch {
                features: matrix(evidence.features, [batch, FEATURES], device),
                estimate: vectors(evidence.estimate),
                information: Tensor::from_data(TensorData::new(evidence.information, [batch, 6, 6]), device),
            }),
        }
    }
}

impl ImageNumbers {
    fn new(samples: &[PairSample]) -> Self {
        let camera = &samples[0].camera;
        let (width, height) = (camera.width, camera.height);
        let pixels = samples.len() * width * height;
        let mut numbers = Self {
            size: [height, width],
            source_image: Vec::with_capacity(3 * pixels),
            target_image: Vec::with_capacity(3 * pixels),
            target_depth: Vec::with_capacity(pixels),
            right: samples.iter().all(|sample| sample.right.is_some()).then(RightNumbers::default),
            ..Self::default()
        };
        for sample in samples {
            assert_eq!((sample.target_image.width, sample.target_image.height), (width, height), "one size in a batch");
            sample.source_image.extend_planar(&mut numbers.source_image);
            sample.target_image.extend_planar(&mut numbers.target_image);
            numbers.target_depth.extend_from_slice(&sample.target_depth.depth_m);
            let camera = &sample.camera;
            numbers.intrinsics.extend([camera.fx, camera.fy, camera.cx, camera.cy].map(|value| value as f32));
            extend_rows(&mut numbers.source_from_target, &sample.source_from_target);
            if let (Some(right), Some(images)) = (&mut numbers.right, &sample.right) {
                images.source_image.extend_planar(&mut right.source_image);
                images.target_image.extend_planar(&mut right.target_image);
                extend_rows(&mut right.source_from_target, &(images.right_from_left * sample.source_from_target));
                extend_rows(&mut right.target_from_target, &images.right_from_left);
            }
        }
        numbers
    }

    fn upload(self, batch: usize, device: &Device) -> ImageBatch {
        let [height, width] = self.size;
        let planes = |values: Vec<f32>, channels: usize| {
            Tensor::<4>::from_data(TensorData::new(values, [batch, channels, height, width]), device)
        };
        let poses = |values: Vec<f32>| Tensor::<3>::from_data(TensorData::new(values, [batch, 4, 4]), device);
        ImageBatch {
            source_image: planes(self.source_image, 3),
            target_image: planes(self.target_image, 3),
            target_depth: planes(self.target_depth, 1),
            intrinsics: matrix(self.intrinsics, [batch, 4], device),
            source_from_target: poses(self.source_from_target),
            right: self.right.map(|right| RightBatch {
                source_image: planes(right.source_image, 3),
                target_image: planes(right.target_image, 3),
                source_from_target: poses(right.source_from_target),
                target_from_target: poses(right.target_from_target),
            }),
        }
    }
}

impl EvidenceNumbers {
    /// `None` where a sample has no evidence.
    fn new(samples: &[PairSample]) -> Option<Self> {
        let mut numbers = Self::default();
        for sample in samples {
            let evidence = sample.evidence.as_ref()?;
            numbers.features.extend(features(evidence, &sample.source_from_target.log()));
            let (estimate, information) = evidence.judged();
            numbers.estimate.extend(estimate.iter().map(|&value| value as f32));
            // Symmetric: rows are columns.
            numbers.information.extend(information.iter().map(|&value| value as f32));
        }
        Some(numbers)
    }
}

fn matrix(values: Vec<f32>, shape: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// A 4x4 matrix, row-major.
fn extend_rows(numbers: &mut Vec<f32>, pose: &Pose) {
    let rows: Matrix4<f64> = pose.matrix().transpose();
    numbers.extend(rows.iter().map(|&value| value as f32));
}

impl PairBatch {
    /// Samples on a device. All have the same size; at least one.
    pub fn new(samples: &[PairSample], device: &Device) -> Self {
        PairNumbers::new(samples, Images::Included).upload(device)
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
