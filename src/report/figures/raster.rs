//! SVG to PNG, with a font of our own: a figure looks the same on a machine without fonts.

use std::sync::{Arc, OnceLock};

use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb::Database};

/// Pixels of the picture for each unit of the drawing.
const SCALE: f32 = 2.0;

/// Rasterises a figure at twice its nominal size.
///
/// # Errors
/// It is not a picture that can be drawn.
pub fn to_png(svg: &str) -> Result<Vec<u8>, String> {
    let options = Options { fontdb: fonts(), ..Options::default() };
    let tree = Tree::from_str(svg, &options).map_err(|error| error.to_string())?;
    let size = tree.size();
    let [width, height] = [size.width(), size.height()].map(|length| (length * SCALE).ceil() as u32);
    let mut pixels = Pixmap::new(width, height).ok_or_else(|| format!("{width}x{height} pixels"))?;
    resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut pixels.as_mut());
    pixels.encode_png().map_err(|error| error.to_string())
}

fn fonts() -> Arc<Database> {
    static FONTS: OnceLock<Arc<Database>> = OnceLock::new();
    FONTS
        .get_or_init(|| {
            let mut fonts = Database::new();
            fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
            let family = fonts.faces().next().and_then(|face| face.families.first()).map(|(name, _)| name.clone());
            if let Some(family) = family {
                fonts.set_sans_serif_family(family);
            }
            Arc::new(fonts)
        })
        .clone()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_and_lines_leave_ink() {
        let svg = |inside: &str| {
            format!(
                r##"<svg width="80" height="40" xmlns="http://www.w3.org/2000/svg"><rect width="80" height="40" fill="#fff"/>{inside}</svg>"##
            )
        };
        let dark = |inside: &str| {
            let png = to_png(&svg(inside)).unwrap();
            let picture = image::load_from_memory(&png).unwrap().into_rgb8();
            assert_eq!(picture.dimensions(), (160, 80));
            picture.pixels().filter(|pixel| pixel.0[0] < 128).count()
        };
        assert_eq!(dark(""), 0);
        assert!(dark(r#"<text x="10" y="30" font-family="sans-serif" font-size="20">σ² χ √</text>"#) > 100);
        assert!(to_png("nonsense").is_err());
    }
}
