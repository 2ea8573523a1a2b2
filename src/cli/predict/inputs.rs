//! What predictions are made for: a drive, a manifest, or one system of a configuration, each as a configuration.

use std::path::{Path, PathBuf};

use super::arguments::{BodyArgument, MeasurementFormat, PredictArguments};
use crate::config::Config;
use crate::depth::DepthConfig;
use crate::error::{Error, Place, Result};
use crate::files::extension;
use crate::pairs::{DataConfig, DriveConfig};
use crate::recordings::{Manifest, MeasurementFrame, is_known_camera, locate_recording};
use crate::systems::{RelativeConfig, SystemConfig, SystemSource, TrajectoryConfig, TrajectoryFormat, TruthConfig};

/// The measurements of one drive.
pub(super) fn of_drive(arguments: &PredictArguments, config: Config, drive: &Path) -> anyhow::Result<Config> {
    let path = arguments.measurements.as_deref().expect("clap requires it");
    if !path.is_file() {
        let problem = if path.exists() { "no regular file" } else { "no such file" };
        return Err(Error::Data(format!("--measurements {}: {problem}", path.display())).into());
    }
    let located = locate_recording(drive)?;
    let path = std::path::absolute(path).map_err(Error::io("read", path))?;
    let form = arguments.measurement_format.unwrap_or(match extension(&path).as_str() {
        "csv" => MeasurementFormat::Relative,
        "tum" => MeasurementFormat::Tum,
        _ if located.layout.has_tum_trajectories() => MeasurementFormat::Tum,
        _ => MeasurementFormat::Kitti,
    });
    let frame = arguments.measurement_frame.map_or(MeasurementFrame::Camera0, BodyArgument::frame);
    let system = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let trajectory = |format| SystemSource::Trajectory(TrajectoryConfig { path: path.clone(), format, frame });
    let source = match form {
        MeasurementFormat::Kitti => trajectory(TrajectoryFormat::Kitti),
        MeasurementFormat::Tum => trajectory(TrajectoryFormat::Tum),
        MeasurementFormat::Relative => SystemSource::Relative(RelativeConfig { path: path.clone(), frame }),
    };
    let takes = |key: &str, taken: bool| arguments.changes(key) || taken;
    // What a run says of its camera is of no other kind of recording, nor of one whose camera is known.
    let (takes_camera, takes_vehicle) = (located.layout.takes_camera(), located.layout.takes_vehicle());
    let own_camera = takes("data.camera", takes_camera && !is_known_camera(&located.name));
    let camera = config.data.camera.clone().filter(|_| own_camera);
    let depth = match located.brings_depth() && !arguments.changes("depth") {
        true => DepthConfig::Recording {},
        false => config.depth.clone(),
    };
    Ok(Config {
        data: DataConfig {
            root: located.root,
            layout: Some(located.layout),
            camera_from_vehicle: config
                .data
                .camera_from_vehicle
                .filter(|_| takes("data.camera_from_vehicle", takes_vehicle)),
            ..only_test(arguments, &config.data, vec![DriveConfig { drive: located.name, frames: None, camera }])
        },
        depth,
        truth: TruthConfig::Recording {},
        systems: vec![SystemConfig { name: system, share: 1.0, source }],
        ..config
    })
}

/// All measurements of a manifest.
pub(super) fn of_manifest(arguments: &PredictArguments, config: Config, path: &Path) -> anyhow::Result<Config> {
    let manifest = Manifest::load(path)?;
    let frame = arguments.measurement_frame.map_or(MeasurementFrame::Camera, BodyArgument::frame);
    let system =
        |name: &str| SystemConfig { name: name.to_owned(), share: 1.0, source: SystemSource::Manifest { frame } };
    let drives = manifest.sequences().map(|name| DriveConfig { drive: name.to_owned(), frames: None, camera: None });
    let data = DataConfig {
        manifest: Some(path.to_owned()),
        camera_from_vehicle: arguments.camera_from_vehicle.or(config.data.camera_from_vehicle),
        ..only_test(arguments, &config.data, drives.collect())
    };
    let depth = match &config.depth {
        _ if arguments.changes("depth") => config.depth.clone(),
        _ if manifest.has_depth() => DepthConfig::Recording {},
        _ if manifest.has_some_depth() => {
            return Err(Error::malformed(
                path,
                Place::Field("depth".to_owned()),
                "rows with a depth map and rows without",
                "one for each target frame, or none; or --set depth.source=ground_plane for all",
            )
            .into());
        }
        DepthConfig::GroundPlane { .. } | DepthConfig::Monodepth2(_) => config.depth.clone(),
        DepthConfig::Lidar { .. } | DepthConfig::Files { .. } | DepthConfig::Recording {} => {
            return Err(Error::malformed(
                path,
                Place::Field("depth".to_owned()),
                "rows without a depth map",
                "one for each target frame, as the model was trained with; or --set depth.source=ground_plane, or a depth network (docs/depth.md)",
            )
            .into());
        }
    };
    let systems = manifest.systems().into_iter().map(system).collect();
    Ok(Config { data, depth, truth: TruthConfig::Manifest { frame }, systems, ..config })
}

/// The data of a configuration replaced by drives to predict for, wherever they lie.
fn only_test(arguments: &PredictArguments, data: &DataConfig, test: Vec<DriveConfig>) -> DataConfig {
    DataConfig {
        root: PathBuf::new(),
        manifest: None,
        layout: None,
        camera: None,
        // What was measured is what the file lists, unless something else is asked for.
        gap: if arguments.changes("data.gap") { data.gap.clone() } else { Vec::new() },
        synthetic: None,
        train: Vec::new(),
        validation: Vec::new(),
        test,
        ..data.clone()
    }
}

/// A prediction that cannot be made is no reason to withhold the others.
pub(super) fn lenient(arguments: &PredictArguments, mut config: Config) -> Config {
    if !arguments.changes("data.max_bad_fraction") {
        config.data.max_bad_fraction = 1.0;
    }
    config
}

/// One system alone, where it was asked for.
pub(super) fn with_system(arguments: &PredictArguments, mut config: Config) -> Result<Config> {
    let Some(name) = &arguments.system else {
        // Nobody measured what was generated.
        config.systems.retain(|system| !matches!(system.source, SystemSource::Perturbation(_)));
        return Ok(config);
    };
    let known: Vec<String> = config.systems.iter().map(|system| system.name.clone()).collect();
    config.systems.retain(|system| system.name == *name);
    if config.systems.is_empty() {
        return Err(Error::Data(format!("--system {name}: the data have {}", known.join(", "))));
    }
    Ok(config)
}
