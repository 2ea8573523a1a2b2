//! Time of judging 100,000 pairs: scores with their intervals, and figures as SVG and PNG.
//! `cargo bench --bench evaluation`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng};
use relcov::evaluation::{Baselines, Origin, PairRow, PairTable, SystemPairs, evaluate_table};
use relcov::geometry::{Covariance6, ErrorFrame, Pose, Tangent};
use relcov::report::figures::{draw_figures, to_png};
use relcov::report::{Comparison, Entry};

/// That of the program.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Scores and figures of 100,000 pairs with full and stated covariances, baselines and intervals included.
fn judge(criterion: &mut Criterion) {
    const PAIRS: usize = 100_000;
    let scale = Tangent::new(0.05, 0.02, 0.03, 1e-3, 2e-3, 8e-4);
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(0);
    let row = |source: usize| {
        let sigma = scale.map(|sigma| sigma * random.random_range(0.5..2.0));
        let error = sigma.map(|sigma| sigma * 3f64.sqrt() * random.random_range(-1.0..1.0));
        let covariance = Covariance6::from_std_devs(&sigma).transported(&Pose::exp(&(0.01 * error)));
        PairRow {
            drive: format!("drive_{}", source / 10_000).into(),
            source,
            target: source + 1,
            interval_s: Some(0.1),
            motion: Some([random.random_range(0.1..2.0), 0.0, 0.0, 0.0, 0.01, random.random_range(-0.05..0.05)]),
            error: error.into(),
            covariance: Some(covariance),
            posterior: None,
            no_verdict: None,
            stated: Some(covariance),
        }
    };
    let rows = (0..PAIRS).map(row).collect();
    let table = PairTable {
        error_frame: ErrorFrame::Vehicle,
        systems: vec![SystemPairs { name: "vo".to_owned(), simulated: true, rows }],
    };
    let baselines = vec![("vo".to_owned(), Baselines::of_system(&table.systems[0]))];
    let origin = Origin::new("bench".to_owned(), Some("relcov".to_owned()), "test");
    let evaluate = || evaluate_table(&table, &baselines, origin.clone()).expect("a prediction for each pair");
    let mut group = criterion.benchmark_group("judge 100,000 pairs");
    group.sample_size(10);
    group.bench_function("scores", |bencher| bencher.iter(|| black_box(evaluate())));
    let entry = Entry { name: "bench".to_owned(), evaluation: evaluate(), table: table.clone(), folder: None };
    let comparison = Comparison::new(vec![entry]).expect("one result");
    group.bench_function("figures", |bencher| {
        bencher.iter(|| {
            let figures = draw_figures(&comparison).expect("figures");
            figures.iter().map(|figure| to_png(&figure.svg).expect("a picture").len()).sum::<usize>()
        })
    });
}

criterion_group!(evaluation, judge);
criterion_main!(evaluation);
