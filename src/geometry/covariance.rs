//! The 6x6 covariance of a relative-pose error and how it moves between frames.

use nalgebra::{Matrix6, Vector6};

use super::{Pose, TRANSLATION};

/// The square of a kilometre over this is a finite number.
const LEAST_VARIANCE: f64 = 1e-280;

/// Covariance of `e = log(T̂ T⁻¹)`: a left perturbation, order ρ then φ, m² and rad².
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Covariance6(Matrix6<f64>);

/// What keeps a 6x6 matrix from being a covariance.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CovarianceError {
    /// An entry is NaN or infinite.
    #[error("entry ({0}, {1}) is not finite")]
    NotFinite(usize, usize),
    /// Two mirrored entries differ by more than rounding.
    #[error("entries ({0}, {1}) and ({1}, {0}) differ by {2:.1e}")]
    NotSymmetric(usize, usize, f64),
    /// Only entries on one side of the diagonal are given.
    #[error("one half of the matrix is zero")]
    HalfFilled,
    /// A component has negative variance.
    #[error("the variance ({0}, {0}) is {1:.1e}")]
    NegativeDiagonal(usize, f64),
    /// A direction has negative variance.
    #[error("smallest eigenvalue {0:.1e} of the correlations is negative")]
    NegativeVariance(f64),
}

/// Largest difference of mirrored entries, in units of `sqrt(c_ii c_jj)`: what arithmetic in f32 leaves, and six digits.
const SYMMETRY_TOLERANCE: f64 = 1e-5;

/// How far below zero eigenvalues of correlations may lie, for the same reasons.
const LEAST_EIGENVALUE: f64 = 1e-6;

impl CovarianceError {
    /// What to do about it.
    pub fn remedy(self) -> &'static str {
        match self {
            Self::NotFinite(..) => "finite numbers",
            Self::NotSymmetric(..) => {
                "mirrored entries equal to 1e-5 of sqrt(c_ii c_jj); write 0.5 (C + Cᵀ) if that is meant"
            }
            Self::HalfFilled => "the whole matrix; mirror its other half",
            Self::NegativeDiagonal(..) | Self::NegativeVariance(_) => {
                "a covariance: no direction with a negative variance"
            }
        }
    }
}

impl Covariance6 {
    /// A covariance from a full matrix. Mirrored entries that differ by no more than 1e-5 of `sqrt(c_ii c_jj)`, as
    /// those computed in f32 do, are averaged.
    ///
    /// # Errors
    /// An entry is not finite, the matrix is not symmetric, or an eigenvalue is negative.
    pub fn from_matrix(matrix: Matrix6<f64>) -> Result<Self, CovarianceError> {
        let scale = matrix.abs().max();
        let entries = || (0..6).flat_map(|row| (0..6).map(move |column| (row, column)));
        if let Some((row, column)) = entries().find(|&entry| !matrix[entry].is_finite()) {
            return Err(CovarianceError::NotFinite(row, column));
        }
        let above = || entries().filter(|(row, column)| row < column);
        let is_zero = |matrix: Matrix6<f64>| above().all(|entry| matrix[entry] == 0.0);
        if is_zero(matrix) != is_zero(matrix.transpose()) {
            return Err(CovarianceError::HalfFilled);
        }
        for (row, column) in above() {
            let difference = (matrix[(row, column)] - matrix[(column, row)]).abs();
            let unit = (matrix[(row, row)] * matrix[(column, column)]).abs().sqrt();
            if difference > (SYMMETRY_TOLERANCE * unit).max(1e-9 * scale) {
                return Err(CovarianceError::NotSymmetric(row, column, difference));
            }
        }
        let symmetrised = symmetric(&matrix);
        if let Some(negative) = (0..6).find(|&component| symmetrised[(component, component)] < 0.0) {
            return Err(CovarianceError::NegativeDiagonal(negative, symmetrised[(negative, negative)]));
        }
        // Of correlations, so that metres do not hide what is wrong with radians.
        let units = symmetrised.diagonal().map(|variance| if variance > 0.0 { variance.sqrt() } else { scale.sqrt() });
        let correlations = Matrix6::from_fn(|row, column| symmetrised[(row, column)] / (units[row] * units[column]));
        let smallest = if scale > 0.0 { correlations.symmetric_eigenvalues().min() } else { 0.0 };
        if smallest < -LEAST_EIGENVALUE {
            return Err(CovarianceError::NegativeVariance(smallest));
        }
        Ok(Self(symmetrised))
    }

    /// `R = D(exp(d))` (paper, below Eq. 6).
    pub fn from_log_variances(log_variance: &Vector6<f64>) -> Self {
        Self(Matrix6::from_diagonal(&log_variance.map(f64::exp)))
    }

    /// `R = L D(exp(d)) Lᵀ`, L unit lower triangular.
    pub fn from_factors(lower: &Matrix6<f64>, log_variance: &Vector6<f64>) -> Self {
        Self(symmetric(&(lower * Matrix6::from_diagonal(&log_variance.map(f64::exp)) * lower.transpose())))
    }

    /// A diagonal covariance from variances, m² and rad².
    pub fn from_variances(variances: &Vector6<f64>) -> Self {
        Self(Matrix6::from_diagonal(variances))
    }

    /// A diagonal covariance from standard deviations, m and rad.
    pub fn from_std_devs(std_devs: &Vector6<f64>) -> Self {
        Self(Matrix6::from_diagonal(&std_devs.component_mul(std_devs)))
    }

    /// The matrix, m² and rad².
    pub fn matrix(&self) -> &Matrix6<f64> {
        &self.0
    }

    /// The diagonal, m² and rad².
    pub fn variance(&self) -> Vector6<f64> {
        self.0.diagonal()
    }

    /// Square roots of the diagonal, m and rad.
    pub fn std_devs(&self) -> Vector6<f64> {
        self.variance().map(f64::sqrt)
    }

    /// Whether every entry is a number and every direction has a variance that an error can be divided by.
    pub fn is_positive(&self) -> bool {
        self.pivots().is_some_and(|pivots| pivots.min() >= LEAST_VARIANCE)
    }

    /// Whether no two components are correlated.
    pub fn is_diagonal(&self) -> bool {
        (0..6).all(|row| (0..row).all(|column| self.0[(row, column)] == 0.0))
    }

    /// D of `R = L D Lᵀ`, L unit lower triangular: the variance of each component given those before it, m²
    /// and rad². `None` for a matrix that is not positive definite.
    pub fn pivots(&self) -> Option<Vector6<f64>> {
        let finite = self.0.iter().all(|value| value.is_finite());
        let factor = finite.then_some(self.0)?.cholesky()?;
        Some(factor.l_dirty().diagonal().map(|pivot| pivot * pivot))
    }

    /// `eᵀR⁻¹e` and `ln det R`; `None` for a matrix that is not positive definite.
    pub fn mahalanobis(&self, error: &Vector6<f64>) -> Option<(f64, f64)> {
        let factor = self.0.cholesky()?;
        Some((error.dot(&factor.solve(error)), 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum()))
    }

    /// Each component scaled: `R' = D(√s) R D(√s)`, s factors on variances.
    pub fn scaled(&self, factors: &[f64; 6]) -> Self {
        Self(Matrix6::from_fn(|row, column| self.0[(row, column)] * factors[row].sqrt() * factors[column].sqrt()))
    }

    /// No error at all.
    pub fn zero() -> Self {
        Self(Matrix6::zeros())
    }

    /// The covariance of the sum of two independent errors.
    pub fn plus(&self, other: &Self) -> Self {
        Self(self.0 + other.0)
    }

    /// `self + v vᵀ`.
    pub fn plus_outer(&self, vector: &Vector6<f64>) -> Self {
        Self(self.0 + vector * vector.transpose())
    }

    /// The covariance of `J e`.
    pub fn mapped(&self, jacobian: &Matrix6<f64>) -> Self {
        Self(symmetric(&(jacobian * self.0 * jacobian.transpose())))
    }

    /// The covariance with its diagonal lifted to least variances of translation (m²) and rotation (rad²). What is
    /// positive semidefinite stays so.
    pub fn with_floor(&self, [translation, rotation]: [f64; 2]) -> Self {
        let mut lifted = self.0;
        for component in 0..6 {
            let least = if TRANSLATION.contains(&component) { translation } else { rotation };
            lifted[(component, component)] = lifted[(component, component)].max(least);
        }
        Self(lifted)
    }

    /// `R⁻¹`; `None` for a matrix that is not positive definite.
    pub fn information(&self) -> Option<Matrix6<f64>> {
        Some(symmetric(&self.0.cholesky()?.inverse()))
    }

    /// The same error in other axes: `Σ' = Ad_X Σ Ad_Xᵀ` with `X = other_from_self`.
    pub fn transported(&self, other_from_self: &Pose) -> Self {
        self.mapped(&other_from_self.adjoint())
    }

    /// The covariance of the right perturbation of the same measurement: `Ad_{T⁻¹} Σ Ad_{T⁻¹}ᵀ`,
    /// axes of the target frame.
    pub fn right_of(&self, source_from_target: &Pose) -> Self {
        self.transported(&source_from_target.inverse())
    }

    /// The covariance of the left perturbation, where this is that of the right one: `Ad_T Σ Ad_Tᵀ`, axes of the source
    /// frame.
    pub fn left_of(&self, source_from_target: &Pose) -> Self {
        self.transported(source_from_target)
    }
}

/// Without the asymmetry of rounding.
fn symmetric(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    0.5 * (matrix + matrix.transpose())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{RngExt, SeedableRng};

    use super::*;
    use crate::geometry::Tangent;

    #[test]
    fn transport_there_and_back_returns_the_covariance() {
        let covariance = Covariance6::from_std_devs(&Vector6::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03));
        let pose = Pose::exp(&Tangent::new(1.0, -2.0, 3.0, 0.3, -0.2, 0.9));
        let back = covariance.transported(&pose).transported(&pose.inverse());
        assert_relative_eq!(back.matrix(), covariance.matrix(), epsilon = 1e-12);
    }

    #[test]
    fn right_covariance_is_that_of_the_right_perturbation() {
        let truth = Pose::exp(&Tangent::new(1.0, 0.1, -0.2, 0.02, -0.05, 0.3));
        let std_devs = Vector6::new(1e-4, 2e-4, 3e-4, 4e-5, 5e-5, 6e-5);
        let left = Covariance6::from_std_devs(&std_devs);
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let draws = 20_000;
        let mut scatter = Matrix6::zeros();
        for _ in 0..draws {
            // A uniform variable on ±√3 σ has standard deviation σ.
            let error = std_devs.map(|std_dev| std_dev * 3f64.sqrt() * random.random_range(-1.0..1.0));
            let measured = Pose::exp(&error) * truth;
            let right = (measured.inverse() * truth).log();
            scatter += right * right.transpose() / draws as f64;
        }
        let expected = left.right_of(&truth);
        for index in 0..6 {
            assert_relative_eq!(scatter[(index, index)], expected.matrix()[(index, index)], max_relative = 0.05);
        }
    }

    #[test]
    fn matrices_that_are_no_covariance_are_named() {
        let mut matrix = Matrix6::identity();
        matrix[(0, 1)] = 0.5;
        assert_eq!(Covariance6::from_matrix(matrix), Err(CovarianceError::HalfFilled));
        matrix[(1, 0)] = 0.25;
        assert_eq!(Covariance6::from_matrix(matrix), Err(CovarianceError::NotSymmetric(0, 1, 0.25)));
        matrix[(1, 0)] = f64::NAN;
        assert_eq!(Covariance6::from_matrix(matrix), Err(CovarianceError::NotFinite(1, 0)));
        assert_eq!(Covariance6::from_matrix(-Matrix6::identity()), Err(CovarianceError::NegativeDiagonal(0, -1.0)));
        // Metres do not hide what is wrong with radians.
        let variances = Vector6::new(1.0, 1.0, 4.0, 1e-6, 1e-6, -1e-6);
        let negative = Covariance6::from_matrix(Matrix6::from_diagonal(&variances));
        assert_eq!(negative, Err(CovarianceError::NegativeDiagonal(5, -1e-6)));
        let mut indefinite = Matrix6::from_diagonal(&variances.abs());
        (indefinite[(3, 4)], indefinite[(4, 3)]) = (2e-6, 2e-6);
        assert!(matches!(Covariance6::from_matrix(indefinite), Err(CovarianceError::NegativeVariance(_))));
    }
}
