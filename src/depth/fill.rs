//! Fills the gaps between LiDAR returns along the surfaces that the image shows.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::DepthMap;
use crate::recordings::RgbImage;

/// Steps that a change of the image by its full range costs beside the step itself. Like the numbers below, chosen by
/// rings of real scans that were left out (`relcov depth --evaluate`, 512x160): abs_rel is .081 with the nearest return
/// alone, .080 with the nearest along the image, .050 with both steps; sq_rel .56, .53 and .40 m.
const EDGE_STEPS: f32 = 10.0;
/// Costs are whole numbers of this fraction of a step.
const COST_STEPS: f32 = 256.0;
/// Neighbours whose depths differ by more than this factor (65 %, three rings of KITTI's scanner on a road 60 m away)
/// lie on different surfaces.
const SURFACE_FACTOR: f32 = 1.65;
/// Rounds of interpolation: the gaps between rings are a few pixels.
const ROUNDS: usize = 20;

/// Gives pixels without a return the depth of their surface, up to `radius_px` from any return; those farther away
/// stay unknown.
///
/// First each pixel goes to the surface of the return that is nearest along the image: a way costs 1 for each step
/// along rows and columns and more where the image changes (a geodesic distance, as in Criminisi, Sharp, Rother,
/// Perez, "Geodesic image and video editing", 2010). Then inverse depth, which is linear in the image of a plane, is
/// interpolated within each surface: every pixel becomes the mean of its neighbours, returns stay. Depths of different
/// surfaces are not mixed.
///
/// # Shapes
/// - `image`: the size of `sparse`
pub fn fill_gaps(sparse: &DepthMap, image: &RgbImage, radius_px: usize) -> DepthMap {
    let size = (sparse.width, sparse.height);
    assert_eq!((image.width, image.height), size, "fill_gaps: image and depth of one size");
    let nearest = nearest_along_image(sparse, image, radius_px);
    interpolated_within_surfaces(sparse, nearest)
}

fn nearest_along_image(sparse: &DepthMap, image: &RgbImage, radius_px: usize) -> DepthMap {
    let (width, height) = (sparse.width, sparse.height);
    let mut depth_m = sparse.depth_m.clone();
    let mut cost = vec![u32::MAX; depth_m.len()];
    let mut front = BinaryHeap::new();
    for (u, v, _) in sparse.known() {
        let pixel = v * width + u;
        cost[pixel] = 0;
        front.push(Reverse((0, pixel, pixel)));
    }
    while let Some(Reverse((reached, pixel, origin))) = front.pop() {
        if reached > cost[pixel] {
            continue;
        }
        depth_m[pixel] = sparse.depth_m[origin];
        for neighbour in neighbours(pixel, width, height) {
            let next = reached + step_cost(image, pixel, neighbour);
            if next < cost[neighbour] && distance_px(neighbour, origin, width) <= radius_px {
                cost[neighbour] = next;
                front.push(Reverse((next, neighbour, origin)));
            }
        }
    }
    DepthMap { width, height, depth_m }
}

/// Gauss-Seidel in checkerboard order, so that neither direction is favoured.
fn interpolated_within_surfaces(sparse: &DepthMap, nearest: DepthMap) -> DepthMap {
    let DepthMap { width, height, depth_m } = &nearest;
    let (width, height) = (*width, *height);
    let one_surface = |a: f32, b: f32| a > 0.0 && b > 0.0 && a < SURFACE_FACTOR * b && b < SURFACE_FACTOR * a;
    let free: Vec<usize> =
        (0..depth_m.len()).filter(|&pixel| sparse.depth_m[pixel] == 0.0 && depth_m[pixel] > 0.0).collect();
    let (even, odd): (Vec<usize>, Vec<usize>) =
        free.into_iter().partition(|pixel| (pixel % width + pixel / width).is_multiple_of(2));
    let linked = |pixel: usize| {
        let surface = depth_m[pixel];
        neighbours(pixel, width, height).filter(move |&other| one_surface(surface, depth_m[other]))
    };
    let mut inverse: Vec<f32> = depth_m.iter().map(|&depth| if depth > 0.0 { depth.recip() } else { 0.0 }).collect();
    for _ in 0..ROUNDS {
        for &pixel in even.iter().chain(&odd) {
            let (sum, count) = linked(pixel).fold((0.0, 0), |(sum, count), other| (sum + inverse[other], count + 1));
            if count > 0 {
                inverse[pixel] = sum / count as f32;
            }
        }
    }
    let mut depth_m = depth_m.clone();
    for pixel in even.into_iter().chain(odd) {
        depth_m[pixel] = inverse[pixel].recip();
    }
    DepthMap { width, height, depth_m }
}

/// The pixels beside, above and below.
fn neighbours(pixel: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (u, v) = (pixel % width, pixel / width);
    let around = [
        (u > 0).then(|| pixel - 1),
        (u + 1 < width).then(|| pixel + 1),
        (v > 0).then(|| pixel - width),
        (v + 1 < height).then(|| pixel + width),
    ];
    around.into_iter().flatten()
}

fn step_cost(image: &RgbImage, from: usize, to: usize) -> u32 {
    let [a, b] = [from, to].map(|pixel| &image.bytes[3 * pixel..3 * pixel + 3]);
    let change: u32 = a.iter().zip(b).map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
    (COST_STEPS * (1.0 + EDGE_STEPS * change as f32 / (3.0 * 255.0))) as u32
}

/// Steps along rows and columns.
fn distance_px(a: usize, b: usize, width: usize) -> usize {
    (a % width).abs_diff(b % width) + (a / width).abs_diff(b / width)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(levels: [u8; 9], returns: &[(usize, f32)]) -> (DepthMap, RgbImage) {
        let mut depth_m = vec![0.0; 9];
        returns.iter().for_each(|&(u, depth)| depth_m[u] = depth);
        let bytes = levels.iter().flat_map(|&level| [level; 3]).collect();
        (DepthMap { width: 9, height: 1, depth_m }, RgbImage { width: 9, height: 1, bytes })
    }

    #[test]
    fn nothing_is_filled_beyond_the_radius() {
        let (sparse, image) = row([100; 9], &[(1, 5.0), (2, 5.0)]);
        let filled = fill_gaps(&sparse, &image, 2);
        assert_eq!(filled.depth_m, [5.0, 5.0, 5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_surface_is_filled_up_to_its_edge_in_the_image() {
        let (sparse, image) = row([50, 50, 50, 50, 50, 50, 50, 200, 200], &[(1, 5.0), (8, 20.0)]);
        let filled = fill_gaps(&sparse, &image, 9);
        assert_eq!(filled.depth_m, [5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 20.0, 20.0]);
    }

    /// A road: inverse depth falls linearly from row to row, here from pixel to pixel.
    #[test]
    fn a_plane_between_returns_stays_a_plane() {
        let (sparse, image) = row([100; 9], &[(0, 10.0), (8, 14.0)]);
        let filled = fill_gaps(&sparse, &image, 9);
        for (u, depth) in filled.depth_m.iter().enumerate() {
            let share = u as f32 / 8.0;
            let expected = ((1.0 - share) / 10.0 + share / 14.0).recip();
            assert!((depth - expected).abs() < 0.2, "pixel {u}: {depth}, expected {expected}");
        }
    }
}
