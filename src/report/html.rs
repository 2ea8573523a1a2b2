//! One self-contained page: no network, no script.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::cells::Intervals;
use super::comparison::Comparison;
use super::figures::{Figure, draw_figures};
use super::notes::{notes, preface};
use super::scores::{Detail, tables};
use super::table::{Cell, Table};
use crate::error::Result;
use crate::geometry::Conventions;

const STYLE: &str = include_str!("page.css");

/// Renders a comparison with its tables, figures, configurations and conventions.
///
/// # Errors
/// A run's loss curves cannot be read.
pub fn html_page(comparison: &Comparison) -> Result<String> {
    let names: Vec<&str> = comparison.entries.iter().map(|entry| entry.name.as_str()).collect();
    let title = format!("relcov: {}", names.join(", "));
    let figures = draw_figures(comparison)?;
    let configurations = configurations(comparison);
    let tables = tables(comparison, Intervals::Shown, Detail::Full);
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header {
                    h1 { "Covariances of relative poses" }
                    p.names { (names.join(", ")) }
                    pre { (preface(comparison)) }
                    @for warning in &comparison.warnings { p.warning { (warning) } }
                    nav {
                        a href="#tables" { "Tables" } " "
                        a href="#figures" { "Figures" } " "
                        a href="#configuration" { "Configuration" } " "
                        a href="#conventions" { "Conventions" }
                    }
                }
                main {
                    section id="tables" {
                        h2 { "Tables" }
                        @for table in &tables { (table_markup(table)) }
                        ul.notes { @for note in notes(comparison, "Bold") { li { (note) } } }
                    }
                    section id="figures" {
                        h2 { "Figures" }
                        @for figure in &figures { (figure_markup(figure)) }
                    }
                    section id="configuration" {
                        h2 { "Configuration" }
                        @for (name, text) in &configurations { details { summary { (name) } pre { (text) } } }
                        @if configurations.is_empty() { p { "These results come with no configuration." } }
                    }
                    section id="conventions" { h2 { "Conventions" } (conventions(comparison)) }
                }
                footer { "relcov " (env!("CARGO_PKG_VERSION")) }
            }
        }
    };
    Ok(page.into_string())
}

fn table_markup(table: &Table) -> Markup {
    html! {
        h3 { (table.title) }
        div.wide {
            table {
                thead { tr { @for (index, name) in table.header.iter().enumerate() {
                    th.number[index >= table.names] { (name) }
                } } }
                tbody { @for (index, row) in table.rows.iter().enumerate() {
                    tr.first[index > 0 && table.rows[index - 1][0] != row[0]] {
                        @for (column, cell) in row.iter().enumerate() {
                            @if column < table.names { th scope="row" { (cell.text) } }
                            @else { (value_markup(cell)) }
                        }
                    }
                } }
            }
        }
    }
}

/// A value, its interval below it.
fn value_markup(cell: &Cell) -> Markup {
    let (value, interval) = match cell.text.split_once(" [") {
        _ if cell.text.is_empty() => ("–", None),
        Some((value, interval)) => (value, Some(format!("[{interval}"))),
        None => (cell.text.as_str(), None),
    };
    html! { td.best[cell.best] { (value) @if let Some(interval) = interval { small { (interval) } } } }
}

fn figure_markup(figure: &Figure) -> Markup {
    html! {
        figure id=(figure.name) {
            div.wide { (PreEscaped(&figure.svg)) }
            figcaption { (figure.caption) }
        }
    }
}

/// The configuration of every evaluation that had one.
fn configurations(comparison: &Comparison) -> Vec<(&str, &str)> {
    let entries = comparison.entries.iter();
    entries.filter_map(|entry| Some((entry.name.as_str(), entry.evaluation.origin.configuration.as_deref()?))).collect()
}

fn conventions(comparison: &Comparison) -> Markup {
    let Conventions { components, units, error, error_frame, relative_pose, .. } =
        Conventions::new(comparison.error_frame());
    let order: Vec<String> = components.iter().zip(&units).map(|(name, unit)| format!("{name} [{unit}]")).collect();
    html! {
        dl {
            dt { "Order and units" } dd { (order.join(", ")) "; variances in m² and rad²" }
            dt { "Error" } dd { "e = " (error) }
            dt { "Axes" } dd { (error_frame.name()) ": " (error_frame.axes()) }
            dt { "Relative pose" } dd { (relative_pose) }
        }
    }
}
