//! The image-warping layer: the source image as the target camera would see it, if the measured pose
//! were right (paper Section IV-A).
//!
//! Owns the pixel-centre convention on the device (centres at integers) and the validity mask.
//! Knows nothing of datasets, systems or the network; works on any device, with or without gradients.

use burn::module::Module;
use burn::tensor::ops::{GridSampleOptions, GridSamplePaddingMode, InterpolateMode};
use burn::tensor::{Bool, Device, Int, Tensor};

use crate::kernels::{self, Validity};

/// A point counts as in front of the source camera beyond this depth, m.
pub const MIN_DEPTH_M: f32 = 1e-3;

/// A coordinate this far outside the border pixels' centres still counts as inside, px: f32 rounding
/// must not invalidate the border under an identity pose.
const BORDER_TOLERANCE_PX: f32 = 1e-3;

/// Builds the warped image `I^w_{i+1}` from `I_i`, the depth of `I_{i+1}` and the measured pose.
///
/// `p_i = K ⁱT̂ᵢ₊₁ D_{i+1} K⁻¹ p_{i+1}` (paper Eq. 5), then bilinear interpolation of `I_i` at `p_i`.
///
/// Departure: pixels without a source (behind the camera, outside the image, unknown depth) are 0
/// and marked in a mask; the paper does not say what it puts there.
#[derive(Module, Debug)]
pub struct Warp;

/// What the warp gives.
#[derive(Debug, Clone)]
pub struct Warped {
    /// `[batch, channels, height, width]`, the source image seen from the target; 0 where not valid.
    pub image: Tensor<4>,
    /// `[batch, 1, height, width]`, 1 where the pixel has a source, else 0.
    pub valid_mask: Tensor<4>,
}

/// Where each target pixel lies in the source image.
#[derive(Debug, Clone)]
pub struct SourceCoordinates {
    /// `[batch, 1, height, width]`, source column, px; arbitrary where not valid.
    pub u: Tensor<4>,
    /// `[batch, 1, height, width]`, source row, px; arbitrary where not valid.
    pub v: Tensor<4>,
    /// `[batch, 1, height, width]`, whether the pixel has a source.
    pub valid: Tensor<4, Bool>,
}

impl Warp {
    /// Warps the source image into the target view.
    ///
    /// # Shapes
    /// - `source_image`: `[batch, channels, height, width]`
    /// - `target_depth`: `[batch, 1, height, width]`, m along the optical axis; 0 = unknown
    /// - `intrinsics`: `[batch, 4]`, fx, fy, cx, cy in px of this image size
    /// - `source_from_target`: `[batch, 4, 4]`, `ⁱT̂ᵢ₊₁` in camera axes, m
    pub fn forward(
        &self,
        source_image: Tensor<4>,
        target_depth: Tensor<4>,
        intrinsics: Tensor<2>,
        source_from_target: Tensor<3>,
    ) -> Warped {
        let [batch, _, height, width] = source_image.dims();
        assert_eq!(target_depth.dims(), [batch, 1, height, width], "target_depth: [batch, 1, height, width]");
        assert_eq!(intrinsics.dims(), [batch, 4], "intrinsics: [batch, 4]");
        assert_eq!(source_from_target.dims(), [batch, 4, 4], "source_from_target: [batch, 4, 4]");
        let validity = Validity { min_depth_m: MIN_DEPTH_M, border_tolerance_px: BORDER_TOLERANCE_PX };
        if let Some((image, valid_mask)) =
            kernels::warp(&source_image, &target_depth, &intrinsics, &source_from_target, validity)
        {
            return Warped { image, valid_mask };
        }
        let coordinates = self.project(target_depth, intrinsics, source_from_target);
        self.sample(source_image, coordinates)
    }

    /// Paper Eq. 5: the source coordinates of every target pixel. Shapes as in [`Warp::forward`].
    pub fn project(
        &self,
        target_depth: Tensor<4>,
        intrinsics: Tensor<2>,
        source_from_target: Tensor<3>,
    ) -> SourceCoordinates {
        let [batch, depth_channels, height, width] = target_depth.dims();
        assert_eq!(depth_channels, 1, "target_depth: [batch, 1, height, width]");
        assert_eq!(intrinsics.dims(), [batch, 4], "intrinsics: [batch, 4]");
        assert_eq!(source_from_target.dims(), [batch, 4, 4], "source_from_target: [batch, 4, 4]");
        let device = target_depth.device();
        let pixels = height * width;

        let intrinsic = |index: usize| intrinsics.clone().slice([0..batch, index..index + 1]).reshape([batch, 1, 1]);
        let (fx, fy, cx, cy) = (intrinsic(0), intrinsic(1), intrinsic(2), intrinsic(3));

        // K⁻¹ p
        let (columns, rows) = pixel_grid(height, width, &device);
        let ray_x = (columns - cx.clone()) / fx.clone();
        let ray_y = (rows - cy.clone()) / fy.clone();
        let rays = Tensor::cat(vec![ray_x, ray_y, Tensor::ones([batch, 1, pixels], &device)], 1);

        // T̂ D K⁻¹ p
        let rotation = source_from_target.clone().slice([0..batch, 0..3, 0..3]);
        let translation = source_from_target.slice([0..batch, 0..3, 3..4]);
        let depth = target_depth.reshape([batch, 1, pixels]);
        let points = rotation.matmul(rays * depth.clone()) + translation;

        // K (·), guarded so that neither values nor gradients overflow where there is no image
        let point = |axis: usize| points.clone().slice([0..batch, axis..axis + 1, 0..pixels]);
        let in_front = point(2).greater_elem(MIN_DEPTH_M).bool_and(depth.greater_elem(0.0));
        let z = point(2).mask_fill(in_front.clone().bool_not(), 1.0);
        let u = point(0) / z.clone() * fx + cx;
        let v = point(1) / z * fy + cy;

        let within = |coordinate: &Tensor<3>, size: usize| {
            let last = (size - 1) as f32;
            let above = coordinate.clone().greater_equal_elem(-BORDER_TOLERANCE_PX);
            above.bool_and(coordinate.clone().lower_equal_elem(last + BORDER_TOLERANCE_PX))
        };
        let valid = in_front.bool_and(within(&u, width)).bool_and(within(&v, height));

        let image_shape = [batch, 1, height, width];
        SourceCoordinates { u: u.reshape(image_shape), v: v.reshape(image_shape), valid: valid.reshape(image_shape) }
    }

    /// Bilinear interpolation of the source image at the given coordinates, 0 where they are not valid.
    ///
    /// # Shapes
    /// - `source_image`: `[batch, channels, height, width]`
    pub fn sample(&self, source_image: Tensor<4>, coordinates: SourceCoordinates) -> Warped {
        let [batch, _, height, width] = source_image.dims();
        assert!(height > 1 && width > 1, "source_image: at least 2x2 pixels");
        let SourceCoordinates { u, v, valid } = coordinates;
        let invalid = valid.clone().bool_not();

        // Burn's sampler takes −1..1 from the first to the last pixel centre.
        let normalised = |coordinate: Tensor<4>, size: usize| {
            let [_, _, rows, columns] = coordinate.dims();
            (coordinate * (2.0 / (size - 1) as f32) - 1.0)
                .mask_fill(invalid.clone(), 0.0)
                .reshape([batch, rows, columns, 1])
        };
        let grid = Tensor::cat(vec![normalised(u, width), normalised(v, height)], 3);
        let options = GridSampleOptions::new(InterpolateMode::Bilinear)
            .with_padding_mode(GridSamplePaddingMode::Border)
            .with_align_corners(true);
        let valid_mask = valid.float();
        let image = source_image.grid_sample_2d(grid, options) * valid_mask.clone();
        Warped { image, valid_mask }
    }
}

/// Column and row of every pixel, row-major; each `[1, 1, height * width]`.
fn pixel_grid(height: usize, width: usize, device: &Device) -> (Tensor<3>, Tensor<3>) {
    let columns = Tensor::<1, Int>::arange(0..width as i64, device).float().reshape([1, width]);
    let rows = Tensor::<1, Int>::arange(0..height as i64, device).float().reshape([height, 1]);
    (
        columns.repeat_dim(0, height).reshape([1, 1, height * width]),
        rows.repeat_dim(1, width).reshape([1, 1, height * width]),
    )
}
