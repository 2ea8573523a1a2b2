//! The pairs of a data set as a manifest: how any layout looks as one's own data would.

use std::path::Path;

use super::dataset::Dataset;
use super::pair::{Pair, PairScope};
use crate::depth::{DepthConfig, map_file};
use crate::recordings::{ManifestCamera, ManifestRow, Recording, format_manifest_row, manifest_header};

/// A manifest of all pairs, split by split, to be written into `folder`: files below it are named from there, others by
/// their whole paths. Poses are those of the camera. Of a data set of measurements without a truth the true poses stay
/// empty, and so does depth that lies in no file, or is not as distorted as the images are.
pub fn manifest_of(dataset: &Dataset, depth: &DepthConfig, folder: &Path) -> String {
    let mut text = manifest_header();
    let mut rows: Vec<&Pair> =
        [&dataset.train, &dataset.validation, &dataset.test].into_iter().flat_map(|split| &split.pairs).collect();
    rows.sort_by_key(|pair| (pair.system, pair.id));
    for pair in rows {
        let recording = &dataset.drives[pair.id.drive];
        let [source, target] = [pair.id.source, pair.id.target];
        let name = |path: &Path| named_from(folder, path);
        let images = [source, target].map(|frame| recording.images.get(&frame).map(|path| name(path)));
        let [Some(source_image), Some(target_image)] = images else { continue };
        let maps_as_stored =
            recording.lens.is_none() || matches!(depth, DepthConfig::Recording {} | DepthConfig::Manifest {});
        let map = map_file(depth, recording, target, &dataset.root).filter(|_| maps_as_stored);
        let map = map.map(|path| name(&path));
        text += &format_manifest_row(&ManifestRow {
            system: &dataset.systems[pair.system],
            sequence: &recording.name,
            frames: [source, target],
            images: [&source_image, &target_image],
            camera: camera_of(recording, depth),
            source_from_target: pair.source_from_target,
            true_source_from_target: (dataset.scope != PairScope::Measured).then(|| pair.true_source_from_target()),
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
    let own = matches!(depth, DepthConfig::Recording {} | DepthConfig::Manifest {});
    let steps = if own { recording.depth_steps_per_metre } else { crate::recordings::KITTI_STEPS_PER_METRE };
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
