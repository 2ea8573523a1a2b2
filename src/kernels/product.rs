//! A matrix product whose operands are read where they lie.
//!
//! `C[m, n] = Σ_k A[m, k] B[k, n]`, with `A[m, k] = left[m · stride + offset_k]` and
//! `B[k, n] = right[offset_k + position_n]`. All three products of a convolution are of this form
//! once the image is padded, so none of them needs a column matrix in memory. `B` is packed, tile by
//! tile, into panels that stay in the cache; `A` is read in place.

use std::any::TypeId;
use std::cell::RefCell;
use std::ops::Range;

use pulp::Simd;
use rayon::prelude::*;

use super::instructions::{Instructions, Kernel};
use super::tile::Tile;

/// Columns of a packed panel: a multiple of three vectors of every instruction set.
const PANEL: usize = 48;
/// Values copied at once while packing.
const CHUNK: usize = 16;
/// Values that must follow the last one of a right operand, so that whole chunks can be read.
pub(super) const SLACK: usize = CHUNK;
/// Most rows, columns and terms of a tile: its packed panels (330 kB) and its part of C (250 kB) share
/// the second-level cache with the rows of A.
const TILE_ROWS: usize = 256;
const TILE_COLUMNS: usize = 5 * PANEL;
const TILE_TERMS: usize = 256;
/// Rows below which a tile is cut only for idle threads: each tile packs its panels anew, at its rows' cost.
const MIN_SHARED_ROWS: usize = 128;
/// Up to so many rows, columns that lie side by side are read where they are: a copy would cost more than it saves.
const FEW_ROWS: usize = 32;
/// With so many vector registers, 8 rows times 3 vectors are summed at once, else 6 times 2.
const MANY_REGISTERS: usize = 32;

/// The left operand: `A[m, k] = values[m · row_stride + offsets[k]]`.
#[derive(Clone, Copy)]
pub(super) struct Left<'a> {
    values: &'a [f32],
    rows: usize,
    row_stride: usize,
    offsets: &'a [u32],
}

/// The right operand: `B[k, n] = values[offsets[k] + position_n]`.
pub(super) struct Right<'a> {
    values: &'a [f32],
    offsets: &'a [u32],
    /// Contiguous positions; `panels[p]..panels[p + 1]` are those of panel p.
    runs: Vec<Run>,
    panels: Vec<usize>,
    columns: usize,
}

/// Columns of a panel whose positions follow each other.
#[derive(Clone, Copy)]
struct Run {
    column: u32,
    len: u32,
    position: usize,
}

impl<'a> Left<'a> {
    pub fn new(values: &'a [f32], rows: usize, row_stride: usize, offsets: &'a [u32]) -> Self {
        let furthest = offsets.iter().max().map_or(0, |&offset| offset as usize);
        assert!(rows > 0 && (rows - 1) * row_stride + furthest < values.len(), "left operand: outside its values");
        Self { values, rows, row_stride, offsets }
    }
}

impl<'a> Right<'a> {
    /// Takes the positions of the columns as stretches `(first position, length)`.
    pub fn new(values: &'a [f32], offsets: &'a [u32], stretches: impl Iterator<Item = (usize, usize)>) -> Self {
        let (mut runs, mut panels): (Vec<Run>, Vec<usize>) = (Vec::new(), vec![0]);
        let (mut columns, mut furthest) = (0, 0);
        for (mut position, mut len) in stretches {
            furthest = furthest.max(position + len);
            while len > 0 {
                let column = columns % PANEL;
                if column == 0 && columns > 0 {
                    panels.push(runs.len());
                }
                let taken = len.min(PANEL - column);
                match runs.last_mut() {
                    Some(last) if column > 0 && last.position + last.len as usize == position => {
                        last.len += taken as u32;
                    }
                    _ => runs.push(Run { column: column as u32, len: taken as u32, position }),
                }
                (columns, position, len) = (columns + taken, position + taken, len - taken);
            }
        }
        panels.push(runs.len());
        furthest += offsets.iter().max().map_or(0, |&offset| offset as usize);
        assert!(furthest + SLACK <= values.len(), "right operand: outside its values");
        Self { values, offsets, runs, panels, columns }
    }

    pub fn columns(&self) -> usize {
        self.columns
    }
}

/// Number of parts to cut a sum of `terms` into when C alone is too small to keep many threads busy.
/// It depends on the shape only, so that results do not depend on the number of threads.
pub(super) fn parts(rows: usize, columns: usize, terms: usize) -> usize {
    let tiles = rows.div_ceil(TILE_ROWS) * columns.div_ceil(TILE_COLUMNS);
    (32 / tiles).clamp(1, terms.div_ceil(4 * TILE_TERMS))
}

/// Computes the product and hands over each finished tile, on several threads at once.
///
/// The sum over k is cut into `parts`, which come as tiles of their own. Each value of each part is handed
/// over exactly once, and summed in the same order whatever the number of threads. `store` must not wait
/// for other parallel work: it holds its thread's scratch memory.
pub(super) fn product(
    instructions: Instructions,
    left: Left,
    right: &Right,
    parts: usize,
    store: impl Fn(Tile) + Sync,
) {
    assert_eq!(left.offsets.len(), right.offsets.len(), "terms of the operands");
    let terms = left.offsets.len();
    let terms_per_part = terms.div_ceil(parts);
    let (row_step, column_step) = steps(left.rows, right.columns, rayon::current_num_threads().div_ceil(parts));
    let (row_tiles, column_tiles) = (left.rows.div_ceil(row_step), right.columns.div_ceil(column_step));
    (0..parts * row_tiles * column_tiles).into_par_iter().with_max_len(1).for_each(|task| {
        let (part, tile) = (task / (row_tiles * column_tiles), task % (row_tiles * column_tiles));
        let (row, column) = (tile % row_tiles * row_step, tile / row_tiles * column_step);
        let rows = row..(row + row_step).min(left.rows);
        let columns = column..(column + column_step).min(right.columns);
        let terms = part * terms_per_part..((part + 1) * terms_per_part).min(terms);
        SCRATCH.with_borrow_mut(|scratch| {
            let scratch = &mut scratch[..];
            let aligned = scratch.as_ptr().align_offset(LINE_BYTES);
            let scratch = &mut scratch[aligned..];
            let stride = columns.len().next_multiple_of(PANEL);
            let (packed, values) = scratch.split_at_mut(PACKED);
            let kernel =
                TileKernel { left, right, rows: rows.clone(), columns: columns.clone(), terms, packed, values, stride };
            instructions.run(kernel);
            store(Tile { part, rows, columns, values, stride });
        });
    });
}

/// Rows and columns of a tile: enough tiles for the threads, cutting rows first, because packing a panel
/// twice costs less than leaving one half empty.
fn steps(rows: usize, columns: usize, threads: usize) -> (usize, usize) {
    let wanted = 4 * threads;
    let even = |size: usize, pieces: usize, unit: usize| size.div_ceil(pieces).next_multiple_of(unit);
    let mut row_step = even(rows, rows.div_ceil(TILE_ROWS), 8);
    let mut column_step = even(columns, columns.div_ceil(TILE_COLUMNS), PANEL);
    let tiles = |row_step: usize, column_step: usize| rows.div_ceil(row_step) * columns.div_ceil(column_step);
    if tiles(row_step, column_step) < wanted && row_step > MIN_SHARED_ROWS {
        row_step = even(rows, rows.div_ceil(MIN_SHARED_ROWS), 8);
    }
    if tiles(row_step, column_step) < wanted {
        let pieces = (wanted / rows.div_ceil(row_step)).clamp(1, columns.div_ceil(2 * PANEL));
        column_step = column_step.min(even(columns, pieces, PANEL));
    }
    while tiles(row_step, column_step) < threads && row_step > 16 {
        row_step = even(row_step, 2, 8);
    }
    (row_step, column_step)
}

/// Vectors that begin with a cache line are read fastest.
const LINE_BYTES: usize = 64;
/// Values from one term of a packed panel to the next: whole chunks may reach beyond the panel.
const TERM: usize = PANEL + CHUNK;
/// Values of a tile's packed panels.
const PACKED: usize = TILE_COLUMNS / PANEL * TILE_TERMS * TERM;

thread_local! {
    /// Packed panels, then the tile of C; kept, so that no step allocates.
    static SCRATCH: RefCell<Vec<f32>> = RefCell::new(vec![0.0; PACKED + TILE_ROWS * TILE_COLUMNS + LINE_BYTES / size_of::<f32>()]);
}

struct TileKernel<'a> {
    left: Left<'a>,
    right: &'a Right<'a>,
    rows: Range<usize>,
    columns: Range<usize>,
    terms: Range<usize>,
    packed: &'a mut [f32],
    values: &'a mut [f32],
    stride: usize,
}

impl Kernel for TileKernel<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { left, right, rows, columns, terms, packed, values, stride } = self;
        assert!(rows.len() * stride <= values.len() && columns.start % PANEL == 0);
        let panels = columns.start / PANEL..columns.end.div_ceil(PANEL);
        let depth = terms.len().div_ceil(terms.len().div_ceil(TILE_TERMS).max(1));
        for first in terms.clone().step_by(depth.max(1)) {
            let block = first..(first + depth).min(terms.end);
            for (slot, panel) in
                panels.clone().enumerate().filter(|(_, panel)| in_place(right, *panel, rows.len()).is_none())
            {
                let runs = &right.runs[right.panels[panel]..right.panels[panel + 1]];
                pack(right, runs, block.clone(), &mut packed[slot * TILE_TERMS * TERM..]);
            }
            let mut row = rows.start;
            while row < rows.end {
                let height = block_height::<S>(rows.end - row);
                for slot in 0..panels.len() {
                    let width = PANEL.min(columns.len() - slot * PANEL);
                    let operands = Operands {
                        left,
                        row,
                        terms: block.clone(),
                        columns: match in_place(right, panels.start + slot, rows.len()) {
                            Some(position) => Columns::InPlace(right, position),
                            None => Columns::Packed(&packed[slot * TILE_TERMS * TERM..]),
                        },
                        output: &mut values[(row - rows.start) * stride + slot * PANEL..],
                        stride,
                        accumulate: first > terms.start,
                    };
                    multiply(simd, height, width.div_ceil(S::F32_LANES), operands);
                }
                row += height;
            }
        }
        if terms.is_empty() {
            values[..rows.len() * stride].fill(0.0);
        }
    }
}

/// Position of a panel's columns, if they lie side by side and few rows want them.
#[inline(always)]
fn in_place(right: &Right, panel: usize, rows: usize) -> Option<usize> {
    let runs = &right.runs[right.panels[panel]..right.panels[panel + 1]];
    (rows <= FEW_ROWS && runs.len() == 1 && runs[0].len as usize == PANEL).then(|| runs[0].position)
}

/// Copies the columns of a panel, each term `TERM` values after the one before.
#[inline(always)]
fn pack(right: &Right, runs: &[Run], terms: Range<usize>, packed: &mut [f32]) {
    assert!(terms.len() * TERM <= packed.len());
    // A chunk that reaches beyond its run is overwritten by the next run, or lies between two terms.
    for run in runs {
        for done in (0..run.len as usize).step_by(CHUNK) {
            for (index, &offset) in right.offsets[terms.clone()].iter().enumerate() {
                // SAFETY: `Right::new` checked positions and offsets, with a chunk to spare, against `values`;
                // a run ends at column `PANEL` at most, so its last chunk ends within the term (asserted above).
                unsafe {
                    let from = right.values.as_ptr().add(offset as usize + run.position + done);
                    let to = packed.as_mut_ptr().add(index * TERM + run.column as usize + done);
                    to.cast::<[f32; CHUNK]>().write_unaligned(from.cast::<[f32; CHUNK]>().read_unaligned());
                }
            }
        }
    }
}

#[inline(always)]
fn multiply_add<S: Simd>(simd: S, a: S::f32s, b: S::f32s, sum: S::f32s) -> S::f32s {
    // The emulated vectors have no fused operation but a library call for each lane.
    let emulated = TypeId::of::<S>() == TypeId::of::<pulp::Scalar128b>();
    if emulated { simd.add_f32s(simd.mul_f32s(a, b), sum) } else { simd.mul_add_e_f32s(a, b, sum) }
}

/// Rows that go into registers at once.
#[inline(always)]
fn block_height<S: Simd>(rows: usize) -> usize {
    match rows {
        8.. if many_registers::<S>() => 8,
        6.. if !many_registers::<S>() => 6,
        4.. => 4,
        2.. => 2,
        _ => 1,
    }
}

const fn many_registers<S: Simd>() -> bool {
    S::REGISTER_COUNT >= MANY_REGISTERS
}

struct Operands<'a> {
    left: Left<'a>,
    row: usize,
    terms: Range<usize>,
    columns: Columns<'a>,
    output: &'a mut [f32],
    stride: usize,
    accumulate: bool,
}

/// The columns of a panel.
#[derive(Clone, Copy)]
enum Columns<'a> {
    /// Copied together.
    Packed(&'a [f32]),
    /// Where they are, all `PANEL` of them from this position on.
    InPlace(&'a Right<'a>, usize),
}

/// Multiplies `height` rows with the first `vectors` vectors of a panel.
#[inline(always)]
fn multiply<S: Simd>(simd: S, height: usize, vectors: usize, mut operands: Operands) {
    assert!(operands.row + height <= operands.left.rows);
    assert!(match operands.columns {
        Columns::Packed(panel) => operands.terms.len() * TERM <= panel.len(),
        // `Right::new` checked offsets and positions, and the run holds `PANEL` columns.
        Columns::InPlace(right, _) => operands.terms.end <= right.offsets.len(),
    });
    assert!((height - 1) * operands.stride + PANEL <= operands.output.len());
    assert!(vectors * S::F32_LANES <= PANEL);
    let together = if many_registers::<S>() { 3 } else { 2 };
    for first in (0..vectors).step_by(together) {
        let at = first * S::F32_LANES;
        // SAFETY: the assertions above bound rows, panel, output and columns.
        unsafe {
            match (height, (vectors - first).min(together)) {
                (8, 3) => block::<S, 8, 3>(simd, &mut operands, at),
                (8, 2) => block::<S, 8, 2>(simd, &mut operands, at),
                (8, _) => block::<S, 8, 1>(simd, &mut operands, at),
                (6, 2) => block::<S, 6, 2>(simd, &mut operands, at),
                (6, _) => block::<S, 6, 1>(simd, &mut operands, at),
                (4, 3) => block::<S, 4, 3>(simd, &mut operands, at),
                (4, 2) => block::<S, 4, 2>(simd, &mut operands, at),
                (4, _) => block::<S, 4, 1>(simd, &mut operands, at),
                (2, 3) => block::<S, 2, 3>(simd, &mut operands, at),
                (2, 2) => block::<S, 2, 2>(simd, &mut operands, at),
                (2, _) => block::<S, 2, 1>(simd, &mut operands, at),
                (_, 3) => block::<S, 1, 3>(simd, &mut operands, at),
                (_, 2) => block::<S, 1, 2>(simd, &mut operands, at),
                (_, _) => block::<S, 1, 1>(simd, &mut operands, at),
            }
        }
    }
}

/// `ROWS` rows times `VECTORS` vectors of columns, all sums in registers.
///
/// # Safety
/// The operands' rows, terms and the columns from `at` on lie inside their slices.
#[inline(always)]
unsafe fn block<S: Simd, const ROWS: usize, const VECTORS: usize>(simd: S, operands: &mut Operands, at: usize) {
    let Operands { left, row, ref terms, columns, ref mut output, stride, accumulate } = *operands;
    let lanes = S::F32_LANES;
    let mut sums = [[simd.splat_f32s(0.0); VECTORS]; ROWS];
    // SAFETY: promised by the caller; `Left::new` and `Right::new` checked rows, positions and offsets.
    unsafe {
        let first_row = left.values.as_ptr().add(row * left.row_stride);
        for (index, &offset) in left.offsets[terms.clone()].iter().enumerate() {
            let a = first_row.add(offset as usize);
            let b = match columns {
                Columns::Packed(panel) => panel.as_ptr().add(index * TERM + at),
                Columns::InPlace(right, position) => {
                    let offset = *right.offsets.get_unchecked(terms.start + index) as usize;
                    right.values.as_ptr().add(offset + position + at)
                }
            };
            let columns: [S::f32s; VECTORS] =
                std::array::from_fn(|vector| b.add(vector * lanes).cast::<S::f32s>().read_unaligned());
            for (r, sums) in sums.iter_mut().enumerate() {
                let factor = simd.splat_f32s(*a.add(r * left.row_stride));
                for (sum, &column) in sums.iter_mut().zip(&columns) {
                    *sum = multiply_add(simd, factor, column, *sum);
                }
            }
        }
        let output = output.as_mut_ptr().add(at);
        for (r, sums) in sums.iter().enumerate() {
            for (vector, &sum) in sums.iter().enumerate() {
                let place = output.add(r * stride + vector * lanes).cast::<S::f32s>();
                let sum = if accumulate { simd.add_f32s(place.read_unaligned(), sum) } else { sum };
                place.write_unaligned(sum);
            }
        }
    }
}
