//! Depth of single images as they come: what a model takes where no depth is given with an image.

use std::sync::Mutex;

use burn::tensor::Device;

use super::{DepthEstimator, DepthMap, ScaleRule, ground_plane_depth};
use crate::depth::DepthConfig;
use crate::error::{Error, Result};
use crate::geometry::Pinhole;
use crate::recordings::RgbImage;

/// Makes depth from an image and its camera alone: a flat road, or a depth network whose depths are metres.
pub struct LiveDepth {
    source: Source,
}

enum Source {
    GroundPlane {
        camera_height_m: f64,
        horizon_px: Option<f64>,
        max_depth_m: f64,
        size: [usize; 2],
        /// The road looks the same from every image of a camera.
        last: Mutex<Option<(Pinhole, DepthMap)>>,
    },
    Network {
        estimator: Box<DepthEstimator>,
        metres_a_unit: f64,
    },
    /// Nothing can be made: why.
    Missing(String),
}

impl LiveDepth {
    /// What a configuration's source gives without files beside the image; `size` is width and height of the road's map,
    /// px. That its depth network cannot be loaded is said when depth is asked for.
    pub fn new(config: &DepthConfig, size: [usize; 2], device: &Device) -> Self {
        let missing = |source: &str| {
            Source::Missing(format!(
                "no depth was given, and depth.source = \"{source}\" has none for a single image; give one, or take ground_plane or a depth network with a known scale"
            ))
        };
        let source = match config {
            DepthConfig::GroundPlane { camera_height_m, horizon_px, max_depth_m } => Source::GroundPlane {
                camera_height_m: *camera_height_m,
                horizon_px: *horizon_px,
                max_depth_m: *max_depth_m,
                size,
                last: Mutex::default(),
            },
            DepthConfig::Monodepth2(network) => match DepthEstimator::load(&network.weights, device) {
                Err(error) => Source::Missing(format!("no depth was given, and there is no network for it: {error}")),
                Ok(estimator) => match network.scale.unwrap_or(estimator.default_scale) {
                    ScaleRule::Fixed(metres_a_unit) => {
                        Source::Network { estimator: Box::new(estimator), metres_a_unit }
                    }
                    ScaleRule::Mean | ScaleRule::Median => Source::Missing(
                        "no depth was given, and the depth network's scale is taken from LiDAR; give a depth, or a known factor: depth.scale.fixed".to_owned(),
                    ),
                },
            },
            DepthConfig::Lidar { .. } => missing("lidar"),
            DepthConfig::Files { .. } => missing("files"),
            DepthConfig::Recording {} => missing("recording"),
        };
        Self { source }
    }

    /// No depth at all, and why: what [`LiveDepth::estimate`] will say.
    pub(crate) fn missing(problem: String) -> Self {
        Self { source: Source::Missing(problem) }
    }

    /// Depth of an image, m; any size of its aspect.
    ///
    /// # Errors
    /// The source has none for a single image, or its network cannot take this one.
    pub fn estimate(&self, image: &RgbImage, camera: &Pinhole) -> Result<DepthMap> {
        match &self.source {
            Source::GroundPlane { camera_height_m, horizon_px, max_depth_m, size: [width, height], last } => {
                let mut last = last.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                if let Some((_, depth)) = last.as_ref().filter(|(known, _)| known == camera) {
                    return Ok(depth.clone());
                }
                let small = camera.resized(*width, *height);
                let horizon_px = horizon_px.map(|row| camera.resized_row(row, *height));
                let depth = ground_plane_depth(&small, *camera_height_m, horizon_px, *max_depth_m);
                *last = Some((*camera, depth.clone()));
                Ok(depth)
            }
            Source::Network { estimator, metres_a_unit } => {
                let depth = estimator.estimate(std::slice::from_ref(image))?.swap_remove(0).scaled(*metres_a_unit);
                // The network saw the image squeezed to an aspect of its own.
                Ok(depth.resized(image.width, image.height))
            }
            Source::Missing(problem) => Err(Error::Data(problem.clone())),
        }
    }
}
