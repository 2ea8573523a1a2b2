//! SE(3): poses, their exponential and logarithm, and the adjoint.

use std::ops::{Mul, Range};

use nalgebra::{Matrix3, Matrix4, Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};

/// Position of the translation part ρ in a [`Tangent`].
pub const TRANSLATION: Range<usize> = 0..3;
/// Position of the rotation part φ in a [`Tangent`].
pub const ROTATION: Range<usize> = 3..6;

/// A tangent vector of SE(3): ρ (m) then φ (rad).
pub type Tangent = Vector6<f64>;

/// Below this angle the coefficients of exp and log come from their Taylor series: at the seam the
/// first omitted term is below 1e-16 while the closed forms still keep 12 digits.
const SERIES_ANGLE_RAD: f64 = 0.03;

/// A rigid motion, named after what it maps: `a_from_b` takes coordinates in b to coordinates in a.
///
/// Composition reads left to right: `a_from_c = a_from_b * b_from_c`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Orthonormal, determinant +1.
    pub rotation: Rotation3<f64>,
    /// Metres.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// The motion that leaves every point where it is.
    pub fn identity() -> Self {
        Self::new(Rotation3::identity(), Vector3::zeros())
    }

    /// A pose from its two parts.
    pub fn new(rotation: Rotation3<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// A pose from a 3x3 block that should be a rotation but carries print rounding.
    ///
    /// The block is replaced by the nearest rotation. Returns the deviation `max |RᵀR − I|` instead
    /// when it exceeds `tolerance` or the determinant is not positive.
    ///
    /// # Errors
    /// The block is not a rotation within `tolerance`.
    pub fn from_rounded_parts(rotation: Matrix3<f64>, translation: Vector3<f64>, tolerance: f64) -> Result<Self, f64> {
        let deviation = (rotation.transpose() * rotation - Matrix3::identity()).abs().max();
        if deviation.is_nan() || deviation > tolerance {
            return Err(deviation);
        }
        if rotation.determinant() <= 0.0 {
            return Err(2.0);
        }
        // Newton's iteration for the orthogonal polar factor: squares the deviation, keeps small angles.
        let nearest = (0..4).fold(rotation, |r, _| r * (3.0 * Matrix3::identity() - r.transpose() * r) * 0.5);
        Ok(Self::new(Rotation3::from_matrix_unchecked(nearest), translation))
    }

    /// The homogeneous 4x4 matrix.
    pub fn matrix(&self) -> Matrix4<f64> {
        let mut matrix = self.rotation.to_homogeneous();
        matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        matrix
    }

    /// `b_from_a` of `a_from_b`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self::new(rotation, -(rotation * self.translation))
    }

    /// Maps a point.
    pub fn transform_point(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// The same motion seen from other axes: `X T X⁻¹` with `X = other_from_self`.
    pub fn conjugated_by(&self, other_from_self: &Pose) -> Self {
        *other_from_self * *self * other_from_self.inverse()
    }

    /// Exponential map: `exp(hat(ξ))`, `t = V(φ) ρ`; the same bits on every machine.
    pub fn exp(tangent: &Tangent) -> Self {
        let rho = tangent.fixed_rows::<3>(0).into_owned();
        let phi = tangent.fixed_rows::<3>(3).into_owned();
        let angle = phi.norm();
        // sin θ/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³
        let (a, b, c) = if angle < SERIES_ANGLE_RAD {
            let s = angle * angle;
            (
                1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0))),
                0.5 - s / 24.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0))),
                1.0 / 6.0 - s / 120.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0))),
            )
        } else {
            let (sine, half_sine) = (libm::sin(angle), libm::sin(0.5 * angle));
            let square = angle * angle;
            (sine / angle, 2.0 * half_sine * half_sine / square, (angle - sine) / (square * angle))
        };
        let w = hat(&phi);
        let w2 = w * w;
        let rotation = Matrix3::identity() + a * w + b * w2;
        let v = Matrix3::identity() + b * w + c * w2;
        Self::new(Rotation3::from_matrix_unchecked(rotation), v * rho)
    }

    /// Logarithm: the tangent ξ with `exp(ξ) = self`, rotation angle in [0, π], `ρ = V(φ)⁻¹ t`.
    pub fn log(&self) -> Tangent {
        // By way of the quaternion the axis stays well conditioned near π, where R − Rᵀ vanishes.
        let quaternion = UnitQuaternion::from_rotation_matrix(&self.rotation).into_inner();
        let sign = if quaternion.w < 0.0 { -1.0 } else { 1.0 };
        let sine = sign * quaternion.imag();
        let half_angle = sine.norm().atan2(sign * quaternion.w);
        let angle = 2.0 * half_angle;
        let phi = if half_angle < SERIES_ANGLE_RAD {
            let s = half_angle * half_angle;
            // θ/sin θ
            2.0 * sine * (1.0 + s / 6.0 * (1.0 + 7.0 * s / 60.0 * (1.0 + 31.0 * s / 294.0)))
        } else {
            2.0 * sine * (half_angle / half_angle.sin())
        };
        // (1 − θ/2 cot θ/2)/θ²
        let coefficient = if angle < SERIES_ANGLE_RAD {
            let s = angle * angle;
            1.0 / 12.0 + s / 720.0 * (1.0 + s / 42.0 * (1.0 + s / 40.0))
        } else {
            (1.0 - half_angle / half_angle.tan()) / (angle * angle)
        };
        let w = hat(&phi);
        let rho = self.translation - 0.5 * (w * self.translation) + coefficient * (w * (w * self.translation));
        Tangent::new(rho.x, rho.y, rho.z, phi.x, phi.y, phi.z)
    }

    /// Adjoint: `T exp(ξ) T⁻¹ = exp(Ad_T ξ)`, for ρ-then-φ tangents.
    pub fn adjoint(&self) -> Matrix6<f64> {
        let r = self.rotation.matrix();
        let mut adjoint = Matrix6::zeros();
        adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
        adjoint.fixed_view_mut::<3, 3>(0, 3).copy_from(&(hat(&self.translation) * r));
        adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
        adjoint
    }

    /// Error of a measured pose: `e = log(T̂ T⁻¹)` (paper Eq. 2), in the axes both poses are given in.
    pub fn error(measured: &Pose, truth: &Pose) -> Tangent {
        (*measured * truth.inverse()).log()
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.matrix().iter().chain(self.translation.iter()).all(|value| value.is_finite())
    }
}

impl Mul for Pose {
    type Output = Pose;

    fn mul(self, right: Pose) -> Pose {
        Pose::new(self.rotation * right.rotation, self.rotation * right.translation + self.translation)
    }
}

/// The skew-symmetric matrix of a cross product: `hat(a) b = a × b`.
pub fn hat(a: &Vector3<f64>) -> Matrix3<f64> {
    a.cross_matrix()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    use super::*;

    fn tangent(scale: f64) -> impl Strategy<Value = Tangent> {
        prop::array::uniform6(-1.0..1.0_f64).prop_map(move |values| scale * Tangent::from(values))
    }

    proptest! {
        #[test]
        fn log_inverts_exp_at_every_size(xi in prop_oneof![tangent(0.0), tangent(1e-8), tangent(1e-3), tangent(1.5)]) {
            let back = Pose::exp(&xi).log();
            prop_assert!((back - xi).norm() <= 1e-12 * xi.norm().max(1.0));
        }

        #[test]
        fn adjoint_moves_a_tangent_through_a_pose(a in tangent(1.0), b in tangent(1.0)) {
            let pose = Pose::exp(&a);
            let left = pose * Pose::exp(&b) * pose.inverse();
            let right = Pose::exp(&(pose.adjoint() * b));
            prop_assert!((left.matrix() - right.matrix()).norm() < 1e-12);
        }

        #[test]
        fn a_pose_times_its_inverse_is_the_identity(a in tangent(2.0)) {
            let pose = Pose::exp(&a);
            prop_assert!(((pose * pose.inverse()).matrix() - Matrix4::identity()).norm() < 1e-12);
        }
    }

    #[test]
    fn exp_and_log_agree_on_both_sides_of_the_series_seam() {
        for angle in [SERIES_ANGLE_RAD * (1.0 - 1e-9), SERIES_ANGLE_RAD * (1.0 + 1e-9)] {
            let xi = Tangent::new(1.0, -2.0, 0.5, angle * 0.6, 0.0, angle * 0.8);
            assert_relative_eq!(Pose::exp(&xi).log(), xi, epsilon = 1e-13);
        }
    }

    #[test]
    fn a_reflection_is_not_a_rotation() {
        let reflection = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        assert!(Pose::from_rounded_parts(reflection, Vector3::zeros(), 1e-3).is_err());
        let nan = Matrix3::from_element(f64::NAN);
        assert!(Pose::from_rounded_parts(nan, Vector3::zeros(), 1e-3).is_err());
    }
}
