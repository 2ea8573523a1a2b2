//! A depth image, and how it is brought to another size.

use std::ops::Range;

/// How far the aspects of a map and its image may differ.
const MOST_SQUEEZE: f64 = 1.05;
/// What to do where they differ more.
pub(crate) const EXPECTED_ASPECT: &str = "one of the image's aspect; bring it to the image's size first";

/// A depth image.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `width * height` depths, m, row-major; 0 = unknown.
    pub depth_m: Vec<f32>,
}

impl DepthMap {
    /// The map at another size, each pixel taking the known depth nearest to its centre within its
    /// footprint: depths of different surfaces are never averaged, sparse ones never lost.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let columns: Vec<Footprint> = (0..width).map(|u| Footprint::new(u, self.width, width)).collect();
        let rows: Vec<Footprint> = (0..height).map(|v| Footprint::new(v, self.height, height)).collect();
        let pixels = rows.iter().flat_map(|row| columns.iter().map(move |column| (row, column)));
        let depth_m = pixels.map(|(row, column)| self.nearest_known(row, column)).collect();
        Self { width, height, depth_m }
    }

    fn nearest_known(&self, row: &Footprint, column: &Footprint) -> f32 {
        let at = |v: usize, u: usize| self.depth_m[v * self.width + u];
        let central = at(row.centre as usize, column.centre as usize);
        if central > 0.0 {
            return central;
        }
        let pixels = row.pixels.clone().flat_map(|v| column.pixels.clone().map(move |u| (v, u)));
        let distance =
            |&(v, u): &(usize, usize)| (v as f64 + 0.5 - row.centre).powi(2) + (u as f64 + 0.5 - column.centre).powi(2);
        let known = pixels.filter(|&(v, u)| at(v, u) > 0.0);
        known.min_by(|a, b| distance(a).total_cmp(&distance(b))).map_or(0.0, |(v, u)| at(v, u))
    }

    /// That the map shows what an image of this size shows, at whatever size: it has its aspect, to 5 %, as the maps of
    /// depth networks have that of their images.
    ///
    /// # Errors
    /// It has another: turned, cropped, or of another camera; it says so with both sizes.
    pub fn require_aspect(&self, [width, height]: [usize; 2]) -> Result<(), String> {
        let squeeze = (self.width * height) as f64 / (self.height * width) as f64;
        match (1.0 / MOST_SQUEEZE..=MOST_SQUEEZE).contains(&squeeze) {
            true => Ok(()),
            false => {
                Err(format!("a depth map of {}x{} pixels for an image of {width}x{height}", self.width, self.height))
            }
        }
    }

    /// The map with every depth multiplied by a factor.
    pub fn scaled(mut self, factor: f64) -> Self {
        self.depth_m.iter_mut().for_each(|depth| *depth = (f64::from(*depth) * factor) as f32);
        self
    }

    /// The map with depths beyond `most_m` brought back to it.
    pub fn bounded(mut self, most_m: f32) -> Self {
        self.depth_m.iter_mut().for_each(|depth| *depth = depth.min(most_m));
        self
    }

    /// Column, row and depth of every pixel with a known depth.
    pub fn known(&self) -> impl Iterator<Item = (usize, usize, f32)> {
        let pixels = self.depth_m.iter().enumerate().filter(|(_, depth)| **depth > 0.0);
        pixels.map(|(pixel, &depth)| (pixel % self.width, pixel / self.width, depth))
    }

    /// Depth at the place that a pixel of another map of the same view covers: bilinear in inverse depth, over the
    /// neighbours whose depth is known; 0 where there is none.
    pub fn seen_from(&self, other: &Self, u: usize, v: usize) -> f64 {
        let (left, right) = Neighbours::of(u, other.width, self.width).both();
        let (upper, lower) = Neighbours::of(v, other.height, self.height).both();
        let (mut inverse, mut weight) = (0.0, 0.0);
        for (column, across) in [left, right] {
            for (row, down) in [upper, lower] {
                let depth = f64::from(self.depth_m[row * self.width + column]);
                if depth > 0.0 {
                    inverse += across * down / depth;
                    weight += across * down;
                }
            }
        }
        if inverse > 0.0 { weight / inverse } else { 0.0 }
    }
}

/// The two pixels along an axis between whose centres a place lies.
struct Neighbours {
    first: usize,
    second: usize,
    /// How far it lies from the first to the second.
    share: f64,
}

impl Neighbours {
    fn of(pixel: usize, from: usize, to: usize) -> Self {
        let place = ((pixel as f64 + 0.5) * to as f64 / from as f64 - 0.5).clamp(0.0, (to - 1) as f64);
        let first = place as usize;
        Self { first, second: (first + 1).min(to - 1), share: place - first as f64 }
    }

    fn both(&self) -> ((usize, f64), (usize, f64)) {
        ((self.first, 1.0 - self.share), (self.second, self.share))
    }
}

/// The source pixels that one target pixel covers along one axis.
struct Footprint {
    pixels: Range<usize>,
    /// Centre of the target pixel, in source pixels from the edge.
    centre: f64,
}

impl Footprint {
    fn new(pixel: usize, from: usize, to: usize) -> Self {
        let scale = from as f64 / to as f64;
        let (first, end) = (pixel as f64 * scale, (pixel + 1) as f64 * scale);
        Self { pixels: first as usize..(end.ceil() as usize).min(from), centre: 0.5 * (first + end) }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn resizing_never_mixes_depths() {
        let map = DepthMap { width: 4, height: 2, depth_m: vec![1.0, 1.0, 9.0, 9.0, 0.0, 1.0, 9.0, 0.0] };
        let small = map.resized(2, 1);
        assert!(small.depth_m.iter().all(|depth| map.depth_m.contains(depth)));
        assert_eq!(map.resized(4, 2), map);
    }

    #[test]
    fn resizing_keeps_the_returns_of_a_sparse_map() {
        let mut depth_m = vec![0.0; 64];
        depth_m[9] = 7.0;
        let map = DepthMap { width: 8, height: 8, depth_m };
        assert_eq!(map.resized(2, 2).depth_m, [7.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_map_has_the_aspect_of_its_image() {
        let map = |width, height| DepthMap { width, height, depth_m: Vec::new() };
        for (width, height) in [(1242, 375), (621, 187), (640, 192), (1024, 320), (41, 12)] {
            assert_eq!(map(width, height).require_aspect([1242, 375]), Ok(()));
        }
        for (width, height) in [(375, 1242), (1242, 300), (384, 384), (0, 5), (5, 0)] {
            assert!(map(width, height).require_aspect([1242, 375]).is_err());
        }
    }

    #[test]
    fn a_larger_view_sees_inverse_depth_between_pixels() {
        let map = DepthMap { width: 2, height: 1, depth_m: vec![10.0, 20.0] };
        let larger = DepthMap { width: 8, height: 4, depth_m: vec![1.0; 32] };
        assert_relative_eq!(map.seen_from(&larger, 0, 0), 10.0);
        // An eighth of the way from the first centre to the second.
        assert_relative_eq!(map.seen_from(&larger, 2, 3), 1.0 / (0.875 / 10.0 + 0.125 / 20.0));
        let half_known = DepthMap { depth_m: vec![0.0, 20.0], ..map };
        assert_relative_eq!(half_known.seen_from(&larger, 2, 0), 20.0, epsilon = 1e-9);
        assert_eq!(half_known.seen_from(&larger, 0, 0), 0.0);
    }
}
