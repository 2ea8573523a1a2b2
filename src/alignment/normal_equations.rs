//! The photometric normal equations at one pose, in one pass over the points of a level.

use nalgebra::{SMatrix, SVector};
use pulp::Simd;

use super::image::Textured;
use crate::geometry::Pose;
use crate::kernels::{Instructions, Kernel};

/// Points of a step: a few registers of any instruction set.
const CHUNK: usize = 64;
/// Values that are summed side by side.
const LANES: usize = 16;
/// Chunks that are summed in f32 before they join the f64 sums.
const FLUSH: usize = 32;
/// Unknowns: six of the pose, gain and bias.
pub(super) const UNKNOWNS: usize = 8;
/// Columns of `[J r]`, and distinct products of two of them.
const COLUMNS: usize = UNKNOWNS + 1;
const PRODUCTS: usize = COLUMNS * (COLUMNS + 1) / 2;
/// Degrees of freedom of Student's t, which residuals of real images follow (Kerl, Sturm and Cremers 2013).
pub(super) const DEGREES_OF_FREEDOM: f32 = 5.0;
/// Standardised residuals from here on have no weight: things that move, or that one view hides.
const OUTLIER: f32 = 2.0;
/// Least depth in the source camera, m.
const MIN_DEPTH_M: f32 = 1e-3;

/// Width and height of a tile, px.
const TILE: usize = 8;
/// Displacement of a tile, px, that depth, sampling and light explain.
const STILL_PX: f32 = 0.25;

/// Target pixels of known depth: points in camera axes, m, and what the target image shows there. Padded with points
/// behind every camera to a whole number of chunks.
pub(super) struct Points {
    pub x: Vec<f32>,
    pub y: Vec<f32>,
    pub z: Vec<f32>,
    pub grey: Vec<f32>,
    /// How far each is believed to stand still, 0…1; a factor on its weight.
    still: Vec<f32>,
    /// Tile of the target image that each lies in, and its squared gradient there, 1/px²; no padding.
    tile: Vec<u32>,
    squared_gradient: Vec<f32>,
    tiles: usize,
    /// How many are no padding.
    pub known: usize,
}

impl Points {
    /// The pixels of a level whose depth is known; `camera` is fx, fy, cx, cy.
    pub fn new(target: &Textured, depth_m: &[f32], [fx, fy, cx, cy]: [f32; 4]) -> Self {
        let Textured { width, height, ref pixels } = *target;
        let tiles_across = width.div_ceil(TILE);
        let list = || vec![0.0; pixels.len()];
        let (mut x, mut y, mut z, mut grey, mut squared_gradient) = (list(), list(), list(), list(), list());
        let mut tile = vec![0; pixels.len()];
        let rays_x: Vec<f32> = (0..width).map(|column| (column as f32 - cx) / fx).collect();
        let mut known = 0;
        for (row, (pixels, depths)) in pixels.chunks_exact(width).zip(depth_m.chunks_exact(width)).enumerate() {
            let ray_y = (row as f32 - cy) / fy;
            let first_tile = row / TILE * tiles_across;
            for (column, ((pixel, &depth), ray_x)) in pixels.iter().zip(depths).zip(&rays_x).enumerate() {
                let [value, along_row, along_column, _] = *pixel;
                // Written in any case, and over again where the depth is unknown: a branch would be guessed wrong.
                x[known] = ray_x * depth;
                y[known] = ray_y * depth;
                z[known] = depth;
                grey[known] = value;
                tile[known] = (first_tile + column / TILE) as u32;
                squared_gradient[known] = along_row * along_row + along_column * along_column;
                known += usize::from(depth > 0.0 && depth < f32::INFINITY);
            }
        }
        let padded = |mut list: Vec<f32>, padding: f32| {
            list.truncate(known);
            list.resize(known.next_multiple_of(CHUNK), padding);
            list
        };
        tile.truncate(known);
        squared_gradient.truncate(known);
        Self {
            x: padded(x, 0.0),
            y: padded(y, 0.0),
            z: padded(z, -f32::MAX),
            grey: padded(grey, 0.0),
            still: vec![1.0; known.next_multiple_of(CHUNK)],
            tile,
            squared_gradient,
            tiles: tiles_across * height.div_ceil(TILE),
            known,
        }
    }

    /// Believes a tile to stand still as far as its residuals may come from a displacement of less than [`STILL_PX`],
    /// the square of which they stand for is `Σ (r² − σ²) / Σ |∇I|²`. Things that move as a whole show so, also where
    /// their pixels look like the background's.
    pub fn distrust_moving(&mut self, residuals: &[f32], noise: f32) {
        let mut sums = vec![[0.0f32; 2]; self.tiles];
        for ((&tile, &r), &squared_gradient) in self.tile.iter().zip(residuals).zip(&self.squared_gradient) {
            if !r.is_nan() {
                let [excess, gradients] = &mut sums[tile as usize];
                *excess += r * r - noise * noise;
                *gradients += squared_gradient;
            }
        }
        let trust = |[excess, gradients]: [f32; 2]| {
            if excess > 0.0 { (STILL_PX * STILL_PX * gradients / excess).min(1.0) } else { 1.0 }
        };
        let trust: Vec<f32> = sums.into_iter().map(trust).collect();
        for (still, &tile) in self.still.iter_mut().zip(&self.tile) {
            *still = trust[tile as usize].powi(2);
        }
    }
}

/// Where residuals are taken: `r = (1 + gain) I(π(T X)) + bias − I_target(X)`.
#[derive(Clone, Copy, Debug)]
pub(super) struct State {
    pub source_from_target: Pose,
    pub gain: f64,
    pub bias: f64,
}

/// Weighted sums over the valid points of a level.
pub(super) struct NormalEquations {
    /// `JᵀWJ`; J by a left perturbation `exp(−δ) T` of the pose (order ρ then φ, m and rad, axes of the source camera),
    /// gain and bias.
    pub hessian: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    /// `JᵀWr`.
    pub gradient: SVector<f64, UNKNOWNS>,
    /// Points inside the source image.
    pub valid: usize,
}

/// Residuals at a state, one a point; NaN where a point is not inside the source image.
pub(super) fn residuals(source: &Textured, camera: [f32; 4], points: &Points, state: &State, residuals: &mut Vec<f32>) {
    residuals.resize(points.z.len(), 0.0);
    let pass = Pass { source, camera, points, state, residuals, scale: None };
    Instructions::current().run(pass);
}

/// Normal equations at a state with Student's t weights of residuals of this scale, and the residuals.
pub(super) fn normal_equations(
    source: &Textured,
    camera: [f32; 4],
    points: &Points,
    state: &State,
    scale: f32,
    residuals: &mut Vec<f32>,
) -> NormalEquations {
    residuals.resize(points.z.len(), 0.0);
    let (products, valid) =
        Instructions::current().run(Pass { source, camera, points, state, residuals, scale: Some(scale) });
    let at = |row: usize, column: usize| {
        let (row, column) = (row.min(column), row.max(column));
        products[row * COLUMNS - row * (row + 1) / 2 + column]
    };
    NormalEquations { hessian: SMatrix::from_fn(at), gradient: SVector::from_fn(|row, _| at(row, UNKNOWNS)), valid }
}

struct Pass<'a> {
    source: &'a Textured,
    camera: [f32; 4],
    points: &'a Points,
    state: &'a State,
    residuals: &'a mut [f32],
    /// Of the residuals, for their weights; `None`: residuals alone.
    scale: Option<f32>,
}

/// A chunk of points in the source view.
struct Projected {
    x: [f32; CHUNK],
    y: [f32; CHUNK],
    z: [f32; CHUNK],
    /// 1/z.
    inverse_z: [f32; CHUNK],
    /// 1 inside the source image, else 0.
    valid: [f32; CHUNK],
    /// Upper left of the four source pixels, and the weights of the right and the lower ones.
    first: [u32; CHUNK],
    right: [f32; CHUNK],
    lower: [f32; CHUNK],
}

impl Kernel for Pass<'_> {
    type Output = ([f64; PRODUCTS], usize);

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> Self::Output {
        let Self { source, camera, points, state, residuals, scale } = self;
        let Textured { width, height, ref pixels } = *source;
        assert!(width > 1 && height > 1 && pixels.len() == width * height, "an image of at least 2x2 pixels");
        let pose: [f32; 12] =
            std::array::from_fn(|index| state.source_from_target.matrix()[(index / 4, index % 4)] as f32);
        let (gain, bias) = (1.0 + state.gain as f32, state.bias as f32);
        let precision = scale.map(|scale| 1.0 / (scale * scale));
        let mut sums = [0.0f64; PRODUCTS];
        let mut lanes = [[0.0f32; LANES]; PRODUCTS];
        let mut valid = [0u32; LANES];
        let mut projected = Projected {
            x: [0.0; CHUNK],
            y: [0.0; CHUNK],
            z: [0.0; CHUNK],
            inverse_z: [0.0; CHUNK],
            valid: [0.0; CHUNK],
            first: [0; CHUNK],
            right: [0.0; CHUNK],
            lower: [0.0; CHUNK],
        };
        let mut sampled = [[0.0f32; CHUNK]; 4];
        let mut columns = [[0.0f32; CHUNK]; COLUMNS];
        let mut weights = [0.0f32; CHUNK];
        let lists = points.x.as_chunks::<CHUNK>().0.iter().zip(points.y.as_chunks::<CHUNK>().0);
        let lists = lists.zip(points.z.as_chunks::<CHUNK>().0).zip(points.grey.as_chunks::<CHUNK>().0);
        let outputs = points.still.as_chunks::<CHUNK>().0.iter().zip(residuals.as_chunks_mut::<CHUNK>().0);
        for (index, ((((x, y), z), grey), (still, output))) in lists.zip(outputs).enumerate() {
            project([x, y, z], &pose, camera, [width, height], &mut projected);
            sample(pixels, width, &projected, &mut sampled);
            let r = &mut columns[UNKNOWNS];
            for k in 0..CHUNK {
                r[k] = gain * sampled[0][k] + bias - grey[k];
                output[k] = if projected.valid[k] > 0.0 { r[k] } else { f32::NAN };
            }
            let Some(precision) = precision else { continue };
            differentiate(&projected, &sampled, camera, gain, &mut columns);
            let r = &columns[UNKNOWNS];
            for k in 0..CHUNK {
                let square = r[k] * r[k] * precision;
                let weight = (DEGREES_OF_FREEDOM + 1.0) / (DEGREES_OF_FREEDOM + square);
                let weight = weight * projected.valid[k] * still[k];
                weights[k] = if square < OUTLIER * OUTLIER { weight } else { 0.0 };
            }
            for chunk in projected.valid.as_chunks::<LANES>().0 {
                for lane in 0..LANES {
                    valid[lane] += u32::from(chunk[lane] > 0.0);
                }
            }
            multiply(&weights, &columns, &mut lanes);
            if index % FLUSH == FLUSH - 1 {
                flush(&mut lanes, &mut sums);
            }
        }
        flush(&mut lanes, &mut sums);
        (sums, valid.iter().sum::<u32>() as usize)
    }
}

/// Derivatives of the residuals by the unknowns.
#[inline(always)]
fn differentiate(
    projected: &Projected,
    [values, along_rows, along_columns, _]: &[[f32; CHUNK]; 4],
    [fx, fy, _, _]: [f32; 4],
    gain: f32,
    columns: &mut [[f32; CHUNK]; COLUMNS],
) {
    for k in 0..CHUNK {
        let (x, y, z, inverse_z) = (projected.x[k], projected.y[k], projected.z[k], projected.inverse_z[k]);
        // By the point in the source view.
        let by_x = gain * along_rows[k] * fx * inverse_z;
        let by_y = gain * along_columns[k] * fy * inverse_z;
        let by_z = -(by_x * x + by_y * y) * inverse_z;
        columns[0][k] = -by_x;
        columns[1][k] = -by_y;
        columns[2][k] = -by_z;
        columns[3][k] = z * by_y - y * by_z;
        columns[4][k] = x * by_z - z * by_x;
        columns[5][k] = y * by_x - x * by_y;
        columns[6][k] = values[k];
        columns[7][k] = 1.0;
    }
}

/// Adds the weighted products of all columns with each other.
#[inline(always)]
fn multiply(weights: &[f32; CHUNK], columns: &[[f32; CHUNK]; COLUMNS], lanes: &mut [[f32; LANES]; PRODUCTS]) {
    let mut product = 0;
    for row in 0..COLUMNS {
        let mut weighted = [0.0f32; CHUNK];
        for k in 0..CHUNK {
            weighted[k] = weights[k] * columns[row][k];
        }
        for column in &columns[row..] {
            let mut sum = lanes[product];
            for (a, b) in weighted.as_chunks::<LANES>().0.iter().zip(column.as_chunks::<LANES>().0) {
                for lane in 0..LANES {
                    sum[lane] += a[lane] * b[lane];
                }
            }
            lanes[product] = sum;
            product += 1;
        }
    }
}

#[inline(always)]
fn flush(lanes: &mut [[f32; LANES]; PRODUCTS], sums: &mut [f64; PRODUCTS]) {
    for (lanes, sum) in lanes.iter_mut().zip(sums) {
        *sum += f64::from(lanes.iter().sum::<f32>());
        *lanes = [0.0; LANES];
    }
}

#[inline(always)]
fn project(
    [x, y, z]: [&[f32; CHUNK]; 3],
    pose: &[f32; 12],
    [fx, fy, cx, cy]: [f32; 4],
    [width, height]: [usize; 2],
    projected: &mut Projected,
) {
    let (last_u, last_v) = ((width - 1) as f32, (height - 1) as f32);
    for k in 0..CHUNK {
        let point = |axis: usize| {
            pose[4 * axis] * x[k] + pose[4 * axis + 1] * y[k] + pose[4 * axis + 2] * z[k] + pose[4 * axis + 3]
        };
        let depth = point(2);
        let in_front = depth > MIN_DEPTH_M;
        let depth = if in_front { depth } else { 1.0 };
        let inverse = 1.0 / depth;
        let (px, py) = (point(0), point(1));
        let (u, v) = (px * inverse * fx + cx, py * inverse * fy + cy);
        let inside = u >= 0.0 && u <= last_u && v >= 0.0 && v <= last_v;
        projected.valid[k] = if in_front && inside { 1.0 } else { 0.0 };
        // Zeros where not valid, so that products with a weight of zero are zero.
        projected.x[k] = if in_front && inside { px } else { 0.0 };
        projected.y[k] = if in_front && inside { py } else { 0.0 };
        projected.z[k] = depth;
        projected.inverse_z[k] = inverse;
        // Clamped, so that a point that is not valid reads some pixel too. `max` turns NaN into 0.
        let (u, v) = (u.max(0.0).min(last_u), v.max(0.0).min(last_v));
        let (left, upper) = (floor(u.min(last_u - 1.0)), floor(v.min(last_v - 1.0)));
        projected.first[k] = whole(upper) * width as u32 + whole(left);
        projected.right[k] = u - left;
        projected.lower[k] = v - upper;
    }
}

/// From here on f32 numbers are whole. Rounding by it and reading bits are plain arithmetic in every instruction set,
/// where conversions of numbers that may be NaN are one by one.
const WHOLE: f32 = 8_388_608.0;

/// Of a number from 0 to [`WHOLE`].
#[inline(always)]
fn floor(value: f32) -> f32 {
    let nearest = (value + WHOLE) - WHOLE;
    if nearest > value { nearest - 1.0 } else { nearest }
}

/// A whole number from 0 to [`WHOLE`] as an integer.
#[inline(always)]
fn whole(value: f32) -> u32 {
    (value + WHOLE).to_bits() - WHOLE.to_bits()
}

/// Bilinear samples of intensity and gradient.
#[inline(always)]
fn sample(pixels: &[[f32; 4]], width: usize, projected: &Projected, sampled: &mut [[f32; CHUNK]; 4]) {
    let mut samples = [[0.0f32; 4]; CHUNK];
    for k in 0..CHUNK {
        // One window, so that its bounds are checked once.
        let window = &pixels[projected.first[k] as usize..][..width + 2];
        let (upper, lower) = (window[..2].as_flattened(), window[width..].as_flattened());
        let (right, down) = (projected.right[k], projected.lower[k]);
        let mut sides = [0.0f32; 8];
        for lane in 0..8 {
            sides[lane] = upper[lane] + (lower[lane] - upper[lane]) * down;
        }
        let mut value = [0.0f32; 4];
        for lane in 0..4 {
            value[lane] = sides[lane] + (sides[lane + 4] - sides[lane]) * right;
        }
        samples[k] = value;
    }
    for k in 0..CHUNK {
        for lane in 0..4 {
            sampled[lane][k] = samples[k][lane];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floor_is_exact_at_whole_numbers_and_beside_them() {
        for whole_number in 0..5000u32 {
            let value = whole_number as f32;
            assert_eq!((floor(value), whole(value)), (value, whole_number));
            assert_eq!(floor(value.next_up()), value);
            assert_eq!(floor((value + 1.0).next_down()), value);
        }
    }
}
