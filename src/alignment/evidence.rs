//! What direct alignment found.

use serde::{Deserialize, Serialize};

/// Why the images of a pair say nothing of its error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoVerdict {
    /// The depth of too few pixels is known.
    NoDepth,
    /// By the measured pose too few pixels of the target lie inside the source image.
    NoOverlap,
    /// Too few pixels have an image gradient: black, constant or overexposed images.
    NoTexture,
    /// The alignment did not come to rest: the pose is too far off, or the images show something else.
    Diverged,
}

impl NoVerdict {
    /// Name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoDepth => "no_depth",
            Self::NoOverlap => "no_overlap",
            Self::NoTexture => "no_texture",
            Self::Diverged => "diverged",
        }
    }

    /// The reason in words.
    pub fn reason(self) -> &'static str {
        match self {
            Self::NoDepth => "the depth of too few pixels is known",
            Self::NoOverlap => "by the measured pose the images share too few pixels",
            Self::NoTexture => "the images have too little texture",
            Self::Diverged => "the alignment of the images did not come to rest",
        }
    }
}
