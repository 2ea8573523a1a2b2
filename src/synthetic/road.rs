//! The road: its width, and its centreline of straight stretches and bends, one after another, never meeting itself.

use std::collections::VecDeque;

use nalgebra::Vector2;

use super::random::{Purpose, Random};

/// Half the width of the carriageway, m.
pub(super) const ROAD_HALF_M: f64 = 3.6;
/// The road never turns farther than this from east, rad: its x grows everywhere, so it cannot meet itself.
const MAX_HEADING_RAD: f64 = 1.35;

/// A stretch of constant curvature.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segment {
    /// Arc length where it begins, m.
    pub first_m: f64,
    pub length_m: f64,
    start: Vector2<f64>,
    heading_rad: f64,
    /// 1/m, positive to the left.
    pub curvature: f64,
}

/// A point of the centreline.
#[derive(Clone, Copy, Debug)]
pub(super) struct RoadPoint {
    /// World east and north, m.
    pub position: Vector2<f64>,
    /// 0 = east, positive to the left.
    pub heading_rad: f64,
    pub curvature: f64,
}

impl RoadPoint {
    /// Unit vector along the road.
    pub(super) fn along(&self) -> Vector2<f64> {
        let (sine, cosine) = libm::sincos(self.heading_rad);
        Vector2::new(cosine, sine)
    }

    /// A point beside the centreline, positive to the left, m.
    pub(super) fn beside(&self, left_m: f64) -> Vector2<f64> {
        let along = self.along();
        self.position + left_m * Vector2::new(-along.y, along.x)
    }
}

impl Segment {
    fn at(&self, arc_m: f64) -> RoadPoint {
        let (s, h, k) = (arc_m - self.first_m, self.heading_rad, self.curvature);
        let (sine, cosine) = libm::sincos(h);
        let offset = if k == 0.0 {
            s * Vector2::new(cosine, sine)
        } else {
            let (end_sine, end_cosine) = libm::sincos(h + k * s);
            Vector2::new(end_sine - sine, cosine - end_cosine) / k
        };
        RoadPoint { position: self.start + offset, heading_rad: h + k * s, curvature: k }
    }

    /// Arc length and distance to the left of a point, if the point lies beside this segment, m.
    pub(super) fn coordinates(&self, point: &Vector2<f64>) -> Option<(f64, f64)> {
        let (sine, cosine) = libm::sincos(self.heading_rad);
        let offset = point - self.start;
        let (along, left) = (cosine * offset.x + sine * offset.y, cosine * offset.y - sine * offset.x);
        let (s, d) = if self.curvature == 0.0 {
            (along, left)
        } else {
            let radius = 1.0 / self.curvature;
            // Seen from the centre of the bend.
            let radial = (radius - left) * radius.signum();
            let distance = (radial * radial + along * along).sqrt();
            (libm::atan2(along, radial) * radius.abs(), radius - radius.signum() * distance)
        };
        (0.0..=self.length_m).contains(&s).then_some((self.first_m + s, d))
    }

    /// Unit vector along the road at an arc length.
    pub(super) fn direction_at(&self, arc_m: f64) -> Vector2<f64> {
        self.at(arc_m).along()
    }
}

/// The centreline as far as it is needed now.
#[derive(Clone, Debug)]
pub(super) struct Road {
    random: Random,
    segments: VecDeque<Segment>,
}

impl Road {
    pub(super) fn new(seed: u64) -> Self {
        let first =
            Segment { first_m: 0.0, length_m: 200.0, start: Vector2::zeros(), heading_rad: 0.0, curvature: 0.0 };
        Self { random: Random::new(seed, Purpose::Road, 0), segments: VecDeque::from([first]) }
    }

    /// Makes the road known from `first_m` to `end_m`; what lies before may be forgotten.
    pub(super) fn cover(&mut self, first_m: f64, end_m: f64) {
        while self.end_m() < end_m {
            let next = self.next_segment();
            self.segments.push_back(next);
        }
        while self.segments.get(1).is_some_and(|second| second.first_m < first_m) {
            self.segments.pop_front();
        }
    }

    fn end_m(&self) -> f64 {
        let last = self.last();
        last.first_m + last.length_m
    }

    fn last(&self) -> &Segment {
        self.segments.back().expect("a road has a segment")
    }

    fn next_segment(&mut self) -> Segment {
        let end = self.last().at(self.end_m());
        let random = &mut self.random;
        let straight = end.curvature != 0.0;
        let (length_m, curvature) = if straight {
            (random.between(30.0, 130.0), 0.0)
        } else {
            let radius = if random.chance(0.5) { random.between(12.0, 25.0) } else { random.between(40.0, 160.0) };
            let turn = if radius < 30.0 { random.between(0.5, 1.6) } else { random.between(0.1, 0.6) };
            let left = if random.chance(0.5) { 1.0 } else { -1.0 };
            let fits = |side: f64| (end.heading_rad + side * turn).abs() < MAX_HEADING_RAD;
            // No turn is wider than the headings between both limits, so one side fits.
            let side = if fits(left) { left } else { -left };
            (turn * radius, side / radius)
        };
        Segment { first_m: self.end_m(), length_m, start: end.position, heading_rad: end.heading_rad, curvature }
    }

    /// The centreline at an arc length that is covered.
    pub(super) fn at(&self, arc_m: f64) -> RoadPoint {
        let next = self.segments.partition_point(|segment| segment.first_m <= arc_m);
        self.segments[next.max(1) - 1].at(arc_m)
    }

    /// Segments that touch a range of arc length.
    pub(super) fn between(&self, first_m: f64, end_m: f64) -> impl Iterator<Item = &Segment> {
        let touches = move |segment: &&Segment| segment.first_m < end_m && segment.first_m + segment.length_m > first_m;
        self.segments.iter().filter(touches)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn the_road_is_continuous_and_its_coordinates_invert_its_points() {
        let mut road = Road::new(3);
        road.cover(0.0, 2000.0);
        assert!(road.segments.iter().any(|segment| segment.curvature > 0.0));
        assert!(road.segments.iter().any(|segment| segment.curvature < 0.0));
        for step in 0..400 {
            let arc_m = 1.0 + 4.9 * f64::from(step);
            let (here, near) = (road.at(arc_m), road.at(arc_m + 1e-6));
            assert_relative_eq!((near.position - here.position).norm(), 1e-6, epsilon = 1e-9);
            assert!(here.heading_rad.abs() <= MAX_HEADING_RAD + 1e-9);
            for left_m in [-5.0, 0.0, 5.0] {
                let point = here.beside(left_m);
                let found: Vec<_> =
                    road.between(arc_m - 1e-3, arc_m + 1e-3).filter_map(|s| s.coordinates(&point)).collect();
                assert!(
                    found.iter().any(|&(s, d)| (s - arc_m).abs() < 1e-6 && (d - left_m).abs() < 1e-9),
                    "{arc_m} {found:?}"
                );
            }
        }
    }

    #[test]
    fn forgetting_what_lies_behind_changes_nothing_ahead() {
        let mut whole = Road::new(8);
        whole.cover(0.0, 3000.0);
        let mut rolling = Road::new(8);
        (0..30).for_each(|step| rolling.cover(100.0 * f64::from(step) - 50.0, 100.0 * f64::from(step) + 100.0));
        assert!(rolling.segments.len() < 10);
        assert_eq!(whole.at(2950.0).position, rolling.at(2950.0).position);
    }
}
