//! The `relcov` command.

/// Training frees and takes the same large buffers in every step: mimalloc keeps them.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    relcov::cli::run().into()
}
