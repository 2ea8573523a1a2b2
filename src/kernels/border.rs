//! The border of an image: what a kernel sees beyond the edge.

/// What lies beyond the edge of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Border {
    /// Zeros.
    #[default]
    Zeros,
    /// The image's mirror image, without its edge pixels; for stride 1.
    Mirror,
}

impl Border {
    /// The row of the image that a row of the padded image shows.
    pub(super) fn inside(self, padded: usize, padding: usize, size: usize) -> Option<usize> {
        match self {
            Self::Zeros => padded.checked_sub(padding).filter(|&row| row < size),
            Self::Mirror if padded < padding => Some(padding - padded),
            Self::Mirror => {
                let row = padded - padding;
                Some(if row < size { row } else { 2 * (size - 1) - row })
            }
        }
    }
}
