//! What stands around the car at one moment, and which of it a ray meets first.
//!
//! Things are upright blocks, columns and crowns on a flat road, in a grid of square cells that rays
//! walk through (Amanatides and Woo 1987).

use nalgebra::{Vector2, Vector3};

use super::road::Segment;
use super::surface::Surface;

/// Width of a grid cell, m.
const CELL_M: f64 = 8.0;
/// Cells along each side of the grid.
const CELLS: usize = 48;
/// Nothing is seen beyond this, m.
pub(super) const RANGE_M: f64 = 170.0;

/// A half-line; distances along it count in lengths of its direction.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub origin: Vector3<f64>,
    pub direction: Vector3<f64>,
}

impl Ray {
    pub(super) fn at(&self, distance: f64) -> Vector3<f64> {
        self.origin + distance * self.direction
    }
}

/// A solid.
#[derive(Clone, Copy, Debug)]
pub(super) enum Shape {
    /// An upright box: footprint `half` along `along` and across it.
    Block { centre: Vector2<f64>, along: Vector2<f64>, half: [f64; 2], low: f64, high: f64 },
    /// An upright cylinder without ends.
    Column { centre: Vector2<f64>, radius: f64, low: f64, high: f64 },
    /// An ellipsoid of revolution.
    Crown { centre: Vector3<f64>, radius: f64, half_height: f64 },
}

/// A solid with its looks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Thing {
    pub shape: Shape,
    pub surface: Surface,
    /// Tells it from all others; the parts of a car share one.
    pub key: u64,
}

/// Where a ray ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// In lengths of the ray's direction.
    pub distance: f64,
    /// Unit length, against the ray.
    pub normal: Vector3<f64>,
    /// Index of the thing; `None` is the ground.
    pub thing: Option<usize>,
}

/// Everything around the car at one moment.
pub(super) struct Scene {
    pub things: Vec<Thing>,
    /// The road's segments near by.
    pub road: Vec<Segment>,
    /// Seed of the street.
    pub seed: u64,
    corner: Vector2<f64>,
    /// For each cell the end of its part of `listed`.
    ends: Vec<u32>,
    listed: Vec<u32>,
    top_m: f64,
}

impl Scene {
    /// A scene around a place.
    pub(super) fn new(centre: Vector2<f64>, seed: u64, things: Vec<Thing>, road: Vec<Segment>) -> Self {
        let corner = centre.map(|value| (value / CELL_M).floor() * CELL_M - 0.5 * CELLS as f64 * CELL_M);
        let mut cells: Vec<Vec<u32>> = vec![Vec::new(); CELLS * CELLS];
        for (index, thing) in things.iter().enumerate() {
            let (low, high) = thing.shape.footprint();
            let cell = |value: f64| ((value / CELL_M).floor().max(0.0) as usize).min(CELLS - 1);
            let (low, high) = (low - corner, high - corner);
            let size = CELL_M * CELLS as f64;
            if high.min() < 0.0 || low.max() >= size {
                continue;
            }
            for row in cell(low.y)..=cell(high.y) {
                for column in cell(low.x)..=cell(high.x) {
                    cells[row * CELLS + column].push(index as u32);
                }
            }
        }
        let mut listed = Vec::new();
        let ends = cells.into_iter().map(|cell| {
            listed.extend(cell);
            listed.len() as u32
        });
        let ends = ends.collect();
        let top_m = things.iter().map(|thing| thing.shape.top()).fold(0.0, f64::max);
        Self { things, road, seed, corner, ends, listed, top_m }
    }

    /// The first thing a ray meets within [`RANGE_M`], or the ground.
    pub(super) fn cast(&self, ray: &Ray) -> Option<Hit> {
        let Ray { origin, direction } = ray;
        let ground = if direction.z < 0.0 { -origin.z / direction.z } else { f64::INFINITY };
        let range = RANGE_M / direction.norm();
        let sky = if direction.z > 0.0 { (self.top_m - origin.z) / direction.z } else { f64::INFINITY };
        let end = ground.min(range).min(sky);
        if let Some(hit) = self.cast_at_things(ray, end) {
            return Some(hit);
        }
        (ground < range).then(|| Hit { distance: ground, normal: Vector3::z(), thing: None })
    }

    fn cast_at_things(&self, ray: &Ray, end: f64) -> Option<Hit> {
        let start = ray.origin.xy() - self.corner;
        let direction = ray.direction.xy();
        let inverse = direction.map(|value| 1.0 / value);
        let mut cell = start.map(|value| (value / CELL_M).floor() as i64);
        let step = direction.map(|value| if value < 0.0 { -1 } else { 1 });
        // Distance at which the ray leaves the cell through each axis; infinite for an axis it runs along.
        let border = |axis: usize, cell: i64| {
            let edge = (cell + i64::from(direction[axis] >= 0.0)) as f64 * CELL_M;
            if direction[axis] == 0.0 { f64::INFINITY } else { (edge - start[axis]) * inverse[axis] }
        };
        let mut leaves = [border(0, cell.x), border(1, cell.y)];
        let mut best: Option<Hit> = None;
        let mut tested = u32::MAX;
        loop {
            if cell.min() < 0 || cell.max() >= CELLS as i64 {
                return best;
            }
            let index = cell.y as usize * CELLS + cell.x as usize;
            let first = if index == 0 { 0 } else { self.ends[index - 1] as usize };
            for &thing in &self.listed[first..self.ends[index] as usize] {
                if thing == tested {
                    continue;
                }
                tested = thing;
                let nearest = best.map_or(end, |hit| hit.distance);
                if let Some((distance, normal)) = self.things[thing as usize].shape.cast(ray, nearest) {
                    best = Some(Hit { distance, normal, thing: Some(thing as usize) });
                }
            }
            let axis = usize::from(leaves[1] < leaves[0]);
            let nearest = best.map_or(end, |hit| hit.distance);
            if leaves[axis] >= nearest {
                return best;
            }
            cell[axis] += step[axis];
            leaves[axis] = border(axis, cell[axis]);
        }
    }

    /// Whether nothing stands between two points.
    pub(super) fn sees(&self, from: &Vector3<f64>, to: &Vector3<f64>) -> bool {
        let ray = Ray { origin: *from, direction: to - from };
        // A hit within two centimetres is the point's own surface.
        let margin = 0.02 / ray.direction.norm();
        self.cast(&ray).is_none_or(|hit| hit.distance > 1.0 - margin)
    }

    /// Things with their footprint near a place, for the shade they throw at their feet.
    pub(super) fn things_at(&self, place: &Vector2<f64>) -> impl Iterator<Item = &Thing> {
        let cell = (place - self.corner).map(|value| (value / CELL_M).floor() as i64);
        let inside = cell.min() >= 0 && cell.max() < CELLS as i64;
        let index = if inside { cell.y as usize * CELLS + cell.x as usize } else { 0 };
        let first = if index == 0 { 0 } else { self.ends[index - 1] as usize };
        let range = if inside { first..self.ends[index] as usize } else { 0..0 };
        self.listed[range].iter().map(|&thing| &self.things[thing as usize])
    }
}

impl Shape {
    /// Corners of the bounding rectangle on the ground.
    fn footprint(&self) -> (Vector2<f64>, Vector2<f64>) {
        match self {
            Self::Block { centre, along, half, .. } => {
                let reach = along.abs() * half[0] + Vector2::new(along.y.abs(), along.x.abs()) * half[1];
                (centre - reach, centre + reach)
            }
            Self::Column { centre, radius, .. } => (centre.add_scalar(-radius), centre.add_scalar(*radius)),
            Self::Crown { centre, radius, .. } => (centre.xy().add_scalar(-radius), centre.xy().add_scalar(*radius)),
        }
    }

    fn top(&self) -> f64 {
        match self {
            Self::Block { high, .. } | Self::Column { high, .. } => *high,
            Self::Crown { centre, half_height, .. } => centre.z + half_height,
        }
    }

    /// Distance and normal where a ray enters, if before `end`.
    fn cast(&self, ray: &Ray, end: f64) -> Option<(f64, Vector3<f64>)> {
        match self {
            Self::Block { centre, along, half, low, high } => {
                let across = Vector2::new(-along.y, along.x);
                let offset = ray.origin.xy() - centre;
                let direction = ray.direction.xy();
                let slab = |offset: f64, direction: f64, low: f64, high: f64| {
                    let inverse = 1.0 / direction;
                    let (a, b) = ((low - offset) * inverse, (high - offset) * inverse);
                    (a.min(b), a.max(b))
                };
                let (in_along, out_along) = slab(offset.dot(along), direction.dot(along), -half[0], half[0]);
                let (in_across, out_across) = slab(offset.dot(&across), direction.dot(&across), -half[1], half[1]);
                let (in_up, out_up) = slab(ray.origin.z, ray.direction.z, *low, *high);
                let enter = in_along.max(in_across).max(in_up);
                if !(enter > 0.0 && enter < end && enter <= out_along.min(out_across).min(out_up)) {
                    return None;
                }
                let normal = if enter == in_up {
                    Vector3::z() * -ray.direction.z.signum()
                } else {
                    let axis = if enter == in_along { *along } else { across };
                    let outwards = axis * -direction.dot(&axis).signum();
                    Vector3::new(outwards.x, outwards.y, 0.0)
                };
                Some((enter, normal))
            }
            Self::Column { centre, radius, low, high } => {
                let offset = ray.origin.xy() - centre;
                let direction = ray.direction.xy();
                let distance = nearer_root(
                    direction.norm_squared(),
                    direction.dot(&offset),
                    offset.norm_squared() - radius * radius,
                )?;
                let height = ray.origin.z + distance * ray.direction.z;
                if !(distance < end && (*low..*high).contains(&height)) {
                    return None;
                }
                let outwards = (offset + distance * direction) / *radius;
                Some((distance, Vector3::new(outwards.x, outwards.y, 0.0)))
            }
            Self::Crown { centre, radius, half_height } => {
                let squeeze = |v: Vector3<f64>| Vector3::new(v.x, v.y, v.z * radius / half_height);
                let (offset, direction) = (squeeze(ray.origin - centre), squeeze(ray.direction));
                let distance = nearer_root(
                    direction.norm_squared(),
                    direction.dot(&offset),
                    offset.norm_squared() - radius * radius,
                )?;
                (distance < end).then(|| (distance, squeeze(offset + distance * direction).normalize()))
            }
        }
    }
}

/// The smaller root of `a t² + 2 b t + c = 0`, if positive.
fn nearer_root(a: f64, b: f64, c: f64) -> Option<f64> {
    let discriminant = b * b - a * c;
    if discriminant <= 0.0 {
        return None;
    }
    let root = (-b - discriminant.sqrt()) / a;
    (root > 0.0).then_some(root)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(shapes: &[Shape]) -> Scene {
        let thing = |(key, &shape): (usize, &Shape)| Thing { shape, surface: Surface::Pole, key: key as u64 };
        Scene::new(Vector2::zeros(), 0, shapes.iter().enumerate().map(thing).collect(), Vec::new())
    }

    #[test]
    fn rays_meet_what_stands_nearest() {
        let scene = scene(&[
            Shape::Block {
                centre: Vector2::new(30.0, 0.0),
                along: Vector2::new(0.6, 0.8),
                half: [3.0, 2.0],
                low: 0.0,
                high: 5.0,
            },
            Shape::Column { centre: Vector2::new(20.0, 0.0), radius: 0.5, low: 0.0, high: 4.0 },
            Shape::Crown { centre: Vector3::new(20.0, 0.0, 6.0), radius: 2.0, half_height: 1.5 },
        ]);
        let cast = |x, y, z| {
            let hit = scene.cast(&Ray { origin: Vector3::new(0.0, 0.0, 1.0), direction: Vector3::new(x, y, z) });
            hit.map(|hit| (hit.thing, hit.distance))
        };
        assert_eq!(cast(1.0, 0.0, 0.0), Some((Some(1), 19.5)));
        assert_eq!(cast(2.0, 0.0, 0.0), Some((Some(1), 9.75)));
        assert_eq!(cast(1.0, 0.0, 0.25).unwrap().0, Some(2));
        assert_eq!(cast(1.0, 0.04, 0.0).unwrap().0, Some(0));
        assert_eq!(cast(1.0, 0.0, -0.1), Some((None, 10.0)));
        assert_eq!(cast(-1.0, 0.3, 0.01), None);
        assert!(scene.sees(&Vector3::new(0.0, 0.0, 1.0), &Vector3::new(19.5, 0.0, 1.0)));
        assert!(!scene.sees(&Vector3::new(0.0, 0.0, 1.0), &Vector3::new(25.0, 0.0, 1.0)));
    }

    #[test]
    fn the_grid_finds_what_a_search_of_all_things_finds() {
        use super::super::random::{Purpose, Random};
        let mut random = Random::new(4, Purpose::Street, 0);
        let mut place = || Vector2::new(random.between(-90.0, 90.0), random.between(-90.0, 90.0));
        let places: Vec<Vector2<f64>> = (0..120).map(|_| place()).collect();
        let shapes: Vec<Shape> = places
            .iter()
            .enumerate()
            .map(|(index, &centre)| match index % 3 {
                0 => Shape::Block { centre, along: Vector2::new(0.28, 0.96), half: [7.0, 2.0], low: 0.0, high: 6.0 },
                1 => Shape::Column { centre, radius: 0.8, low: 0.0, high: 5.0 },
                _ => Shape::Crown { centre: Vector3::new(centre.x, centre.y, 3.0), radius: 2.5, half_height: 2.0 },
            })
            .collect();
        let scene = scene(&shapes);
        let mut hits = 0;
        for _ in 0..3000 {
            let direction = Vector3::new(random.normal(), random.normal(), 0.1 * random.normal());
            let ray = Ray { origin: Vector3::new(0.3, 0.2, 1.7), direction };
            let found = scene.cast_at_things(&ray, 100.0).map(|hit| hit.distance);
            let all = shapes.iter().filter_map(|shape| shape.cast(&ray, 100.0)).map(|(distance, _)| distance);
            assert_eq!(found, all.min_by(f64::total_cmp));
            hits += usize::from(found.is_some());
        }
        assert!(hits > 500, "{hits}");
    }
}
