//! Fills the gaps between LiDAR returns along the surfaces that the image shows.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::DepthMap;
use crate::data::RgbImage;

/// Steps that a change of the image by its full range costs beside the step itself: a gap is rather filled from
/// eight pixels away on the same surface than from next door across a strong edge. Chosen by leaving out returns of
/// real scans; docs/depth.md has the table.
const EDGE_STEPS: f32 = 30.0;
/// Costs are whole numbers of this fraction of a step.
const COST_STEPS: f32 = 256.0;

/// Gives every unknown pixel the depth of the known one that is nearest along the image, up to `radius_px` away;
/// pixels farther from any return stay unknown.
///
/// A way costs 1 for each step along rows and columns, and more where the image changes
/// (a geodesic distance, as in Criminisi, Sharp, Rother, Perez, "Geodesic image and video editing", 2010). Depths
/// are passed on, never mixed: a pixel between two surfaces lies on one of them.
///
/// # Shapes
/// - `image`: the size of `sparse`
pub fn fill_gaps(sparse: &DepthMap, image: &RgbImage, radius_px: usize) -> DepthMap {
    let (width, height) = (sparse.width, sparse.height);
    assert_eq!((image.width, image.height), (width, height), "fill_gaps: image and depth of one size");
    let mut depth_m = sparse.depth_m.clone();
    let mut cost = vec![u32::MAX; depth_m.len()];
    let mut front = BinaryHeap::new();
    for (u, v, _) in sparse.known() {
        let pixel = v * width + u;
        cost[pixel] = 0;
        front.push(Reverse((0, pixel as u32, pixel as u32)));
    }
    while let Some(Reverse((reached, pixel, origin))) = front.pop() {
        let pixel = pixel as usize;
        if reached > cost[pixel] {
            continue;
        }
        depth_m[pixel] = sparse.depth_m[origin as usize];
        let (u, v) = (pixel % width, pixel / width);
        let neighbours = [
            (u > 0).then(|| pixel - 1),
            (u + 1 < width).then(|| pixel + 1),
            (v > 0).then(|| pixel - width),
            (v + 1 < height).then(|| pixel + width),
        ];
        for neighbour in neighbours.into_iter().flatten() {
            let next = reached + step_cost(image, pixel, neighbour);
            if next < cost[neighbour] && distance_px(neighbour, origin as usize, width) <= radius_px {
                cost[neighbour] = next;
                front.push(Reverse((next, neighbour as u32, origin)));
            }
        }
    }
    DepthMap { width, height, depth_m }
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
    fn gaps_take_the_nearest_return_within_the_radius() {
        let (sparse, image) = row([100; 9], &[(1, 5.0), (5, 7.0)]);
        let filled = fill_gaps(&sparse, &image, 2);
        assert_eq!(filled.depth_m, [5.0, 5.0, 5.0, 5.0, 7.0, 7.0, 7.0, 7.0, 0.0]);
    }

    #[test]
    fn a_surface_is_filled_up_to_its_edge_in_the_image() {
        let (sparse, image) = row([50, 50, 50, 50, 50, 50, 50, 200, 200], &[(1, 5.0), (8, 20.0)]);
        let filled = fill_gaps(&sparse, &image, 9);
        assert_eq!(filled.depth_m, [5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 20.0, 20.0]);
    }
}
