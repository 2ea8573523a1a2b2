//! Exit codes of the program.

pub(super) const FINE: u8 = 0;
pub(super) const FAILED: u8 = 1;
pub(super) const USAGE: u8 = 2;
/// After Ctrl-C, as shells expect it.
pub(super) const INTERRUPTED: u8 = 130;
