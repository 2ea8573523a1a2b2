//! Threads, memory and disk.

use std::path::Path;

use sysinfo::{Disks, System};

use super::finding::Finding;

/// What the first command takes at its peak, with room to spare.
const ENOUGH_MEMORY_BYTES: u64 = 2 << 30;
/// A rendered world and a run.
const ENOUGH_DISK_BYTES: u64 = 2 << 30;

pub fn threads() -> Finding {
    let used = rayon::current_num_threads();
    match std::thread::available_parallelism().map(usize::from) {
        Ok(there) if used < there => {
            Finding::Note(format!("{used} of {there}: RAYON_NUM_THREADS keeps the others from computing"))
        }
        Ok(there) => Finding::Ok(format!("{used} of {there}")),
        Err(_) => Finding::Ok(used.to_string()),
    }
}

/// That of the machine, or of the container.
pub fn memory() -> Finding {
    let mut system = System::new();
    system.refresh_memory();
    let (mut total, mut available) = (system.total_memory(), system.available_memory());
    if let Some(limits) = system.cgroup_limits() {
        (total, available) = (total.min(limits.total_memory), available.min(limits.free_memory));
    }
    if total == 0 {
        return Finding::Note("this system does not say how much there is".to_owned());
    }
    Finding::scarce(
        available < ENOUGH_MEMORY_BYTES,
        format!("{} of {} GB free", gigabytes(available), gigabytes(total)),
        "smaller training.micro_batch and data.cache_mb need less",
    )
}

/// That of the current folder: runs are kept there, and data that are rendered.
pub fn disk() -> Finding {
    // Links matter on Unix; elsewhere a resolved path no longer looks like its disk's.
    let resolve = |folder| if cfg!(unix) { std::fs::canonicalize(folder) } else { Ok(folder) };
    let folder = match std::env::current_dir().and_then(resolve) {
        Ok(folder) => folder,
        Err(error) => return Finding::wrong(format!("the current folder: {error}"), "change to another folder"),
    };
    if let Err(error) = tempfile::tempfile_in(&folder) {
        return Finding::wrong(
            format!("{}: cannot write: {error}", folder.display()),
            "call relcov from a folder of yours: runs go to checkpoints/ there",
        );
    }
    match free_bytes(&folder) {
        None => Finding::Note(format!("{}: can be written; how much is free is not known", folder.display())),
        Some(free) => Finding::scarce(
            free < ENOUGH_DISK_BYTES,
            format!("{} GB free in {}", gigabytes(free), folder.display()),
            "call relcov from a folder on another disk: data and runs go there",
        ),
    }
}

/// Of the disk that is mounted closest above.
fn free_bytes(folder: &Path) -> Option<u64> {
    let disks = Disks::new_with_refreshed_list();
    let above = disks.list().iter().filter(|disk| folder.starts_with(disk.mount_point()));
    above.max_by_key(|disk| disk.mount_point().components().count()).map(|disk| disk.available_space())
}

fn gigabytes(bytes: u64) -> String {
    format!("{:.1}", bytes as f64 / 1e9)
}
