//! Decoding colour images and bringing them to the network's size.

use std::path::{Path, PathBuf};
use std::sync::Once;

use fast_image_resize::images::Image as ResizeImage;
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use image::metadata::Orientation;
use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};

use crate::error::{Error, Place, Result};
use crate::files::{read_bytes, require_readable, require_regular};

/// Largest width and height, px, and largest size of a decoded image: a small file can claim to hold far more.
pub(super) const MOST_PIXELS: u32 = 16_384;
const MOST_BYTES: u64 = 256 << 20;

/// An 8-bit RGB image, rows of `r g b`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RgbImage {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// `3 * width * height` bytes.
    pub bytes: Vec<u8>,
}

impl RgbImage {
    /// The image at another size, antialiased (bilinear kernel widened by the scale), with the pixel
    /// geometry of [`Pinhole::resized`](crate::geometry::Pinhole::resized).
    pub fn resized(self, width: usize, height: usize) -> Self {
        self.filtered(width, height, FilterType::Bilinear)
    }

    /// The same by Lanczos' kernel of three lobes, as Pillow does it (rows, then columns; equal to a grey level): what
    /// depth networks are trained on.
    pub fn resized_sharply(self, width: usize, height: usize) -> Self {
        let rows = self.height;
        self.filtered(width, rows, FilterType::Lanczos3).filtered(width, height, FilterType::Lanczos3)
    }

    fn filtered(self, width: usize, height: usize, filter: FilterType) -> Self {
        if (self.width, self.height) == (width, height) {
            return self;
        }
        let source = ResizeImage::from_vec_u8(self.width as u32, self.height as u32, self.bytes, PixelType::U8x3)
            .expect("3 bytes a pixel");
        let mut target = ResizeImage::new(width as u32, height as u32, PixelType::U8x3);
        let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
        Resizer::new().resize(&source, &mut target, &options).expect("same pixel type");
        Self { width, height, bytes: target.into_vec() }
    }

    /// Appends the image as planes of 0…1, channel by channel.
    pub fn extend_planar(&self, planes: &mut Vec<f32>) {
        for channel in 0..3 {
            planes.extend(self.bytes[channel..].iter().step_by(3).map(|&byte| f32::from(byte) / 255.0));
        }
    }
}

/// Decodes a PNG or JPEG file (grey images become RGB). Pixels are taken as they are stored: an EXIF orientation, which
/// would turn them, is not followed, and said once.
///
/// # Errors
/// The file cannot be read or decoded, or is not whole.
pub fn read_image(path: &Path) -> Result<RgbImage> {
    decode_image(&read_bytes(path)?, path)
}

/// Decodes the content of a PNG or JPEG file; `origin` names it in errors.
///
/// # Errors
/// It cannot be decoded, or is not whole.
pub fn decode_image(bytes: &[u8], origin: &Path) -> Result<RgbImage> {
    let image = decode(bytes, origin, "a complete PNG or JPEG image")?;
    warn_of_few_bits(&image, origin);
    let image = image.into_rgb8();
    Ok(RgbImage { width: image.width() as usize, height: image.height() as usize, bytes: image.into_raw() })
}

/// Decodes any image; the only place that does. `expected` says what it should be.
pub(crate) fn decode(bytes: &[u8], origin: &Path, expected: &str) -> Result<DynamicImage> {
    let broken = |found: String| Error::malformed(origin, Place::Whole, found, expected);
    if bytes.is_empty() {
        return Err(broken("an empty file".to_owned()));
    }
    let mut reader = ImageReader::new(std::io::Cursor::new(bytes));
    reader.limits(limits());
    let reader = reader.with_guessed_format().map_err(Error::io("read", origin))?;
    // Its decoder makes grey of what is missing.
    if reader.format() == Some(ImageFormat::Jpeg) && !is_whole_jpeg(bytes) {
        return Err(broken(format!("a JPEG that is cut off: {} bytes without its end", bytes.len())));
    }
    let decoded = reader.into_decoder().and_then(|mut decoder| {
        let orientation = decoder.orientation()?;
        let mut limits = limits();
        limits.reserve(decoder.total_bytes())?;
        decoder.set_limits(limits)?;
        Ok((orientation, DynamicImage::from_decoder(decoder)?))
    });
    let (orientation, image) = decoded.map_err(|error| broken(error.to_string()))?;
    if orientation != Orientation::NoTransforms {
        static SAID: Once = Once::new();
        SAID.call_once(|| {
            tracing::warn!(
                "{}: its EXIF orientation ({}) is not followed; intrinsics, depth and pose must be those of the pixels as stored",
                origin.display(),
                orientation.to_exif()
            );
        });
    }
    Ok(image)
}

/// Says once that an image of 16 bits uses the lower ones alone: of a camera of 12 bits it is nearly black.
fn warn_of_few_bits(image: &DynamicImage, origin: &Path) {
    static SAID: Once = Once::new();
    let brightest = match image {
        DynamicImage::ImageLuma16(image) => image.iter().max(),
        DynamicImage::ImageRgb16(image) => image.iter().max(),
        _ => return,
    };
    if let Some(brightest) = brightest.filter(|brightest| **brightest < 1 << 12) {
        SAID.call_once(|| {
            tracing::warn!(
                "{}: 16 bits with no value above {brightest}, so nearly black; scale images of 12 bits by 16",
                origin.display()
            );
        });
    }
}

fn limits() -> Limits {
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MOST_PIXELS), Some(MOST_PIXELS));
    limits.max_alloc = Some(MOST_BYTES);
    limits
}

/// Width and height of the first image that can be read, px: a broken one costs its own pairs.
///
/// # Errors
/// None can be read.
pub(super) fn size_of_first<'a>(mut images: impl Iterator<Item = &'a PathBuf>) -> Result<[usize; 2]> {
    let first = images.next().ok_or_else(|| Error::Data("no image is listed".to_owned()))?;
    image_size(first).or_else(|error| images.find_map(|image| image_size(image).ok()).ok_or(error))
}

/// Whether an image is 16-bit grey, by its header; one that cannot be read is not.
pub(super) fn is_grey_16(path: &Path) -> bool {
    let read = || {
        require_regular(path).ok()?;
        let reader = ImageReader::open(path).ok()?.with_guessed_format().ok()?;
        Some(reader.into_decoder().ok()?.color_type() == ColorType::L16)
    };
    read() == Some(true)
}

/// Width and height of an image file, px, by its header.
fn image_size(path: &Path) -> Result<[usize; 2]> {
    require_regular(path)?;
    require_readable(path)?;
    let reader = ImageReader::open(path).map_err(Error::io("read", path))?;
    let reader = reader.with_guessed_format().map_err(Error::io("read", path))?;
    let (width, height) = reader
        .into_dimensions()
        .map_err(|error| Error::malformed(path, Place::Whole, error.to_string(), "a complete PNG or JPEG image"))?;
    Ok([width as usize, height as usize])
}

/// Whether a JPEG reaches its end: segment by segment, and through the entropy-coded data of its scans, where `FF 00` and
/// restart markers are content (ITU T.81, B.1).
fn is_whole_jpeg(bytes: &[u8]) -> bool {
    let mut place = 2;
    let mut in_scan = false;
    loop {
        let Some(next) = bytes.get(place..).and_then(|rest| rest.iter().position(|byte| *byte == 0xFF)) else {
            return false;
        };
        place += next + 1;
        match bytes.get(place) {
            // Padding, content, or a marker without a segment.
            Some(0xFF) => continue,
            Some(0x00 | 0x01 | 0xD0..=0xD8) => place += 1,
            Some(0xD9) if in_scan => return true,
            Some(0xD9) | None => return false,
            Some(marker) => {
                in_scan |= *marker == 0xDA;
                let &[high, low] = bytes.get(place + 1..).and_then(|rest| rest.first_chunk()).unwrap_or(&[0, 2]);
                place += 1 + usize::from(u16::from_be_bytes([high, low]));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pinhole;

    #[test]
    fn a_resized_ramp_keeps_the_pixel_geometry_of_the_resized_camera() {
        let (width, height) = (128, 8);
        let bytes = (0..height).flat_map(|_| (0..width).flat_map(|u| [2 * u as u8; 3])).collect();
        let small = RgbImage { width, height, bytes }.resized(32, 4);
        let camera = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width, height }.resized(32, 4);
        for u in 2..30 {
            // Full-size column seen by pixel u of the small image.
            let column = (u as f64 - camera.cx) / camera.fx;
            let value = f64::from(small.bytes[3 * u]);
            assert!((value - 2.0 * column).abs() <= 1.0, "column {u}: {value} at {column}");
        }
    }
}
