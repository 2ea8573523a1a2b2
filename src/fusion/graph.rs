//! The pose graph: relative poses between frames, fixes of single frames, solved by factrs.

use std::collections::BTreeMap;

use factrs::core::{BetweenResidual, Factor, GaussianNoise, Graph, PriorResidual, SE3, SO3, Values};
use factrs::fac;
use factrs::linalg::{Const, ForwardProp, Matrix6 as Matrix6f, Numeric, Vector3 as Vector3f, VectorX};
use factrs::residuals::Residual1;
use nalgebra::{Matrix3, Matrix6, Quaternion, UnitQuaternion, Vector3};

use super::fixes::{Fix, anchor};
use super::solver::{marginals, solve};
use super::variables::X;
use crate::error::{Error, Result};
use crate::geometry::{Covariance6, Pose, ROTATION, TRANSLATION, hat};
use crate::recordings::Trajectory;
use crate::systems::{RelativePose, chain_poses};

/// Fixes that place a trajectory in the world when none has an attitude.
const FEWEST_POSITIONS: usize = 3;

/// Standard deviation of a rotation beyond which nothing is known of it, rad: a linearised covariance ends there.
const LEAST_KNOWN_RAD: f64 = 0.5;

/// One system's relative poses on one drive.
#[derive(Clone, Debug)]
pub struct Odometry {
    /// Its name.
    pub system: String,
    /// Its measurements in axes of the body; each needs its covariance.
    pub motions: Vec<RelativePose>,
}

/// The most likely trajectory.
#[derive(Clone, Debug)]
pub struct FusedTrajectory {
    /// `world_from_body` of each frame.
    pub poses: Trajectory,
    /// Marginal covariance of each: right perturbation, order ρ then φ, axes of the body, m² and rad².
    pub covariances: BTreeMap<usize, Covariance6>,
    /// Whether it was placed by fixes; else its first frame is the world.
    pub placed: bool,
}

impl FusedTrajectory {
    /// The trajectory in the truth's world: as it is where fixes placed it, else laid onto the truth by its first frame.
    /// Covariances stay, for they are those of the right perturbation. `None` where the truth does not know that frame.
    pub fn in_world_of(&self, truth: &Trajectory) -> Option<Self> {
        if self.placed {
            return Some(self.clone());
        }
        let (first, pose) = self.poses.first_key_value()?;
        let world_from_fused = *truth.get(first)? * pose.inverse();
        let poses = self.poses.iter().map(|(&frame, pose)| (frame, world_from_fused * *pose)).collect();
        Some(Self { poses, ..self.clone() })
    }
}

/// `t − p`: a measured position.
#[derive(Clone, Debug)]
struct PositionResidual {
    position: [f64; 3],
}

#[factrs::mark]
impl Residual1 for PositionResidual {
    type Differ = ForwardProp<Const<6>>;
    type V1 = SE3;
    type DimIn = Const<6>;
    type DimOut = Const<3>;

    fn residual1<T: Numeric>(&self, pose: SE3<T>) -> VectorX<T> {
        let position = pose.xyz();
        VectorX::from_fn(3, |axis, _| position[axis] - T::from(self.position[axis]))
    }
}

/// Joins odometry and fixes. Without a fix the first frame is the world.
///
/// # Errors
/// There is no motion; a covariance is not positive definite; frames hang together by no motion; the fixes do not place
/// the trajectory in the world, or leave more than half a radian of its rotation open; one is of a
/// frame that no motion reaches; or the solver does not converge.
pub fn fuse(odometry: &[Odometry], fixes: &[Fix]) -> Result<FusedTrajectory> {
    let local = chain(odometry)?;
    let number: BTreeMap<usize, u32> = local.keys().enumerate().map(|(index, &frame)| (frame, index as u32)).collect();
    if let Some(fix) = fixes.iter().find(|fix| !number.contains_key(&fix.frame)) {
        return Err(Error::Data(format!("a fix of frame {}: no motion reaches that frame", fix.frame)));
    }
    // Far from the origin, metres lose their digits: the graph's world begins at its first fix.
    let origin = fixes.first().map_or(Vector3::zeros(), |fix| fix.position);
    let anchors: Vec<Fix> = match local.keys().next() {
        Some(&first) if fixes.is_empty() => vec![anchor(first, &Pose::identity())],
        _ => fixes.iter().map(|fix| Fix { position: fix.position - origin, ..fix.clone() }).collect(),
    };
    let world_from_local = place(&local, &anchors)?;
    require_turned(&local, &world_from_local, &anchors)?;

    let mut graph = Graph::new();
    for Odometry { system, motions } in odometry {
        for RelativePose { source, target, source_from_target: pose, covariance } in motions {
            let information = covariance.and_then(|covariance| covariance.right_of(pose).information());
            let noise = information.as_ref().and_then(gaussian).ok_or_else(|| {
                Error::Data(format!(
                    "{system}, frames {source} and {target}: no covariance, or one that cannot be inverted; every direction needs a variance, and none far from the others"
                ))
            })?;
            let between = BetweenResidual::new(to_factrs(pose));
            graph.add_factor(fac![between, (X(number[source]), X(number[target])), noise]);
        }
    }
    for fix in &anchors {
        graph.add_factor(fix_factor(fix, number[&fix.frame])?);
    }
    let mut values = Values::new();
    for (&frame, &index) in &number {
        values.insert(X(index), to_factrs(&(world_from_local * local[&frame])));
    }
    let values = solve(&graph, values)?;
    let covariances = marginals(&graph, &values, &number)?;
    let poses = number.iter().map(|(&frame, &index)| {
        let pose = from_factrs(values.get(X(index)).expect("every frame has a pose"));
        (frame, Pose::new(pose.rotation, pose.translation + origin))
    });
    Ok(FusedTrajectory { poses: poses.collect(), covariances, placed: !fixes.is_empty() })
}

/// What a fix says of the pose with this number.
fn fix_factor(fix: &Fix, number: u32) -> Result<Factor> {
    let Some((rotation, deviations)) = &fix.attitude else {
        let std = fix.position_std_m;
        let noise = GaussianNoise::<3>::from_diag_sigmas(std.x, std.y, std.z);
        return Ok(fac![PositionResidual { position: fix.position.into() }, X(number), noise]);
    };
    // In axes of the body, as a right perturbation has it.
    let position = rotation.inverse() * Matrix3::from_diagonal(&fix.position_std_m.map(|std| std.powi(-2)));
    let mut information = Matrix6::zeros();
    information.fixed_view_mut::<3, 3>(0, 0).copy_from(&(position * rotation.matrix()));
    let about = Matrix3::from_diagonal(&deviations.map(|std| std.powi(-2)));
    information.fixed_view_mut::<3, 3>(3, 3).copy_from(&about);
    let noise = gaussian(&(0.5 * (information + information.transpose()))).ok_or_else(|| {
        Error::Data(format!("the fix of frame {}: its standard deviations differ too much in size", fix.frame))
    })?;
    let prior = PriorResidual::new(to_factrs(&Pose::new(*rotation, fix.position)));
    Ok(fac![prior, X(number), noise])
}

/// Poses of all frames in the first.
fn chain(odometry: &[Odometry]) -> Result<Trajectory> {
    let motions = odometry.iter().flat_map(|system| &system.motions);
    let motions: Vec<(usize, usize, Pose)> =
        motions.map(|motion| (motion.source, motion.target, motion.source_from_target)).collect();
    let mut parts = chain_poses(&motions);
    match parts.as_slice() {
        [] => Err(Error::Data("no system has a motion: there is nothing to fuse".to_owned())),
        [_] => Ok(parts.swap_remove(0)),
        [first, second, ..] => Err(Error::Data(format!(
            "frames {} and {} hang together by no motion; fuse the parts one by one, or add a system that bridges the gap",
            first.keys().next().expect("a part has a frame"),
            second.keys().next().expect("a part has a frame")
        ))),
    }
}

/// Where the chained trajectory begins in the world: by the first attitude, else by fitting positions to positions.
fn place(local: &Trajectory, fixes: &[Fix]) -> Result<Pose> {
    if let Some((fix, rotation)) = fixes.iter().find_map(|fix| Some((fix, fix.attitude.as_ref()?.0))) {
        return Ok(Pose::new(rotation, fix.position) * local[&fix.frame].inverse());
    }
    let unplaced = || {
        Error::Data(format!(
            "{} positions without an attitude do not place a trajectory; give at least {FEWEST_POSITIONS} that do not lie on a line, or a fix with an attitude",
            fixes.len()
        ))
    };
    let chained: Vec<Vector3<f64>> = fixes.iter().map(|fix| local[&fix.frame].translation).collect();
    let fixed: Vec<Vector3<f64>> = fixes.iter().map(|fix| fix.position).collect();
    let mean = |points: &[Vector3<f64>]| points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let (from, to) = (mean(&chained), mean(&fixed));
    // Kabsch: the rotation that maximises Σ (to)ᵀ R (from).
    let scatter: Matrix3<f64> = chained.iter().zip(&fixed).map(|(a, b)| (b - to) * (a - from).transpose()).sum();
    let spread = scatter.svd(true, true);
    let (Some(u), Some(v_t)) = (spread.u, spread.v_t) else { return Err(unplaced()) };
    if fixes.len() < FEWEST_POSITIONS || spread.singular_values[1] < 1e-9 * spread.singular_values[0].max(1e-300) {
        return Err(unplaced());
    }
    let handed = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(u * handed * v_t);
    Ok(Pose::new(rotation, to - rotation * from))
}

/// That the fixes say how the trajectory is turned in the world, by their own standard deviations: positions near a line
/// say little of the rotation about it.
fn require_turned(local: &Trajectory, world_from_local: &Pose, fixes: &[Fix]) -> Result<()> {
    // Information of a rotation and a shift of the whole trajectory, axes of the world.
    let (mut rotation, mut mixed, mut shift) = (Matrix3::zeros(), Matrix3::zeros(), Matrix3::zeros());
    for fix in fixes {
        let body = *world_from_local * local[&fix.frame];
        let known = Matrix3::from_diagonal(&fix.position_std_m.map(|std| std.powi(-2)));
        let turned = -hat(&body.translation);
        rotation += turned.transpose() * known * turned;
        mixed += turned.transpose() * known;
        shift += known;
        if let Some((_, deviations)) = &fix.attitude {
            let known = Matrix3::from_diagonal(&deviations.map(|std| std.powi(-2)));
            rotation += body.rotation.matrix() * known * body.rotation.matrix().transpose();
        }
    }
    let left = shift.try_inverse().map(|inverse| rotation - mixed * inverse * mixed.transpose());
    let information = left.map_or(0.0, |left| (0.5 * (left + left.transpose())).symmetric_eigenvalues().min());
    let std_rad = information.max(0.0).sqrt().recip();
    match std_rad <= LEAST_KNOWN_RAD {
        true => Ok(()),
        false => Err(Error::Data(format!(
            "by the fixes' own deviations the trajectory's rotation is known to {std_rad:.1e} rad only: positions near a line leave it open; give others, or a fix with an attitude"
        ))),
    }
}

/// Noise of an information matrix, ρ then φ here and φ then ρ there.
fn gaussian(information: &Matrix6<f64>) -> Option<GaussianNoise<6>> {
    let order: Vec<usize> = ROTATION.chain(TRANSLATION).collect();
    let theirs = Matrix6f::from_fn(|row, column| information[(order[row], order[column])]);
    let finite = information.iter().all(|value| value.is_finite());
    finite.then(|| GaussianNoise::from_matrix_inf(theirs.as_view())).flatten()
}

fn to_factrs(pose: &Pose) -> SE3 {
    let q = UnitQuaternion::from_rotation_matrix(&pose.rotation);
    let t = &pose.translation;
    SE3::from_rot_trans(SO3::from_xyzw(q.i, q.j, q.k, q.w), Vector3f::new(t.x, t.y, t.z))
}

fn from_factrs(pose: &SE3) -> Pose {
    let (rotation, t) = (pose.rot(), pose.xyz());
    let quaternion = Quaternion::new(rotation.w(), rotation.x(), rotation.y(), rotation.z());
    let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix();
    Pose::new(rotation, Vector3::new(t[0], t[1], t[2]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Tangent;

    const STEP: [f64; 6] = [1.0, 0.05, -0.02, 0.01, -0.005, 0.1];

    fn truth(frames: usize) -> BTreeMap<usize, Pose> {
        let step = Pose::exp(&Tangent::from(STEP));
        let mut pose = Pose::exp(&Tangent::new(4e5, 5e6, 100.0, 0.1, 0.2, 1.0));
        let next = |frame| {
            let here = pose;
            pose = pose * step;
            (frame, here)
        };
        (0..frames).map(next).collect()
    }

    fn odometry(system: &str, truth: &BTreeMap<usize, Pose>, std: f64, errors: &[Tangent]) -> Odometry {
        let covariance = Covariance6::from_std_devs(&Tangent::repeat(std));
        let motion = |source: usize| {
            let exact = truth[&source].inverse() * truth[&(source + 1)];
            let error = errors.get(source).copied().unwrap_or_else(Tangent::zeros);
            RelativePose {
                source,
                target: source + 1,
                source_from_target: Pose::exp(&error) * exact,
                covariance: Some(covariance),
            }
        };
        Odometry { system: system.to_owned(), motions: (0..truth.len() - 1).map(motion).collect() }
    }

    fn position(frame: usize, pose: &Pose, std: f64) -> Fix {
        Fix { frame, position: pose.translation, position_std_m: Vector3::repeat(std), attitude: None }
    }

    #[test]
    fn exact_measurements_give_the_truth_in_a_world_far_away() {
        let truth = truth(12);
        let fixes: Vec<Fix> = [0, 5, 11].map(|frame| position(frame, &truth[&frame], 0.1)).into();
        let fused = fuse(&[odometry("vo", &truth, 0.01, &[])], &fixes).unwrap();
        for (frame, pose) in &truth {
            assert!(
                Pose::error(&fused.poses[frame].conjugated_by(&Pose::identity()), pose).fixed_rows::<3>(3).norm()
                    < 1e-6
            );
            assert!((fused.poses[frame].translation - pose.translation).norm() < 1e-5);
        }
    }

    #[test]
    fn marginals_are_those_of_chained_covariances() {
        // From an anchor at the first frame: what `export::Chain` adds up, on the other side.
        let truth = truth(4);
        let odometry = odometry("vo", &truth, 0.01, &[]);
        let fused = fuse(std::slice::from_ref(&odometry), &[]).unwrap();
        assert!(!fused.placed);
        let (mut sum, mut pose) = (Covariance6::zero(), Pose::identity());
        for RelativePose { target, source_from_target, covariance, .. } in &odometry.motions {
            sum = sum.plus(&covariance.unwrap().transported(&pose));
            pose = pose * *source_from_target;
            let expected = sum.right_of(&pose);
            let difference = fused.covariances[target].matrix() - expected.matrix();
            assert!(difference.norm() < 1e-6 * expected.matrix().norm(), "{difference}");
        }
    }

    #[test]
    fn two_systems_are_weighted_by_their_information() {
        let truth = truth(2);
        let error = Tangent::new(0.03, 0.0, 0.0, 0.0, 0.0, 0.0);
        let (good, bad) = (odometry("wheel", &truth, 0.01, &[]), odometry("vo", &truth, 0.02, &[error]));
        let fused = fuse(&[bad, good], &[]).unwrap();
        // Weights 1/4 and 1: a fifth of the error is left.
        let left = Pose::error(&fused.poses[&1], &(truth[&0].inverse() * truth[&1]));
        assert!((left - 0.2 * error).norm() < 1e-6, "{left}");
        let expected = 1.0 / (1.0 / 0.01_f64.powi(2) + 1.0 / 0.02_f64.powi(2));
        let forward = fused.covariances[&1].left_of(&fused.poses[&1]).variance()[0];
        assert!((forward / expected - 1.0).abs() < 1e-4, "{forward} against {expected}");
    }

    #[test]
    fn what_fixes_near_a_line_do_not_say_is_refused() {
        // A millimetre beside a straight road, positions to half a metre: its roll is known to some 500 rad.
        let bend = |angle: f64| Pose::exp(&Tangent::new(1.0, 0.0, 0.0, 0.0, angle, 0.0));
        let mut truth = BTreeMap::from([(0, Pose::identity())]);
        for (frame, angle) in [5e-4, 0.0, -5e-4, 5e-4].into_iter().enumerate() {
            truth.insert(frame + 1, truth[&frame] * bend(angle));
        }
        let fixes = |std: f64| [0, 2, 4].map(|frame| position(frame, &truth[&frame], std)).to_vec();
        let odometry = [odometry("vo", &truth, 0.02, &[])];
        let message = fuse(&odometry, &fixes(0.5)).unwrap_err().to_string();
        assert!(message.contains("rotation is known to"), "{message}");
        // Known to micrometres they say it; and so does one attitude.
        assert!(fuse(&odometry, &fixes(1e-5)).is_ok());
        let attitude = Some((truth[&0].rotation, Vector3::repeat(0.01)));
        let one = Fix { attitude, ..position(0, &truth[&0], 0.5) };
        assert!(fuse(&odometry, &[vec![one], fixes(0.5)[1..].to_vec()].concat()).is_ok());
    }

    #[test]
    fn what_cannot_be_fused_is_said() {
        let truth = truth(6);
        let whole = odometry("vo", &truth, 0.01, &[]);
        let mut broken = whole.clone();
        broken.motions.remove(2);
        let mut flat = whole.clone();
        flat.motions[1].covariance = Some(Covariance6::zero());
        let outside = Fix { frame: 99, ..position(0, &truth[&0], 0.1) };
        let two: Vec<Fix> = [0, 5].map(|frame| position(frame, &truth[&frame], 0.1)).into();
        for (odometry, fixes, word) in [
            (vec![], vec![], "nothing to fuse"),
            (vec![broken], vec![], "frames 0 and 3"),
            (vec![flat], vec![], "cannot be inverted"),
            (vec![whole.clone()], vec![outside], "frame 99"),
            (vec![whole], two, "2 positions"),
        ] {
            let message = fuse(&odometry, &fixes).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    }
}
