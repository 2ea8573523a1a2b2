//! Solves a pose graph by factrs, and finds the marginal covariances of its poses, which factrs leaves to its users.

use std::collections::BTreeMap;

use factrs::containers::ValuesOrder;
use factrs::core::{GaussNewton, Graph, LevenMarquardt, Values};
use factrs::linalg::DiffResult;
use factrs::linear::LinearSolver;
use factrs::optimizers::{BaseOptParams, LevenParams, OptError};
use factrs::traits::Optimizer;
use faer::linalg::solvers::Solve;
use faer::sparse::SparseColMatRef;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::{Mat, MatRef, Side};
use nalgebra::Matrix6;

use super::variables::X;
use crate::error::{Error, Result};
use crate::geometry::Covariance6;

/// Poses whose marginals are computed at once.
const MARGINALS_AT_ONCE: usize = 64;
/// Half the sum of squared whitened residuals below which nothing is left to solve.
const SOLVED: f64 = 1e-12;

/// The most likely poses: by Levenberg and Marquardt's method, and where it finds no step, because the poses are as good as
/// numbers allow, by that of Gauss and Newton.
pub(super) fn solve(graph: &Graph, begin: Values) -> Result<Values> {
    let base = BaseOptParams { error_tol: SOLVED, ..BaseOptParams::default() };
    let mut damped = LevenMarquardt::new(LevenParams { base: base.clone(), ..LevenParams::default() }, graph.clone());
    damped.set_solver(Cholesky::default());
    let mut undamped = GaussNewton::new(base, graph.clone());
    undamped.set_solver(Cholesky::default());
    let solved = match damped.optimize(begin.clone()) {
        Err(OptError::InvalidSystem | OptError::FailedToStep) => undamped.optimize(begin),
        solved => solved,
    };
    let values = match solved {
        Ok(values) => values,
        Err(OptError::MaxIterations(values)) => {
            tracing::warn!("the pose graph still moved after the last iteration");
            values
        }
        Err(OptError::InvalidSystem | OptError::FailedToStep) => return Err(unsolved()),
    };
    if graph.error(&values).is_finite() { Ok(values) } else { Err(unsolved()) }
}

fn unsolved() -> Error {
    Error::Data(
        "the pose graph has no solution: its fixes and motions leave poses undetermined, or its covariances differ too much in size"
            .to_owned(),
    )
}

/// factrs' own Cholesky solver, but for one thing: what cannot be solved has NaN for a solution and does not end the
/// program.
#[derive(Default)]
struct Cholesky {
    pattern: Option<SymbolicLlt<usize>>,
}

impl LinearSolver for Cholesky {
    fn solve_symmetric(&mut self, a: SparseColMatRef<usize, f64>, b: MatRef<f64>) -> Mat<f64> {
        let nothing = || Mat::full(b.nrows(), b.ncols(), f64::NAN);
        if self.pattern.is_none() {
            self.pattern = SymbolicLlt::try_new(a.symbolic(), Side::Lower).ok();
        }
        let Some(pattern) = self.pattern.clone() else { return nothing() };
        Llt::try_new_with_symbolic(pattern, a, Side::Lower).map_or_else(|_| nothing(), |factor| factor.solve(&b))
    }

    fn solve_lst_sq(&mut self, a: SparseColMatRef<usize, f64>, b: MatRef<f64>) -> Mat<f64> {
        let Ok(transposed) = a.transpose().to_col_major() else { return Mat::full(a.ncols(), b.ncols(), f64::NAN) };
        self.solve_symmetric((&transposed * a).as_ref(), (a.transpose() * b).as_ref())
    }
}

/// The diagonal blocks of `(JᵀJ)⁻¹` at the solution.
pub(super) fn marginals(
    graph: &Graph,
    values: &Values,
    number: &BTreeMap<usize, u32>,
) -> Result<BTreeMap<usize, Covariance6>> {
    let unusable =
        || Error::Data("the pose graph does not fix every pose: its information matrix is singular".to_owned());
    let order = graph.sparsity_pattern(ValuesOrder::from_values(values));
    let DiffResult { diff: jacobian, .. } = graph.linearize(values).residual_jacobian(&order);
    let transposed = jacobian.transpose().to_col_major().map_err(|_| unusable())?;
    let information = &transposed * &jacobian;
    let symbolic = SymbolicLlt::try_new(information.symbolic(), Side::Lower).map_err(|_| unusable())?;
    let factor = Llt::try_new_with_symbolic(symbolic, information.as_ref(), Side::Lower).map_err(|_| unusable())?;
    let columns = information.ncols();
    let places: Vec<(usize, usize)> = number
        .iter()
        .map(|(&frame, &index)| (frame, order.order.get(X(index)).expect("every frame has a place").idx))
        .collect();
    let mut covariances = BTreeMap::new();
    for places in places.chunks(MARGINALS_AT_ONCE) {
        let mut unit = Mat::<f64>::zeros(columns, 6 * places.len());
        for (block, (_, place)) in places.iter().enumerate() {
            (0..6).for_each(|axis| unit[(place + axis, 6 * block + axis)] = 1.0);
        }
        let solved = factor.solve(&unit);
        for (block, (frame, place)) in places.iter().enumerate() {
            // factrs has φ before ρ.
            let order: Vec<usize> = (3..6).chain(0..3).collect();
            let entry = |row: usize, column: usize| solved[(place + order[row], 6 * block + order[column])];
            let matrix = Matrix6::from_fn(|row, column| 0.5 * (entry(row, column) + entry(column, row)));
            covariances.insert(*frame, Covariance6::from_matrix(matrix).map_err(|_| unusable())?);
        }
    }
    Ok(covariances)
}
