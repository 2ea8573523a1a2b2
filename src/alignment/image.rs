//! Grey images, their gradients and their pyramid.

/// A grey image, rows of intensities in 0…1.
#[derive(Clone, Debug, PartialEq)]
pub struct GreyImage {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `width * height` intensities.
    pub pixels: Vec<f32>,
}

impl GreyImage {
    /// Luma (ITU-R BT.601) of `r g b` bytes, row by row.
    pub fn from_rgb(width: usize, height: usize, bytes: &[u8]) -> Self {
        assert_eq!(bytes.len(), 3 * width * height, "three bytes a pixel");
        const LUMA: [f32; 3] = [0.299 / 255.0, 0.587 / 255.0, 0.114 / 255.0];
        let luma = |rgb: &[u8; 3]| (0..3).map(|channel| LUMA[channel] * f32::from(rgb[channel])).sum();
        Self { width, height, pixels: bytes.as_chunks().0.iter().map(luma).collect() }
    }

    /// Means of 2x2 pixels; a last odd row or column is left out.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut pixels = Vec::with_capacity(width * height);
        for row in 0..height {
            let lines = &self.pixels[2 * row * self.width..][..2 * self.width];
            let (upper, lower) = lines.split_at(self.width);
            let pairs = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
            pixels.extend(pairs.map(|(upper, lower)| 0.25 * (upper[0] + upper[1] + lower[0] + lower[1])));
        }
        Self { width, height, pixels }
    }
}

/// An image that is sampled together with its gradient.
pub(super) struct Textured {
    pub width: usize,
    pub height: usize,
    /// Intensity, its derivatives along rows and columns (1/px, central differences), and one to fill up four lanes.
    pub pixels: Vec<[f32; 4]>,
}

impl Textured {
    pub fn new(image: &GreyImage) -> Self {
        let GreyImage { width, height, ref pixels } = *image;
        let line = |row: usize| &pixels[row * width..][..width];
        let mut textured = vec![[0.0; 4]; width * height];
        for (row, output) in textured.chunks_exact_mut(width).enumerate() {
            let middle = line(row);
            let (above, below) = (line(row.saturating_sub(1)), line((row + 1).min(height - 1)));
            // One-sided at the border.
            let rows = if row == 0 || row + 1 == height { 1.0 } else { 0.5 };
            for (output, ((&grey, above), below)) in output.iter_mut().zip(middle.iter().zip(above).zip(below)) {
                *output = [grey, 0.0, rows * (below - above), 0.0];
            }
            for column in 1..width - 1 {
                output[column][1] = 0.5 * (middle[column + 1] - middle[column - 1]);
            }
            output[0][1] = middle[1] - middle[0];
            output[width - 1][1] = middle[width - 1] - middle[width - 2];
        }
        Self { width, height, pixels: textured }
    }
}

/// Depths of 2x2 pixels in one, m; 0 = unknown. Across an edge, where they differ by more than a fifth, the nearest
/// stands for all, as it hides the others.
pub(super) fn halved_depth(depth_m: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mut halved = Vec::with_capacity(width / 2 * (height / 2));
    for row in 0..height / 2 {
        let (upper, lower) = depth_m[2 * row * width..][..2 * width].split_at(width);
        let pairs = upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0);
        halved.extend(pairs.map(|(&[a, b], &[c, d])| joined_depth([a, b, c, d])));
    }
    halved
}

/// Largest ratio of depths on one surface.
const SURFACE: f32 = 1.2;

fn joined_depth(depths: [f32; 4]) -> f32 {
    let (mut nearest, mut farthest, mut inverse, mut known) = (f32::INFINITY, 0.0f32, 0.0, 0.0);
    for depth in depths {
        if depth > 0.0 {
            nearest = nearest.min(depth);
            farthest = farthest.max(depth);
            inverse += 1.0 / depth;
            known += 1.0;
        }
    }
    match known {
        0.0 => 0.0,
        _ if farthest > SURFACE * nearest => nearest,
        _ => known / inverse,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_depths_and_those_behind_an_edge_are_left_out() {
        let depth = [2.0, 2.2, 0.0, 0.0, 5.0, 9.0, 2.0, 0.0, 0.0, 0.0, 5.0, 5.0];
        let halved = halved_depth(&depth, 6, 2);
        assert!((halved[0] - 2.0625).abs() < 0.01, "{halved:?}");
        assert_eq!(halved[1..], [0.0, 5.0]);
    }

    #[test]
    fn gradients_of_a_plane_are_its_slopes_up_to_the_border() {
        let (width, height) = (5, 4);
        let pixels = (0..20).map(|index| 0.1 * (index % width) as f32 - 0.05 * (index / width) as f32).collect();
        for [_, along_row, along_column, _] in Textured::new(&GreyImage { width, height, pixels }).pixels {
            assert!((along_row - 0.1).abs() < 1e-6 && (along_column + 0.05).abs() < 1e-6);
        }
    }
}
