//! Time of each stage: render, decode and resize, undistort, open a data set, warp, prediction, loading, training step, and the whole
//! training loop beside its bare step. `cargo bench`; sizes below are those of configs/kitti_sample.toml.

mod rendered;

use std::cell::RefCell;
use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use burn::optim::{GradientsAccumulator, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use rayon::prelude::*;
use relcov::alignment::align;
use relcov::config::Config;
use relcov::depth::ground_plane_depth;
use relcov::geometry::{Lens, Pinhole, Pose, Tangent};
use relcov::kernels::Adam;
use relcov::model::{Architecture, CovarianceModel, InputBasis, MicroBatch};
use relcov::pairs::{Dataset, PairBatch, PairReader, PairSample, PairScope, SplitName};
use relcov::recordings::{RgbImage, Undistortion, read_image};
use relcov::synthetic::{Replace, SyntheticSettings, record};
use relcov::training::{Event, Learner};
use relcov::warp::Warp;
use relcov::{Measurement, Model};

use rendered::RenderedPair;

/// That of the program.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const CAMERA: Pinhole = Pinhole { fx: 707.0912, fy: 707.0912, cx: 601.8873, cy: 183.1104, width: 1226, height: 370 };
const SIZES: [(usize, usize); 2] = [(320, 96), (512, 160)];

/// Noise images, a road and a plausible motion: the arithmetic is that of real pairs.
fn batch(pairs: usize, (width, height): (usize, usize), device: &Device) -> PairBatch {
    let camera = CAMERA.resized(width, height);
    let image = |seed: usize| {
        let bytes = (0..3 * width * height).map(|k| (k * 2_654_435_761 + seed * 40_503) as u8).collect();
        Arc::new(RgbImage { width, height, bytes })
    };
    let samples: Vec<PairSample> = (0..pairs)
        .map(|index| PairSample {
            source_image: image(index),
            target_image: image(index + 1),
            target_depth: Arc::new(ground_plane_depth(&camera, 1.65, None, 80.0)),
            camera,
            source_from_target: Pose::exp(&Tangent::new(0.01, 0.0, 0.9, 0.0, 0.01, 0.0)),
            error: Tangent::new(0.04, 0.008, 0.009, 7e-4, 6e-4, 8e-4),
            right: None,
            evidence: None,
        })
        .collect();
    PairBatch::new(&samples, device)
}

fn architecture((width, height): (usize, usize)) -> Architecture {
    Architecture { input: InputBasis::Residual, ..Architecture::paper(width, height) }
}

fn finish<const D: usize>(tensor: Tensor<D>) {
    black_box(tensor.into_data());
}

fn warp(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("warp");
    for size in SIZES {
        let images = batch(8, size, &device).images.expect("included");
        group.throughput(Throughput::Elements(8));
        group.bench_function(BenchmarkId::from_parameter(format!("{}x{}x8", size.0, size.1)), |bencher| {
            bencher.iter(|| {
                let images = images.clone();
                finish(
                    Warp.forward(
                        images.source_image,
                        images.target_depth,
                        images.intrinsics,
                        images.source_from_target,
                    )
                    .image,
                );
            });
        });
    }
}

/// One pair on one thread, and as many pairs at once as keep every thread busy.
fn alignment(criterion: &mut Criterion) {
    const PAIRS: usize = 16;
    let mut group = criterion.benchmark_group("alignment");
    for (width, height) in [(192, 64), (512, 160)] {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let pair = RenderedPair::new(folder.path(), (width, height));
        let input = pair.input();
        assert_eq!(align(&input).no_verdict, None, "an alignment that comes to rest is timed");
        group.throughput(Throughput::Elements(1));
        group.bench_function(BenchmarkId::new("one pair, one thread", format!("{width}x{height}")), |bencher| {
            bencher.iter(|| black_box(align(&input)));
        });
        group.throughput(Throughput::Elements(PAIRS as u64));
        group.bench_function(BenchmarkId::new("16 pairs, all threads", format!("{width}x{height}")), |bencher| {
            bencher.iter(|| {
                (0..PAIRS).into_par_iter().for_each(|_| {
                    black_box(align(&input));
                })
            });
        });
    }
}

fn forward(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("predict");
    for size in SIZES {
        let model = architecture(size).init([-8.0; 6], &device);
        let pairs = batch(1, size, &device);
        group.bench_function(BenchmarkId::from_parameter(format!("{}x{}x1", size.0, size.1)), |bencher| {
            bencher.iter(|| finish(model.forward(&pairs)));
        });
    }
}

/// A run folder on disk to its first covariance, as a robot starts.
fn load(criterion: &mut Criterion) {
    let device = Device::flex();
    let (width, height) = SIZES[1];
    let folder = tempfile::tempdir().expect("a temporary folder");
    let Some(run) = trained_run(folder.path(), (width, height)) else { return };
    let image = RgbImage { width, height, bytes: vec![128; 3 * width * height] };
    let camera = CAMERA.resized(width, height);
    let measurement = Measurement {
        source_image: image.clone(),
        target_image: image,
        target_depth: ground_plane_depth(&camera, 1.65, None, 80.0),
        camera,
        source_from_target: Pose::exp(&Tangent::new(0.01, 0.0, 0.9, 0.0, 0.01, 0.0)),
        right: None,
        camera_from_vehicle: None,
    };
    let mut group = criterion.benchmark_group("load and predict first");
    group.sample_size(10);
    group.bench_function(format!("{width}x{height}"), |bencher| {
        bencher.iter(|| {
            let model = Model::load(&run, &device).expect("a run just made");
            black_box(model.predict(&measurement).expect("a covariance"))
        });
    });
}

/// One mini-batch of training on the real sample; `None`, and said so, without it.
fn trained_run(folder: &Path, (width, height): (usize, usize)) -> Option<PathBuf> {
    let settings = [
        format!("checkpoints={}", folder.display()),
        format!("model.width={width}"),
        format!("model.height={height}"),
        "training.epochs=1".to_owned(),
        "training.batches_per_epoch=1".to_owned(),
        "training.batch=4".to_owned(),
        "training.micro_batch=4".to_owned(),
    ];
    let config = Config::load("configs/kitti_sample.toml".as_ref(), &settings).expect("a shipped configuration");
    let Ok(dataset) = Dataset::load(&config.pairs(), PairScope::Images) else {
        eprintln!("skipped: load (no data at {})", config.data.root.display());
        return None;
    };
    let run = config.run_folder();
    let mut learner = Learner::start(config, Arc::new(dataset), &Device::flex(), false).expect("a new run");
    learner.train(&mut |_| ()).expect("one epoch");
    Some(run)
}

fn training_step(criterion: &mut Criterion) {
    let device = Device::flex();
    let mut group = criterion.benchmark_group("training step");
    group.sample_size(10);
    let size = SIZES[0];
    let model = architecture(size).init([-8.0; 6], &device.clone().autodiff());
    let mut optimiser = ModuleOptimizer::from(Adam::new());
    for pairs in [4, 14] {
        let batch = batch(pairs, size, &device);
        group.throughput(Throughput::Elements(pairs as u64));
        group.bench_function(
            BenchmarkId::new("forward+backward", format!("{}x{}x{pairs}", size.0, size.1)),
            |bencher| {
                bencher.iter(|| {
                    let batch = MicroBatch { pairs: batch.clone(), weight: 0.1, corrected_share: 0.5 };
                    black_box(model.step(&batch).1)
                });
            },
        );
    }
    group.finish();

    let mut group = criterion.benchmark_group("adam");
    group.sample_size(10);
    let batch = batch(14, size, &device);
    let gradients = |model: &CovarianceModel| {
        let mut sum = GradientsAccumulator::new();
        let batch = MicroBatch { pairs: batch.clone(), weight: 0.1, corrected_share: 0.5 };
        sum.accumulate(model, model.step(&batch).1);
        sum.grads()
    };
    // The benchmark's two closures need the model in turn.
    let model = RefCell::new(Some(model));
    group.bench_function("all weights at 320x96", |bencher| {
        bencher.iter_batched(
            || gradients(model.borrow().as_ref().expect("put back below")),
            |gradients| {
                let network = model.take().expect("put back below");
                model.replace(Some(optimiser.step(1e-4, network, gradients)));
            },
            criterion::BatchSize::PerIteration,
        );
    });
}

fn decode(criterion: &mut Criterion) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut group = criterion.benchmark_group("decode+resize");
    let image = image::RgbImage::from_fn(1226, 370, |u, v| image::Rgb([(u / 3) as u8, (v / 2) as u8, (u ^ v) as u8]));
    for extension in ["png", "jpg"] {
        let path = folder.path().join(format!("frame.{extension}"));
        image.save(&path).expect("an image file");
        group.bench_function(BenchmarkId::new(extension, "1226x370 to 320x96"), |bencher| {
            bencher.iter(|| black_box(read_image(&path).expect("readable").resized(320, 96)));
        });
    }
}

/// An image of EuRoC's cam0, and a depth map of its size, by the table that a recording has.
fn undistort(criterion: &mut Criterion) {
    let camera = Pinhole { fx: 458.654, fy: 457.296, cx: 367.215, cy: 248.375, width: 752, height: 480 };
    let lens = Lens { camera, distortion: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0] };
    let rectified = lens.rectified().expect("a real lens");
    let undistortion = Undistortion::new(&lens, rectified);
    let bytes = (0..3 * 752 * 480_usize).map(|k| (k * 2_654_435_761) as u8).collect();
    let image = RgbImage { width: 752, height: 480, bytes };
    let depth = vec![2.5; 752 * 480];
    let mut group = criterion.benchmark_group("undistort");
    group.bench_function(BenchmarkId::new("image", "752x480"), |bencher| {
        bencher.iter(|| black_box(undistortion.image(&image)));
    });
    group.bench_function(BenchmarkId::new("depth", "752x480"), |bencher| {
        bencher.iter(|| black_box(undistortion.depth(&depth)));
    });
    group.bench_function(BenchmarkId::new("rectified camera", "752x480"), |bencher| {
        bencher.iter(|| black_box(lens.rectified()));
    });
    group.bench_function(BenchmarkId::new("table", "752x480"), |bencher| {
        bencher.iter(|| black_box(Undistortion::new(&lens, rectified)));
    });
}

/// A data set of 20,000 pairs as it is opened: a TUM RGB-D recording, its lists joined by time.
fn open(criterion: &mut Criterion) {
    const FRAMES: usize = 20_001;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let long = folder.path().join("long");
    let image = image::DynamicImage::ImageRgb8(image::RgbImage::new(64, 48));
    let [mut rgb, mut depth, mut truth] = [const { String::new() }; 3];
    for kind in ["rgb", "depth"] {
        std::fs::create_dir_all(long.join(kind)).expect("a folder");
    }
    let mut png = std::io::Cursor::new(Vec::new());
    image.write_to(&mut png, image::ImageFormat::Png).expect("an image");
    for frame in 0..FRAMES {
        let time = 1.3e9 + frame as f64 / 30.0;
        for (kind, list) in [("rgb", &mut rgb), ("depth", &mut depth)] {
            let name = format!("{kind}/{time:.6}.png");
            // What is in them is read when they are used.
            std::fs::write(long.join(&name), png.get_ref()).expect("an image file");
            list.push_str(&format!("{time:.6} {name}\n"));
        }
        truth.push_str(&format!("{time:.6} {:.6} 0 0 0 0 0 1\n", frame as f64 * 0.01));
    }
    for (name, text) in [("rgb.txt", rgb), ("depth.txt", depth), ("groundtruth.txt", truth)] {
        std::fs::write(long.join(name), text).expect("a list");
    }
    let path = folder.path().join("config.toml");
    let text = "name = \"long\"\n[data]\nroot = \".\"\ncamera = { width = 64, height = 48, fx = 60, fy = 60, cx = 32, cy = 24 }\n\
                train = [{ drive = \"long\" }]\ntest = []\n[depth]\nsource = \"recording\"\n\
                [[systems]]\nname = \"truth\"\nshare = 1.0\nsource = \"truth\"\n";
    std::fs::write(&path, text).expect("a configuration");
    let config = Config::load(&path, &[]).expect("a configuration");
    let mut group = criterion.benchmark_group("open");
    group.sample_size(10);
    group.bench_function(BenchmarkId::new("TUM RGB-D", "20,000 pairs"), |bencher| {
        bencher.iter(|| black_box(Dataset::load(&config.pairs(), PairScope::Images).expect("a data set")));
    });
}

/// The whole loop on the real sample, beside the bare step on one fixed micro-batch: how well loading
/// keeps the network fed. Skipped, and said so, when the sample is not there.
fn training_loop(criterion: &mut Criterion) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let settings = [
        format!("checkpoints={}", folder.path().display()),
        "training.epochs=1".to_owned(),
        "training.batches_per_epoch=1000000".to_owned(),
    ];
    let config = Config::load("configs/kitti_sample.toml".as_ref(), &settings).expect("a shipped configuration");
    let Ok(dataset) = Dataset::load(&config.pairs(), PairScope::Images) else {
        eprintln!("skipped: training loop (no data at {})", config.data.root.display());
        return;
    };
    let device = Device::flex();
    let pairs = config.training.batch as u64;
    let mut group = criterion.benchmark_group("training loop");
    group.sample_size(10).measurement_time(Duration::from_secs(60)).throughput(Throughput::Elements(pairs));

    let reader = PairReader::new(&config.pairs(), &dataset, SplitName::Train);
    let samples: Vec<PairSample> = dataset.train.pairs[..config.training.micro_batch]
        .iter()
        .map(|pair| reader.read(pair).expect("readable").expect("readable"))
        .collect();
    let part = PairBatch::new(&samples, &device);
    let architecture = architecture((config.model.width, config.model.height));
    let mut model = Some(architecture.init([-8.0; 6], &device.clone().autodiff()));
    let mut optimiser = ModuleOptimizer::from(Adam::new());
    group.bench_function("bare step", |bencher| {
        bencher.iter(|| {
            let mut gradients = GradientsAccumulator::new();
            let network = model.take().expect("put back below");
            for _ in 0..config.training.batch / config.training.micro_batch {
                let part = MicroBatch { pairs: part.clone(), weight: 1.0 / pairs as f32, corrected_share: 0.5 };
                let (loss, of_part) = network.step(&part);
                gradients.accumulate(&network, of_part);
                finish(loss);
            }
            model = Some(optimiser.step(1e-4, network, gradients.grads()));
        });
    });

    // The learner runs until its interrupt; criterion's iterations take its batches one by one.
    let (sender, batches) = std::sync::mpsc::sync_channel::<()>(0);
    let mut learner = Learner::start(config, Arc::new(dataset), &device, false).expect("a new run");
    let interrupt = learner.interrupt_flag();
    let thread = std::thread::spawn(move || {
        let outcome = learner.train(&mut |event| {
            if matches!(event, Event::Batch { .. }) && sender.send(()).is_err() {
                learner_done(&interrupt);
            }
        });
        assert!(outcome.is_err(), "only the interrupt ends it");
    });
    group.bench_function("learner", |bencher| bencher.iter(|| batches.recv().expect("a batch")));
    drop(batches);
    thread.join().expect("the learner ends");
}

fn learner_done(interrupt: &std::sync::atomic::AtomicBool) {
    interrupt.store(true, std::sync::atomic::Ordering::Relaxed);
}

/// Stereo frames with depth and LiDAR, rendered and written.
fn render(criterion: &mut Criterion) {
    const FRAMES: usize = 32;
    let mut group = criterion.benchmark_group("render");
    group.sample_size(10).throughput(Throughput::Elements(FRAMES as u64));
    for (width, height) in [(192, 64), (512, 160)] {
        let settings = SyntheticSettings { drives: 1, frames: FRAMES, size: [width, height], ..Default::default() };
        group.bench_function(BenchmarkId::from_parameter(format!("{width}x{height}")), |bencher| {
            bencher.iter_batched(
                || tempfile::tempdir().expect("a temporary folder"),
                |folder| {
                    record(folder.path(), &settings, Replace::Never, &mut |_| Ok(())).expect("rendered");
                    folder
                },
                criterion::BatchSize::PerIteration,
            );
        });
    }
    group.finish();
}

criterion_group!(stages, render, decode, undistort, open, warp, alignment, forward, load, training_step, training_loop);
criterion_main!(stages);
