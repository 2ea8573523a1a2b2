//! What the user chooses among by the same words in several commands: splits and axes.

use clap::ValueEnum;

use crate::geometry::ErrorFrame;
use crate::pairs::SplitName;

/// A role of pairs.
#[derive(Clone, Copy, ValueEnum)]
pub(super) enum SplitArgument {
    Train,
    Validation,
    Test,
}

impl SplitArgument {
    pub(super) fn name(self) -> SplitName {
        match self {
            Self::Train => SplitName::Train,
            Self::Validation => SplitName::Validation,
            Self::Test => SplitName::Test,
        }
    }
}

/// Axes of errors and covariances.
#[derive(Clone, Copy, ValueEnum)]
pub(super) enum FrameArgument {
    Vehicle,
    Camera,
    World,
}

impl FrameArgument {
    pub(super) fn frame(self) -> ErrorFrame {
        match self {
            Self::Vehicle => ErrorFrame::Vehicle,
            Self::Camera => ErrorFrame::Camera,
            Self::World => ErrorFrame::World,
        }
    }
}
