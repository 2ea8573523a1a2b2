//! The pairs of a data set as a manifest: how any layout looks as one's own data would.

use std::path::Path;

use super::dataset::Dataset;
use super::pair::Pair;
use crate::depth::{DepthConfig, map_file};
use crate::recordings::{
    KITTI_STEPS_PER_METRE, ManifestCamera, ManifestRow, Recording, format_manifest_row, manifest_header,
};

/// A manifest of all pairs, split by split, to be written into `folder`: files below it are named from there, others by
/// their whole paths. Poses are those of the camera. What is not known stays empty: true poses without a truth, and depth
/// that lies in no file, or is of undistorted images where those in the files are distorted.
pub fn manifest_of(dataset: &Dataset, depth: &DepthConfig, folder: &Path) -> String {
    let mut text = manifest_header();
    let mut rows: Vec<&Pair> =
        [&dataset.train, &dataset.validation, &dataset.test].into_iter().flat_map(|split| &split.pairs).collect();
    rows.sort_by_key(|pair| (pair.system, pair.id));
    // A drive may be in several splits.
    rows.dedup_by_key(|pair| (pair.system, pair.id));
    for pair in rows {
        let recording = &dataset.drives[pair.id.drive];
        let [source, target] = [pair.id.source, pair.id.target];
        let name = |path: &Path| named_from(folder, path);
        let images = [source, target].map(|frame| recording.images.get(&frame).map(|path| name(path)));
        let [Some(source_image), Some(target_image)] = images else { continue };
        let as_stored = recording.lens.is_none() || *depth == DepthConfig::Recording {};
        let map = map_file(depth, recording, target, &dataset.root).filter(|_| as_stored);
        let map = map.map(|path| name(&path));
        text += &format_manifest_row(&ManifestRow {
            system: &dataset.systems[pair.system],
            sequence: &recording.name,
            frames: [source, target],
            images: [&source_image, &target_image],
            camera: camera_of(recording, depth),
            source_from_target: pair.source_from_target,
            true_source_from_target: pair.true_source_from_target(),
            depth: map.as_deref(),
            times: [source, target].map(|frame| recording.times.get(&frame).copied()),
        });
    }
    text
}

/// The camera of the images as stored.
fn camera_of(recording: &Recording, depth: &DepthConfig) -> ManifestCamera {
    let (camera, distortion) = match &recording.lens {
        Some(undistortion) => (undistortion.lens().camera, undistortion.lens().distortion),
        None => (recording.calibration.camera, [0.0; 5]),
    };
    let own = *depth == DepthConfig::Recording {};
    let steps = if own { recording.depth_steps_per_metre } else { KITTI_STEPS_PER_METRE };
    ManifestCamera {
        intrinsics: [camera.fx, camera.fy, camera.cx, camera.cy],
        distortion,
        depth_factor: f64::from(steps),
    }
}

fn named_from(folder: &Path, path: &Path) -> String {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    absolute.strip_prefix(folder).unwrap_or(&absolute).to_string_lossy().into_owned()
}
