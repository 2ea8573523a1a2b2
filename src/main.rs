//! The `relcov` command.

fn main() -> std::process::ExitCode {
    relcov::cli::run()
}
