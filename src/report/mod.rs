//! Results for people: tables, figures, one page. Takes evaluations, never tensors.

mod cells;
mod columns;
mod comparison;
mod conditional;
mod contact_sheet;
pub mod figures;
mod full_table;
mod fusion;
mod html;
mod method_table;
mod notes;
mod scores;
mod summary;
mod table;
mod table_two;

pub use cells::Intervals;
pub use comparison::{Comparison, Entry, Judged};
pub use contact_sheet::{CONTACT_SHEET_COLUMNS, SheetRow, contact_sheet};
pub use fusion::{FusionRow, fusion_table};
pub use html::html_page;
pub use scores::{Detail, render_results};
pub use table::TableFormat;
