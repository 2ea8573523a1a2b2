//! What things are made of, and how rich in texture the street is along its length.

use super::random::smooth;

/// What a thing is made of.
#[derive(Clone, Copy, Debug)]
pub(super) enum Surface {
    /// A house front with windows.
    Facade {
        colour: [f32; 3],
        /// Strength of plaster and windows, 0 (poor in texture) to 1 (rich).
        richness: f32,
        /// Width of a window's field, m.
        window_m: f32,
    },
    /// A hedge or the crown of a tree.
    Leaves { brightness: f32 },
    /// A trunk.
    Bark,
    /// A lamp post or sign.
    Pole,
    /// The lower part of a car.
    CarBody { colour: [f32; 3] },
    /// Its windows and roof.
    CarCabin { colour: [f32; 3] },
}

/// How rich in texture the street is along its length, 0 to 1.
pub(super) fn richness_at(seed: u64, arc_m: f64) -> f64 {
    let wave = smooth(seed ^ 0x7165, arc_m / 55.0);
    (0.5 + 0.75 * wave).clamp(0.1, 1.0)
}
