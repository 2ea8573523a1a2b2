//! A finished part of a matrix product C, on its way to where it is stored.

use std::ops::Range;

/// A finished part of C.
pub(super) struct Tile<'a> {
    /// Which part of the sum over k, if it was cut.
    pub part: usize,
    /// Rows of C.
    pub rows: Range<usize>,
    /// Columns of C.
    pub columns: Range<usize>,
    /// Its rows, `stride` apart.
    pub values: &'a [f32],
    pub stride: usize,
}

impl Tile<'_> {
    /// The values of a row, given by its number in C.
    #[inline]
    pub fn row(&self, row: usize) -> &[f32] {
        &self.values[(row - self.rows.start) * self.stride..][..self.columns.len()]
    }

    /// Columns of the tile, cut where a new image or row of `len` begins: first column and length of each.
    pub fn pieces(&self, len: usize) -> impl Iterator<Item = (usize, usize)> {
        let Range { start: mut column, end } = self.columns;
        std::iter::from_fn(move || {
            let piece = (column, (len - column % len).min(end - column));
            column += piece.1;
            (piece.1 > 0).then_some(piece)
        })
    }
}
