//! Renders what the sensors see: colour images with depth, and LiDAR scans.

use nalgebra::Vector3;

use super::random::{Purpose, Random, mix};
use super::scene::{Hit, Ray, Scene};
use super::shading::{Colour, Light, PixelCone, albedo, shade};
use crate::depth::DepthMap;
use crate::geometry::{Pinhole, Pose};

/// Rays of a pixel on an edge, along each axis.
const EDGE_RAYS: usize = 2;
/// LiDAR: beams, their highest and lowest elevation, range, and noise, as of KITTI's HDL-64E.
const BEAMS: usize = 64;
const ELEVATION_DEG: [f64; 2] = [2.0, -24.8];
const LIDAR_RANGE_M: f64 = 120.0;
const LIDAR_NOISE_M: f64 = 0.02;
/// Share of beams that do not come back.
const LIDAR_LOSS: f64 = 0.03;

/// A camera in the world.
#[derive(Clone, Copy)]
pub(super) struct View<'a> {
    pub scene: &'a Scene,
    pub light: &'a Light,
    pub camera: Pinhole,
    pub world_from_camera: Pose,
}

impl View<'_> {
    /// The ray through a pixel; distances along it are depths.
    pub(super) fn ray(&self, u: f64, v: f64) -> Ray {
        let direction = Vector3::new((u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy, 1.0);
        Ray { origin: self.world_from_camera.translation, direction: self.world_from_camera.rotation * direction }
    }

    /// What a pixel covers, in parts of a pixel.
    pub(super) fn cone(&self, pixels: f64) -> PixelCone {
        let rotation = &self.world_from_camera.rotation;
        PixelCone {
            right: rotation * Vector3::new(pixels / self.camera.fx, 0.0, 0.0),
            down: rotation * Vector3::new(0.0, pixels / self.camera.fy, 0.0),
        }
    }

    /// Colours of all pixels, row by row, and what each pixel's centre sees.
    fn render(&self) -> (Vec<Colour>, Vec<Option<Hit>>) {
        let Pinhole { width, height, .. } = self.camera;
        let whole = self.cone(1.0);
        let mut hits = Vec::with_capacity(width * height);
        let mut colours = Vec::with_capacity(width * height);
        for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
            let ray = self.ray(u as f64, v as f64);
            let hit = self.scene.cast(&ray);
            colours.push(shade(self.scene, self.light, &ray, &whole, hit.as_ref()));
            hits.push(hit);
        }
        // Where neighbours see different things an edge runs through the pixel.
        let part = self.cone(1.0 / EDGE_RAYS as f64);
        for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
            let pixel = v * width + u;
            let neighbours = [
                (u > 0).then(|| pixel - 1),
                (u + 1 < width).then(|| pixel + 1),
                (v > 0).then(|| pixel - width),
                (v + 1 < height).then(|| pixel + width),
            ];
            if neighbours.into_iter().flatten().any(|other| is_edge(&hits[pixel], &hits[other])) {
                let offset = |step: usize| (step as f64 + 0.5) / EDGE_RAYS as f64 - 0.5;
                let rays = (0..EDGE_RAYS * EDGE_RAYS)
                    .map(|k| self.ray(u as f64 + offset(k % EDGE_RAYS), v as f64 + offset(k / EDGE_RAYS)));
                let sum: Colour =
                    rays.map(|ray| shade(self.scene, self.light, &ray, &part, self.scene.cast(&ray).as_ref())).sum();
                colours[pixel] = sum / (EDGE_RAYS * EDGE_RAYS) as f64;
            }
        }
        (colours, hits)
    }
}

fn is_edge(a: &Option<Hit>, b: &Option<Hit>) -> bool {
    match (a, b) {
        (Some(a), Some(b)) => a.thing != b.thing || a.normal.dot(&b.normal) < 0.9,
        (None, None) => false,
        _ => true,
    }
}

/// What the camera makes of the light that reaches it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exposure {
    /// Brightness of linear colour.
    pub gain: f64,
    /// Standard deviation of a pixel's noise, grey levels.
    pub noise: f64,
    /// Tells the noise of images apart.
    pub key: u64,
}

/// An image of several views of one exposure (the moments of its motion blur; the first one's depth).
pub(super) fn photograph(views: &[View<'_>], exposure: &Exposure) -> (Vec<u8>, DepthMap) {
    let Pinhole { width, height, .. } = views[0].camera;
    let (mut colours, hits) = views[0].render();
    for view in &views[1..] {
        for (sum, colour) in colours.iter_mut().zip(view.render().0) {
            *sum += colour;
        }
    }
    let gain = exposure.gain / views.len() as f64;
    let bytes = colours.iter().enumerate().flat_map(|(pixel, colour)| {
        let random = mix(exposure.key ^ pixel as u64);
        // Gamma 2.
        [0, 1, 2].map(|channel| {
            let level = 255.0 * (gain * colour[channel]).clamp(0.0, 1.0).sqrt();
            let noise = exposure.noise * nearly_normal(random >> (16 * channel));
            (level + noise).round().clamp(0.0, 255.0) as u8
        })
    });
    let bytes = bytes.collect();
    let depth_m = hits.iter().map(|hit| hit.map_or(0.0, |hit| hit.distance as f32)).collect();
    (bytes, DepthMap { width, height, depth_m })
}

/// A number of variance 1 from 16 random bits: the sum of four uniform ones.
fn nearly_normal(bits: u64) -> f64 {
    let digits: u64 = (0..4).map(|digit| (bits >> (4 * digit)) & 15).sum();
    // Each digit has mean 7.5 and variance (16² − 1) / 12.
    (digits as f64 - 30.0) / 85.0_f64.sqrt()
}

/// Directions of all beams of a turn, unit length; x forward, y left, z up.
pub(super) fn beam_directions(steps: usize) -> Vec<Vector3<f64>> {
    let elevation = |beam: usize| {
        let share = beam as f64 / (BEAMS - 1) as f64;
        (ELEVATION_DEG[0] + share * (ELEVATION_DEG[1] - ELEVATION_DEG[0])).to_radians()
    };
    let beams = (0..BEAMS).flat_map(|beam| (0..steps).map(move |step| (beam, step)));
    let directions = beams.map(|(beam, step)| {
        let (sine, cosine) = libm::sincos(elevation(beam));
        // A turn begins at the back, clockwise.
        let (side, ahead) = libm::sincos(std::f64::consts::PI - std::f64::consts::TAU * step as f64 / steps as f64);
        Vector3::new(cosine * ahead, cosine * side, sine)
    });
    directions.collect()
}

/// A scan as KITTI stores it: x, y, z (m, LiDAR axes) and reflectance, little-endian f32.
pub(super) fn scan(
    scene: &Scene,
    world_from_velodyne: &Pose,
    beams: &[Vector3<f64>],
    seed: u64,
    frame: u64,
) -> Vec<u8> {
    let mut random = Random::new(seed, Purpose::Lidar, frame);
    let mut bytes = Vec::with_capacity(16 * beams.len());
    for beam in beams {
        let ray = Ray { origin: world_from_velodyne.translation, direction: world_from_velodyne.rotation * beam };
        let Some(hit) = scene.cast(&ray).filter(|hit| hit.distance < LIDAR_RANGE_M) else { continue };
        let (lost, noise) = (random.chance(LIDAR_LOSS), LIDAR_NOISE_M * random.normal());
        if lost {
            continue;
        }
        // A beam is some 2 mrad wide.
        let cone =
            PixelCone { right: Vector3::new(-ray.direction.y, ray.direction.x, 0.0) * 2e-3, down: Vector3::z() * 2e-3 };
        let colour = albedo(scene, &ray, &cone, &hit);
        let reflectance = ((colour.x + colour.y + colour.z) / 3.0).clamp(0.0, 1.0);
        let point = beam * (hit.distance + noise);
        for value in [point.x, point.y, point.z, (reflectance * 100.0).round() / 100.0] {
            bytes.extend((value as f32).to_le_bytes());
        }
    }
    bytes
}
