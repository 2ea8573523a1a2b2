//! A drive through a street, moment by moment.

use nalgebra::Vector3;

use super::motion::{Body, CarState, Driver};
use super::random::{Purpose, Random, smooth};
use super::road::Road;
use super::scene::Scene;
use super::settings::SyntheticSettings;
use super::shading::Light;
use super::street::{MovingCar, Street};
use crate::geometry::Pose;

/// Moments of an exposure that are averaged into motion blur, in shutter times from its middle; the
/// first is where depth and pose are true.
const BLUR_MOMENTS: [f64; 5] = [0.0, -0.4, -0.2, 0.2, 0.4];

/// Everything at the time of a frame.
pub(super) struct Moment {
    pub frame: usize,
    pub state: CarState,
    pub world_from_vehicle: Pose,
    /// Roll, pitch, yaw, rad.
    pub attitude: [f64; 3],
    /// rad/s, positive to the left.
    pub yaw_rate_rad_s: f64,
    /// `world_from_vehicle` while the shutter is open, the first in its middle.
    pub exposed_world_from_vehicle: Vec<Pose>,
    pub scene: Scene,
    pub moving: Vec<MovingCar>,
    pub light: Light,
    /// Gain of the camera.
    pub gain: f64,
}

/// A street and the car that drives it.
pub(super) struct World {
    seed: u64,
    settings: SyntheticSettings,
    street: Street,
    road: Road,
    driver: Driver,
    body: Body,
    towards_sun: Vector3<f64>,
    next_frame: usize,
}

impl World {
    /// The world of a drive; drives of one data set have seeds of their own.
    pub(super) fn new(settings: &SyntheticSettings, drive: usize) -> Self {
        let seed = Random::new(settings.seed, Purpose::Recording, drive as u64).bits();
        let mut random = Random::new(seed, Purpose::Exposure, 0);
        let (azimuth, elevation) = (random.between(0.0, std::f64::consts::TAU), random.between(0.4, 1.1));
        let ((sin_a, cos_a), (sin_e, cos_e)) = (libm::sincos(azimuth), libm::sincos(elevation));
        Self {
            seed,
            settings: settings.clone(),
            street: Street { seed },
            road: Road::new(seed),
            driver: Driver::new(seed),
            body: Body::new(seed),
            towards_sun: Vector3::new(cos_e * cos_a, cos_e * sin_a, sin_e),
            next_frame: 0,
        }
    }

    /// Seed of this drive's world.
    pub(super) fn seed(&self) -> u64 {
        self.seed
    }

    /// The next frame's moment.
    pub(super) fn next_moment(&mut self) -> Moment {
        let state = self.driver.state();
        Street::cover(&mut self.road, &state);
        let (world_from_vehicle, attitude) = self.body.pose(&state, &self.road);
        let blurred = self.settings.shutter_s > 0.0;
        let moments = if blurred { &BLUR_MOMENTS[..] } else { &BLUR_MOMENTS[..1] };
        let exposed_world_from_vehicle = moments.iter().map(|&part| {
            let later_s = part * self.settings.shutter_s;
            let later =
                CarState { time_s: state.time_s + later_s, arc_m: state.arc_m + later_s * state.speed_m_s, ..state };
            self.body.pose(&later, &self.road).0
        });
        let exposed_world_from_vehicle = exposed_world_from_vehicle.collect();
        let (scene, moving) = self.street.scene(&self.road, &state);
        let sun = (0.6 + 0.8 * smooth(self.seed ^ 0x50, state.time_s / 8.0)).clamp(0.0, 1.0);
        let mut random = Random::new(self.seed, Purpose::Exposure, 1 + self.next_frame as u64);
        let drift = 0.1 * smooth(self.seed ^ 0xe7, state.time_s / 4.0);
        let gain = 1.15 * (1.0 + drift + self.settings.exposure_jitter * random.normal()) / (0.75 + 0.4 * sun);
        let moment = Moment {
            frame: self.next_frame,
            state,
            world_from_vehicle,
            attitude,
            yaw_rate_rad_s: state.speed_m_s * self.road.at(state.arc_m).curvature,
            exposed_world_from_vehicle,
            scene,
            moving,
            light: Light { towards_sun: self.towards_sun, sun },
            gain,
        };
        self.driver.advance(&self.road);
        self.next_frame += 1;
        moment
    }
}
