//! Textures that stay sharp near by and never flicker far away: everything is averaged over the
//! footprint of a pixel, noise by a table filtered along both axes (a ripmap), edges in closed form.

use std::sync::OnceLock;

use super::random::mix;

/// Cells of the noise table along an axis, a power of two.
const SIZE: usize = 256;
const LEVELS: usize = 9;

/// A tile of noise, mean 0 and variance 1, averaged over `2^i x 2^j` cells for every i and j.
pub(super) struct Noise {
    levels: Vec<Vec<f32>>,
}

impl Noise {
    /// The one table; every surface looks at another part of it.
    pub(super) fn table() -> &'static Self {
        static TABLE: OnceLock<Noise> = OnceLock::new();
        TABLE.get_or_init(Self::new)
    }

    fn new() -> Self {
        let mut cells = vec![0.0_f64; SIZE * SIZE];
        for octave in 2..8_u32 {
            let lattice = 1_usize << octave;
            let amplitude = if octave == 2 { 0.7 } else { 1.0 };
            let at = |x: usize, y: usize| {
                let key = (u64::from(octave) << 40) | (((y % lattice) as u64) << 20) | (x % lattice) as u64;
                (mix(key) >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
            };
            let step = SIZE / lattice;
            for (index, cell) in cells.iter_mut().enumerate() {
                let (x, y) = (index % SIZE, index / SIZE);
                let (u, v) = ((x % step) as f64 / step as f64, (y % step) as f64 / step as f64);
                let (x, y) = (x / step, y / step);
                let upper = at(x, y) * (1.0 - u) + at(x + 1, y) * u;
                let lower = at(x, y + 1) * (1.0 - u) + at(x + 1, y + 1) * u;
                *cell += amplitude * (upper * (1.0 - v) + lower * v);
            }
        }
        let count = cells.len() as f64;
        let mean = cells.iter().sum::<f64>() / count;
        let deviation = (cells.iter().map(|cell| (cell - mean) * (cell - mean)).sum::<f64>() / count).sqrt();
        let finest: Vec<f32> = cells.iter().map(|cell| ((cell - mean) / deviation) as f32).collect();
        let mut levels: Vec<Vec<f32>> = Vec::with_capacity(LEVELS * LEVELS);
        for row_level in 0..LEVELS {
            for column_level in 0..LEVELS {
                let level = match (row_level, column_level) {
                    (0, 0) => finest.clone(),
                    (_, 0) => halved_rows(&levels[(row_level - 1) * LEVELS], SIZE),
                    _ => halved_columns(&levels[row_level * LEVELS + column_level - 1]),
                };
                levels.push(level);
            }
        }
        Self { levels }
    }

    /// Mean of the noise over a box of `widths` around `position`, both in units of the finest cell.
    pub(super) fn sample(&self, position: [f64; 2], widths: [f64; 2]) -> f64 {
        let [(column_level, column_blend), (row_level, row_blend)] = widths.map(level_of);
        let at = |row: usize, column: usize| f64::from(self.bilinear(row, column, position));
        let blend = |row: usize| {
            let fine = at(row, column_level);
            if column_blend == 0.0 { fine } else { fine + column_blend * (at(row, column_level + 1) - fine) }
        };
        let fine = blend(row_level);
        if row_blend == 0.0 { fine } else { fine + row_blend * (blend(row_level + 1) - fine) }
    }

    fn bilinear(&self, row_level: usize, column_level: usize, position: [f64; 2]) -> f32 {
        let level = &self.levels[row_level * LEVELS + column_level];
        let (columns, rows) = (SIZE >> column_level, SIZE >> row_level);
        let x = position[0] / (1 << column_level) as f64 - 0.5;
        let y = position[1] / (1 << row_level) as f64 - 0.5;
        let (left, top) = (x.floor(), y.floor());
        let (u, v) = ((x - left) as f32, (y - top) as f32);
        let wrap = |cell: i64, cells: usize| (cell & (cells as i64 - 1)) as usize;
        let (x0, x1) = (wrap(left as i64, columns), wrap(left as i64 + 1, columns));
        let (y0, y1) = (wrap(top as i64, rows) * columns, wrap(top as i64 + 1, rows) * columns);
        let upper = level[y0 + x0] + u * (level[y0 + x1] - level[y0 + x0]);
        let lower = level[y1 + x0] + u * (level[y1 + x1] - level[y1 + x0]);
        upper + v * (lower - upper)
    }
}

/// The level whose cells are as wide as a footprint, and how far it is to the next.
fn level_of(width: f64) -> (usize, f64) {
    if width <= 1.0 {
        return (0, 0.0);
    }
    // Exponent and mantissa: a base-two logarithm, linear between powers of two.
    let bits = width.to_bits();
    let exponent = ((bits >> 52) as usize) - 1023;
    if exponent >= LEVELS - 1 {
        return (LEVELS - 1, 0.0);
    }
    let mantissa = f64::from_bits((bits & 0x000f_ffff_ffff_ffff) | 0x3ff0_0000_0000_0000);
    (exponent, mantissa - 1.0)
}

fn halved_columns(level: &[f32]) -> Vec<f32> {
    level.chunks_exact(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect()
}

fn halved_rows(level: &[f32], columns: usize) -> Vec<f32> {
    let pairs = level.chunks_exact(2 * columns);
    pairs.flat_map(|rows| (0..columns).map(|x| 0.5 * (rows[x] + rows[columns + x]))).collect()
}

/// Share of a footprint covered by the stripes `[begin, end)` of every `period`.
pub(super) fn stripes(position: f64, period: f64, begin: f64, end: f64, width: f64) -> f64 {
    let width = width.max(1e-6);
    let integral = |x: f64| {
        let periods = (x / period).floor();
        periods * (end - begin) + (x - periods * period).clamp(begin, end) - begin
    };
    (integral(position + 0.5 * width) - integral(position - 0.5 * width)) / width
}

/// Share of a footprint covered by the one stripe `[begin, end)`.
pub(super) fn band(position: f64, begin: f64, end: f64, width: f64) -> f64 {
    let width = width.max(1e-6);
    let covered = (position + 0.5 * width).min(end) - (position - 0.5 * width).max(begin);
    covered.max(0.0) / width
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filtered_noise_is_the_mean_of_the_noise_under_the_footprint() {
        let noise = Noise::table();
        // Aligned with a cell of level (2, 1): 4 columns, 2 rows.
        let mean =
            (0..8).map(|k| noise.sample([f64::from(k % 4) + 40.5, f64::from(k / 4) + 12.5], [1.0; 2])).sum::<f64>()
                / 8.0;
        assert!((noise.sample([42.0, 13.0], [4.0, 2.0]) - mean).abs() < 1e-6);
        assert!(noise.sample([3.3, 9.9], [1e9, 1e9]).abs() < 1e-5);
    }

    #[test]
    fn noise_has_mean_zero_and_variance_one_and_repeats() {
        let noise = Noise::table();
        let cells: Vec<f64> = (0..SIZE * SIZE)
            .map(|k| noise.sample([(k % SIZE) as f64 + 0.5, (k / SIZE) as f64 + 0.5], [1.0; 2]))
            .collect();
        let mean = cells.iter().sum::<f64>() / cells.len() as f64;
        let variance = cells.iter().map(|cell| cell * cell).sum::<f64>() / cells.len() as f64;
        assert!(mean.abs() < 1e-4 && (variance - 1.0).abs() < 1e-3);
        assert_eq!(noise.sample([-3.2, 7.9], [1.0; 2]), noise.sample([SIZE as f64 - 3.2, 7.9], [1.0; 2]));
    }

    #[test]
    fn stripes_cover_what_they_should() {
        assert!((stripes(0.5, 2.0, 0.0, 1.0, 0.1) - 1.0).abs() < 1e-12);
        assert!(stripes(1.5, 2.0, 0.0, 1.0, 0.1).abs() < 1e-12);
        assert!((stripes(1.0, 2.0, 0.0, 1.0, 0.5) - 0.5).abs() < 1e-12);
        assert!((stripes(-7.3, 2.0, 0.0, 1.0, 200.0) - 0.5).abs() < 1e-3);
        assert_eq!(band(0.0, -1.0, 1.0, 0.5), 1.0);
        assert_eq!(band(1.0, -1.0, 1.0, 0.5), 0.5);
    }
}
