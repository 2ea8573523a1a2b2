//! What a synthetic data set is made of.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// A synthetic data set: the same settings give the same bytes on every machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SyntheticSettings {
    /// Seed of everything; each drive has a world of its own, drawn from it. Default: 0.
    pub seed: u64,
    /// Drives. Default: 4.
    pub drives: usize,
    /// Frames of each drive, 10 a second. Default: 300.
    pub frames: usize,
    /// Width and height of images, px. Default: 512 x 160.
    pub size: [usize; 2],
    /// LiDAR: steps of each of the 64 beams in a turn (KITTI's has some 1,900); 0 leaves the scans out.
    /// Default: 900.
    pub lidar_steps: usize,
    /// Standard deviation of pixel noise, grey levels. Default: 1.
    pub image_noise: f64,
    /// Time the shutter is open, s: above zero, images are blurred by the car's motion. Default: 0.
    pub shutter_s: f64,
    /// Standard deviation of the gain from frame to frame, beside its slow drift. Default: 0.005.
    pub exposure_jitter: f64,
    /// Standard deviation of the simulated visual odometry's landmarks in the image, px. Default: 0.5.
    pub vo_pixel_noise: f64,
    /// Most landmarks it follows, of 192 places it looks at. Default: 60.
    pub vo_landmarks: usize,
}

impl Default for SyntheticSettings {
    fn default() -> Self {
        Self {
            seed: 0,
            drives: 4,
            frames: 300,
            size: [512, 160],
            lidar_steps: 900,
            image_noise: 1.0,
            shutter_s: 0.0,
            exposure_jitter: 0.005,
            vo_pixel_noise: 0.5,
            vo_landmarks: 60,
        }
    }
}

impl SyntheticSettings {
    /// Checks every value; `prefix` is what stands before a key in messages.
    ///
    /// # Errors
    /// Names the key, the value found and what would do.
    pub fn validate(&self, prefix: &str) -> Result<()> {
        let require = |holds: bool, key: &str, problem: String| {
            if holds { Ok(()) } else { Err(Error::config(format!("{prefix}{key}"), problem)) }
        };
        let [width, height] = self.size;
        let (drives, frames) = (self.drives, self.frames);
        require((1..=9999).contains(&drives), "drives", format!("{drives} is not between 1 and 9999"))?;
        require((2..=1_000_000).contains(&frames), "frames", format!("{frames} is not between 2 and 1000000"))?;
        let fits = width.min(height) >= 16 && width.max(height) <= 4096 && width * height <= 4_000_000;
        require(
            fits,
            "size",
            format!("{width}x{height}: each side must have 16 to 4096 pixels, the image at most four million"),
        )?;
        let steps = self.lidar_steps;
        require(steps <= 10_000, "lidar_steps", format!("{steps} is more than 10000"))?;
        for (key, value, limit) in [
            ("image_noise", self.image_noise, 64.0),
            ("shutter_s", self.shutter_s, 0.1),
            ("exposure_jitter", self.exposure_jitter, 0.5),
        ] {
            require((0.0..=limit).contains(&value), key, format!("{value} is not between 0 and {limit}"))?;
        }
        let noise = self.vo_pixel_noise;
        require((1e-3..=100.0).contains(&noise), "vo_pixel_noise", format!("{noise} is not between 0.001 and 100"))?;
        let landmarks = self.vo_landmarks;
        require(landmarks <= 192, "vo_landmarks", format!("{landmarks} is more than the 192 places that are looked at"))
    }
}
