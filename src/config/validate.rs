//! What a configuration must satisfy beyond its types.

use std::collections::BTreeSet;
use std::path::Path;

use super::Config;
use crate::alignment::EvidenceInput;
use crate::depth::monodepth2::{MOST_SIZE, SIZE_STEP, is_input_size};
use crate::depth::{DepthConfig, DepthRange, NetworkDepthConfig, ScaleRule};
use crate::error::{Error, Result};
use crate::files::{DEPTH_SLOTS, MEASUREMENT_SLOTS, is_plain, require_slots};
use crate::model::{ImagePair, MinLogVariance, ModelConfig, PoseInput};
use crate::network::{Head, ImageNetwork};
use crate::pairs::{DataConfig, DriveConfig};
use crate::recordings::{CameraConfig, Layout};
use crate::schedule::DepthTrainingConfig;
use crate::synthetic::{SyntheticSettings, drive_name};
use crate::systems::{PerturbationConfig, SystemSource, TruthConfig};

/// Frames of a pair are not farther apart.
const LARGEST_GAP: usize = 10_000;

/// Least smaller side of images that are aligned, px; the larger one is twice that.
const LEAST_ALIGNED: usize = 16;

impl Config {
    /// Checks values against each other.
    ///
    /// # Errors
    /// Names the key, the value found and what would do.
    pub fn validate(&self) -> Result<()> {
        self.validate_name()?;
        self.validate_data()?;
        self.validate_systems()?;
        self.validate_depth()?;
        self.validate_model()?;
        self.validate_training()?;
        self.validate_depth_training()
    }

    fn validate_name(&self) -> Result<()> {
        require(is_plain(&self.name), "name", || {
            format!("`{}` cannot name a folder; use letters, digits, - and _", self.name)
        })
    }

    fn validate_data(&self) -> Result<()> {
        self.validate_place()?;
        if let Some(synthetic) = &self.data.synthetic {
            synthetic.validate("data.synthetic.")?;
            self.validate_synthetic_drives(synthetic)?;
        }
        let gaps = &self.data.gap;
        let usable = gaps.iter().all(|gap| (1..=LARGEST_GAP).contains(gap));
        require(usable, "data.gap", || format!("{gaps:?}: a pair's frames are 1 to {LARGEST_GAP} frames apart"))?;
        let twice = gaps.iter().enumerate().any(|(index, gap)| gaps[..index].contains(gap));
        require(!twice, "data.gap", || format!("{gaps:?} names a number twice"))?;
        let cameras = [("data.camera".to_owned(), &self.data.camera)].into_iter().chain(self.cameras_of_drives());
        for (key, camera) in cameras {
            camera.as_ref().map_or(Ok(()), |camera| camera.validate(&key))?;
        }
        let fraction = self.data.validation_fraction;
        require((0.0..1.0).contains(&fraction), "data.validation_fraction", || format!("{fraction} is not in [0, 1)"))?;
        let cache_mb = self.data.cache_mb;
        require(cache_mb <= 1_000_000, "data.cache_mb", || format!("{cache_mb} MB is more than a terabyte"))?;
        let bad = self.data.max_bad_fraction;
        require((0.0..=1.0).contains(&bad), "data.max_bad_fraction", || format!("{bad} is not in [0, 1]"))?;
        for (split, drives) in
            [("train", &self.data.train), ("validation", &self.data.validation), ("test", &self.data.test)]
        {
            for (index, drive) in drives.iter().enumerate() {
                if let Some([first, end]) = drive.frames {
                    require(first < end, &format!("data.{split}.{index}.frames"), || {
                        format!("[{first}, {end}] holds no frame: the first must lie below the end")
                    })?;
                }
            }
        }
        Ok(())
    }

    /// The cameras that stand beside drives, and their keys.
    fn cameras_of_drives(&self) -> impl Iterator<Item = (String, &Option<CameraConfig>)> {
        let DataConfig { train, validation, test, .. } = &self.data;
        [("train", train), ("validation", validation), ("test", test)].into_iter().flat_map(|(split, drives)| {
            let key = move |index| format!("data.{split}.{index}.camera");
            drives.iter().enumerate().map(move |(index, drive)| (key(index), &drive.camera))
        })
    }

    /// Where the data are: below a folder, or listed in a file.
    fn validate_place(&self) -> Result<()> {
        let DataConfig { root, manifest, layout, camera, camera_from_vehicle, synthetic, .. } = &self.data;
        let listed = manifest.is_some();
        require(listed || !root.as_os_str().is_empty(), "data.root", || {
            "names no folder; give data.root, or a pairs manifest as data.manifest".to_owned()
        })?;
        require(!(listed && synthetic.is_some()), "data.manifest", || {
            "a manifest and data.synthetic exclude one another".to_owned()
        })?;
        require(!(listed && layout.is_some_and(|layout| layout != Layout::Manifest)), "data.layout", || {
            "is of recordings below data.root; data.manifest names a manifest, leave one of them out".to_owned()
        })?;
        let told = camera.is_some() || self.cameras_of_drives().any(|(_, camera)| camera.is_some());
        require(!(listed && told), "data.camera", || {
            "a manifest has its own intrinsics in the columns fx, fy, cx, cy; leave one of them out".to_owned()
        })?;
        require(!(listed && self.model.stereo), "model.stereo", || {
            "a pairs manifest has no right images; set model.stereo = false".to_owned()
        })?;
        let Some([_, _, _, quaternion @ ..]) = camera_from_vehicle else { return Ok(()) };
        let norm = quaternion.iter().map(|value| value * value).sum::<f64>().sqrt();
        let finite = camera_from_vehicle.iter().flatten().all(|value| value.is_finite());
        require(finite && (norm - 1.0).abs() < 1e-2, "data.camera_from_vehicle", || {
            format!("x y z qx qy qz qw with a quaternion of length {norm:.4}; expected 1")
        })
    }

    /// What the configuration reads must be among what it renders: found now rather than after rendering.
    fn validate_synthetic_drives(&self, synthetic: &SyntheticSettings) -> Result<()> {
        for (split, drives) in
            [("train", &self.data.train), ("validation", &self.data.validation), ("test", &self.data.test)]
        {
            for (index, DriveConfig { drive, .. }) in drives.iter().enumerate() {
                let rendered = (1..=synthetic.drives).any(|number| drive_name(number) == *drive);
                require(rendered, &format!("data.{split}.{index}.drive"), || {
                    let (first, last) = (drive_name(1), drive_name(synthetic.drives));
                    format!(
                        "`{drive}` is none of the {} drives that data.synthetic renders: {first} to {last}",
                        synthetic.drives
                    )
                })?;
            }
        }
        let scans = synthetic.lidar_steps > 0 || !matches!(self.depth, DepthConfig::Lidar { .. });
        require(scans, "depth.source", || {
            "`lidar` needs scans; data.synthetic.lidar_steps = 0 leaves them out".to_owned()
        })
    }

    fn validate_systems(&self) -> Result<()> {
        require(!self.systems.is_empty(), "systems", || {
            "none is given; add [[systems]] with name, share and source".to_owned()
        })?;
        for (index, system) in self.systems.iter().enumerate() {
            let SystemSource::Perturbation(PerturbationConfig { base }) = &system.source else { continue };
            let key = format!("systems.{index}.base");
            let sizes = base.unwrap_or([1.0; 6]);
            let positive = sizes.iter().all(|&size| size.is_finite() && size > 0.0);
            require(positive, &key, || format!("{sizes:?} are no sizes of errors; all must be positive, m and rad"))?;
            let measured = self.systems.iter().any(|other| {
                other.share > 0.0 && !matches!(other.source, SystemSource::Truth {} | SystemSource::Perturbation(_))
            });
            require(measured || base.is_some(), &key, || {
                "no other system is learned from whose errors could tell the size; give six sizes, m and rad".to_owned()
            })?;
        }
        for (index, system) in self.systems.iter().enumerate() {
            let key = format!("systems.{index}.share");
            require((0.0..=1.0).contains(&system.share), &key, || format!("{} is not in [0, 1]", system.share))?;
            require(index > 0 || system.share > 0.0, &key, || "the first system must be learned from".to_owned())?;
            let twin = self.systems[..index].iter().any(|other| other.name == system.name);
            let key = format!("systems.{index}.name");
            require(!twin, &key, || format!("`{}` is used twice; tables tell systems apart by name", system.name))?;
            require(is_plain(&system.name), &key, || {
                format!("`{}` cannot head a column; use letters, digits, - and _", system.name)
            })?;
        }
        self.validate_templates()?;
        let total: f64 = self.systems.iter().map(|system| system.share).sum();
        require((total - 1.0).abs() < 1e-9, "systems", || format!("the shares sum to {total}, not 1"))?;
        let batch = self.training.batch;
        let learned = || self.systems.iter().filter(|system| system.share > 0.0);
        for (index, system) in self.systems.iter().enumerate().filter(|(_, system)| system.share > 0.0) {
            let pairs = system.share * batch as f64;
            require(
                (pairs - pairs.round()).abs() < 1e-6 && pairs.round() >= 1.0,
                &format!("systems.{index}.share"),
                || {
                    let fits = |batch: &usize| {
                        learned().all(|system| {
                            let pairs = system.share * *batch as f64;
                            (pairs - pairs.round()).abs() < 1e-6 && pairs.round() >= 1.0
                        })
                    };
                    let better = (1..=1000).filter(fits).min_by_key(|candidate| candidate.abs_diff(batch));
                    let advice =
                        better.map_or(String::new(), |batch| format!("; training.batch = {batch} fits all shares"));
                    format!(
                        "{} of a batch of {batch} is {pairs} pairs, not a whole number of at least 1{advice}",
                        system.share
                    )
                },
            )?;
        }
        if let Some(name) = &self.training.watch_system {
            let known = learned().any(|system| &system.name == name);
            let problem = || format!("`{name}` is none of the systems that are learned from");
            require(known, "training.watch_system", problem)?;
        }
        Ok(())
    }

    /// Paths with slots, such as `{drive}`.
    fn validate_templates(&self) -> Result<()> {
        let DataConfig { train, validation, test, .. } = &self.data;
        let drives: BTreeSet<&str> =
            [train, validation, test].into_iter().flatten().map(|config| &*config.drive).collect();
        let check = |path: &Path, slots: &[&str], key: &str| {
            require_slots(path, slots).map_err(|problem| Error::config(key, problem))?;
            let text = path.to_string_lossy();
            let distinct = drives.len() < 2 || text.contains("{drive}") || text.contains("{sequence}");
            require(distinct, key, || format!("is one file for {} drives; name it by {{drive}}", drives.len()))
        };
        for (index, system) in self.systems.iter().enumerate() {
            let path = match &system.source {
                SystemSource::Trajectory(config) => &config.path,
                SystemSource::Relative(config) => &config.path,
                _ => continue,
            };
            check(path, &MEASUREMENT_SLOTS, &format!("systems.{index}.path"))?;
        }
        if let TruthConfig::Trajectory(config) = &self.truth {
            check(&config.path, &MEASUREMENT_SLOTS, "truth.path")?;
        }
        if let DepthConfig::Files { path } = &self.depth {
            check(Path::new(path), &DEPTH_SLOTS, "depth.path")?;
            require(path.contains("{frame}"), "depth.path", || {
                "is one map for all frames; name it by {frame}".to_owned()
            })?;
        }
        Ok(())
    }

    fn validate_depth(&self) -> Result<()> {
        match &self.depth {
            DepthConfig::GroundPlane { camera_height_m, horizon_px, max_depth_m } => {
                let positive = |key: &str, metres: f64| {
                    require(metres.is_finite() && metres > 0.0, &format!("depth.{key}"), || {
                        format!("{metres} m is not positive")
                    })
                };
                positive("camera_height_m", *camera_height_m)?;
                positive("max_depth_m", *max_depth_m)?;
                let row = horizon_px.unwrap_or(0.0);
                require(row.is_finite(), "depth.horizon_px", || format!("{row} is no image row"))
            }
            DepthConfig::Lidar { .. } | DepthConfig::Files { .. } | DepthConfig::Recording {} => Ok(()),
            DepthConfig::Monodepth2(NetworkDepthConfig { scale, cache, .. }) => {
                require(!cache.as_os_str().is_empty(), "depth.cache", || "names no folder".to_owned())?;
                let factor = if let Some(ScaleRule::Fixed(factor)) = scale { *factor } else { 1.0 };
                let positive = factor.is_finite() && factor > 0.0;
                require(positive, "depth.scale", || format!("fixed = {factor} is not positive"))
            }
        }
    }

    fn validate_model(&self) -> Result<()> {
        for (key, size) in [("model.width", self.model.width), ("model.height", self.model.height)] {
            require((16..=8192).contains(&size), key, || format!("{size} is not in [16, 8192] pixels"))?;
        }
        let masked = !(self.model.validity_mask && self.model.pair == ImagePair::Raw);
        require(masked, "model.validity_mask", || {
            "a raw pair has no validity; set model.pair = \"warped\"".to_owned()
        })?;
        self.validate_evidence()?;
        let dropout = self.model.dropout;
        require((0.0..1.0).contains(&dropout), "model.dropout", || format!("{dropout} is not in [0, 1)"))?;
        let key = "model.min_log_variance";
        match self.model.min_log_variance {
            MinLogVariance::Off => Ok(()),
            MinLogVariance::BelowMean(nats) => {
                require(nats.is_finite() && nats > 0.0, key, || format!("below_mean = {nats} is not positive"))
            }
            MinLogVariance::Absolute(values) => {
                let fine = values.iter().all(|value| value.abs() <= 80.0);
                require(fine, key, || format!("absolute = {values:?} must lie within ±80 (ln m², ln rad²)"))
            }
        }
    }

    fn validate_evidence(&self) -> Result<()> {
        let ModelConfig { evidence, network, head, pose, stereo, width, height, .. } = self.model;
        let known = evidence == EvidenceInput::Alignment;
        require(known || network == ImageNetwork::TableOne, "model.network", || {
            "`none` leaves nothing to see; set model.evidence = \"alignment\"".to_owned()
        })?;
        require(known || head != Head::Posterior, "model.head", || {
            "`posterior` needs evidence; set model.evidence = \"alignment\"".to_owned()
        })?;
        let pose_known = network == ImageNetwork::TableOne || pose == PoseInput::None;
        require(pose_known, "model.pose", || {
            "`mlp` stands beside images; evidence knows the measured motion, so leave it out".to_owned()
        })?;
        require(network == ImageNetwork::TableOne || !stereo, "model.stereo", || {
            "without Table I nothing looks at the right camera".to_owned()
        })?;
        let large = width.min(height) >= LEAST_ALIGNED && width.max(height) >= 2 * LEAST_ALIGNED;
        require(!known || large, "model.evidence", || {
            format!("`alignment` needs images of at least {}x{LEAST_ALIGNED} pixels", 2 * LEAST_ALIGNED)
        })
    }

    fn validate_training(&self) -> Result<()> {
        let training = &self.training;
        for (key, value) in [
            ("batch", training.batch),
            ("micro_batch", training.micro_batch),
            ("epochs", training.epochs),
            ("batches_per_epoch", training.batches_per_epoch.unwrap_or(1)),
            ("loader_threads", training.loader_threads),
            ("prefetch", training.prefetch),
            ("prefetch_mb", training.prefetch_mb),
            ("stop.smoothing", training.stop.smoothing),
            ("stop.window", training.stop.window),
        ] {
            require(value > 0, &format!("training.{key}"), || "must be at least 1".to_owned())?;
        }
        for (key, value, most) in
            [("loader_threads", training.loader_threads, 256), ("prefetch", training.prefetch, 1024)]
        {
            require(value <= most, &format!("training.{key}"), || format!("{value} is more than {most}"))?;
        }
        let left = self.model.network == ImageNetwork::None || training.evidence_epochs < training.epochs;
        require(left, "training.evidence_epochs", || {
            format!(
                "{} of {} epochs leave none for images; raise training.epochs, or set model.network = \"none\"",
                training.evidence_epochs, training.epochs
            )
        })?;
        let alone = training.evidence_epochs == 0 || self.model.evidence == EvidenceInput::Alignment;
        require(alone, "training.evidence_epochs", || "needs model.evidence = \"alignment\"".to_owned())?;
        let share = training.corrected_share;
        require((0.0..=1.0).contains(&share), "training.corrected_share", || format!("{share} is not in [0, 1]"))?;
        let rate = training.learning_rate;
        require(rate.is_finite() && rate > 0.0, "training.learning_rate", || format!("{rate} is not positive"))?;
        let rate = training.image_learning_rate.unwrap_or(rate);
        let positive = rate.is_finite() && rate > 0.0;
        require(positive, "training.image_learning_rate", || format!("{rate} is not positive"))?;
        let tolerance = training.stop.tolerance;
        require(tolerance.is_finite() && tolerance >= 0.0, "training.stop.tolerance", || {
            format!("{tolerance} is negative")
        })
    }
}

impl Config {
    fn validate_depth_training(&self) -> Result<()> {
        let DepthTrainingConfig { width, height, batch, epochs, learning_rate, range_m, initial_depth_m, .. } =
            &self.depth_training;
        for (key, size) in [("width", *width), ("height", *height)] {
            require(is_input_size(size), &format!("depth_training.{key}"), || {
                format!("{size} is no multiple of {SIZE_STEP} from {} to {MOST_SIZE}", 2 * SIZE_STEP)
            })?;
        }
        let per_epoch = self.depth_training.batches_per_epoch.unwrap_or(1);
        for (key, value) in [("batch", *batch), ("epochs", *epochs), ("batches_per_epoch", per_epoch)] {
            require(value > 0, &format!("depth_training.{key}"), || "must be at least 1".to_owned())?;
        }
        let rate = *learning_rate;
        require(rate.is_finite() && rate > 0.0, "depth_training.learning_rate", || format!("{rate} is not positive"))?;
        let DepthRange { min, max } = *range_m;
        require(min > 0.0 && max.is_finite() && min < max, "depth_training.range_m", || {
            format!("{min} to {max} m is no range of depths")
        })?;
        let start = *initial_depth_m;
        require(start > min && start < max, "depth_training.initial_depth_m", || {
            format!("{start} m is not inside depth_training.range_m, {min} to {max} m")
        })
    }
}

fn require(condition: bool, key: &str, problem: impl FnOnce() -> String) -> Result<()> {
    if condition { Ok(()) } else { Err(Error::config(key, problem())) }
}
