//! Depth maps that a network made, kept as files: a map for each frame, and a manifest that says what made them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::estimator::weight_hashes;
use super::files::is_whole_png;
use super::{DepthEstimator, DepthMap, ScaleRule, ScaleScope, read_depth_png};
use crate::depth::NetworkDepthConfig;
use crate::error::{Error, Place, Result, shortened};
use crate::files::{is_partial, read_text, sha256_hex, write_atomically};
use crate::recordings::{Calibration, Recording};

/// A name of its own: run folders have a manifest.json, and a cache can be cleared.
const MANIFEST: &str = "depth_cache.json";
const SCHEMA: u32 = 1;

/// A folder of depth maps: `DATE/DRIVE/FRAME.png`, metres x 256, at the network's size.
#[derive(Clone, Debug)]
pub struct DepthCache {
    folder: PathBuf,
}

/// What made the maps of a cache.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CacheManifest {
    schema: u32,
    /// Name and SHA-256 of each file of weights.
    weights: Vec<(String, String)>,
    /// Width and height of the maps, px.
    size: [usize; 2],
    scale: ScaleRule,
    /// The rule these weights call for, taken where the configuration names none.
    default_scale: ScaleRule,
    scope: ScaleScope,
    /// For each drive, a hash of its calibration and first image: another drive of the same name has other depth.
    drives: BTreeMap<String, String>,
    /// The factor of each sequence that has been needed and has scans: its mean.
    pub sequence_factors: BTreeMap<String, f64>,
}

impl CacheManifest {
    pub fn new(estimator: &DepthEstimator, config: &NetworkDepthConfig) -> Self {
        Self {
            schema: SCHEMA,
            weights: estimator.hashes.clone(),
            size: [estimator.width, estimator.height],
            scale: config.scale.unwrap_or(estimator.default_scale),
            default_scale: estimator.default_scale,
            scope: config.scope,
            drives: BTreeMap::new(),
            sequence_factors: BTreeMap::new(),
        }
    }

    /// Notes which drives the maps are of.
    ///
    /// # Errors
    /// A drive is not the one whose maps are there.
    pub fn add_drives(&mut self, drives: &[Recording], folder: &Path) -> Result<()> {
        for drive in drives {
            let found = self.drives.entry(drive.name.clone()).or_insert_with(|| drive_hash(drive)).clone();
            if found != drive_hash(drive) {
                return Err(other_drive(drive, folder));
            }
        }
        Ok(())
    }

    /// What tells one set of maps from another.
    pub fn fingerprint(&self) -> String {
        format!("{:?}", (&self.weights, self.size, self.scale, self.scope))
    }

    pub fn scale(&self) -> ScaleRule {
        self.scale
    }

    /// What differs from another manifest, factors aside.
    fn difference(&self, other: &Self) -> Option<String> {
        let of = |name: &str, a: String, b: String| (a != b).then(|| format!("{name}: {a} there, {b} wanted"));
        let hash = |manifest: &Self| {
            let short = manifest.weights.iter().map(|(file, hash)| format!("{file} {}", &hash[..hash.len().min(8)]));
            short.collect::<Vec<_>>().join(", ")
        };
        let differences = [
            of("schema", self.schema.to_string(), other.schema.to_string()),
            of("weights", hash(self), hash(other)),
            of("size", format!("{:?}", self.size), format!("{:?}", other.size)),
            of("scale", format!("{:?}", self.scale), format!("{:?}", other.scale)),
            of("scope", format!("{:?}", self.scope), format!("{:?}", other.scope)),
        ];
        differences.into_iter().flatten().next()
    }
}

impl DepthCache {
    /// The cache of a configuration, whether or not it is there.
    pub fn of(config: &NetworkDepthConfig) -> Self {
        Self { folder: config.cache.clone() }
    }

    /// Where the maps are.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Path of every map, as `depth.path` of files has it.
    pub fn map_template(&self) -> String {
        self.folder.join("{date}/{drive}/{frame}.png").display().to_string()
    }

    /// Path of a frame's map.
    pub fn map_path(&self, drive: &Recording, frame: usize) -> PathBuf {
        self.folder.join(drive.date()).join(&drive.name).join(format!("{frame:010}.png"))
    }

    /// Whether a frame's map is there, from beginning to end.
    pub(super) fn holds(&self, drive: &Recording, frame: usize) -> bool {
        is_whole_png(&self.map_path(drive, frame))
    }

    /// Reads a frame's map, m.
    ///
    /// # Errors
    /// It is not there, or damaged.
    pub fn load(&self, drive: &Recording, frame: usize) -> Result<DepthMap> {
        let path = self.map_path(drive, frame);
        if !self.holds(drive, frame) {
            let problem = "no whole depth map of this frame; `relcov depth --config …` makes those that are missing";
            return Err(Error::Data(format!("{}: {problem}", path.display())));
        }
        read_depth_png(&path)
    }

    /// That the cache is there and was made of these drives by the configured weights and settings. Returns what tells
    /// its maps from others.
    ///
    /// # Errors
    /// It is missing or stale; the message says what differs and how to renew it.
    pub fn require(&self, config: &NetworkDepthConfig, drives: &[Recording]) -> Result<String> {
        let Some(manifest) = self.manifest()? else {
            return Err(Error::config(
                "depth.source",
                format!(
                    "monodepth2 needs its depth maps, and {} holds none; make them with: relcov depth --config … (and the same --set)",
                    self.folder.display()
                ),
            ));
        };
        // On a machine without the weights their maps are still good; nothing says otherwise.
        let weights = weight_hashes(&config.weights).unwrap_or_else(|error| {
            tracing::warn!("the depth cache's weights are not checked: {error}");
            manifest.weights.clone()
        });
        let scale = config.scale.unwrap_or(manifest.default_scale);
        let wanted = CacheManifest { weights, scale, scope: config.scope, ..manifest.clone() };
        self.refuse_other(&manifest, &wanted)?;
        let other =
            drives.iter().find(|drive| manifest.drives.get(&drive.name).is_some_and(|hash| *hash != drive_hash(drive)));
        match other {
            Some(drive) => Err(other_drive(drive, &self.folder)),
            None => Ok(manifest.fingerprint()),
        }
    }

    /// The manifest to go on with: that of the folder if it is the wanted one, else a new one.
    ///
    /// # Errors
    /// The folder's maps were made otherwise, or it holds something else.
    pub(super) fn begin(&self, wanted: CacheManifest) -> Result<CacheManifest> {
        if let Some(manifest) = self.manifest()? {
            self.refuse_other(&manifest, &wanted)?;
            return Ok(manifest);
        }
        self.refuse_foreign()?;
        Ok(wanted)
    }

    /// That the folder is a cache, or holds nothing.
    ///
    /// # Errors
    /// It holds something else.
    pub(super) fn refuse_foreign(&self) -> Result<()> {
        let foreign = self.folder.read_dir().is_ok_and(|mut entries| entries.next().is_some());
        if !foreign || self.folder.join(MANIFEST).is_file() {
            return Ok(());
        }
        Err(Error::config(
            "depth.cache",
            format!("{} holds something else; name a new or empty folder", self.folder.display()),
        ))
    }

    pub(super) fn write(&self, manifest: &CacheManifest) -> Result<()> {
        std::fs::create_dir_all(&self.folder).map_err(Error::io("create the folder", &self.folder))?;
        let json = serde_json::to_string_pretty(manifest).expect("a manifest is JSON");
        write_atomically(&self.folder.join(MANIFEST), json.as_bytes())
    }

    /// Removes a cache's maps and manifest, and nothing else.
    ///
    /// # Errors
    /// The folder holds something else than a cache, or a file cannot be removed.
    pub(super) fn clear(&self) -> Result<()> {
        self.refuse_foreign()?;
        let folders = |path: &Path| -> Vec<PathBuf> {
            let entries = path.read_dir().into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
            entries.filter(|path| path.is_dir()).collect()
        };
        for date in folders(&self.folder) {
            for drive in folders(&date) {
                let files = drive.read_dir().into_iter().flatten().filter_map(|entry| Some(entry.ok()?.path()));
                for map in files.filter(|path| is_map(path)) {
                    std::fs::remove_file(&map).map_err(Error::io("remove", &map))?;
                }
                // Not empty: someone keeps other files there.
                let _ = std::fs::remove_dir(&drive);
            }
            let _ = std::fs::remove_dir(&date);
        }
        let manifest = self.folder.join(MANIFEST);
        if manifest.exists() { std::fs::remove_file(&manifest).map_err(Error::io("remove", &manifest)) } else { Ok(()) }
    }

    fn refuse_other(&self, found: &CacheManifest, wanted: &CacheManifest) -> Result<()> {
        match found.difference(wanted) {
            None => Ok(()),
            Some(difference) => Err(Error::config(
                "depth",
                format!(
                    "the depth maps in {} were made otherwise ({difference}); renew them with: relcov depth --force --config … (and the same --set)",
                    self.folder.display()
                ),
            )),
        }
    }

    fn manifest(&self) -> Result<Option<CacheManifest>> {
        let path = self.folder.join(MANIFEST);
        if !path.is_file() {
            return Ok(None);
        }
        serde_json::from_str(&read_text(&path)?).map(Some).map_err(|error| {
            let expected = "what `relcov depth` of this version writes; --force renews the cache";
            Error::malformed(&path, Place::Whole, shortened(&error.to_string()), expected)
        })
    }
}

/// A map's name: ten digits, and what a killed command leaves of one.
fn is_map(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let name = if is_partial(name.as_ref()) { &name[1..] } else { name };
    let (frame, extension) = name.split_once('.').unwrap_or((name, ""));
    frame.len() == 10
        && frame.bytes().all(|byte| byte.is_ascii_digit())
        && (extension == "png" || extension.starts_with("png.") && extension.ends_with(".partial"))
}

fn drive_hash(drive: &Recording) -> String {
    let first = drive.images.values().next().and_then(|path| std::fs::read(path).ok()).unwrap_or_default();
    let mut bytes = calibration_of(&drive.calibration).into_bytes();
    bytes.extend(first);
    sha256_hex(&bytes)
}

/// A calibration in words that stay, whatever its fields are called.
fn calibration_of(calibration: &Calibration) -> String {
    let Calibration { camera, camera_from_camera0, camera_from_velodyne, camera_from_vehicle, right_from_left } =
        calibration;
    format!(
        "Calibration {{ camera2: {camera:?}, camera2_from_camera0: {camera_from_camera0:?}, camera2_from_velodyne: {camera_from_velodyne:?}, camera2_from_vehicle: {camera_from_vehicle:?}, camera3_from_camera2: {right_from_left:?} }}"
    )
}

fn other_drive(drive: &Recording, folder: &Path) -> Error {
    Error::config(
        "depth.cache",
        format!(
            "the maps of {} in {} are of another drive of that name (its calibration or first image differs): other data; name another depth.cache, or renew the maps with: relcov depth --force --config … (and the same --set)",
            drive.name,
            folder.display()
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clearing_takes_maps_and_leaves_everything_else() {
        let folder = tempfile::tempdir().unwrap();
        let cache = DepthCache { folder: folder.path().to_owned() };
        let drive = folder.path().join("2026_01_01/drive");
        std::fs::create_dir_all(&drive).unwrap();
        for name in ["0000000003.png", "0000000004.png.77.partial", ".0000000005.png.77.partial", "notes.txt"] {
            std::fs::write(drive.join(name), "x").unwrap();
        }
        let message = cache.clear().unwrap_err().to_string();
        assert!(message.contains("holds something else"), "{message}");
        std::fs::write(folder.path().join(MANIFEST), "{}").unwrap();
        cache.clear().unwrap();
        let left: Vec<_> = drive.read_dir().unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left, ["notes.txt"]);
        assert!(!folder.path().join(MANIFEST).exists());
    }
}
