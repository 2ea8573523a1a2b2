//! The shared reference data, and a small drive in the KITTI raw layout made from nothing.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix4, Vector3};
use relcov::geometry::{Pose, Tangent};

/// A file of the reference data beside the project, or `None` with a line that says the test skipped.
pub fn shared(relative: &str) -> Option<PathBuf> {
    let root = std::env::var_os("RELCOV_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let path = root.join(relative);
    if path.exists() {
        return Some(path);
    }
    skip(&format!("{} is not there", path.display()));
    None
}

/// A device, or `None` with a line that says the test skipped: its backend is not built in, or the machine has none.
pub fn device(name: &str) -> Option<burn::tensor::Device> {
    relcov::device::open_device(name).map_err(|error| skip(&error.to_string())).ok()
}

/// A matrix of 16 numbers, row-major, as a pose.
pub fn pose_from_rows(rows: &[f64]) -> Pose {
    let matrix = Matrix4::from_row_slice(rows);
    Pose::from_rounded_parts(
        matrix.fixed_view::<3, 3>(0, 0).into_owned(),
        matrix.fixed_view::<3, 1>(0, 3).into_owned(),
        1e-9,
    )
    .expect("a rotation")
}

/// Size of the made drive's images, px.
pub const SIZE: (usize, usize) = (96, 48);
/// Its name.
pub const DRIVE: &str = "2020_01_01_drive_0001_sync";

/// Writes a drive of `frames` frames, a straight street with a drifting visual odometry, below `root`.
pub fn write_drive(root: &Path, frames: usize) {
    let date = root.join("2020_01_01");
    let drive = date.join(DRIVE);
    for folder in ["image_02/data", "oxts/data"] {
        std::fs::create_dir_all(drive.join(folder)).unwrap();
    }
    write_calibration(&date);
    let mut odometry = String::new();
    let mut world_from_camera = Pose::identity();
    for frame in 0..frames {
        write_image(&drive.join(format!("image_02/data/{frame:010}.png")), frame);
        // 1 m north per frame.
        let latitude = 49.0 + frame as f64 * 1.0 / 111_319.49;
        let mut packet = vec!["0".to_owned(); 30];
        packet[0] = format!("{latitude:.12}");
        packet[1] = "8.4".to_owned();
        packet[2] = "115".to_owned();
        packet[5] = format!("{:.12}", std::f64::consts::FRAC_PI_2);
        std::fs::write(drive.join(format!("oxts/data/{frame:010}.txt")), packet.join(" ")).unwrap();
        let m = world_from_camera.matrix();
        for k in 0..12 {
            write!(odometry, "{:.12e}{}", m[(k / 4, k % 4)], if k == 11 { "\n" } else { " " }).unwrap();
        }
        world_from_camera = world_from_camera * noisy_step(frame);
    }
    std::fs::create_dir_all(root.join("vo")).unwrap();
    std::fs::write(root.join("vo/2020_01_01_drive_0001.txt"), odometry).unwrap();
}

/// A configuration for the made drive; 16 training, 4 validation and 4 test frames of 24.
pub fn write_config(folder: &Path, data: &Path) -> PathBuf {
    let path = folder.join("config.toml");
    let (width, height) = (32, 16);
    let text = format!(
        r#"name = "tiny"
checkpoints = "runs"
device = "flex"
[data]
root = {root:?}
train = [{{ drive = "{DRIVE}", frames = [0, 16] }}]
validation = [{{ drive = "{DRIVE}", frames = [16, 20] }}]
test = [{{ drive = "{DRIVE}", frames = [20, 24] }}]
[[systems]]
name = "vo"
share = 0.75
source = "trajectory"
path = "vo/{{drive}}.txt"
[[systems]]
name = "gnss"
share = 0.25
source = "truth"
[model]
width = {width}
height = {height}
[training]
batch = 8
micro_batch = 4
epochs = 2
batches_per_epoch = 2
"#,
        root = data.display().to_string(),
    );
    std::fs::write(&path, text).unwrap();
    path
}

/// The true motion of a frame plus an error that depends on the frame, camera axes.
fn noisy_step(frame: usize) -> Pose {
    let phase = frame as f64;
    let error = Tangent::new(
        0.01 * phase.sin(),
        0.005 * phase.cos(),
        0.05 * (1.7 * phase).sin(),
        1e-3,
        -1e-3 * phase.sin(),
        5e-4,
    );
    Pose::exp(&error) * Pose { translation: Vector3::new(0.0, 0.0, 1.0), ..Pose::identity() }
}

fn write_calibration(date: &Path) {
    let (width, height) = SIZE;
    // Camera 2 looks from 5 cm to the right of camera 0: P = K [I | (−0.05, 0, 0)].
    let projection = format!("60 0 {} -3 0 60 {} 0 0 0 1 0", width as f64 / 2.0, height as f64 / 2.0);
    let camera = format!(
        "calib_time: 01-Jan-2020 00:00:00\nR_rect_00: 1 0 0 0 1 0 0 0 1\nS_rect_02: {width} {height}\nP_rect_02: {projection}\n"
    );
    std::fs::write(date.join("calib_cam_to_cam.txt"), camera).unwrap();
    // Velodyne x forward, y left, z up into camera x right, y down, z forward.
    std::fs::write(date.join("calib_velo_to_cam.txt"), "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n").unwrap();
    std::fs::write(date.join("calib_imu_to_velo.txt"), "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n").unwrap();
}

fn write_image(path: &Path, frame: usize) {
    let (width, height) = SIZE;
    let image = image::RgbImage::from_fn(width as u32, height as u32, |u, v| {
        let wave = |scale: f64| {
            (127.0 + 120.0 * ((u as f64 * scale + frame as f64 * 0.3).sin() * (v as f64 * scale).cos())) as u8
        };
        image::Rgb([wave(0.2), wave(0.35), wave(0.5)])
    });
    image.save(path).unwrap();
}

/// The oracle's weights: a formula of layer and flat index (`oracles/covnet.json`).
pub fn with_formula_weights<M: burn::module::Module>(module: M) -> M {
    module.map(&mut FormulaWeights { layer: 0 })
}

struct FormulaWeights {
    layer: usize,
}

impl burn::module::ModuleMapper for FormulaWeights {
    fn map_float<const D: usize>(
        &mut self,
        param: burn::module::Param<burn::tensor::Tensor<D>>,
    ) -> burn::module::Param<burn::tensor::Tensor<D>> {
        use burn::tensor::{Tensor, TensorData};
        let p = self.layer as f64;
        let is_bias = D == 1;
        let mapped = param.map(|tensor| {
            let shape: Vec<usize> = tensor.dims().to_vec();
            let device = tensor.device();
            if is_bias {
                let values: Vec<f32> = (0..shape[0]).map(|e| (0.01 * (p + e as f64).sin()) as f32).collect();
                return Tensor::from_data(TensorData::new(values, shape), &device);
            }
            // Burn keeps linear weights as [in, out]; the formula counts [out, in].
            let linear = D == 2;
            let fan_in: usize = if linear { shape[0] } else { shape[1..].iter().product() };
            let scale = 2.0 / (fan_in as f64).sqrt();
            let weight = |e: usize| {
                let e = e as f64;
                (scale * ((0.7 + 1.3 * p + 0.37 * e + 1e-4 * e * e) % std::f64::consts::TAU).sin()) as f32
            };
            let count: usize = shape.iter().product();
            let values: Vec<f32> = match linear {
                false => (0..count).map(weight).collect(),
                true => (0..count).map(|k| weight((k % shape[1]) * shape[0] + k / shape[1])).collect(),
            };
            Tensor::from_data(TensorData::new(values, shape), &device)
        });
        if is_bias {
            self.layer += 1;
        }
        let trains = mapped.device().is_autodiff();
        mapped.set_require_grad(trains)
    }
}

/// Says that a test could not run; fails where everything is meant to be there.
pub fn skip(reason: &str) {
    assert!(std::env::var_os("RELCOV_STRICT_TESTS").is_none(), "would be skipped: {reason}");
    eprintln!("skipped: {reason}");
}

/// Writes predictions for made errors of one system on two drives: correlated in time, larger where σ is.
pub fn write_pairs_csv(path: &Path, pairs: usize, seed: u64) {
    use rand::{RngExt, SeedableRng};
    use relcov::evaluation::{PairRow, PairTable, SystemPairs, write_pairs};
    use relcov::geometry::{Covariance6, ErrorFrame};
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut noise = [0.0_f64; 6];
    let row = |index: usize| {
        let speed = 0.6 + 0.4 * (index as f64 * 0.07).sin();
        let sigma = [0.05, 0.02, 0.03, 1e-3, 2e-3, 8e-4].map(|sigma| sigma * speed);
        for value in &mut noise {
            // A uniform variable on ±√3 has variance 1.
            *value = 0.7 * *value + 0.51_f64.sqrt() * 3f64.sqrt() * random.random_range(-1.0..1.0);
        }
        let drive = if index < pairs / 2 { "drive_a" } else { "drive_b" };
        PairRow {
            drive: drive.into(),
            source: index,
            target: index + 1,
            interval_s: Some(0.1),
            motion: Some([speed, 0.0, 0.0, 0.0, 0.0, 0.01 * speed]),
            error: std::array::from_fn(|c| sigma[c] * noise[c]),
            covariance: Some(Covariance6::from_std_devs(&Tangent::from(sigma))),
            posterior: None,
            no_verdict: None,
            stated: None,
        }
    };
    let rows = (0..pairs).map(row).collect();
    let systems = vec![SystemPairs { name: "vo".to_owned(), simulated: false, rows }];
    write_pairs(path, &PairTable { error_frame: ErrorFrame::Vehicle, systems }).unwrap();
}
