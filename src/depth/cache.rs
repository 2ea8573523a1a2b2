//! Depth maps that a network made, kept as files: a map for each frame, and a manifest that says what made them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::estimator::weight_hashes;
use super::{DepthEstimator, DepthMap, ScaleRule, ScaleScope, read_depth_png};
use crate::config::NetworkDepthConfig;
use crate::data::Drive;
use crate::error::{Error, Place, Result};
use crate::files::{read_text, write_atomically};

const MANIFEST: &str = "manifest.json";
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
    scope: ScaleScope,
    /// The factor of each sequence, for frames without a scan or by the scope.
    #[serde(default)]
    pub sequence_factors: BTreeMap<String, f64>,
}

impl CacheManifest {
    pub fn new(estimator: &DepthEstimator, config: &NetworkDepthConfig) -> Self {
        Self {
            schema: SCHEMA,
            weights: estimator.hashes.clone(),
            size: [estimator.width, estimator.height],
            scale: config.scale.unwrap_or(estimator.default_scale),
            scope: config.scope,
            sequence_factors: BTreeMap::new(),
        }
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
    pub fn map_path(&self, drive: &Drive, frame: usize) -> PathBuf {
        self.folder.join(drive.date()).join(&drive.name).join(format!("{frame:010}.png"))
    }

    /// Reads a frame's map, m.
    ///
    /// # Errors
    /// It is not there, or damaged.
    pub fn load(&self, drive: &Drive, frame: usize) -> Result<DepthMap> {
        let path = self.map_path(drive, frame);
        if !path.is_file() {
            let problem = "no depth map of this frame; `relcov depth --config …` makes those that are missing";
            return Err(Error::Data(format!("{}: {problem}", path.display())));
        }
        read_depth_png(&path)
    }

    /// That the cache is there and was made by the configured weights and settings.
    ///
    /// # Errors
    /// It is missing or stale; the message says what differs and how to renew it.
    pub fn require(&self, config: &NetworkDepthConfig) -> Result<()> {
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
        let wanted = CacheManifest {
            weights,
            scale: config.scale.unwrap_or(manifest.scale),
            scope: config.scope,
            ..manifest.clone()
        };
        self.refuse_other(&manifest, &wanted)
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
        let foreign = self.folder.read_dir().is_ok_and(|mut entries| entries.next().is_some());
        if foreign {
            return Err(Error::config(
                "depth.cache",
                format!("{} holds something else; name a new or empty folder", self.folder.display()),
            ));
        }
        self.write(&wanted)?;
        Ok(wanted)
    }

    pub(super) fn write(&self, manifest: &CacheManifest) -> Result<()> {
        std::fs::create_dir_all(&self.folder).map_err(Error::io("create the folder", &self.folder))?;
        let json = serde_json::to_string_pretty(manifest).expect("a manifest is JSON");
        write_atomically(&self.folder.join(MANIFEST), json.as_bytes())
    }

    /// Removes the maps of a cache, and nothing that is not one.
    ///
    /// # Errors
    /// The folder is no cache, or cannot be removed.
    pub fn clear(&self) -> Result<()> {
        if !self.folder.exists() {
            return Ok(());
        }
        if !self.folder.join(MANIFEST).is_file() {
            let problem = format!("{} is no depth cache; it stays as it is", self.folder.display());
            return Err(Error::config("depth.cache", problem));
        }
        std::fs::remove_dir_all(&self.folder).map_err(Error::io("remove", &self.folder))
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
            Error::malformed(&path, Place::Whole, error.to_string(), expected)
        })
    }
}
