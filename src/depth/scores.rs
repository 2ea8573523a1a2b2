//! Depth against LiDAR, as the field's tables have it (Eigen, Puhrsch, Fergus 2014; Garg et al. 2016).

use super::DepthMap;

/// Depths that are judged, m.
const LEAST_DEPTH_M: f32 = 1e-3;
const MOST_DEPTH_M: f32 = 80.0;

/// The part of a KITTI image that the field judges (Garg et al. 2016), called after Eigen's split.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct EigenCrop {
    rows: [usize; 2],
    columns: [usize; 2],
}

impl EigenCrop {
    pub fn of(map: &DepthMap) -> Self {
        let part = |size: usize, shares: [f64; 2]| shares.map(|share| (share * size as f64) as usize);
        Self {
            rows: part(map.height, [0.408_108_11, 0.991_891_89]),
            columns: part(map.width, [0.035_947_71, 0.964_052_29]),
        }
    }

    /// Whether a return is judged.
    pub fn contains(&self, u: usize, v: usize, depth: f32) -> bool {
        let within = |[first, end]: [usize; 2], index| (first..end).contains(&index);
        within(self.rows, v) && within(self.columns, u) && depth > LEAST_DEPTH_M && depth < MOST_DEPTH_M
    }
}

/// Errors of predicted depth d against true depth g, means over pixels, then over images.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DepthScores {
    /// Images that were judged.
    pub images: usize,
    /// Pixels that were judged.
    pub pixels: usize,
    /// True pixels that were not, for want of a prediction.
    pub unknown: usize,
    /// `|d − g| / g`.
    pub abs_rel: f64,
    /// `(d − g)² / g`, m.
    pub sq_rel: f64,
    /// `√mean (d − g)²`, m.
    pub rmse: f64,
    /// `√mean (ln d − ln g)²`.
    pub rmse_log: f64,
    /// Share of pixels with `max(d/g, g/d)` below 1.25, 1.25² and 1.25³.
    pub below: [f64; 3],
}

impl DepthScores {
    /// One image: the truth's known pixels in the Eigen crop, up to 80 m; predictions are bounded to the same range.
    /// `None` without such a pixel. Pixels without a prediction are left out.
    pub fn of_image(predicted: &DepthMap, truth: &DepthMap) -> Option<Self> {
        let crop = EigenCrop::of(truth);
        let mut scores = Self { images: 1, ..Self::default() };
        for (u, v, depth) in truth.known().filter(|&(u, v, depth)| crop.contains(u, v, depth)) {
            let predicted = predicted.seen_from(truth, u, v);
            if predicted <= 0.0 {
                scores.unknown += 1;
                continue;
            }
            let (d, g) = (predicted.clamp(LEAST_DEPTH_M.into(), MOST_DEPTH_M.into()), f64::from(depth));
            scores.pixels += 1;
            scores.abs_rel += (d - g).abs() / g;
            scores.sq_rel += (d - g).powi(2) / g;
            scores.rmse += (d - g).powi(2);
            scores.rmse_log += (d.ln() - g.ln()).powi(2);
            for (power, below) in scores.below.iter_mut().enumerate() {
                *below += f64::from((d / g).max(g / d) < 1.25_f64.powi(power as i32 + 1));
            }
        }
        let pixels = scores.pixels as f64;
        let mean = |sum: f64| sum / pixels;
        (scores.pixels > 0).then(|| Self {
            abs_rel: mean(scores.abs_rel),
            sq_rel: mean(scores.sq_rel),
            rmse: mean(scores.rmse).sqrt(),
            rmse_log: mean(scores.rmse_log).sqrt(),
            below: scores.below.map(mean),
            ..scores
        })
    }

    /// The mean over images, each counting the same, as the field takes it.
    pub fn mean(images: &[Self]) -> Option<Self> {
        let count = images.len() as f64;
        let mean = |of: fn(&Self) -> f64| images.iter().map(of).sum::<f64>() / count;
        (!images.is_empty()).then(|| Self {
            images: images.len(),
            pixels: images.iter().map(|scores| scores.pixels).sum(),
            unknown: images.iter().map(|scores| scores.unknown).sum(),
            abs_rel: mean(|scores| scores.abs_rel),
            sq_rel: mean(|scores| scores.sq_rel),
            rmse: mean(|scores| scores.rmse),
            rmse_log: mean(|scores| scores.rmse_log),
            below: [mean(|scores| scores.below[0]), mean(|scores| scores.below[1]), mean(|scores| scores.below[2])],
        })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn scores_of_a_map_that_is_twenty_percent_too_far() {
        let truth = DepthMap { width: 40, height: 20, depth_m: vec![10.0; 800] };
        let predicted = DepthMap { depth_m: vec![12.0; 800], ..truth.clone() };
        let scores = DepthScores::of_image(&predicted, &truth).unwrap();
        assert_eq!(scores.pixels, 37 * 11, "columns 1 to 37, rows 8 to 18");
        assert_relative_eq!(scores.abs_rel, 0.2, epsilon = 1e-6);
        assert_relative_eq!(scores.sq_rel, 0.4, epsilon = 1e-6);
        assert_relative_eq!(scores.rmse, 2.0, epsilon = 1e-6);
        assert_relative_eq!(scores.rmse_log, 1.2_f64.ln(), epsilon = 1e-6);
        assert_eq!(scores.below, [1.0; 3]);
    }

    #[test]
    fn far_unknown_and_cropped_pixels_are_not_judged() {
        let mut truth = DepthMap { width: 40, height: 20, depth_m: vec![0.0; 800] };
        truth.depth_m[10 * 40 + 20] = 90.0;
        truth.depth_m[2 * 40 + 20] = 10.0;
        let predicted = DepthMap { depth_m: vec![12.0; 800], ..truth.clone() };
        assert_eq!(DepthScores::of_image(&predicted, &truth), None);
    }
}
