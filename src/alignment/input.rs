//! Whether pairs are aligned.

use serde::{Deserialize, Serialize};

/// Whether the network is told what direct alignment says of the measured pose's error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EvidenceInput {
    /// No (the paper).
    #[default]
    Off,
    /// By the photometric normal equations at the measured pose ([`align`](super::align)).
    Alignment,
}
