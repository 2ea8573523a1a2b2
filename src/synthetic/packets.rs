//! GNSS/INS packets and times, as KITTI's files hold them.

use nalgebra::Vector3;

use super::motion::{FRAME_S, LANE_M};
use super::world::Moment;
use crate::recordings::EARTH_RADIUS_M;

/// Where a drive begins, degrees and metres.
const LATITUDE_DEG: f64 = 49.0;
const LONGITUDE_DEG: f64 = 8.4;
const ALTITUDE_M: f64 = 115.0;

/// The text of a packet: 30 numbers. The inverse of the Mercator projection in
/// [`world_from_vehicle`](crate::recordings::world_from_vehicle); the drive begins at `start`.
pub(super) fn packet(moment: &Moment, start: &Vector3<f64>) -> String {
    let position = moment.world_from_vehicle.translation - start;
    let scaled_radius = libm::cos(LATITUDE_DEG.to_radians()) * EARTH_RADIUS_M;
    let north = libm::log(libm::tan((90.0 + LATITUDE_DEG) * std::f64::consts::PI / 360.0)) + position.y / scaled_radius;
    let latitude = libm::atan(libm::exp(north)) * 360.0 / std::f64::consts::PI - 90.0;
    let longitude = LONGITUDE_DEG + (position.x / scaled_radius).to_degrees();
    let [roll, pitch, yaw] = moment.attitude;
    // The car drives beside the centreline, on which its speed is counted.
    let speed = moment.state.speed_m_s - moment.yaw_rate_rad_s * LANE_M;
    let (sine, cosine) = libm::sincos(yaw);
    let [forward, left] = moment.state.acceleration_m_s2;
    let numbers = [
        latitude,
        longitude,
        ALTITUDE_M + position.z,
        roll,
        pitch,
        yaw,
        // Velocity north, east, forward, left, up.
        speed * sine,
        speed * cosine,
        speed,
        0.0,
        0.0,
        // Acceleration in the vehicle's axes, then forward, left, up.
        forward,
        left,
        9.81,
        forward,
        left,
        9.81,
        // Rates of turn in the same axes twice; the body's sway is left out.
        0.0,
        0.0,
        moment.yaw_rate_rad_s,
        0.0,
        0.0,
        moment.yaw_rate_rad_s,
        // Accuracy of position and velocity.
        0.01,
        0.01,
    ];
    let numbers: Vec<String> = numbers.iter().map(|value| format!("{value:.14}")).collect();
    // Navigation status, satellites, modes.
    format!("{} 4 12 6 6 6\n", numbers.join(" "))
}

/// A `timestamps.txt` of so many frames.
pub(super) fn timestamps(frames: usize) -> String {
    let line = |frame: usize| {
        let seconds = frame as f64 * FRAME_S;
        let (hours, minutes) = (12 + (seconds / 3600.0) as u64, (seconds / 60.0) as u64 % 60);
        format!("2026-01-{:02} {:02}:{minutes:02}:{:012.9}\n", 1 + hours / 24, hours % 24, seconds % 60.0)
    };
    (0..frames).map(line).collect()
}
