//! The loss of self-supervised depth: each image must be what its neighbours show, warped by the predicted depth and
//! the known motion (Godard et al. 2019, with measured poses in place of a pose network).

use burn::tensor::Tensor;
use burn::tensor::module::{avg_pool2d, conv2d};
use burn::tensor::ops::{AvgPoolOptions, ConvOptions, PadMode};

use super::photometric::{Target, smoothness};
use crate::depth::DepthRange;
use crate::depth::monodepth2::{Monodepth2, disparity_to_depth};
use crate::kernels::double;
use crate::pairs::ImageBatch;
use crate::warp::{Warp, Warped};

/// Frames that each target is explained by: the one before and the one after.
pub(super) const NEIGHBOURS: usize = 2;
/// Weight of smoothness at the finest scale; half as much at each coarser one (Godard et al. 2019: 1e-3 / 2^s).
const SMOOTHNESS: f64 = 1e-3;
/// Beyond any photometric error: a pixel that has no source explains nothing.
const NO_SOURCE: f32 = 10.0;
/// By so much an unwarped neighbour wins a tie: where the camera stands still nothing is learned.
const TIE_BREAK: f64 = 1e-5;

/// What a mini-batch costs.
pub(super) struct ReprojectionLoss {
    /// `[1]`, with gradients.
    pub loss: Tensor<1>,
    /// `[1]`, the photometric part at the finest scale, without gradients.
    pub photometric: Tensor<1>,
}

/// The loss of targets, each of which the batch holds `NEIGHBOURS` times: all with their first neighbour, then all
/// with their second.
///
/// For each scale s: depth at full size from disparity s, both neighbours warped by it; at each pixel the neighbour
/// that explains it better counts (so that what one does not see is left to the other), and the pixel is left out
/// where an unwarped neighbour explains it better still (auto-mask: what moves along with the camera).
///
/// Departures: a pixel whose source lies outside the image counts as unexplained, and windows beside it see the target
/// there, where Godard et al. repeat the source's border; coarse disparities are enlarged by repeated doubling; ties are
/// broken by a constant in place of noise.
pub(super) fn reprojection_loss(network: &Monodepth2, range_m: DepthRange, batch: &ImageBatch) -> ReprojectionLoss {
    let targets = batch.target_image.dims()[0] / NEIGHBOURS;
    let target = batch.target_image.clone().narrow(0, 0, targets);
    let disparities = network.forward(target.clone());
    let scales = disparities.len();

    // All scales at once, scale by scale: [scales · targets, 1, height, width].
    let enlarged = disparities
        .iter()
        .enumerate()
        .map(|(scale, disparity)| (0..scale).fold(disparity.clone(), |disparity, _| doubled_smoothly(disparity)));
    let depth = disparity_to_depth(Tensor::cat(enlarged.collect(), 0), range_m.min, range_m.max);
    let seen = Target::new(target.clone());
    let seen_at_all_scales = seen.clone().repeated(scales);
    let every_target = target.clone().repeat_dim(0, scales);

    let errors = (0..NEIGHBOURS).map(|neighbour| {
        let of = |tensor: Tensor<4>| tensor.narrow(0, neighbour * targets, targets);
        let source = of(batch.source_image.clone()).repeat_dim(0, scales);
        let intrinsics = batch.intrinsics.clone().narrow(0, neighbour * targets, targets).repeat_dim(0, scales);
        let motion = batch.source_from_target.clone().narrow(0, neighbour * targets, targets).repeat_dim(0, scales);
        let Warped { image, valid_mask } = Warp.forward(source, depth.clone(), intrinsics, motion);
        // Windows at the edge of the valid region see the target beyond it, not black.
        let image = image + every_target.clone() * (valid_mask.clone() * -1.0 + 1.0);
        seen_at_all_scales.photometric_error(image).mask_fill(valid_mask.equal_elem(0.0), NO_SOURCE)
    });
    let explained = least(errors);

    let unwarped = (0..NEIGHBOURS)
        .map(|neighbour| seen.photometric_error(batch.source_image.clone().narrow(0, neighbour * targets, targets)));
    let unmoved = (least(unwarped) - TIE_BREAK).repeat_dim(0, scales);

    let photometric = Tensor::min_pair(explained, unmoved);
    // NaN disparities have no valid pixel and would go unseen: 0 times their mean is NaN too.
    let sanity = disparities[0].clone().mean() * 0.0;
    let finest = (photometric.clone().narrow(0, 0, targets).mean() + sanity).detach();
    let mut loss = photometric.mean();
    let mut image = target;
    for (scale, disparity) in disparities.into_iter().enumerate() {
        if scale > 0 {
            image = halved(image);
        }
        let weight = SMOOTHNESS / f64::from(1 << scale) / scales as f64;
        loss = loss + smoothness(disparity, image.clone()) * weight;
    }
    ReprojectionLoss { loss, photometric: finest }
}

/// The smallest of several images at each pixel.
fn least(images: impl Iterator<Item = Tensor<4>>) -> Tensor<4> {
    images.reduce(Tensor::min_pair).expect("at least one neighbour")
}

/// Twice the size, bilinear: each pixel twice, then weights ¼, ½, ¼ along rows and columns. (Burn's bilinear
/// interpolation has gradients on some devices only.)
fn doubled_smoothly(image: Tensor<4>) -> Tensor<4> {
    let device = image.device();
    let doubled = double(image).pad([(1, 1), (1, 1)], PadMode::Edge);
    let weights = [1.0, 2.0, 1.0, 2.0, 4.0, 2.0, 1.0, 2.0, 1.0].map(|weight: f32| weight / 16.0);
    let weights = Tensor::<1>::from_floats(weights, &device).reshape([1, 1, 3, 3]);
    conv2d(doubled, weights, None, ConvOptions::new([1, 1], [0, 0], [1, 1], 1))
}

/// Half the size, each pixel the mean of four.
fn halved(image: Tensor<4>) -> Tensor<4> {
    avg_pool2d(image, AvgPoolOptions::new([2, 2]))
}
