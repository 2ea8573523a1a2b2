//! What lines the road and what drives on it, block by block from the seed.

use nalgebra::{Vector2, Vector3};

use super::motion::{CarState, LANE_M};
use super::random::{Purpose, Random, mix, smooth, uniform_of};
use super::road::{ROAD_HALF_M, Road, RoadPoint, Segment};
use super::scene::{RANGE_M, Scene, Shape, Thing};
use super::surface::{Surface, richness_at};

/// Length of a block, m.
const BLOCK_M: f64 = 16.0;
/// The street is there as far as anything can be seen, but no farther than this along the road, m.
const MOST_BEHIND_M: f64 = 200.0;
const MOST_AHEAD_M: f64 = 400.0;
/// Blocks reach farther than their middle, m.
const SEEN_M: f64 = RANGE_M + BLOCK_M;
/// How far along the road something may reach that stands beside it, m.
const REACH_M: f64 = 80.0;
/// Nothing may stand nearer to the centreline, m.
const CLEARANCE_M: f64 = ROAD_HALF_M + 2.4;

/// Oncoming traffic: one place for a car in so many metres, and its speed.
const ONCOMING_GAP_M: f64 = 45.0;
const ONCOMING_M_S: f64 = 9.0;

/// Keys of moving things have this bit.
const MOVING: u64 = 1 << 63;

/// A car on the road at a moment.
#[derive(Clone, Copy, Debug)]
pub(super) struct MovingCar {
    pub key: u64,
    /// World, m.
    pub centre: Vector2<f64>,
    /// Unit vector along the car, world axes.
    pub along: Vector2<f64>,
}

impl MovingCar {
    /// Where a point of this car is when the car is `later`.
    pub(super) fn carry(&self, point: &Vector3<f64>, later: &Self) -> Vector3<f64> {
        let offset = point.xy() - self.centre;
        let (x, y) = (offset.dot(&self.along), self.along.x * offset.y - self.along.y * offset.x);
        let moved = later.centre + later.along * x + Vector2::new(-later.along.y, later.along.x) * y;
        Vector3::new(moved.x, moved.y, point.z)
    }
}

/// A street from a seed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Street {
    pub seed: u64,
}

impl Street {
    /// Makes the road known as far as [`Self::scene`] needs it.
    pub(super) fn cover(road: &mut Road, state: &CarState) {
        road.cover(state.arc_m - MOST_BEHIND_M - REACH_M - BLOCK_M, state.arc_m + MOST_AHEAD_M + REACH_M + BLOCK_M);
    }

    /// Everything around the car, and which of it moves.
    pub(super) fn scene(&self, road: &Road, state: &CarState) -> (Scene, Vec<MovingCar>) {
        let here = road.at(state.arc_m).position;
        let in_sight = |arc_m: f64| (road.at(arc_m).position - here).norm() < SEEN_M;
        let reach = |direction: f64, most_m: f64| {
            let steps = (0..=(most_m / BLOCK_M) as u32).map(|step| f64::from(step) * BLOCK_M);
            steps.take_while(|way_m| in_sight(state.arc_m + direction * way_m)).last().unwrap_or(0.0)
        };
        let first_m = (state.arc_m - reach(-1.0, MOST_BEHIND_M)).max(0.0);
        let end_m = state.arc_m + reach(1.0, MOST_AHEAD_M);
        let mut things = Vec::with_capacity(256);
        for block in (first_m / BLOCK_M).floor() as i64..=(end_m / BLOCK_M).floor() as i64 {
            if block >= 0 {
                self.furnish(block, road, &mut things);
            }
        }
        let moving = self.traffic(road, state, first_m, end_m);
        for car in &moving {
            push_car(&mut things, car.key, car.centre, car.along);
        }
        let segments = road.between(first_m, end_m).copied().collect();
        (Scene::new(here, self.seed, things, segments), moving)
    }

    /// Houses, hedges, trees, poles and parked cars of one block, both sides.
    fn furnish(&self, block: i64, road: &Road, things: &mut Vec<Thing>) {
        let middle_m = (block as f64 + 0.5) * BLOCK_M;
        let near: Vec<Segment> = road.between(middle_m - REACH_M, middle_m + REACH_M).copied().collect();
        let richness = richness_at(self.seed, middle_m);
        for (side, left) in [(0_u64, 1.0), (1, -1.0)] {
            let key = mix(self.seed ^ mix(2 * block as u64 + side)) & !MOVING;
            let mut random = Random::new(self.seed, Purpose::Street, 2 * block as u64 + side);
            let mut place = Placer { near: &near, things: &mut *things, key, next: 0 };
            let house = random.chance(0.82);
            let point = road.at(middle_m);
            if house {
                let setback = 8.2 + random.between(0.0, 1.0) * random.uniform() * 6.0;
                let half = [BLOCK_M * random.between(0.42, 0.52), 5.0];
                let shade = random.between(0.25, 0.75);
                let colour =
                    [0.0, 0.0, 0.0].map(|_: f64| (shade + random.between(-0.12, 0.12)).clamp(0.12, 0.85) as f32);
                let window_m = (2.0 * half[0] / (2.0 * half[0] / random.between(2.0, 4.0)).round()) as f32;
                let high = random.between(5.0, 16.0);
                let surface = Surface::Facade { colour, richness: richness as f32, window_m };
                place.block(&point, left * (setback + half[1]), half, [0.0, high], surface);
            } else if random.chance(0.7) {
                let surface = Surface::Leaves { brightness: random.between(0.7, 1.5) as f32 };
                place.block(&point, left * 8.6, [BLOCK_M * 0.48, 0.4], [0.0, random.between(0.8, 1.8)], surface);
            }
            let mut along = |chance: f64| random.chance(chance).then(|| (block as f64 + random.uniform()) * BLOCK_M);
            let pole = along(0.25 + 0.5 * richness);
            let tree = along(0.1 + 0.5 * richness);
            let parked = [along(0.2 + 0.3 * richness), along(0.15)];
            if let Some(arc_m) = pole {
                let shape = |centre| Shape::Column {
                    centre,
                    radius: random.between(0.06, 0.13),
                    low: 0.0,
                    high: random.between(4.0, 8.0),
                };
                place.upright(&road.at(arc_m), left * 6.15, shape, Surface::Pole);
            }
            if let Some(arc_m) = tree {
                let radius = random.between(1.1, 2.0);
                let point = road.at(arc_m);
                let trunk = |centre| Shape::Column { centre, radius: 0.1 * radius, low: 0.0, high: 3.0 };
                let crown = |centre: Vector2<f64>| Shape::Crown {
                    centre: Vector3::new(centre.x, centre.y, 2.4 + 1.2 * radius),
                    radius,
                    half_height: 1.3 * radius,
                };
                place.upright(&point, left * 6.9, trunk, Surface::Bark);
                let surface = Surface::Leaves { brightness: random.between(0.7, 1.6) as f32 };
                place.upright(&point, left * 6.9, crown, surface);
            }
            for (slot, arc_m) in parked.into_iter().enumerate() {
                // Two slots, so that parked cars do not stand in each other.
                let Some(arc_m) = arc_m else { continue };
                let within = (arc_m / BLOCK_M).fract();
                let point = road.at((block as f64 + 0.5 * slot as f64 + 0.2 + 0.1 * within) * BLOCK_M);
                let centre = point.beside(left * (ROAD_HALF_M + 1.15));
                if place.is_clear(&centre, ROAD_HALF_M + 0.9) {
                    push_car(place.things, key ^ (slot as u64 + 77), centre, point.along());
                }
            }
        }
    }

    /// Oncoming cars, and one that drives ahead, near or far.
    fn traffic(&self, road: &Road, state: &CarState, first_m: f64, end_m: f64) -> Vec<MovingCar> {
        let mut cars = Vec::new();
        let mut push = |key: u64, arc_m: f64, left_m: f64, forward: f64| {
            let point = road.at(arc_m);
            cars.push(MovingCar { key: key | MOVING, centre: point.beside(left_m), along: forward * point.along() });
        };
        let travelled = ONCOMING_M_S * state.time_s;
        let index = |arc_m: f64| ((arc_m + travelled) / ONCOMING_GAP_M).floor() as i64;
        for car in index(first_m)..=index(end_m) {
            let key = mix(self.seed ^ mix(0x0c0c ^ car as u64)) & !MOVING;
            let arc_m = (car as f64 + 0.6 * uniform_of(key ^ 1)) * ONCOMING_GAP_M - travelled;
            if uniform_of(key) < 0.45 && (first_m + 10.0..end_m - 10.0).contains(&arc_m) {
                push(key, arc_m, -LANE_M, -1.0);
            }
        }
        // The gap to the car ahead changes with the way driven, so slowly that it never drives backwards.
        let wave = 0.5 + 0.5 * smooth(self.seed ^ 0x1ead, state.arc_m / 500.0);
        let gap_m = 10.0 + 130.0 * wave * wave;
        push(mix(self.seed ^ 0x1ead) & !MOVING, state.arc_m + gap_m, LANE_M, 1.0);
        cars
    }
}

/// Puts things beside the road unless they would stand on it.
struct Placer<'a> {
    near: &'a [Segment],
    things: &'a mut Vec<Thing>,
    key: u64,
    next: u64,
}

impl Placer<'_> {
    fn push(&mut self, shape: Shape, surface: Surface) {
        self.next += 1;
        self.things.push(Thing { shape, surface, key: mix(self.key ^ self.next) & !MOVING });
    }

    fn is_clear(&self, place: &Vector2<f64>, distance_m: f64) -> bool {
        let distances = self.near.iter().filter_map(|segment| segment.coordinates(place));
        distances.map(|(_, left)| left.abs()).all(|left| left >= distance_m)
    }

    fn block(&mut self, point: &RoadPoint, left_m: f64, half: [f64; 2], [low, high]: [f64; 2], surface: Surface) {
        let (centre, along) = (point.beside(left_m), point.along());
        let across = Vector2::new(-along.y, along.x);
        let steps = [-1.0, -0.5, 0.0, 0.5, 1.0];
        let corners = steps.iter().flat_map(|u| steps.map(|v| centre + along * (u * half[0]) + across * (v * half[1])));
        if corners.into_iter().all(|corner| self.is_clear(&corner, CLEARANCE_M)) {
            self.push(Shape::Block { centre, along, half, low, high }, surface);
        }
    }

    fn upright(&mut self, point: &RoadPoint, left_m: f64, shape: impl FnOnce(Vector2<f64>) -> Shape, surface: Surface) {
        let centre = point.beside(left_m);
        if self.is_clear(&centre, CLEARANCE_M - 0.5) {
            self.push(shape(centre), surface);
        }
    }
}

/// Body and cabin; colour by key.
fn push_car(things: &mut Vec<Thing>, key: u64, centre: Vector2<f64>, along: Vector2<f64>) {
    const PAINTS: [[f32; 3]; 7] = [
        [0.75, 0.75, 0.74],
        [0.06, 0.06, 0.07],
        [0.35, 0.36, 0.38],
        [0.50, 0.06, 0.05],
        [0.05, 0.12, 0.35],
        [0.60, 0.58, 0.50],
        [0.10, 0.26, 0.14],
    ];
    let colour = PAINTS[(mix(key ^ 0xca7) % PAINTS.len() as u64) as usize];
    let body = Shape::Block { centre, along, half: [2.15, 0.88], low: 0.18, high: 0.88 };
    let cabin = Shape::Block { centre: centre - along * 0.25, along, half: [1.2, 0.76], low: 0.88, high: 1.45 };
    things.push(Thing { shape: body, surface: Surface::CarBody { colour }, key });
    things.push(Thing { shape: cabin, surface: Surface::CarCabin { colour }, key });
}

/// Whether a thing with this key moves.
pub(super) fn is_moving(key: u64) -> bool {
    key & MOVING != 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_stands_on_the_road() {
        let street = Street { seed: 11 };
        let mut road = Road::new(11);
        for step in 0..30 {
            let state = CarState {
                time_s: 0.0,
                arc_m: 250.0 + 60.0 * f64::from(step),
                speed_m_s: 10.0,
                acceleration_m_s2: [0.0; 2],
            };
            Street::cover(&mut road, &state);
            let (scene, moving) = street.scene(&road, &state);
            assert!(scene.things.len() > 40);
            let parked = scene.things.iter().filter(|thing| !is_moving(thing.key));
            let blocking = parked.filter(|thing| match thing.shape {
                Shape::Block { centre, along, half, .. } => [-1.0, 1.0].iter().any(|u| {
                    [-1.0, 1.0].iter().any(|v| {
                        let corner = centre + along * (u * half[0]) + Vector2::new(-along.y, along.x) * (v * half[1]);
                        scene
                            .road
                            .iter()
                            .filter_map(|s| s.coordinates(&corner))
                            .any(|(_, d)| d.abs() < ROAD_HALF_M - 0.3)
                    })
                }),
                _ => false,
            });
            assert_eq!(blocking.count(), 0, "at {} m", state.arc_m);
            assert!(moving.iter().all(|car| is_moving(car.key)));
        }
    }

    #[test]
    fn a_point_is_carried_along_with_its_car() {
        let car = MovingCar { key: MOVING, centre: Vector2::new(1.0, 2.0), along: Vector2::new(1.0, 0.0) };
        let later = MovingCar { key: MOVING, centre: Vector2::new(5.0, 2.0), along: Vector2::new(0.0, 1.0) };
        assert_eq!(car.carry(&Vector3::new(2.0, 2.5, 0.7), &later), Vector3::new(4.5, 3.0, 0.7));
    }
}
