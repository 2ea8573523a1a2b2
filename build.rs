//! Tells the program which commit it was built from, for the manifests of its runs.

use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=.git/logs/HEAD");
    println!("cargo:rerun-if-changed=build.rs");
    // A crate from the registry has no repository; its manifests then carry no commit.
    let Ok(output) = Command::new("git").args(["rev-parse", "--short=12", "HEAD"]).output() else { return };
    if output.status.success() {
        println!("cargo:rustc-env=RELCOV_GIT_COMMIT={}", String::from_utf8_lossy(&output.stdout).trim());
    }
}
