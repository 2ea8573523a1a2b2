//! The axes an error is written in, and the conventions that travel with every stored number.

use serde::{Deserialize, Serialize};

/// The axes in which `e` and its covariance are expressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ErrorFrame {
    /// Axes of the vehicle (KITTI: its IMU) at time i: x forward, y left, z up.
    #[default]
    Vehicle,
    /// Axes of the colour camera at time i: x right, y down, z forward.
    Camera,
    /// At the vehicle's origin at time i, axes of the world the truth is given in (OXTS: east, north, up).
    World,
}

impl ErrorFrame {
    /// Name as in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vehicle => "vehicle",
            Self::Camera => "camera",
            Self::World => "world",
        }
    }

    /// The axes of a name.
    pub(crate) fn of(name: &str) -> Option<Self> {
        [Self::Vehicle, Self::Camera, Self::World].into_iter().find(|frame| frame.name() == name)
    }

    /// What its axes are, for table headers.
    pub fn axes(self) -> &'static str {
        match self {
            Self::Vehicle => "x forward, y left, z up",
            Self::Camera => "x right, y down, z forward",
            Self::World => "axes of the truth's world",
        }
    }
}

/// The conventions a stored number depends on. Two sets of numbers compare only when these agree.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Conventions {
    /// Names of the six components, in order.
    pub components: [String; 6],
    /// Their units.
    pub units: [String; 6],
    /// How the error is formed.
    pub error: String,
    /// The axes it is expressed in.
    pub error_frame: ErrorFrame,
    /// What a relative pose maps.
    pub relative_pose: String,
    /// Where pixel centres lie.
    pub pixel_centre: String,
}

impl Conventions {
    /// Names of the components: order ρ then φ; roll, pitch and yaw are the rotations about x, y and z.
    pub const COMPONENTS: [&'static str; 6] = ["x", "y", "z", "roll", "pitch", "yaw"];
    /// Their units.
    pub const UNITS: [&'static str; 6] = ["m", "m", "m", "rad", "rad", "rad"];

    /// This program's conventions with errors in the given axes.
    pub fn new(error_frame: ErrorFrame) -> Self {
        Self {
            components: Self::COMPONENTS.map(str::to_owned),
            units: Self::UNITS.map(str::to_owned),
            error: "log(measured * truth^-1), left".to_owned(),
            error_frame,
            relative_pose: "source_from_target (view i from view i+1)".to_owned(),
            pixel_centre: "integer".to_owned(),
        }
    }
}
