//! Results for people: tables. Takes evaluations, never tensors.

mod contact_sheet;
mod table;

pub use contact_sheet::{CONTACT_SHEET_COLUMNS, contact_sheet};
pub use table::mde_table;
