//! Gauss-Newton from the measured pose, coarse to fine.

use std::borrow::Cow;

use nalgebra::{Matrix2, Matrix6, Matrix6x2, SVector, Vector2, Vector3};

use super::evidence::{Evidence, LEVELS, LevelEvidence, NoVerdict};
use super::image::{GreyImage, Textured, halved_depth};
use super::normal_equations::{NormalEquations, Points, State, UNKNOWNS, normal_equations, residuals};
use super::scale::scale;
use crate::geometry::{Pinhole, Pose, Tangent};

/// Most steps at a level.
const STEPS: usize = 8;
/// A step of less than this Mahalanobis length squared, by the information of the residuals, is at rest. That
/// information is some thirty times too large (docs/method.md): the step is far below the estimate's own error.
const AT_REST: f64 = 0.05;
/// The same after the last step of the finest level, beyond which the alignment has not come to rest.
const RESTLESS: f64 = 100.0;
/// Least standard deviation of a residual: half a step of 8-bit images.
const LEAST_RESIDUAL: f32 = 0.5 / 255.0;
/// Least share of a level's pixels, and least number, that say anything.
const LEAST_SHARE: f64 = 0.02;
const LEAST_PIXELS: usize = 60;
/// Damping of a step, relative to the diagonal.
const DAMPING: f64 = 1e-4;
/// Largest change of intensity that is one of light.
const MOST_GAIN: f64 = 0.8;
/// Longest step, m relative to the median depth, and rad.
const LONGEST_STEP: f64 = 0.3;
/// Largest residual after alignment, relative to the contrast of the target, that still shows the same scene: pictures of
/// different places have some .4 to .6, aligned ones below .2.
const MOST_UNEXPLAINED: f64 = 0.35;
/// Least RMS gradient of an image that shows anything, 1/px.
const LEAST_GRADIENT: f64 = 0.5 / 255.0;

/// Least area in which the points of the target may lie in the source view, relative to that in the target itself: from
/// so far away one pixel would stand for hundreds.
const LEAST_SHRINKAGE: f64 = 0.01;

/// What an alignment starts from.
#[derive(Clone, Copy, Debug)]
pub struct AlignmentInput<'a> {
    /// `I_i`.
    pub source_image: &'a GreyImage,
    /// `I_{i+1}`, the same size.
    pub target_image: &'a GreyImage,
    /// Depth of the target, the same size, m; 0 = unknown. Sparse depth is as good as dense.
    pub target_depth_m: &'a [f32],
    /// Camera of both images at their size.
    pub camera: Pinhole,
    /// Measured `ⁱT̂ᵢ₊₁`, axes of the camera, m.
    pub source_from_target: Pose,
}

/// A level of the pyramid.
struct Level {
    source: Textured,
    points: Points,
    camera: [f32; 4],
    pixels: usize,
}

/// Aligns the images from the measured pose on; the evidence is in axes of the source camera.
///
/// Minimises the robust photometric error `Σ ρ(((1 + a) I_i(π(exp(−ê) T̂ X)) + b − I_{i+1}) / σ)` over ê, a and b, ρ of
/// Student's t (Kerl, Sturm and Cremers 2013), forward compositional (Baker and Matthews 2004), over three levels.
///
/// # Panics
/// Images and depth are not of the camera's size.
pub fn align(input: &AlignmentInput) -> Evidence {
    let AlignmentInput { source_image, target_image, target_depth_m, camera, source_from_target } = *input;
    let size = (camera.width, camera.height);
    assert_eq!((source_image.width, source_image.height), size, "source image and camera have one size");
    assert_eq!((target_image.width, target_image.height), size, "target image and camera have one size");
    assert_eq!(target_depth_m.len(), size.0 * size.1, "one depth a pixel");
    let Some(mut pyramid) = pyramid(source_image, target_image, target_depth_m, &camera) else {
        return Evidence::none(NoVerdict::NoTexture);
    };
    let finest = &pyramid[LEVELS - 1];
    let least = |level: &Level| LEAST_PIXELS.max((LEAST_SHARE * level.pixels as f64) as usize);
    if finest.points.known < least(finest) {
        return Evidence::none(NoVerdict::NoDepth);
    }
    if shrinkage(&finest.points, &source_from_target) < LEAST_SHRINKAGE {
        return Evidence::none(NoVerdict::NoOverlap);
    }
    let longest_m = LONGEST_STEP * f64::from(median_depth(&finest.points));
    let mut evidence = Evidence::none(NoVerdict::Diverged);
    let mut state = State { source_from_target, gain: 0.0, bias: 0.0 };
    let mut buffer = Vec::new();
    for (index, level) in pyramid.iter_mut().enumerate() {
        let measured = State { source_from_target, gain: state.gain, bias: state.bias };
        residuals(&level.source, level.camera, &level.points, &measured, &mut buffer);
        let valid = buffer.iter().filter(|residual| !residual.is_nan()).count();
        // A coarse level may be too small to say anything; the finest may not.
        if valid < LEAST_PIXELS || (index == LEVELS - 1 && valid < least(level)) {
            if index == LEVELS - 1 {
                return Evidence { no_verdict: Some(NoVerdict::NoOverlap), ..evidence };
            }
            continue;
        }
        let before = scale(&buffer, robust_guess(&buffer, valid), LEAST_RESIDUAL);
        let no_texture = Some(NoVerdict::NoTexture);
        let Some(mut aligned) = align_level(level, &mut state, before, longest_m, &mut buffer) else {
            return Evidence { no_verdict: no_texture, ..evidence };
        };
        if index == LEVELS - 1 {
            // Once more without what moves by itself, which only shows when all else is at rest.
            level.points.distrust_moving(&buffer, aligned.scale);
            let Some(again) = align_level(level, &mut state, aligned.scale, longest_m, &mut buffer) else {
                return Evidence { no_verdict: no_texture, ..evidence };
            };
            aligned = again;
        }
        evidence.levels[index] = LevelEvidence {
            error: Pose::error(&source_from_target, &state.source_from_target),
            information: aligned.information,
            residual_before: f64::from(before),
            residual_after: f64::from(aligned.scale),
            valid_share: aligned.valid as f64 / level.pixels as f64,
        };
        if index == LEVELS - 1 {
            (evidence.gain, evidence.bias) = (state.gain, state.bias);
            let unexplained = f64::from(aligned.scale) / contrast(target_image);
            evidence.no_verdict = match verdict(&aligned, least(level), before) {
                None if unexplained > MOST_UNEXPLAINED => Some(NoVerdict::Diverged),
                verdict => verdict,
            };
        }
    }
    evidence
}

/// What one level ended with.
struct Aligned {
    information: Matrix6<f64>,
    scale: f32,
    valid: usize,
    /// Mahalanobis length squared of the step that was not taken any more.
    last_step: f64,
}

/// Steps until they are short; `None` where the image has no gradient to step along.
fn align_level(
    level: &Level,
    state: &mut State,
    before: f32,
    longest_m: f64,
    buffer: &mut Vec<f32>,
) -> Option<Aligned> {
    let mut scale_now = before;
    for step in 0.. {
        let equations = normal_equations(&level.source, level.camera, &level.points, state, scale_now, buffer);
        scale_now = scale(buffer, scale_now, LEAST_RESIDUAL);
        let variance = f64::from(scale_now).powi(2);
        let delta = equations.step()?;
        let length = (delta.transpose() * equations.hessian * delta)[(0, 0)] / variance;
        if length < AT_REST || step == STEPS {
            let information = equations.pose_information() / variance;
            return Some(Aligned { information, scale: scale_now, valid: equations.valid, last_step: length });
        }
        state.advance(&delta, longest_m);
    }
    unreachable!("the last step returns")
}

fn verdict(aligned: &Aligned, least: usize, before: f32) -> Option<NoVerdict> {
    if aligned.valid < least {
        Some(NoVerdict::NoOverlap)
    } else if aligned.last_step > RESTLESS || aligned.scale > 1.2 * before {
        Some(NoVerdict::Diverged)
    } else {
        None
    }
}

impl NormalEquations {
    /// `−(H + damping)⁻¹ b`; `None` where nothing is known of any direction.
    fn step(&self) -> Option<SVector<f64, UNKNOWNS>> {
        let mut damped = self.hessian;
        let largest: f64 = (0..6).map(|c| damped[(c, c)]).fold(0.0, f64::max);
        if !(largest.is_finite() && largest > 0.0) {
            return None;
        }
        for c in 0..UNKNOWNS {
            damped[(c, c)] += DAMPING * damped[(c, c)] + 1e-9 * largest;
        }
        Some(-damped.cholesky()?.solve(&self.gradient))
    }

    /// The pose's block after elimination of gain and bias (Schur complement).
    fn pose_information(&self) -> Matrix6<f64> {
        let pose: Matrix6<f64> = self.hessian.fixed_view::<6, 6>(0, 0).into();
        let cross: Matrix6x2<f64> = self.hessian.fixed_view::<6, 2>(0, 6).into();
        let light: Matrix2<f64> = self.hessian.fixed_view::<2, 2>(6, 6).into();
        match light.cholesky() {
            Some(light) => {
                let reduced = pose - cross * light.solve(&cross.transpose());
                0.5 * (reduced + reduced.transpose())
            }
            None => pose,
        }
    }
}

impl State {
    /// `T ← exp(−δ) T`, no further than reasonable.
    fn advance(&mut self, delta: &SVector<f64, UNKNOWNS>, longest_m: f64) {
        let motion: Tangent = delta.fixed_rows::<6>(0).into();
        let translation = motion.fixed_rows::<3>(0).norm() / longest_m;
        let rotation = motion.fixed_rows::<3>(3).norm() / LONGEST_STEP;
        let motion = motion / translation.max(rotation).max(1.0);
        self.source_from_target = Pose::exp(&-motion) * self.source_from_target;
        self.gain = (self.gain + delta[6]).clamp(-MOST_GAIN, MOST_GAIN);
        self.bias = (self.bias + delta[7]).clamp(-MOST_GAIN, MOST_GAIN);
    }
}

/// From coarse to fine; `None` where an image has no gradient anywhere, or too few pixels for all levels.
fn pyramid(source: &GreyImage, target: &GreyImage, depth_m: &[f32], camera: &Pinhole) -> Option<[Level; LEVELS]> {
    let (mut source, mut target, mut depth_m) = (Cow::Borrowed(source), Cow::Borrowed(target), Cow::Borrowed(depth_m));
    let mut intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy];
    let mut levels = Vec::with_capacity(LEVELS);
    for level in 0..LEVELS {
        if level > 0 {
            depth_m = Cow::Owned(halved_depth(&depth_m, target.width, target.height));
            (source, target) = (Cow::Owned(source.halved()), Cow::Owned(target.halved()));
            let [fx, fy, cx, cy] = intrinsics;
            intrinsics = [0.5 * fx, 0.5 * fy, 0.5 * (cx + 0.5) - 0.5, 0.5 * (cy + 0.5) - 0.5];
        }
        if source.width < 2 || source.height < 2 {
            return None;
        }
        let camera = intrinsics.map(|value| value as f32);
        let (seen, wanted) = (Textured::new(&source), Textured::new(&target));
        if level == 0 && !(shows_anything(&seen) && shows_anything(&wanted)) {
            return None;
        }
        let points = Points::new(&wanted, &depth_m, camera);
        levels.push(Level { source: seen, points, camera, pixels: target.pixels.len() });
    }
    levels.reverse();
    levels.try_into().ok()
}

/// Whether the RMS gradient is more than [`LEAST_GRADIENT`]; most images show that within their first rows.
fn shows_anything(image: &Textured) -> bool {
    let enough = LEAST_GRADIENT * LEAST_GRADIENT * image.pixels.len() as f64;
    let mut squares = 0.0;
    image.pixels.iter().any(|[_, along_row, along_column, _]| {
        squares += f64::from(along_row * along_row + along_column * along_column);
        squares > enough
    })
}

/// Standard deviation of the intensities, no less than that of noise.
fn contrast(image: &GreyImage) -> f64 {
    let count = image.pixels.len() as f64;
    let mean = image.pixels.iter().map(|&grey| f64::from(grey)).sum::<f64>() / count;
    let squares = image.pixels.iter().map(|&grey| (f64::from(grey) - mean).powi(2)).sum::<f64>();
    (squares / count).sqrt().max(f64::from(LEAST_RESIDUAL))
}

/// How the area that points of the target take changes from its view to that of the source: the ratio of the
/// determinants of their scatter, square root; points behind the source camera left out.
fn shrinkage(points: &Points, source_from_target: &Pose) -> f64 {
    let area = |pose: &Pose| {
        let seen = (0..points.known).step_by(points.known / 256 + 1).filter_map(|k| {
            let point = Vector3::new(points.x[k], points.y[k], points.z[k]).map(f64::from);
            let point = pose.transform_point(&point);
            (point.z > 0.0).then(|| Vector2::new(point.x / point.z, point.y / point.z))
        });
        let seen: Vec<Vector2<f64>> = seen.collect();
        let mean = seen.iter().sum::<Vector2<f64>>() / seen.len().max(1) as f64;
        let scatter: Matrix2<f64> = seen.iter().map(|point| (point - mean) * (point - mean).transpose()).sum();
        (scatter / seen.len().max(1) as f64).determinant().max(0.0).sqrt()
    };
    area(source_from_target) / area(&Pose::identity()).max(f64::MIN_POSITIVE)
}

fn median_depth(points: &Points) -> f32 {
    let mut sample: Vec<f32> = points.z[..points.known].iter().step_by(points.known / 256 + 1).copied().collect();
    let middle = sample.len() / 2;
    *sample.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// A first guess of the residuals' scale: 1.48 times the median of |r| over a sample.
fn robust_guess(residuals: &[f32], valid_count: usize) -> f32 {
    let valid = residuals.iter().filter(|residual| !residual.is_nan());
    let mut sample: Vec<f32> = valid.step_by(valid_count / 512 + 1).map(|residual| residual.abs()).collect();
    let middle = sample.len() / 2;
    1.4826 * *sample.select_nth_unstable_by(middle, f32::total_cmp).1
}
