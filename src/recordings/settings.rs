//! Configuration of recordings whose layout does not say everything.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::geometry::{Lens, Pinhole};

/// A camera, for layouts that do not say it (`tum_rgbd`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Width of the images that these numbers are of, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// Focal length along rows, px.
    pub fx: f64,
    /// Focal length along columns, px.
    pub fy: f64,
    /// Column of the principal point, px, pixel centres at integer coordinates.
    pub cx: f64,
    /// Row of the principal point, px.
    pub cy: f64,
    /// Radial-tangential distortion in OpenCV's order, `k1 k2 p1 p2`, or with `k3`; its images are undistorted when they
    /// are read. Default: none, they are undistorted already.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub distortion: Vec<f64>,
}

impl CameraConfig {
    /// The same as a lens.
    pub(super) fn lens(&self) -> Lens {
        let Self { width, height, fx, fy, cx, cy, distortion: coefficients } = self;
        let mut distortion = [0.0; 5];
        distortion.iter_mut().zip(coefficients).for_each(|(place, value)| *place = *value);
        let camera = Pinhole { fx: *fx, fy: *fy, cx: *cx, cy: *cy, width: *width, height: *height };
        Lens { camera, distortion }
    }

    /// That its numbers can be a camera's; `key` names it.
    ///
    /// # Errors
    /// A focal length is not positive, a number not finite, or the distortion has another count of coefficients.
    pub(crate) fn validate(&self, key: &str) -> Result<()> {
        let Self { width, height, fx, fy, cx, cy, distortion } = self;
        let finite = [fx, fy, cx, cy].into_iter().chain(distortion).all(|value| value.is_finite());
        if !(finite && *fx > 0.0 && *fy > 0.0 && *width.min(height) >= 2) {
            let found = format!("{width}x{height} px, fx {fx}, fy {fy}, cx {cx}, cy {cy}, distortion {distortion:?}");
            return Err(Error::config(
                key,
                format!("{found}: sizes and focal lengths are positive, px, and all finite"),
            ));
        }
        match distortion.len() {
            0 | 4 | 5 => Ok(()),
            count => {
                let problem = format!("has {count} numbers; expected k1 k2 p1 p2, or k1 k2 p1 p2 k3");
                Err(Error::config(format!("{key}.distortion"), problem))
            }
        }
    }
}
