//! KITTI's GNSS/INS packets and the poses they give.

use std::path::Path;

use nalgebra::{Rotation3, Vector3};

use crate::error::{Error, Place, Result};
use crate::files::{parse_numbers, read_text};
use crate::geometry::Pose;

/// Radius of the Mercator sphere, m (KITTI development kit).
pub(crate) const EARTH_RADIUS_M: f64 = 6_378_137.0;
/// Values in a packet.
const PACKET_VALUES: usize = 30;

/// Position and attitude of the IMU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OxtsPacket {
    /// Degrees.
    pub latitude_deg: f64,
    /// Degrees.
    pub longitude_deg: f64,
    /// Metres.
    pub altitude_m: f64,
    /// Rotation about x (forward).
    pub roll_rad: f64,
    /// Rotation about y (left).
    pub pitch_rad: f64,
    /// Rotation about z (up), 0 = east.
    pub yaw_rad: f64,
}

impl OxtsPacket {
    /// Reads one packet file.
    ///
    /// # Errors
    /// Not 30 finite numbers, a latitude no Mercator projection has, or no fix yet.
    pub fn load(path: &Path) -> Result<Self> {
        let text = read_text(path)?;
        let place = Place::Line(1);
        let values = parse_numbers(&text, path, &place)?;
        if values.len() != PACKET_VALUES {
            let found = format!("{} values", values.len());
            return Err(Error::malformed(path, place, found, format!("{PACKET_VALUES} values of an OXTS packet")));
        }
        let packet = Self {
            latitude_deg: values[0],
            longitude_deg: values[1],
            altitude_m: values[2],
            roll_rad: values[3],
            pitch_rad: values[4],
            yaw_rad: values[5],
        };
        if packet.latitude_deg == 0.0 && packet.longitude_deg == 0.0 {
            let found = "latitude 0, longitude 0";
            return Err(Error::malformed(path, place, found, "a position; the receiver had no fix yet"));
        }
        let angles = [packet.roll_rad, packet.pitch_rad, packet.yaw_rad];
        if angles.iter().any(|angle| angle.abs() > std::f64::consts::TAU) {
            let found = format!("roll, pitch, yaw {angles:?}");
            return Err(Error::malformed(path, place, found, "radians; degrees are to be converted"));
        }
        if packet.latitude_deg.abs() >= 89.0 || packet.longitude_deg.abs() > 360.0 {
            let found = format!("latitude {}, longitude {}", packet.latitude_deg, packet.longitude_deg);
            return Err(Error::malformed(path, place, found, "degrees between the poles"));
        }
        Ok(packet)
    }

    /// The packet with its longitude told within half a turn of another's: no step of a drive is a journey round the globe.
    pub fn beside(self, other: &Self) -> Self {
        let turned = (self.longitude_deg - other.longitude_deg + 180.0).rem_euclid(360.0) - 180.0;
        match (self.longitude_deg - other.longitude_deg).abs() > 180.0 {
            true => Self { longitude_deg: other.longitude_deg + turned, ..self },
            false => self,
        }
    }

    /// Mercator scale of a drive: the cosine of its first latitude.
    pub fn mercator_scale(&self) -> f64 {
        self.latitude_deg.to_radians().cos()
    }
}

/// Pose of the vehicle (IMU) in a world of east, north, up.
///
/// KITTI development kit, `convertOxtsToPose`; the world's origin is far away, so only relative
/// poses and rotations mean something.
pub fn world_from_vehicle(packet: &OxtsPacket, mercator_scale: f64) -> Pose {
    let scaled_radius = mercator_scale * EARTH_RADIUS_M;
    let translation = Vector3::new(
        scaled_radius * packet.longitude_deg.to_radians(),
        scaled_radius * ((90.0 + packet.latitude_deg) * std::f64::consts::PI / 360.0).tan().ln(),
        packet.altitude_m,
    );
    // Rz(yaw) Ry(pitch) Rx(roll)
    let rotation = Rotation3::from_euler_angles(packet.roll_rad, packet.pitch_rad, packet.yaw_rad);
    Pose::new(rotation, translation)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    const PACKET: OxtsPacket = OxtsPacket {
        latitude_deg: 49.0,
        longitude_deg: 8.4,
        altitude_m: 115.0,
        roll_rad: 0.02,
        pitch_rad: -0.01,
        yaw_rad: 0.7,
    };

    #[test]
    fn a_millidegree_of_latitude_is_111_metres_north() {
        let scale = PACKET.mercator_scale();
        let north = OxtsPacket { latitude_deg: PACKET.latitude_deg + 1e-3, ..PACKET };
        let step = world_from_vehicle(&north, scale).translation - world_from_vehicle(&PACKET, scale).translation;
        assert_relative_eq!(step.y, 111.32, epsilon = 0.01);
        assert_relative_eq!(step.x, 0.0, epsilon = 1e-9);
    }

    #[test]
    fn the_date_line_is_no_wall() {
        let west = OxtsPacket { longitude_deg: -179.99999, ..PACKET };
        let east = OxtsPacket { longitude_deg: 179.99999, ..PACKET };
        let scale = PACKET.mercator_scale();
        for (from, to, metres) in [(east, west, 1.4607), (west, east, -1.4607)] {
            let step =
                world_from_vehicle(&to.beside(&from), scale).translation - world_from_vehicle(&from, scale).translation;
            // 2e-5 degrees of a circle of latitude of 2π 6378137 m cos 49°.
            assert_relative_eq!(step.x, metres, epsilon = 1e-4);
        }
        assert_eq!(PACKET.beside(&OxtsPacket { longitude_deg: 8.3, ..PACKET }), PACKET);
    }

    #[test]
    fn yaw_turns_the_forward_axis_from_east_to_north() {
        let level = OxtsPacket { roll_rad: 0.0, pitch_rad: 0.0, yaw_rad: std::f64::consts::FRAC_PI_2, ..PACKET };
        let forward = world_from_vehicle(&level, 1.0).rotation * Vector3::x();
        assert_relative_eq!(forward, Vector3::y(), epsilon = 1e-12);
    }
}
