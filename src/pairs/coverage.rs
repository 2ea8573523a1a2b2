//! What drives give to splits, and why they may give nothing.

use std::fmt;
use std::path::PathBuf;

use super::pair::PairScope;
use super::split::SplitName;
use crate::error::Error;
use crate::recordings::Recording;

/// What one drive gives to one split.
#[derive(Clone, Debug)]
pub struct Coverage {
    /// The split.
    pub split: SplitName,
    /// Index into [`Dataset::drives`](super::Dataset::drives).
    pub drive: usize,
    /// First and one past the last source frame, where the configuration cuts.
    pub frames: Option<[usize; 2]>,
    /// Frames with a true pose.
    pub true_poses: usize,
    /// Frames with an image.
    pub images: usize,
    /// Frames with an image of the right camera.
    pub right_images: usize,
    /// Frames with a LiDAR scan.
    pub scans: usize,
    /// Pairs of frames, as far apart as asked for, that both have a true pose.
    pub pose_pairs: usize,
    /// Of those, pairs whose two images exist.
    pub image_pairs: usize,
    /// Of those, pairs whose target has depth.
    pub depth_pairs: usize,
    /// For each system: pairs with a measured and a true pose, with or without images.
    pub measured_pairs: Vec<usize>,
    /// For each system: those of them whose two images exist.
    pub measured_with_images: Vec<usize>,
    /// The first depth file that was looked for and is not there.
    pub missing_depth: Option<PathBuf>,
    /// For each system: the frames it measured, with or without a truth.
    pub measured_frames: Vec<FrameSpan>,
    /// The frames of the drive with a true pose.
    pub true_frames: FrameSpan,
    /// The frames of the drive with an image.
    pub image_frames: FrameSpan,
    /// For each system: the file that was looked for and is not there.
    pub missing_files: Vec<Option<PathBuf>>,
}

/// What drives have, where a system has no pairs.
pub(super) struct Absence<'a> {
    pub coverage: &'a [Coverage],
    pub recordings: &'a [Recording],
    pub scope: PairScope,
    /// `data.gap`.
    pub gaps: &'a [usize],
}

impl Absence<'_> {
    /// Why no pair of a system, called `label`, is in a split: what each side has.
    pub fn explain(&self, name: SplitName, system: usize, label: &str) -> Error {
        let coverage: Vec<_> = self.coverage.iter().filter(|coverage| coverage.split == name).collect();
        if name == SplitName::Validation && coverage.is_empty() {
            return Error::config(
                "data.validation_fraction",
                "holds out no pair of the training drives; raise it, or list drives in data.validation",
            );
        }
        let Some(first) = coverage.first() else {
            return Error::config(format!("data.{}", name.name()), "lists no drive");
        };
        let lacks_depth = |coverage: &&&Coverage| coverage.measured_with_images[system] > 0;
        let without_depth = coverage.iter().find(lacks_depth).filter(|_| self.scope != PairScope::Poses);
        let shown = without_depth.unwrap_or(first);
        let drive = &self.recordings[shown.drive].name;
        let elsewhere = match coverage.len() {
            1 => String::new(),
            drives => format!(" (one of {drives} drives)"),
        };
        if without_depth.is_some() {
            let problem = format!("{drive}{elsewhere}: none of the pairs of `{label}` has depth");
            let remedy = "choose another depth.source (docs/depth.md)";
            return Error::Data(match &shown.missing_depth {
                Some(path) => format!("{problem}: not found: {}", path.display()),
                None => format!("{problem}; {remedy}"),
            });
        }
        if let Some(path) = &shown.missing_files[system] {
            return Error::Data(format!(
                "`{label}` measured nothing in {drive}{elsewhere}: not found: {}",
                path.display()
            ));
        }
        let mut sides = vec![format!("`{label}` measured {}", shown.measured_frames[system])];
        if self.scope != PairScope::Measured {
            sides.push(format!("true poses are of {}", shown.true_frames));
        }
        if self.scope != PairScope::Poses {
            sides.push(format!("images are of {}", shown.image_frames));
        }
        let cut =
            shown.frames.map_or(String::new(), |[first, end]| format!(", frames {first} … {}", end.saturating_sub(1)));
        if !self.gaps.is_empty() {
            sides.push(format!("pairs are {:?} frames apart (data.gap)", self.gaps));
        }
        Error::Data(format!("no pair of `{label}` in {drive}{cut}{elsewhere} has all it needs: {}", sides.join(", ")))
    }
}

/// How many frames there are of something, and which.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameSpan {
    count: usize,
    first: usize,
    last: usize,
}

impl FrameSpan {
    /// Of frames in order.
    pub(super) fn of(frames: impl IntoIterator<Item = usize>) -> Self {
        let mut span = Self::default();
        for frame in frames {
            span = Self { count: span.count + 1, first: if span.count == 0 { frame } else { span.first }, last: frame };
        }
        span
    }
}

impl fmt::Display for FrameSpan {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self { count: 0, .. } => write!(formatter, "no frames"),
            Self { count, first, last } if last - first + 1 == *count => write!(formatter, "frames {first} … {last}"),
            Self { count, first, last } => write!(formatter, "{count} of the frames {first} … {last}"),
        }
    }
}
