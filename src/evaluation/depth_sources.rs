//! Which depth to choose: the same pairs warped by the true motion with the depth of several sources.

use burn::tensor::Device;

use super::warped::{WarpedPair, mean_difference, warp_pair};
use crate::config::Config;
use crate::depth::DepthConfig;
use crate::error::{Error, Result};
use crate::pairs::{Dataset, PairReader, PairSample, PairScope, SplitName};
use crate::recordings::RgbImage;

/// How well one source's depth explains the pairs, means over them.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceScores {
    /// The source.
    pub name: String,
    /// Share of pixels whose depth is known.
    pub known: f64,
    /// Share of pixels that have a source in the other image.
    pub valid: f64,
    /// Mean of `|I^w − I_{i+1}|` over those pixels, grey levels.
    pub difference: f64,
    /// The same over the pixels that are valid by every source.
    pub common_difference: f64,
}

/// Sources judged on the same pairs.
#[derive(Clone, Debug)]
pub struct SourceComparison {
    /// Pairs that every source can warp.
    pub pairs: usize,
    /// Share of pixels that are valid by every source.
    pub common: f64,
    /// Mean of `|I_i − I_{i+1}|` over those, grey levels: without any warp.
    pub unwarped_difference: f64,
    /// One for each source.
    pub sources: Vec<SourceScores>,
    /// A pair in the middle by each source, to be looked at.
    pub example: Vec<(PairSample, WarpedPair)>,
}

/// Warps the test pairs by their true motion, with each of the sources.
///
/// # Errors
/// No pair has an image and depth by every source, or one of them cannot be read.
pub fn compare_depth_sources(
    config: &Config,
    sources: &[(String, DepthConfig)],
    device: &Device,
) -> Result<SourceComparison> {
    let readers = sources
        .iter()
        .map(|(_, depth)| {
            let mut config = Config { depth: depth.clone(), ..config.with_truth_alone() };
            // A source needs to know the pairs that are compared, not those of other splits.
            (config.data.train, config.data.validation) = (Vec::new(), Vec::new());
            let dataset = Dataset::load(&config.pairs(), PairScope::Images)?;
            Ok((PairReader::new(&config.pairs(), &dataset, SplitName::Test), dataset.test.pairs))
        })
        .collect::<Result<Vec<_>>>()?;
    let Some((first, others)) = readers.split_first() else {
        return Err(Error::Data("no depth source to compare".to_owned()));
    };
    let everywhere = |id| others.iter().all(|(_, pairs)| pairs.iter().any(|pair| pair.id == id));
    let ids: Vec<_> = first.1.iter().map(|pair| pair.id).filter(|&id| everywhere(id)).collect();
    if ids.is_empty() {
        return Err(Error::Data(
            "not one test pair has images and depth by every source: `relcov inspect` shows what the drives hold; data.test chooses them"
                .to_owned(),
        ));
    }
    let mut sums = Sums::new(sources.len());
    let mut example = Vec::new();
    for (index, id) in ids.iter().enumerate() {
        let mut warped = Vec::new();
        for (reader, pairs) in &readers {
            let pair = pairs.iter().find(|pair| pair.id == *id).expect("everywhere");
            if let Some(sample) = reader.read(pair)? {
                let pair = warp_pair(&sample, device)?;
                warped.push((sample, pair));
            }
        }
        // A pair that one source cannot read is left out; the reader has warned of it.
        if warped.len() == readers.len() {
            sums.add(&warped);
            if index <= ids.len() / 2 {
                example = warped;
            }
        }
    }
    if sums.pairs == 0 {
        return Err(Error::Data(
            "not one test pair can be read by every source; the warnings above say why".to_owned(),
        ));
    }
    Ok(sums.comparison(sources, example))
}

#[derive(Clone, Copy, Default)]
struct Sum {
    known: f64,
    valid: f64,
    difference: f64,
    common_difference: f64,
}

/// Sums over pairs.
struct Sums {
    pairs: usize,
    common: f64,
    unwarped: f64,
    sources: Vec<Sum>,
}

impl Sums {
    fn new(sources: usize) -> Self {
        Self { pairs: 0, common: 0.0, unwarped: 0.0, sources: vec![Sum::default(); sources] }
    }

    fn add(&mut self, warped: &[(PairSample, WarpedPair)]) {
        let pixels = warped[0].1.valid.len();
        let common: Vec<bool> = (0..pixels).map(|pixel| warped.iter().all(|(_, pair)| pair.valid[pixel])).collect();
        let share = |mask: &[bool]| mask.iter().filter(|&&inside| inside).count() as f64 / pixels as f64;
        let difference =
            |a: &RgbImage, b: &RgbImage, mask: &[bool]| mean_difference(&a.bytes, &b.bytes, mask).unwrap_or(0.0);
        let sample = &warped[0].0;
        self.pairs += 1;
        self.common += share(&common);
        self.unwarped += difference(&sample.source_image, &sample.target_image, &common);
        for (sum, (sample, pair)) in self.sources.iter_mut().zip(warped) {
            let (image, target) = (&pair.warped_image, &sample.target_image);
            sum.known += sample.target_depth.known().count() as f64 / pixels as f64;
            sum.valid += share(&pair.valid);
            sum.difference += difference(image, target, &pair.valid);
            sum.common_difference += difference(image, target, &common);
        }
    }

    fn comparison(self, sources: &[(String, DepthConfig)], example: Vec<(PairSample, WarpedPair)>) -> SourceComparison {
        let mean = |sum: f64| sum / self.pairs as f64;
        let scores = sources.iter().zip(&self.sources).map(|((name, _), sum)| SourceScores {
            name: name.clone(),
            known: mean(sum.known),
            valid: mean(sum.valid),
            difference: mean(sum.difference),
            common_difference: mean(sum.common_difference),
        });
        SourceComparison {
            pairs: self.pairs,
            common: mean(self.common),
            unwarped_difference: mean(self.unwarped),
            sources: scores.collect(),
            example,
        }
    }
}
