//! `relcov init`: the configurations that the README speaks of, for those who have the program alone.

use std::path::{Path, PathBuf};

use clap::Args;

use super::progress::note;
use super::terminal::{Terminal, print_result};
use crate::error::{Error, Result};
use crate::files::{read_bytes, write_atomically};

/// Arguments of `relcov init`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov init .
  relcov init street && relcov train --config street/configs/synthetic.toml

A configuration's relative paths start where it lies: the rendered world of configs/synthetic.toml goes to
data/ beside configs/. Runs go to checkpoints/ in the folder that relcov is called from.")]
pub struct InitArguments {
    /// Where to: configurations go to its folder `configs`, which is made
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Replace files that are there and differ
    #[arg(long)]
    force: bool,
}

/// Paths as in the repository, with what is in them.
const FILES: [(&str, &str); 10] = [
    ("configs/synthetic.toml", include_str!("../../configs/synthetic.toml")),
    ("configs/synthetic_large.toml", include_str!("../../configs/synthetic_large.toml")),
    ("configs/synthetic_depth.toml", include_str!("../../configs/synthetic_depth.toml")),
    ("configs/synthetic_fusion.toml", include_str!("../../configs/synthetic_fusion.toml")),
    ("configs/kitti.toml", include_str!("../../configs/kitti.toml")),
    ("configs/kitti_sample.toml", include_str!("../../configs/kitti_sample.toml")),
    ("configs/kitti_sample_depth.toml", include_str!("../../configs/kitti_sample_depth.toml")),
    ("configs/kitti_03.toml", include_str!("../../configs/kitti_03.toml")),
    ("configs/redkitchen.toml", include_str!("../../configs/redkitchen.toml")),
    ("data_scripts/download_kitti.sh", include_str!("../../data_scripts/download_kitti.sh")),
];

pub fn run(arguments: &InitArguments, terminal: &Terminal) -> anyhow::Result<()> {
    let folder = &arguments.folder;
    let mut missing = Vec::new();
    for (name, text) in FILES {
        let path = folder.join(name);
        if !path.exists() {
            missing.push((path, text));
        } else if read_bytes(&path)? != text.as_bytes() {
            if !arguments.force {
                let problem = "has other content; --force replaces it, and relcov init elsewhere leaves it alone";
                return Err(Error::Data(format!("{}: {problem}; nothing was written", path.display())).into());
            }
            missing.push((path, text));
        }
    }
    missing.iter().try_for_each(|(path, text)| write(path, text))?;
    missing.iter().try_for_each(|(path, _)| print_result(&format!("{}\n", path.display())))?;
    let first = folder.join(FILES[0].0);
    note(terminal.quiet, &format!("first: relcov train --config {}", first.display()));
    Ok(())
}

fn write(path: &Path, text: &str) -> Result<()> {
    super::output::make_folder(path)?;
    write_atomically(path, text.as_bytes())?;
    #[cfg(unix)]
    if path.extension().is_some_and(|extension| extension == "sh") {
        use std::os::unix::fs::PermissionsExt;
        let executable = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(path, executable).map_err(Error::io("make executable", path))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_configuration_of_the_repository_comes_along() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
        let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let mut there: Vec<String> = entries
            .filter(|path| path.is_file())
            .map(|path| format!("configs/{}", path.file_name().unwrap().to_string_lossy()))
            .collect();
        let mut brought: Vec<&str> =
            FILES.iter().map(|(name, _)| *name).filter(|name| name.starts_with("configs/")).collect();
        there.sort();
        brought.sort();
        assert_eq!(brought, there);
    }
}
