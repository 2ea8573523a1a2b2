//! One measurement for `data_scripts/bench_peer.py`, which runs the same one in PyTorch beside it.
//!
//! `cargo bench --bench peer -- train|forward|warp|alignment|depth|latency HEIGHT WIDTH BATCH RUNS` prints one line of JSON:
//! median, least and 99th percentile of the time in milliseconds, peak memory in MB, and memory before the network was built. `RAYON_NUM_THREADS` sets the threads,
//! `RELCOV_INSTRUCTIONS=burn` takes Burn's own operations in place of relcov's kernels, and
//! `RELCOV_BENCH_DEVICE` names another device than flex. `latency` predicts one covariance from end to end, from the two
//! image files that `RELCOV_BENCH_IMAGES` names (FIRST:SECOND). `alignment` aligns BATCH pairs at once, all the pair that
//! it renders into the folder `RELCOV_BENCH_FOLDER`; what the peer needs of it lies there in `pair.json`.

mod rendered;

use std::path::Path;
use std::time::Instant;

use burn::optim::{GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Distribution, Tensor, TensorData};
use rayon::prelude::*;
use relcov::alignment::align;
use relcov::depth::ground_plane_depth;
use relcov::depth::monodepth2::Monodepth2;
use relcov::device::open_device;
use relcov::geometry::{ErrorFrame, Pinhole, Pose, Tangent};
use relcov::kernels::Adam;
use relcov::model::Architecture;
use relcov::network::{CovarianceNetworkConfig, Head, ImageNetwork, NetworkInput};
use relcov::recordings::decode_image;
use relcov::warp::Warp;
use relcov::{Measurement, Model};

use rendered::RenderedPair;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const WARM_UP: usize = 3;

fn main() {
    // Cargo adds `--bench`.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let [mode, numbers @ ..] = &arguments[..] else {
        eprintln!(
            "peer: run by data_scripts/bench_peer.py, or with `-- train|forward|warp|alignment|depth|latency HEIGHT WIDTH BATCH RUNS`"
        );
        return;
    };
    let numbers: Vec<usize> = numbers.iter().map(|number| number.parse().expect("a number")).collect();
    let &[height, width, batch, runs] = &numbers[..] else { panic!("expected HEIGHT WIDTH BATCH RUNS") };
    let name = std::env::var("RELCOV_BENCH_DEVICE").unwrap_or_else(|_| "flex".to_owned());
    let device = open_device(&name).expect("a device");
    let before = memory_mb("VmRSS");
    let times = match mode.as_str() {
        "train" => train([batch, height, width], runs, &device),
        "forward" => forward([batch, height, width], runs, &device),
        "warp" => warp([batch, height, width], runs, &device),
        "alignment" => alignment([batch, height, width], runs),
        "depth" => depth([batch, height, width], runs, &device),
        "latency" => latency([height, width], runs, &device),
        mode => panic!("unknown measurement `{mode}`"),
    };
    let middle = times.len() / 2;
    let (median, least) = (0.5 * (times[middle] + times[(times.len() - 1) / 2]), times[0]);
    let late = times[(times.len() * 99).div_ceil(100) - 1];
    let numbers = [median, least, late, memory_mb("VmHWM"), before].map(|number| format!("{number:.3}"));
    let [median, least, late, peak, before] = numbers;
    println!(
        r#"{{"median_ms": {median}, "least_ms": {least}, "p99_ms": {late}, "peak_mb": {peak}, "before_mb": {before}}}"#
    );
}

/// Times of `run`, ascending, ms.
fn times(runs: usize, mut run: impl FnMut()) -> Vec<f64> {
    for _ in 0..WARM_UP {
        run();
    }
    let mut times: Vec<f64> = (0..runs)
        .map(|_| {
            let begin = Instant::now();
            run();
            begin.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times
}

fn network(height: usize, width: usize) -> CovarianceNetworkConfig {
    CovarianceNetworkConfig {
        network: ImageNetwork::TableOne,
        channels: 6,
        pose: false,
        evidence: None,
        head: Head::Diagonal,
        height,
        width,
        dropout: 0.5,
    }
}

fn input(images: &Tensor<4>) -> NetworkInput {
    NetworkInput { images: Some(images.clone()), ..NetworkInput::default() }
}

/// Forward, mean square, backward, Adam.
fn train([batch, height, width]: [usize; 3], runs: usize, device: &Device) -> Vec<f64> {
    let mut model = Some(network(height, width).init([0.0; 6], &device.clone().autodiff()));
    let mut optimiser = ModuleOptimizer::from(Adam::new());
    let images = Tensor::<4>::random([batch, 6, height, width], Distribution::Normal(0.0, 1.0), device);
    let targets = Tensor::<2>::random([batch, 6], Distribution::Normal(0.0, 1.0), device);
    times(runs, || {
        let network = model.take().expect("put back below");
        let loss = (network.forward(input(&images)) - targets.clone()).square().mean();
        let gradients = GradientsParams::from_grads(loss.backward(), &network);
        model = Some(optimiser.step(1e-4, network, gradients));
        device.sync().expect("a device that works");
        assert!(loss.into_scalar::<f32>().is_finite());
    })
}

fn forward([batch, height, width]: [usize; 3], runs: usize, device: &Device) -> Vec<f64> {
    let network = network(height, width).init([0.0; 6], device);
    let images = Tensor::<4>::random([batch, 6, height, width], Distribution::Normal(0.0, 1.0), device);
    times(runs, || {
        std::hint::black_box(network.forward(input(&images)).into_data());
        device.sync().expect("a device that works");
    })
}

/// A flat road, seen from a car that drives on.
fn warp([batch, height, width]: [usize; 3], runs: usize, device: &Device) -> Vec<f64> {
    let images = Tensor::<4>::random([batch, 3, height, width], Distribution::Default, device);
    let focal_px = 0.58 * width as f32;
    let (centre_u, centre_v) = (0.5 * width as f32, 0.5 * height as f32);
    let row_depth = |row: usize| (1.65 * focal_px / (row as f32 - centre_v).max(1.0)).min(80.0);
    let depth: Vec<f32> = (0..batch * height * width).map(|index| row_depth(index / width % height)).collect();
    let depth = Tensor::from_data(TensorData::new(depth, [batch, 1, height, width]), device);
    let intrinsics = [focal_px, focal_px, centre_u, centre_v].repeat(batch);
    let intrinsics = Tensor::from_data(TensorData::new(intrinsics, [batch, 4]), device);
    let pose = [1.0, 0.0, 0.01, 0.01, 0.0, 1.0, 0.0, 0.0, -0.01, 0.0, 1.0, 0.9, 0.0, 0.0, 0.0, 1.0f32].repeat(batch);
    let pose = Tensor::from_data(TensorData::new(pose, [batch, 4, 4]), device);
    times(runs, || {
        let warped = Warp.forward(images.clone(), depth.clone(), intrinsics.clone(), pose.clone());
        std::hint::black_box(warped);
        device.sync().expect("a device that works");
    })
}

/// The pair of a rendered street, aligned from what its visual odometry measured. With more than one pair, threads share
/// them.
fn alignment([pairs, height, width]: [usize; 3], runs: usize) -> Vec<f64> {
    let folder = std::env::var("RELCOV_BENCH_FOLDER").expect("RELCOV_BENCH_FOLDER=FOLDER");
    let pair = RenderedPair::new(folder.as_ref(), (width, height));
    let input = pair.input();
    let evidence = align(&input);
    assert_eq!(evidence.no_verdict, None, "an alignment that comes to rest is timed");
    let aligned = Pose::exp(&-evidence.finest().error) * input.source_from_target;
    let rows = |pose: &Pose| pose.matrix().transpose().as_slice().to_vec();
    let Pinhole { fx, fy, cx, cy, .. } = input.camera;
    let description = serde_json::json!({
        "images": pair.images,
        "depths": pair.depths,
        "intrinsics": [fx, fy, cx, cy],
        "measured_source_from_target": rows(&input.source_from_target),
        "aligned_source_from_target": rows(&aligned),
        "true_source_from_target": rows(&pair.true_source_from_target()),
    });
    std::fs::write(Path::new(&folder).join("pair.json"), description.to_string()).expect("a folder to write to");
    times(runs, || {
        (0..pairs).into_par_iter().for_each(|_| {
            std::hint::black_box(align(&input));
        })
    })
}

/// The depth network's finest disparity, as `relcov depth` runs it.
fn depth([batch, height, width]: [usize; 3], runs: usize, device: &Device) -> Vec<f64> {
    let network = Monodepth2::init(0.1, device);
    let images = Tensor::<4>::random([batch, 3, height, width], Distribution::Default, device);
    times(runs, || drop(std::hint::black_box(network.disparity(images.clone()).into_data())))
}

/// One covariance from end to end: two image files in memory are decoded and brought to the network's size, the source is
/// warped by the measured pose and the given depth, and the network's six numbers come back.
fn latency([height, width]: [usize; 2], runs: usize, device: &Device) -> Vec<f64> {
    let names = std::env::var("RELCOV_BENCH_IMAGES").expect("RELCOV_BENCH_IMAGES=FIRST:SECOND");
    let files: Vec<(&Path, Vec<u8>)> =
        names.split(':').map(|name| (Path::new(name), std::fs::read(name).expect("an image file"))).collect();
    let [source, target] = &files[..] else { panic!("RELCOV_BENCH_IMAGES names two files") };
    let model = Model::untrained(Architecture::paper(width, height), ErrorFrame::Vehicle, [-4.0; 6], device);
    let image = decode_image(&source.1, source.0).expect("an image");
    let (full_width, full_height) = (image.width, image.height);
    let focal = 0.58 * full_width as f64;
    let (cx, cy) = (0.5 * full_width as f64, 0.5 * full_height as f64);
    let camera = Pinhole { fx: focal, fy: focal, cx, cy, width: full_width, height: full_height };
    let depth = ground_plane_depth(&camera.resized(width, height), 1.65, None, 80.0);
    times(runs, || {
        let decode = |file: &(&Path, Vec<u8>)| decode_image(&file.1, file.0).expect("an image");
        let (source_image, target_image) = rayon::join(|| decode(source), || decode(target));
        let measurement = Measurement {
            source_image,
            target_image,
            target_depth: depth.clone(),
            camera,
            source_from_target: Pose::exp(&Tangent::new(0.01, 0.0, 0.9, 0.0, 0.01, 0.0)),
            right: None,
            camera_from_vehicle: None,
        };
        std::hint::black_box(model.predict(&measurement).expect("a covariance"));
    })
}

/// A line of this process's memory statistics, MB; 0 where the system keeps none.
fn memory_mb(name: &str) -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kilobytes.unwrap_or(0.0) / 1024.0
}
