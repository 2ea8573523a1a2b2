//! Poses and covariances as the numbers of a line.

use nalgebra::{Matrix6, UnitQuaternion};

use crate::geometry::{Pose, ROTATION, TRANSLATION};

/// Position and quaternion `x y z qx qy qz qw`.
pub(super) fn pose_numbers(pose: &Pose) -> [f64; 7] {
    let quaternion = UnitQuaternion::from_rotation_matrix(&pose.rotation);
    let (t, q) = (pose.translation, quaternion.coords);
    // The same rotation either way; readers expect the short one.
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [t.x, t.y, t.z, sign * q.x, sign * q.y, sign * q.z, sign * q.w]
}

/// Entries of a matrix, row by row.
pub(super) fn rows(matrix: &Matrix6<f64>) -> impl Iterator<Item = f64> {
    let entries: Vec<f64> = matrix.transpose().iter().copied().collect();
    entries.into_iter()
}

/// The matrix with φ before ρ.
pub(super) fn rotation_first(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    let order: Vec<usize> = ROTATION.chain(TRANSLATION).collect();
    Matrix6::from_fn(|row, column| matrix[(order[row], order[column])])
}

/// Numbers in a line, shortest text that gives the same number back.
pub(super) fn join(numbers: impl IntoIterator<Item = f64>, separator: &str) -> String {
    numbers.into_iter().map(|number| format!("{number:?}")).collect::<Vec<_>>().join(separator)
}
