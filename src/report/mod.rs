//! Results for people: tables. Takes evaluations, never tensors.

mod table;

pub use table::mde_table;
