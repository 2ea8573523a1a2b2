//! How the car drives: speed between 0 and 20 m/s by the bends ahead, stops, and a body that pitches
//! and rolls.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::random::{Purpose, Random};
use super::road::Road;
use crate::geometry::Pose;

/// Time between two frames, s.
pub(super) const FRAME_S: f64 = 0.1;
/// Where the car keeps, m to the left of the centreline.
pub(super) const LANE_M: f64 = -1.75;
/// Height of the vehicle's origin (the IMU) above the road, m.
const ORIGIN_HEIGHT_M: f64 = 0.93;
/// Arc length of the first frame: there is a road behind it too, m.
const START_M: f64 = 150.0;

const MAX_SPEED_M_S: f64 = 20.0;
const MAX_LATERAL_M_S2: f64 = 2.5;
const BRAKING_M_S2: f64 = 3.0;
const DRIVING_M_S2: f64 = 2.2;
/// How far ahead the driver looks, m.
const LOOK_AHEAD_M: f64 = 80.0;
/// Share of a change in acceleration that the springs pass on within a frame.
const SPRING: f64 = 0.3;

/// The car at a moment.
#[derive(Clone, Copy, Debug)]
pub(super) struct CarState {
    pub time_s: f64,
    /// Arc length along the centreline, m.
    pub arc_m: f64,
    pub speed_m_s: f64,
    /// Forward and leftward acceleration as the springs pass it on, m/s².
    pub acceleration_m_s2: [f64; 2],
}

/// Drives the car frame by frame.
#[derive(Clone, Debug)]
pub(super) struct Driver {
    random: Random,
    state: CarState,
    cruise_m_s: f64,
    cruise_until_m: f64,
    stop_at_m: f64,
    /// Frames left to stand.
    standing: u32,
}

impl Driver {
    pub(super) fn new(seed: u64) -> Self {
        let mut random = Random::new(seed, Purpose::Motion, 0);
        let speed_m_s = random.between(3.0, 15.0);
        let stop_at_m = START_M + random.between(80.0, 300.0);
        let state = CarState { time_s: 0.0, arc_m: START_M, speed_m_s, acceleration_m_s2: [0.0; 2] };
        Self { random, state, cruise_m_s: speed_m_s, cruise_until_m: START_M, stop_at_m, standing: 0 }
    }

    pub(super) fn state(&self) -> CarState {
        self.state
    }

    /// One frame on; the road must be covered for [`LOOK_AHEAD_M`].
    pub(super) fn advance(&mut self, road: &Road) {
        let CarState { arc_m, speed_m_s, .. } = self.state;
        if arc_m >= self.cruise_until_m {
            self.cruise_m_s = self.random.between(5.0, MAX_SPEED_M_S);
            self.cruise_until_m = arc_m + self.random.between(60.0, 200.0);
        }
        let acceleration = if self.standing > 0 {
            self.standing -= 1;
            -speed_m_s / FRAME_S
        } else {
            let wanted = self.wanted_speed(road);
            ((wanted - speed_m_s) / FRAME_S).clamp(-1.2 * BRAKING_M_S2, DRIVING_M_S2)
        };
        let speed = (speed_m_s + acceleration * FRAME_S).clamp(0.0, MAX_SPEED_M_S);
        let new_acceleration = [(speed - speed_m_s) / FRAME_S, speed * speed * road.at(arc_m).curvature];
        let [forward, left] = [0, 1].map(|axis| {
            let old = self.state.acceleration_m_s2[axis];
            old + SPRING * (new_acceleration[axis] - old)
        });
        self.state = CarState {
            time_s: self.state.time_s + FRAME_S,
            arc_m: arc_m + 0.5 * (speed_m_s + speed) * FRAME_S,
            speed_m_s: speed,
            acceleration_m_s2: [forward, left],
        };
        if self.standing == 0 && self.state.arc_m > self.stop_at_m - 1.0 && speed < 0.35 {
            self.standing = 8 + (self.random.uniform() * 15.0) as u32;
            self.stop_at_m = self.state.arc_m + self.random.between(120.0, 450.0);
        }
    }

    /// The fastest speed from which every bend and stop ahead can be met.
    fn wanted_speed(&self, road: &Road) -> f64 {
        let arc_m = self.state.arc_m;
        let bends = (0..=(LOOK_AHEAD_M / 4.0) as u32).map(|step| {
            let ahead_m = 4.0 * f64::from(step);
            let curvature = road.at(arc_m + ahead_m).curvature.abs();
            // The bend may begin right after the place looked at before.
            (MAX_LATERAL_M_S2 / curvature.max(1e-4) + 2.0 * BRAKING_M_S2 * (ahead_m - 4.0).max(0.0)).sqrt()
        });
        let stop = (2.0 * BRAKING_M_S2 * (self.stop_at_m - arc_m).max(0.0)).sqrt().max(0.3);
        bends.fold(self.cruise_m_s.min(stop), f64::min)
    }
}

/// Springs and dampers: how the body moves on its wheels.
#[derive(Clone, Debug)]
pub(super) struct Body {
    /// Phase and frequency (Hz) of pitch, roll and heave.
    waves: [[(f64, f64); 2]; 3],
}

impl Body {
    pub(super) fn new(seed: u64) -> Self {
        let mut random = Random::new(seed, Purpose::Motion, 1);
        let mut wave = |low, high| (random.between(0.0, std::f64::consts::TAU), random.between(low, high));
        Self { waves: std::array::from_fn(|_| [wave(0.2, 0.5), wave(0.8, 1.6)]) }
    }

    /// Pose of the vehicle (x forward, y left, z up) in the world (east, north, up) at a moment, and
    /// roll, pitch and yaw as in an OXTS packet.
    pub(super) fn pose(&self, state: &CarState, road: &Road) -> (Pose, [f64; 3]) {
        let point = road.at(state.arc_m);
        let sway = |waves: &[(f64, f64); 2]| -> f64 {
            let wave = |&(phase, hertz): &(f64, f64)| libm::sin(phase + std::f64::consts::TAU * hertz * state.time_s);
            0.6 * wave(&waves[0]) + 0.4 * wave(&waves[1])
        };
        // A car at rest does not sway.
        let liveliness = state.speed_m_s / (state.speed_m_s + 3.0);
        let [forward, left] = state.acceleration_m_s2;
        // Braking lowers the nose, which is a positive rotation about the axis to the left.
        let pitch = 0.012 * liveliness * sway(&self.waves[0]) - 0.004 * forward;
        let roll = 0.012 * liveliness * sway(&self.waves[1]) + 0.006 * left;
        let heave = 0.02 * liveliness * sway(&self.waves[2]);
        let position = point.beside(LANE_M);
        let translation = Vector3::new(position.x, position.y, ORIGIN_HEIGHT_M + heave);
        (Pose::new(euler(roll, pitch, point.heading_rad), translation), [roll, pitch, point.heading_rad])
    }
}

/// Rz(yaw) Ry(pitch) Rx(roll), as KITTI's packets mean it.
fn euler(roll: f64, pitch: f64, yaw: f64) -> Rotation3<f64> {
    let ((sr, cr), (sp, cp), (sy, cy)) = (libm::sincos(roll), libm::sincos(pitch), libm::sincos(yaw));
    Rotation3::from_matrix_unchecked(Matrix3::new(
        cy * cp,
        cy * sp * sr - sy * cr,
        cy * sp * cr + sy * sr,
        sy * cp,
        sy * sp * sr + cy * cr,
        sy * sp * cr - cy * sr,
        -sp,
        cp * sr,
        cp * cr,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_car_drives_stops_and_keeps_to_its_limits() {
        let (mut road, mut driver) = (Road::new(5), Driver::new(5));
        let (mut stopped, mut fast) = (0, 0);
        for _ in 0..3000 {
            let state = driver.state();
            road.cover(state.arc_m - 10.0, state.arc_m + 200.0);
            let lateral = state.speed_m_s.powi(2) * road.at(state.arc_m).curvature.abs();
            assert!(lateral < 1.5 * MAX_LATERAL_M_S2, "{lateral}");
            assert!((0.0..=MAX_SPEED_M_S).contains(&state.speed_m_s));
            stopped += u32::from(state.speed_m_s == 0.0);
            fast += u32::from(state.speed_m_s > 12.0);
            driver.advance(&road);
        }
        assert!((100..900).contains(&stopped) && fast > 300, "{stopped} {fast}");
    }

    #[test]
    fn euler_angles_are_nalgebras() {
        let ours = euler(0.1, -0.2, 0.7);
        assert!((ours.matrix() - Rotation3::from_euler_angles(0.1, -0.2, 0.7).matrix()).norm() < 1e-14);
    }
}
