//! What the network sees of a pair: which images, in which basis.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::Architecture;
use crate::alignment::EvidenceInput;
use crate::network::{ImageNetwork, NetworkInput};
use crate::pairs::{ImageBatch, Images, PairBatch};
use crate::warp::{Warp, Warped};

/// Images lie in 0…1; the network sees them around 0.
const IMAGE_MEAN: f32 = 0.5;
/// Scale of the residual image, which brings it to the contrast of an image.
const RESIDUAL_GAIN: f32 = 4.0;
/// Motions that count as one in the pose input: metres between frames, and radians.
const UNIT_MOTION: [f32; 6] = [1.0, 1.0, 1.0, 0.02, 0.02, 0.02];

/// Which source image stands beside the target's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ImagePair {
    /// `I^w_{i+1}`: the source warped into the target by the measured pose (the paper).
    #[default]
    Warped,
    /// `I_i` itself: the network does not see the measured pose (the paper's references 5 and 7).
    Raw,
}

impl ImagePair {
    /// Whether nothing is to be seen where the source shows nothing of the target: of a warp alone. With evidence there is
    /// no verdict instead.
    pub(crate) fn needs_overlap(self, evidence: EvidenceInput) -> bool {
        self == Self::Warped && evidence == EvidenceInput::Off
    }
}

/// What the network sees of target and source image: the same information in two bases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InputBasis {
    /// `(I_{i+1}, I^w_{i+1})`, the paper's.
    Pair,
    /// `(I_{i+1}, 4 (I^w_{i+1} − I_{i+1}))` on valid pixels: learns far faster.
    #[default]
    Residual,
}

/// Whether the network is told the measured pose in numbers too.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseInput {
    /// No: by the warp alone (the paper).
    #[default]
    None,
    /// As `log ⁱT̂ᵢ₊₁` through a small multilayer perceptron whose output joins the image features, as
    /// Wagstaff, Peretroukhin and Kelly do (SS-DPC-Net, 2020).
    Mlp,
}

impl Architecture {
    /// Channels of the network's input: three a picture, and one a validity mask.
    pub fn channels(&self) -> usize {
        let views = if self.stereo { 3 } else { 1 };
        3 + views * (3 + usize::from(self.validity_mask))
    }

    /// Whether a batch for this model needs its images.
    pub fn images(&self) -> Images {
        match self.network {
            ImageNetwork::TableOne => Images::Included,
            ImageNetwork::None => Images::LeftOut,
        }
    }

    /// All that the network sees of a batch.
    pub(super) fn network_input(&self, warp: &Warp, pairs: &PairBatch) -> NetworkInput {
        let images = pairs.images.as_ref().filter(|_| self.network == ImageNetwork::TableOne);
        let evidence = match self.evidence {
            EvidenceInput::Off => None,
            EvidenceInput::Alignment => {
                Some(pairs.evidence.as_ref().expect("a model with evidence is given it").features.clone())
            }
        };
        NetworkInput {
            motion: images.and_then(|_| self.pose_input(pairs)),
            images: images.map(|images| self.images_input(warp, images)),
            evidence,
        }
    }

    /// The target image, and everything to be compared with it, channel after channel.
    fn images_input(&self, warp: &Warp, images: &ImageBatch) -> Tensor<4> {
        let target = &images.target_image;
        let mut channels = vec![target.clone() - IMAGE_MEAN];
        for view in self.views(warp, images) {
            channels.push(match self.input {
                InputBasis::Pair => view.image - IMAGE_MEAN,
                InputBasis::Residual => (view.image - target.clone()) * view.valid_mask.clone() * RESIDUAL_GAIN,
            });
            if self.validity_mask {
                channels.push(view.valid_mask - IMAGE_MEAN);
            }
        }
        Tensor::cat(channels, 1)
    }

    /// The source image; with stereo also the right camera's source and target image (the paper's
    /// footnote 1). Warped, all of them show what the target image shows: the right target by the
    /// calibration alone, so that it tells errors of the depth from those of the pose.
    fn views(&self, warp: &Warp, pairs: &ImageBatch) -> Vec<Warped> {
        let see = |image: &Tensor<4>, pose: &Tensor<3>| match self.pair {
            ImagePair::Warped => {
                warp.forward(image.clone(), pairs.target_depth.clone(), pairs.intrinsics.clone(), pose.clone())
            }
            ImagePair::Raw => {
                let [batch, _, height, width] = image.dims();
                Warped { image: image.clone(), valid_mask: Tensor::ones([batch, 1, height, width], &image.device()) }
            }
        };
        let mut views = vec![see(&pairs.source_image, &pairs.source_from_target)];
        if self.stereo {
            let right = pairs.right.as_ref().expect("a stereo model is given the right camera's images");
            views.push(see(&right.source_image, &right.source_from_target));
            views.push(see(&right.target_image, &right.target_from_target));
        }
        views
    }

    /// The measured motion in units of an ordinary one, `[batch, 6]`; `None` when the network is not told.
    fn pose_input(&self, pairs: &PairBatch) -> Option<Tensor<2>> {
        match self.pose {
            PoseInput::None => None,
            PoseInput::Mlp => {
                let unit = Tensor::<1>::from_floats(UNIT_MOTION, &pairs.motion.device());
                Some(pairs.motion.clone() / unit.unsqueeze())
            }
        }
    }
}
