//! Shell completions and man pages, made from the arguments themselves.

use std::path::Path;

use clap::Command;
use clap_complete::Shell;

use super::terminal::print_result;
use crate::error::Error;

/// What a shell reads to complete commands and options.
pub fn completions(shell: Shell, mut command: Command) -> String {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut command, "relcov", &mut text);
    String::from_utf8(text).expect("arguments are text")
}

/// A page for the program and each of its commands.
pub fn write_pages(folder: &Path, command: Command) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).map_err(Error::io("create the folder", folder))?;
    let command = command.version(env!("CARGO_PKG_VERSION"));
    clap_mangen::generate_to(command, folder).map_err(Error::io("write man pages into", folder))?;
    print_result(&format!("{}\n", folder.display()))
}
