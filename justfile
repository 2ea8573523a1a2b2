# Shortcuts; `.ci/run` is the reference.

# Every check
check:
    bash .ci/run

# Format, then what the compiler and clippy say
lint:
    cargo fmt
    cargo clippy --release --workspace --all-targets --features wgpu,relcov-python/wgpu -- -D warnings

test *ARGS:
    cargo test --release --features wgpu {{ARGS}}

# The first command: renders a street world, trains, prints the table
synthetic *ARGS:
    cargo run --release -- train --config configs/synthetic.toml {{ARGS}}

# A rendered data set as pykitti sees it
check-synthetic:
    uv run data_scripts/check_synthetic.py

# Every score as scipy, uncertainty-toolbox and arch see it
check-metrics:
    uv run data_scripts/check_metrics.py

# Every export as GTSAM, a g2o reader, ROS and evo understand it
check-exports:
    uv run data_scripts/check_exports.py

# The Python package and its tests
python:
    pip install './python[test]' && pytest python

# The main job on the real sample
sample *ARGS:
    cargo run --release -- train --config configs/kitti_sample.toml {{ARGS}}

bench *ARGS:
    cargo bench {{ARGS}}

# Side by side with PyTorch; writes docs/performance.md
bench-peer *ARGS:
    uv run data_scripts/bench_peer.py {{ARGS}}

doc:
    cargo doc --no-deps --open
