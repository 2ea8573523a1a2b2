//! `relcov --version`: the program, what was built into it, and what it finds on this machine.

use crate::COMMIT;
use crate::device::{BACKENDS, Presence, look_for_devices};
use crate::error::Result;
use crate::kernels::Instructions;

/// The first line is `relcov VERSION` alone, for scripts.
pub fn describe() -> String {
    let lines = [
        ("commit", COMMIT.unwrap_or("unknown").to_owned()),
        ("features", features()),
        ("instructions", instructions().unwrap_or_else(|error| error.to_string())),
        ("devices", devices()),
    ];
    let lines = lines.map(|(name, value)| format!("{name}: {value}\n"));
    format!("relcov {}\n{}", env!("CARGO_PKG_VERSION"), lines.concat())
}

/// Backends that were built in, and those that were not.
pub fn features() -> String {
    let names = |wanted: bool| {
        let named = BACKENDS.iter().filter(|(_, built_in)| *built_in == wanted);
        named.map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
    };
    match names(false) {
        missing if missing.is_empty() => names(true),
        missing => format!("{} (without {missing})", names(true)),
    }
}

/// Those in use, and those that there are.
pub fn instructions() -> Result<String> {
    let available: Vec<&str> = Instructions::available().iter().map(Instructions::name).collect();
    let chosen = Instructions::chosen()?.map_or("Burn's own operations", |chosen| chosen.name());
    Ok(format!("{chosen} (this processor has {})", available.join(", ")))
}

fn devices() -> String {
    let found = look_for_devices().into_iter().filter_map(|(name, presence)| match presence {
        Presence::Found { part, .. } => Some(format!("{name} ({part})")),
        Presence::Unusable(error) => Some(error.to_string()),
        Presence::NotBuiltIn | Presence::NoGpu => None,
    });
    found.collect::<Vec<_>>().join(", ")
}
