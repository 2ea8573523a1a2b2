//! Images and depth maps as a pinhole camera would have taken them: one table a recording, looked up for every frame.

use std::sync::Arc;

use nalgebra::Vector2;

use super::image::RgbImage;
use crate::geometry::{Lens, Pinhole};

/// Parts of a pixel that places are rounded to: 2¹³, so that three channels of 8 bits weighted by it fit a `u64`.
const PART_BITS: u32 = 13;
const PARTS: u64 = 1 << PART_BITS;
/// Undistorted images are not farther from distorted ones than by this factor in focal length.
const LARGEST_ZOOM: f64 = 3.0;
/// Bits of one channel in [`spread`].
const LANE_BITS: u32 = u8::BITS + PART_BITS;
/// Half a level in each of the three lanes.
const HALVES: u64 = (PARTS / 2) | (PARTS / 2) << LANE_BITS | (PARTS / 2) << (2 * LANE_BITS);
/// [`Place::corner`] of a target pixel that no source pixel shows.
const NOWHERE: u32 = u32::MAX;

/// Takes images behind a [`Lens`] to those of a pinhole camera with the same centre and axes.
///
/// Build it once for a recording; it holds 8 bytes for each target pixel. Places in the distorted image are rounded to
/// 1/8192 px (OpenCV's `remap` rounds them to 1/32 px). A pixel covers half a pixel around its centre, so places that lie
/// beyond the outermost centres by less take the outermost pixel; further out, and where the lens model folds over, the
/// result is black and its depth unknown.
#[derive(Clone, Debug)]
pub struct Undistortion {
    lens: Lens,
    camera: Pinhole,
    /// Of the distorted image, px.
    width: usize,
    height: usize,
    /// One for each target pixel, row by row.
    places: Vec<Place>,
}

/// Where a target pixel lies between four pixels of the distorted image.
#[derive(Clone, Copy, Debug)]
struct Place {
    /// Index of the upper left of the four.
    corner: u32,
    /// Distance from it in [`PARTS`] of a pixel, the whole pixel included.
    right: u16,
    down: u16,
}

impl Undistortion {
    /// The camera of a lens's undistorted images, and what takes the distortion out of them, where there is one. `None` if
    /// the lens folds over within the image, or bends it so much that no lens does.
    pub(super) fn of(lens: &Lens) -> Option<(Pinhole, Option<Arc<Self>>)> {
        let rectified = lens.rectified()?;
        let zoom = [rectified.fx / lens.camera.fx, rectified.fy / lens.camera.fy];
        let is_mild = zoom.iter().all(|zoom| (1.0 / LARGEST_ZOOM..=LARGEST_ZOOM).contains(zoom));
        is_mild.then(|| (rectified, Self::to(lens, rectified)))
    }

    /// What takes a lens's images to those of a camera, where they are not those already.
    pub(super) fn to(lens: &Lens, camera: Pinhole) -> Option<Arc<Self>> {
        let differs = lens.camera != camera || lens.distortion != [0.0; 5];
        differs.then(|| Arc::new(Self::new(lens, camera)))
    }

    /// The table from a lens to a camera such as [`Lens::rectified`] gives, which may have another size.
    ///
    /// # Panics
    /// The distorted image has fewer than two rows or columns.
    pub fn new(lens: &Lens, rectified: Pinhole) -> Self {
        let Pinhole { width, height, .. } = lens.camera;
        assert!(width >= 2 && height >= 2, "a distorted image of {width}x{height}: expected 2x2 pixels at least");
        let place = |column: usize, row: usize| {
            let ray = rectified.backproject(&Vector2::new(column as f64, row as f64), 1.0).xy();
            let seen = lens.distort(&ray);
            let along_both = along(seen.x, width).zip(along(seen.y, height));
            match along_both.filter(|_| !lens.folds_before(&ray)) {
                Some(((u, right), (v, down))) => Place { corner: (v * width + u) as u32, right, down },
                None => Place { corner: NOWHERE, right: 0, down: 0 },
            }
        };
        let places = (0..rectified.height)
            .flat_map(|row| (0..rectified.width).map(move |column| (column, row)))
            .map(|(column, row)| place(column, row))
            .collect();
        Self { lens: *lens, camera: rectified, width, height, places }
    }

    /// The lens whose distortion it takes out.
    pub fn lens(&self) -> &Lens {
        &self.lens
    }

    /// The camera of what comes out.
    pub fn camera(&self) -> Pinhole {
        self.camera
    }

    /// An image without distortion: bilinear, rounded to the nearest level, black where the lens saw nothing.
    ///
    /// # Panics
    /// `distorted` is not of the lens' size.
    pub fn image(&self, distorted: &RgbImage) -> RgbImage {
        let size = (distorted.width, distorted.height);
        assert_eq!(size, (self.width, self.height), "image size and that of the lens differ");
        let mut bytes = vec![0; 3 * self.places.len()];
        for (target, place) in bytes.chunks_exact_mut(3).zip(&self.places) {
            if place.corner != NOWHERE {
                target.copy_from_slice(&place.colour(&distorted.bytes, 3 * self.width));
            }
        }
        RgbImage { width: self.camera.width, height: self.camera.height, bytes }
    }

    /// A depth map without distortion, by the nearest pixel: depth is not mixed across edges. It runs along the optical
    /// axis, which the lens leaves where it is, so values stay as they are.
    ///
    /// # Shapes
    /// - `distorted`: `width * height` of the lens, row by row; m, 0 where it is unknown. A map of another size would need
    ///   a lens of its own.
    /// - returns: `width * height` of [`camera`](Self::camera); m, 0 where it is unknown or the lens saw nothing
    ///
    /// # Panics
    /// `distorted` is not of the lens' size.
    pub fn depth(&self, distorted: &[f32]) -> Vec<f32> {
        assert_eq!(distorted.len(), self.width * self.height, "pixels of the depth map and of the lens differ");
        let nearest = |place: &Place| {
            let right = usize::from(u64::from(place.right) >= PARTS / 2);
            let down = usize::from(u64::from(place.down) >= PARTS / 2);
            distorted[place.corner as usize + right + down * self.width]
        };
        self.places.iter().map(|place| if place.corner == NOWHERE { 0.0 } else { nearest(place) }).collect()
    }
}

impl Place {
    /// The four pixels' weighted mean, all channels at once; `stride` is the bytes of a row.
    #[inline]
    fn colour(self, bytes: &[u8], stride: usize) -> [u8; 3] {
        let at = 3 * self.corner as usize;
        let (upper, lower) = (&bytes[at..at + 6], &bytes[at + stride..at + stride + 6]);
        let (right, down) = (u64::from(self.right), u64::from(self.down));
        // The four weights are not negative, and their sum is PARTS.
        let lower_right = (right * down + PARTS / 2) >> PART_BITS;
        let (upper_right, lower_left) = (right - lower_right, down - lower_right);
        let upper_left = PARTS - right - lower_left;
        let sum = spread(&upper[..3]) * upper_left
            + spread(&upper[3..]) * upper_right
            + spread(&lower[..3]) * lower_left
            + spread(&lower[3..]) * lower_right
            + HALVES;
        [0, 1, 2].map(|channel| (sum >> (channel * LANE_BITS + PART_BITS)) as u8)
    }
}

/// The three channels of a pixel side by side in one number, each with room for its product with a weight.
#[inline]
fn spread(pixel: &[u8]) -> u64 {
    u64::from(pixel[0]) | u64::from(pixel[1]) << LANE_BITS | u64::from(pixel[2]) << (2 * LANE_BITS)
}

/// The pixel before a place (px) on a side of `size` pixels, never the last one, and the distance from it in [`PARTS`].
fn along(place: f64, size: usize) -> Option<(usize, u16)> {
    let last = size as f64 - 1.0;
    (place >= -0.5 && place < last + 0.5).then(|| {
        let parts = (place.clamp(0.0, last) * PARTS as f64).round() as u64;
        let pixel = (parts >> PART_BITS).min(size as u64 - 2);
        (pixel as usize, (parts - (pixel << PART_BITS)) as u16)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { fx: 458.654, fy: 457.296, cx: 367.215, cy: 248.375, width: 752, height: 480 };
    const EUROC: Lens = Lens { camera: CAMERA, distortion: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0] };

    /// The ramps of data_scripts/lens_reference.py.
    fn ramps(width: usize, height: usize) -> RgbImage {
        let wave = |phase: usize| (phase % 510).abs_diff(255) as u8;
        let pixel = |index: usize| {
            let (u, v) = (index % width, index / width);
            [wave(4 * u + 2 * v), wave(u + 5 * v), wave(6 * u)]
        };
        RgbImage { width, height, bytes: (0..width * height).flat_map(pixel).collect() }
    }

    fn depths(camera: &Pinhole) -> Vec<f32> {
        (1..=camera.width * camera.height).map(|index| index as f32).collect()
    }

    #[test]
    fn a_lens_without_distortion_returns_the_image_and_its_depth() {
        let lens = Lens { distortion: [0.0; 5], ..EUROC };
        let undistortion = Undistortion::new(&lens, lens.rectified().unwrap());
        let image = ramps(752, 480);
        assert_eq!(undistortion.image(&image), image);
        assert_eq!(undistortion.depth(&depths(&CAMERA)), depths(&CAMERA));
        assert_eq!(undistortion.camera(), CAMERA);
    }

    #[test]
    fn nothing_of_the_rectified_image_is_missing() {
        let undistortion = Undistortion::new(&EUROC, EUROC.rectified().unwrap());
        let white = RgbImage { width: 752, height: 480, bytes: vec![255; 3 * 752 * 480] };
        assert_eq!(undistortion.image(&white), white);
        assert!(undistortion.depth(&vec![2.5; 752 * 480]).iter().all(|depth_m| *depth_m == 2.5));
    }

    #[test]
    fn half_a_pixel_is_the_mean_of_its_neighbours_and_the_outside_is_black() {
        let lens =
            Lens { camera: Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 3, height: 2 }, distortion: [0.0; 5] };
        let bytes = [[10, 0, 255], [20, 1, 255], [30, 2, 0], [40, 3, 0], [50, 4, 0], [60, 5, 0]].concat();
        let image = RgbImage { width: 3, height: 2, bytes };
        // Columns -1, 0.5 and 2; rows 0.5 and 1.5, of which the second is outside.
        let target = Pinhole { fx: 2.0 / 3.0, fy: 1.0, cx: 2.0 / 3.0, cy: -0.5, width: 3, height: 2 };
        let undistortion = Undistortion::new(&lens, target);
        let black = [0; 3];
        // (10 + 20 + 40 + 50) / 4 and so on; 127.5 and 3.5 are rounded up.
        let expected = [black, [30, 2, 128], [45, 4, 0], black, black, black].concat();
        assert_eq!(undistortion.image(&image).bytes, expected);
        let depth = undistortion.depth(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(depth, [0.0, 5.0, 6.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn beyond_a_fold_the_image_is_black_and_not_seen_twice() {
        let lens = Lens { distortion: [-1.0, 0.3, 0.0, 0.0, 0.0], ..EUROC };
        let wide = Pinhole { fx: 100.0, fy: 100.0, ..CAMERA };
        let white = RgbImage { width: 752, height: 480, bytes: vec![255; 3 * 752 * 480] };
        let image = Undistortion::new(&lens, wide).image(&white);
        // The first zero of 1 - 3 r² + 1.5 r⁴.
        let fold = (1.0 - 1.0 / 3.0_f64.sqrt()).sqrt();
        for (index, pixel) in image.bytes.chunks_exact(3).enumerate() {
            let (u, v) = ((index % 752) as f64, (index / 752) as f64);
            let radius = (u - wide.cx).hypot(v - wide.cy) / 100.0;
            assert_eq!(pixel == [255; 3], radius < fold, "at ({u}, {v}), radius {radius}");
        }
    }

    #[test]
    fn colours_are_those_of_opencv() {
        let reference: serde_json::Value =
            serde_json::from_str(include_str!("../../tests/data/lens.json")).expect("JSON");
        for found in reference["lenses"].as_array().unwrap() {
            let [width, height]: [usize; 2] = serde_json::from_value(found["size"].clone()).unwrap();
            let camera = |field: &str| {
                let [fx, fy, cx, cy]: [f64; 4] = serde_json::from_value(found[field].clone()).unwrap();
                Pinhole { fx, fy, cx, cy, width, height }
            };
            let distortion = serde_json::from_value(found["distortion"].clone()).unwrap();
            let lens = Lens { camera: camera("intrinsics"), distortion };
            let image = Undistortion::new(&lens, camera("target")).image(&ramps(width, height));
            let colours: Vec<[usize; 5]> = serde_json::from_value(found["colours"].clone()).unwrap();
            assert!(colours.len() > 150);
            for [u, v, r, g, b] in colours {
                let ours = &image.bytes[3 * (v * width + u)..][..3];
                let off = ours.iter().zip([r, g, b]).map(|(ours, theirs)| usize::from(*ours).abs_diff(theirs));
                assert!(off.max() <= Some(1), "({u}, {v}): {ours:?}, OpenCV {r} {g} {b}");
            }
        }
    }
}
