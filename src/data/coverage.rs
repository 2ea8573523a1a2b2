//! What drives give to splits, and why they may give nothing.

use std::path::PathBuf;

use super::dataset::{Dataset, PairScope, SplitName};
use crate::error::Error;

/// What one drive gives to one split.
#[derive(Clone, Debug)]
pub struct Coverage {
    /// The split.
    pub split: SplitName,
    /// Index into [`Dataset::drives`].
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
    /// Neighbouring frames that both have a true pose.
    pub pose_pairs: usize,
    /// Of those, pairs whose two images exist.
    pub image_pairs: usize,
    /// Of those, pairs whose target has depth.
    pub depth_pairs: usize,
    /// For each system: pairs with a measured and a true pose, with or without images.
    pub measured_pairs: Vec<usize>,
    /// For each system: those of them whose two images exist.
    pub measured_with_images: Vec<usize>,
    /// For each system: the first and last frame it measured, with or without a truth.
    pub measured_frames: Vec<Option<[usize; 2]>>,
    /// The first and last frame with a true pose.
    pub true_frames: Option<[usize; 2]>,
    /// For each system: the file that was looked for and is not there.
    pub missing_files: Vec<Option<PathBuf>>,
}

impl Dataset {
    /// Why no pair of a system is in a split: what each side has.
    pub(super) fn explain_empty(&self, name: SplitName, system: usize) -> Error {
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
        let (drive, label) = (&self.drives[first.drive], &self.systems[system]);
        let elsewhere = match coverage.len() {
            1 => String::new(),
            drives => format!(" (the first of {drives} drives)"),
        };
        if let Some(path) = &first.missing_files[system] {
            return Error::Data(format!(
                "`{label}` measured nothing in {}{elsewhere}: not found: {}",
                drive.name,
                path.display()
            ));
        }
        if coverage.iter().any(|coverage| coverage.measured_with_images[system] > 0) && self.scope != PairScope::Poses {
            return Error::Data(format!(
                "{}{elsewhere}: none of the pairs of `{label}` has depth; choose another depth.source (docs/depth.md)",
                drive.name
            ));
        }
        let mut sides = vec![format!("`{label}` measured {}", describe_span(first.measured_frames[system]))];
        if self.scope != PairScope::Measured {
            sides.push(format!("true poses are of {}", describe_span(first.true_frames)));
        }
        if self.scope != PairScope::Poses {
            let span = drive.images.keys().next().zip(drive.images.keys().last()).map(|(&first, &last)| [first, last]);
            sides.push(format!("images are of {}", describe_span(span)));
        }
        let cut =
            first.frames.map_or(String::new(), |[first, end]| format!(", frames {first} … {}", end.saturating_sub(1)));
        Error::Data(format!("no pairs of `{label}` in {}{cut}{elsewhere}: {}", drive.name, sides.join(", ")))
    }
}

/// Of frames 3 … 17.
fn describe_span(span: Option<[usize; 2]>) -> String {
    span.map_or("no frames".to_owned(), |[first, last]| format!("frames {first} … {last}"))
}
