//! What surfaces look like: colours averaged over the footprint of a pixel.

use nalgebra::{Vector2, Vector3};

use super::random::{mix, uniform_of};
use super::road::ROAD_HALF_M;
use super::scene::{Hit, Ray, Scene, Shape, Thing};
use super::surface::{Surface, richness_at};
use super::texture::{Noise, band, stripes};

/// Linear colour, 1 = white paper in full light.
pub(super) type Colour = Vector3<f64>;

/// From here to the houses: the pavement, m from the centreline.
const PAVEMENT_M: f64 = 5.8;

/// Light of a moment.
#[derive(Clone, Copy, Debug)]
pub(super) struct Light {
    /// Unit vector towards the sun.
    pub towards_sun: Vector3<f64>,
    /// 0 (overcast) to 1 (clear).
    pub sun: f64,
}

/// A point of a surface, in coordinates of the surface, with the footprint of a pixel in them.
struct Spot {
    at: [f64; 2],
    width: [f64; 2],
}

/// The part of a ray's neighbourhood that a pixel covers: how its direction changes by a pixel to the
/// right and down.
#[derive(Clone, Copy, Debug)]
pub(super) struct PixelCone {
    pub right: Vector3<f64>,
    pub down: Vector3<f64>,
}

impl PixelCone {
    /// Footprint of the pixel along two directions of the surface it hits.
    fn widths(&self, ray: &Ray, hit: &Hit, axes: [Vector3<f64>; 2]) -> [f64; 2] {
        let facing = ray.direction.dot(&hit.normal);
        let facing = if facing.abs() < 1e-3 { -1e-3 } else { facing };
        let on_surface =
            |change: &Vector3<f64>| hit.distance * (change - ray.direction * (change.dot(&hit.normal) / facing));
        let (right, down) = (on_surface(&self.right), on_surface(&self.down));
        axes.map(|axis| right.dot(&axis).abs() + down.dot(&axis).abs())
    }
}

/// Colour of what a ray sees.
pub(super) fn shade(scene: &Scene, light: &Light, ray: &Ray, cone: &PixelCone, hit: Option<&Hit>) -> Colour {
    let Some(hit) = hit else { return sky(&ray.direction, light) };
    let albedo = albedo(scene, ray, cone, hit);
    let lit = 0.45 + 0.25 * (1.0 - light.sun) + 0.6 * light.sun * hit.normal.dot(&light.towards_sun).max(0.0);
    // Haze takes over far away.
    let metres = hit.distance * ray.direction.norm();
    let haze = metres * metres / (metres * metres + 220.0 * 220.0);
    albedo * (lit * (1.0 - haze)) + Colour::new(0.62, 0.67, 0.72) * (haze * (0.8 + 0.3 * light.sun))
}

/// Share of light a surface gives back.
pub(super) fn albedo(scene: &Scene, ray: &Ray, cone: &PixelCone, hit: &Hit) -> Colour {
    let point = ray.at(hit.distance);
    match hit.thing {
        None => ground(scene, ray, cone, hit, &point),
        Some(index) => {
            let thing = &scene.things[index];
            thing_albedo(thing, &spot_on(thing, ray, cone, hit, &point), &hit.normal)
        }
    }
}

/// Surface coordinates: along the wall and up; for columns around and up; on top of things east and north.
fn spot_on(thing: &Thing, ray: &Ray, cone: &PixelCone, hit: &Hit, point: &Vector3<f64>) -> Spot {
    let (at, axes) = match thing.shape {
        Shape::Block { centre, along, .. } => {
            let offset = point.xy() - centre;
            let across = Vector2::new(-along.y, along.x);
            let flat = |v: Vector2<f64>| Vector3::new(v.x, v.y, 0.0);
            if hit.normal.z.abs() > 0.5 {
                ([offset.dot(&along), offset.dot(&across)], [flat(along), flat(across)])
            } else if hit.normal.xy().dot(&across).abs() > 0.5 {
                ([offset.dot(&along), point.z], [flat(along), Vector3::z()])
            } else {
                ([offset.dot(&across), point.z], [flat(across), Vector3::z()])
            }
        }
        Shape::Column { radius, .. } => {
            let around = Vector3::new(-hit.normal.y, hit.normal.x, 0.0);
            ([radius * libm::atan2(hit.normal.y, hit.normal.x), point.z], [around, Vector3::z()])
        }
        Shape::Crown { centre, .. } => {
            let offset = point - centre;
            ([offset.x + 0.7 * offset.y, offset.z - 0.6 * offset.y], [Vector3::new(0.8, 0.6, 0.0), Vector3::z()])
        }
    };
    Spot { at, width: cone.widths(ray, hit, axes) }
}

/// Noise with cells of `cell_m`, from a part of the table that belongs to `key`.
fn noise(spot: &Spot, cell_m: f64, key: u64) -> f64 {
    let shift = [256.0 * uniform_of(key), 256.0 * uniform_of(key ^ 0x5bd1)];
    Noise::table().sample(
        [spot.at[0] / cell_m + shift[0], spot.at[1] / cell_m + shift[1]],
        [spot.width[0] / cell_m, spot.width[1] / cell_m],
    )
}

fn thing_albedo(thing: &Thing, spot: &Spot, normal: &Vector3<f64>) -> Colour {
    let [u, v] = spot.at;
    let [width_u, width_v] = spot.width;
    match thing.surface {
        Surface::Facade { colour, richness, window_m } => {
            let (richness, period) = (f64::from(richness), f64::from(window_m));
            let plaster = 1.0 + (0.05 + 0.22 * richness) * noise(spot, 0.06, thing.key);
            let wall = tint(colour) * plaster.clamp(0.3, 1.7);
            if normal.z > 0.5 {
                return wall * 0.6;
            }
            let window = |inset: f64| {
                stripes(u, period, inset * period, (1.0 - inset) * period, width_u)
                    * stripes(v - 0.6, 3.0, 3.0 * inset, 3.0 * (1.0 - inset), width_v)
            };
            let (frame, pane) = (window(0.24), window(0.28));
            // Each pane reflects something else.
            let field = |position: f64, period: f64| (position / period).floor() as i64 as u64;
            let own = uniform_of(thing.key ^ mix(field(u, period)) ^ field(v - 0.6, 3.0));
            let sharp = 1.0 / (1.0 + width_u * width_u / (period * period));
            let glass = Colour::new(0.10, 0.13, 0.17) * (1.0 + 1.6 * sharp * own);
            let show = 0.12 + 0.88 * richness;
            let painted = wall + (Colour::repeat(0.75) - wall) * (show * (frame - pane).max(0.0));
            painted + (glass - painted) * (show * pane)
        }
        Surface::Leaves { brightness } => {
            let light = f64::from(brightness) * (1.0 + 0.45 * noise(spot, 0.10, thing.key)).max(0.15);
            Colour::new(0.16, 0.30, 0.10) * light
        }
        Surface::Bark => Colour::new(0.24, 0.18, 0.13) * (1.0 + 0.3 * noise(spot, 0.03, thing.key)).max(0.2),
        Surface::Pole => Colour::repeat(0.42) * (1.0 + 0.12 * noise(spot, 0.05, thing.key)).max(0.2),
        Surface::CarBody { colour } => {
            let wheels = stripes(u + 1.7, 2.6, 0.0, 0.62, width_u) * band(v, 0.0, 0.62, width_v);
            let sides = if normal.z > 0.5 { 0.0 } else { wheels };
            let lights = if normal.z > 0.5 {
                0.0
            } else {
                0.5 * stripes(u, 1.3, 0.0, 0.2, width_u) * band(v, 0.6, 0.75, width_v)
            };
            let paint = tint(colour) * (1.0 + 0.04 * noise(spot, 0.12, thing.key));
            let body = paint + (Colour::repeat(0.05) - paint) * sides;
            body + (Colour::new(0.8, 0.7, 0.6) - body) * lights
        }
        Surface::CarCabin { colour } => {
            if normal.z > 0.5 {
                return tint(colour);
            }
            let pane = stripes(u + 0.5, 1.0, 0.08, 0.92, width_u) * band(v, 0.85, 1.35, width_v);
            tint(colour) + (Colour::new(0.08, 0.10, 0.13) - tint(colour)) * pane
        }
    }
}

/// Carriageway with marks, parking strip, pavement, and what lies beyond; in coordinates along the
/// road and across it.
fn ground(scene: &Scene, ray: &Ray, cone: &PixelCone, hit: &Hit, point: &Vector3<f64>) -> Colour {
    let place = point.xy();
    let nearest = scene
        .road
        .iter()
        .filter_map(|segment| segment.coordinates(&place).map(|(s, d)| (s, d, segment)))
        .min_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
    let world_axes = [Vector3::x(), Vector3::y()];
    let world = Spot { at: [place.x, place.y], width: cone.widths(ray, hit, world_axes) };
    let earth = || Colour::new(0.30, 0.31, 0.20) * (1.0 + 0.35 * noise(&world, 0.12, 11)).max(0.2);
    let Some((s, d, segment)) = nearest else { return earth() };
    let along = segment.direction_at(s);
    let across = Vector2::new(-along.y, along.x);
    let axes = [along, across].map(|axis| Vector3::new(axis.x, axis.y, 0.0));
    let spot = Spot { at: [s, d], width: cone.widths(ray, hit, axes) };
    let [width_s, width_d] = spot.width;
    let richness = richness_at(scene.seed, s);

    let road = band(d, -ROAD_HALF_M, ROAD_HALF_M, width_d);
    let kerb = band(d.abs(), ROAD_HALF_M, ROAD_HALF_M + 0.25, width_d);
    let strip = band(d.abs(), ROAD_HALF_M + 0.25, PAVEMENT_M, width_d);
    let pavement = band(d.abs(), PAVEMENT_M, 8.0, width_d);
    let beyond = (1.0 - road - kerb - strip - pavement).max(0.0);

    let patches = noise(&world, 1.3, 7);
    let asphalt = 0.27 * (1.0 + 0.08 * patches + (0.04 + 0.26 * richness) * noise(&spot, 0.045, 5)).max(0.2);
    let dashes = stripes(s, 9.0, 0.0, 3.0, width_s) * band(d, -0.08, 0.08, width_d);
    let edges = band(d.abs(), 3.35, 3.47, width_d);
    let worn = 0.8 + 0.2 * richness;
    let marks = (dashes + edges).min(1.0) * worn;
    let mut colour = Colour::repeat((asphalt + (0.8 - asphalt) * marks) * road);
    colour += Colour::repeat(0.52 * kerb);
    if strip > 0.0 {
        let setts = 1.0 + (0.05 + 0.3 * richness) * noise(&spot, 0.09, 13);
        colour += Colour::new(0.33, 0.32, 0.31) * (strip * setts.max(0.2));
    }
    if pavement > 0.0 {
        let joints = stripes(s, 0.8, 0.0, 0.05, width_s).max(stripes(d, 0.8, 0.0, 0.05, width_d));
        let slabs = (1.0 - 0.5 * richness * joints) * (1.0 + (0.03 + 0.12 * richness) * noise(&spot, 0.06, 17));
        colour += Colour::new(0.46, 0.44, 0.42) * (pavement * slabs.max(0.2));
    }
    if beyond > 0.0 {
        colour += earth() * beyond;
    }
    colour * shade_at_feet(scene, &place)
}

/// Cars darken the ground beneath them.
fn shade_at_feet(scene: &Scene, place: &Vector2<f64>) -> f64 {
    let mut light: f64 = 1.0;
    for thing in scene.things_at(place) {
        if let (Surface::CarBody { .. }, Shape::Block { centre, along, half, .. }) = (&thing.surface, &thing.shape) {
            let offset = place - centre;
            let outside_along = (offset.dot(along).abs() - half[0]).max(0.0);
            let outside_across = (offset.dot(&Vector2::new(-along.y, along.x)).abs() - half[1]).max(0.0);
            let outside = (outside_along * outside_along + outside_across * outside_across).sqrt();
            light = light.min(0.35 + 0.65 * (outside / 0.6).min(1.0));
        }
    }
    light
}

fn sky(direction: &Vector3<f64>, light: &Light) -> Colour {
    let level = (direction.x * direction.x + direction.y * direction.y).sqrt().max(1e-9);
    let rise = (direction.z / level).max(0.0);
    let height = rise / (rise + 0.35);
    let clear = Colour::new(0.78, 0.83, 0.88) * (1.0 - height) + Colour::new(0.38, 0.55, 0.82) * height;
    let overcast = Colour::repeat(0.78);
    // Clouds lie in a plane high above.
    let scale = 1.0 / (rise + 0.08);
    let spot = Spot { at: [direction.x / level * scale, direction.y / level * scale], width: [0.05 * scale; 2] };
    let clouds = (0.5 + 0.35 * noise(&spot, 0.12, 23)).clamp(0.0, 1.0) * (1.0 - 0.6 * light.sun);
    (clear + (overcast - clear) * clouds) * (0.85 + 0.3 * light.sun)
}

fn tint(colour: [f32; 3]) -> Colour {
    Colour::from(colour.map(f64::from))
}
