//! A picture of what the network sees: a row for each measurement, pictures side by side.

use std::io::Cursor;

use crate::evaluation::WarpedPair;
use crate::pairs::PairSample;
use crate::recordings::RgbImage;

/// What the columns of a contact sheet show; the last one where a row of the sheet was aligned.
pub const CONTACT_SHEET_COLUMNS: [&str; 6] = [
    "source",
    "target",
    "warped (source seen from target)",
    "valid",
    "difference of warped and target, doubled",
    "the same after alignment",
];

/// A row of a contact sheet.
#[derive(Clone, Debug)]
pub struct SheetRow {
    /// The measurement.
    pub sample: PairSample,
    /// Its source image, seen from the target by the measured pose.
    pub warped: WarpedPair,
    /// The same by the pose that direct alignment found, where it came to a verdict.
    pub aligned: Option<WarpedPair>,
}

/// Pixels between two pictures.
const GAP: usize = 4;
/// Pictures narrower than this are enlarged by a whole factor.
const LEAST_WIDTH: usize = 256;

/// Draws a contact sheet as a PNG; all pictures have one size.
pub fn contact_sheet(rows: &[SheetRow]) -> Vec<u8> {
    let [width, height] =
        rows.first().map_or([1, 1], |row| [row.warped.warped_image.width, row.warped.warped_image.height]);
    let scale = LEAST_WIDTH.div_ceil(width);
    let (cell_width, cell_height) = (width * scale + GAP, height * scale + GAP);
    let aligned = rows.iter().any(|row| row.aligned.is_some());
    let columns = CONTACT_SHEET_COLUMNS.len() - usize::from(!aligned);
    let (sheet_width, sheet_height) = (columns * cell_width + GAP, rows.len() * cell_height + GAP);
    let mut sheet = image::RgbImage::from_pixel(sheet_width as u32, sheet_height as u32, image::Rgb([255; 3]));
    for (row, SheetRow { sample, warped, aligned }) in rows.iter().enumerate() {
        let aligned = aligned.as_ref().map(|aligned| difference(sample, aligned));
        let (valid, difference) = (validity(warped), difference(sample, warped));
        let pictures: [&RgbImage; 5] =
            [&sample.source_image, &sample.target_image, &warped.warped_image, &valid, &difference];
        let pictures = pictures.into_iter().chain(&aligned);
        for (column, picture) in pictures.enumerate() {
            let (left, top) = (GAP + column * cell_width, GAP + row * cell_height);
            for (v, u) in (0..height * scale).flat_map(|v| (0..width * scale).map(move |u| (v, u))) {
                let pixel = 3 * (v / scale * width + u / scale);
                let colour = [0, 1, 2].map(|channel| picture.bytes[pixel + channel]);
                sheet.put_pixel((left + u) as u32, (top + v) as u32, image::Rgb(colour));
            }
        }
    }
    let mut png = Cursor::new(Vec::new());
    sheet.write_to(&mut png, image::ImageFormat::Png).expect("an RGB image is a PNG");
    png.into_inner()
}

fn validity(warped: &WarpedPair) -> RgbImage {
    let bytes = warped.valid.iter().flat_map(|&valid| [if valid { 255 } else { 0 }; 3]).collect();
    RgbImage { bytes, ..warped.warped_image }
}

/// Grey where not valid.
fn difference(sample: &PairSample, warped: &WarpedPair) -> RgbImage {
    let levels = warped.warped_image.bytes.iter().zip(&sample.target_image.bytes).enumerate();
    let bytes = levels.map(|(index, (warped_level, target_level))| match warped.valid[index / 3] {
        true => warped_level.abs_diff(*target_level).saturating_mul(2),
        false => 128,
    });
    RgbImage { bytes: bytes.collect(), ..warped.warped_image }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::depth::DepthMap;
    use crate::geometry::{Pinhole, Pose, Tangent};

    #[test]
    fn a_sheet_shows_its_pictures_a_row_each() {
        let picture = |level: u8| RgbImage { width: 128, height: 4, bytes: vec![level; 3 * 128 * 4] };
        let sample = PairSample {
            source_image: Arc::new(picture(10)),
            target_image: Arc::new(picture(20)),
            target_depth: Arc::new(DepthMap { width: 128, height: 4, depth_m: vec![1.0; 128 * 4] }),
            camera: Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 128, height: 4 },
            source_from_target: Pose::identity(),
            error: Tangent::zeros(),
            right: None,
            evidence: None,
        };
        let mut valid = vec![true; 128 * 4];
        valid[0] = false;
        let warped = WarpedPair { warped_image: picture(50), valid, mean_difference: Some(30.0) };
        let row = SheetRow { sample, warped: warped.clone(), aligned: None };
        let png = contact_sheet(&[row.clone(), row.clone()]);
        let sheet = image::load_from_memory(&png).unwrap().into_rgb8();
        assert_eq!(sheet.dimensions(), (5 * 260 + 4, 2 * 12 + 4));
        let at = |column: u32, u: u32| sheet.get_pixel(4 + 260 * column + u, 4).0[0];
        assert_eq!([at(0, 9), at(1, 9), at(2, 9), at(3, 9), at(4, 9)], [10, 20, 50, 255, 60]);
        assert_eq!([at(3, 0), at(4, 1)], [0, 128]);
        assert_eq!(sheet.get_pixel(0, 0).0, [255; 3]);
        let aligned = Some(WarpedPair { warped_image: picture(22), ..warped });
        let sheet = image::load_from_memory(&contact_sheet(&[row.clone(), SheetRow { aligned, ..row }])).unwrap();
        assert_eq!(sheet.width(), 6 * 260 + 4);
        let at = |row: u32| sheet.clone().into_rgb8().get_pixel(4 + 260 * 5 + 9, 4 + 12 * row).0[0];
        assert_eq!([at(0), at(1)], [255, 4], "nothing where the alignment came to no verdict");
    }
}
