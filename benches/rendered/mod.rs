//! A pair of the synthetic street with its simulated visual odometry: images, depth and an error as the readers give
//! them, for benchmarks of the alignment.

use std::path::{Path, PathBuf};

use relcov::alignment::{AlignmentInput, GreyImage};
use relcov::config::Config;
use relcov::geometry::Pose;
use relcov::pairs::{Dataset, PairReader, PairSample, PairScope, SplitName};
use relcov::recordings::RgbImage;
use relcov::synthetic::{Replace, record};

const DRIVE: &str = "2026_01_01_drive_0001_sync";
const FRAMES: usize = 32;

/// Two frames and what a system measured between them.
#[allow(dead_code, reason = "a module of two benchmarks, of which one asks for times alone")]
pub struct RenderedPair {
    sample: PairSample,
    source_image: GreyImage,
    target_image: GreyImage,
    /// Images and depths of source and target, as files.
    pub images: [PathBuf; 2],
    pub depths: [PathBuf; 2],
}

impl RenderedPair {
    /// The pair of a drive that is rendered into a folder, where it is not there yet. Of all its pairs that with the
    /// median length of the error.
    pub fn new(folder: &Path, (width, height): (usize, usize)) -> Self {
        let settings = [
            format!("data.root={}", folder.display()),
            "data.error_frame=camera".to_owned(),
            format!("data.train=[{{drive=\"{DRIVE}\"}}]"),
            "data.validation=[]".to_owned(),
            "data.test=[]".to_owned(),
            "data.synthetic.drives=1".to_owned(),
            format!("data.synthetic.frames={FRAMES}"),
            format!("data.synthetic.size=[{width},{height}]"),
            format!("model.width={width}"),
            format!("model.height={height}"),
        ];
        let config = Config::load("configs/synthetic.toml".as_ref(), &settings).expect("a shipped configuration");
        let synthetic = config.data.synthetic.as_ref().expect("a rendered data set");
        record(folder, synthetic, Replace::Never, &mut |_| Ok(())).expect("rendered");
        let dataset = Dataset::load(&config.pairs(), PairScope::Images).expect("a drive just rendered");
        let mut measured: Vec<_> = dataset.train.pairs_of(0).iter().collect();
        measured.sort_by(|a, b| a.error.norm().total_cmp(&b.error.norm()));
        let pair = measured[measured.len() / 2];
        let reader = PairReader::new(&config.pairs(), &dataset, SplitName::Train);
        let sample = reader.read(pair).expect("readable").expect("readable");
        let grey = |image: &RgbImage| GreyImage::from_rgb(image.width, image.height, &image.bytes);
        let file =
            |kind: &str, frame: usize| folder.join(format!("{}/{DRIVE}/{kind}/data/{frame:010}.png", &DRIVE[..10]));
        let frames = [pair.id.source, pair.id.target];
        Self {
            source_image: grey(&sample.source_image),
            target_image: grey(&sample.target_image),
            images: frames.map(|frame| file("image_02", frame)),
            depths: frames.map(|frame| file("depth_02", frame)),
            sample,
        }
    }

    /// What an alignment starts from.
    pub fn input(&self) -> AlignmentInput<'_> {
        AlignmentInput {
            source_image: &self.source_image,
            target_image: &self.target_image,
            target_depth_m: &self.sample.target_depth.depth_m,
            camera: self.sample.camera,
            source_from_target: self.sample.source_from_target,
        }
    }

    /// The true motion.
    #[allow(dead_code, reason = "as above")]
    pub fn true_source_from_target(&self) -> Pose {
        Pose::exp(&-self.sample.error) * self.sample.source_from_target
    }
}
