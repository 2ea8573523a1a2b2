//! Depth maps on disk: 16-bit PNG, metres x 256, 0 = unknown (KITTI's own format).

use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageBuffer, ImageFormat, Luma};

use super::DepthMap;
use super::map::EXPECTED_ASPECT;
use crate::error::{Error, Place, Result};
use crate::files::{read_bytes, write_atomically};
use crate::recordings::{KITTI_STEPS_PER_METRE, Recording, decode};

/// Steps of a metre in a depth PNG.
const STEPS_PER_METRE: f32 = KITTI_STEPS_PER_METRE;
/// The farthest depth that the format holds, m.
pub(super) const FARTHEST_M: f32 = u16::MAX as f32 / STEPS_PER_METRE;
/// What every whole PNG ends with.
const PNG_END: &[u8; 12] = b"\0\0\0\0IEND\xAE\x42\x60\x82";

/// Path of a frame's depth map from a template below `root`.
pub(super) fn depth_path(template: &str, drive: &Recording, frame: usize, root: &Path) -> PathBuf {
    root.join(
        template
            .replace("{date}", drive.date())
            .replace("{drive}", &drive.name)
            .replace("{frame}", &format!("{frame:010}")),
    )
}

/// Reads a depth PNG at its own size.
///
/// # Errors
/// The file cannot be read or decoded, or is not 16-bit grey.
pub fn read_depth_png(path: &Path) -> Result<DepthMap> {
    decode_depth_png(&read_bytes(path)?, path)
}

/// Reads the depth PNG of an image of this size, with so many steps to a metre.
///
/// # Errors
/// As [`read_depth_png`]; or the map has another aspect.
pub(super) fn read_depth_of(path: &Path, image_size: [usize; 2], steps_per_metre: f32) -> Result<DepthMap> {
    let map = decode_steps(&read_bytes(path)?, path, steps_per_metre)?;
    let fits = map.require_aspect(image_size);
    fits.map_err(|found| Error::malformed(path, Place::Whole, found, EXPECTED_ASPECT))?;
    Ok(map)
}

/// Decodes the content of a depth PNG; `origin` names it in errors.
///
/// # Errors
/// It cannot be decoded, or is not 16-bit grey.
pub fn decode_depth_png(bytes: &[u8], path: &Path) -> Result<DepthMap> {
    decode_steps(bytes, path, STEPS_PER_METRE)
}

fn decode_steps(bytes: &[u8], path: &Path, steps_per_metre: f32) -> Result<DepthMap> {
    let expected = &format!("a 16-bit grey PNG, metres x {steps_per_metre}");
    let image = decode(bytes, path, expected)?;
    let DynamicImage::ImageLuma16(image) = image else {
        return Err(Error::malformed(path, Place::Whole, format!("{:?} pixels", image.color()), expected.as_str()));
    };
    let depth_m = image.pixels().map(|pixel| f32::from(pixel.0[0]) / steps_per_metre).collect();
    Ok(DepthMap { width: image.width() as usize, height: image.height() as usize, depth_m })
}

/// Whether a PNG is there from beginning to end.
pub(super) fn is_whole_png(path: &Path) -> bool {
    let ends_well = || -> std::io::Result<bool> {
        let mut file = std::fs::File::open(path)?;
        file.seek(SeekFrom::End(-(PNG_END.len() as i64)))?;
        let mut end = [0; PNG_END.len()];
        file.read_exact(&mut end)?;
        Ok(end == *PNG_END)
    };
    ends_well().unwrap_or(false)
}

/// Writes a depth PNG; depths beyond the format's 255.99 m become unknown.
///
/// # Errors
/// The file cannot be written.
pub fn write_depth_png(path: &Path, map: &DepthMap) -> Result<()> {
    write_atomically(path, &encode_depth_png(map))
}

/// A depth map as a PNG; depths beyond the format's 255.99 m become unknown.
pub(crate) fn encode_depth_png(map: &DepthMap) -> Vec<u8> {
    let step = |&depth: &f32| {
        let steps = (depth * STEPS_PER_METRE).round();
        if (0.0..=f32::from(u16::MAX)).contains(&steps) { steps as u16 } else { 0 }
    };
    let pixels = map.depth_m.iter().map(step).collect();
    let image: ImageBuffer<Luma<u16>, Vec<u16>> =
        ImageBuffer::from_raw(map.width as u32, map.height as u32, pixels).expect("one value a pixel");
    let mut png = Cursor::new(Vec::new());
    image.write_to(&mut png, ImageFormat::Png).expect("a 16-bit grey image is a PNG");
    png.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_comes_back_to_the_step() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        let map = DepthMap { width: 3, height: 1, depth_m: vec![0.0, 12.34, 300.0] };
        write_depth_png(&path, &map).unwrap();
        let back = read_depth_png(&path).unwrap();
        assert_eq!(back.depth_m[0], 0.0);
        assert!((back.depth_m[1] - 12.34).abs() <= 0.5 / STEPS_PER_METRE);
        assert_eq!(back.depth_m[2], 0.0);
    }

    #[test]
    fn an_8_bit_picture_is_no_depth_map() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        image::GrayImage::new(4, 4).save(&path).unwrap();
        assert!(read_depth_png(&path).unwrap_err().to_string().contains("16-bit"));
    }
}
