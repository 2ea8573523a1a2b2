//! Layers a configuration: file, environment, `--set key=value`; and anchors its relative paths.

use std::path::{Path, PathBuf};

use toml::{Table, Value};

use crate::error::{Error, Place, Result};

/// Keys whose values are paths.
const PATH_KEYS: [&str; 2] = ["data.root", "checkpoints"];

/// The file's table with its paths made absolute and the overrides applied.
pub(super) fn merge(
    text: &str,
    path: &Path,
    folder: &Path,
    data_root: Option<&Path>,
    overrides: &[String],
) -> Result<Table> {
    let mut table: Table = text.parse().map_err(|error: toml::de::Error| {
        Error::malformed(path, Place::Whole, error.to_string().trim_end().to_owned(), "TOML")
    })?;
    for key in PATH_KEYS {
        anchor(&mut table, key, folder);
    }
    if let Some(root) = data_root {
        assign(&mut table, "data.root", Value::String(root.display().to_string()))?;
        anchor(&mut table, "data.root", Path::new(""));
    }
    for text in overrides {
        let (key, value) = text
            .split_once('=')
            .ok_or_else(|| Error::config(text, "an override has the form key=value, such as training.epochs=3"))?;
        let (key, value) = (key.trim(), value.trim());
        assign(&mut table, key, parse_value(value))?;
        if PATH_KEYS.contains(&key) {
            anchor(&mut table, key, Path::new(""));
        }
    }
    Ok(table)
}

/// A TOML value, or else the text itself: `--set name=trial` needs no quotes.
fn parse_value(text: &str) -> Value {
    match format!("value = {text}").parse::<Table>() {
        Ok(mut table) => table.remove("value").expect("just parsed"),
        Err(_) => Value::String(text.to_owned()),
    }
}

fn assign(table: &mut Table, key: &str, value: Value) -> Result<()> {
    let (parents, last) = match key.rsplit_once('.') {
        Some((parents, last)) => (parents.split('.').collect(), last),
        None => (Vec::new(), key),
    };
    let unknown = |part: &str| Error::config(key, format!("`{part}` is not a table or list that can be set into"));
    let mut slots = table;
    let mut parts = parents.into_iter();
    while let Some(part) = parts.next() {
        let child = slots.entry(part).or_insert_with(|| Value::Table(Table::new()));
        slots = match child {
            Value::Table(table) => table,
            Value::Array(items) => {
                let index = parts.next().and_then(|index| index.parse::<usize>().ok());
                let item = index.and_then(|index| items.get_mut(index));
                item.and_then(Value::as_table_mut).ok_or_else(|| unknown(part))?
            }
            _ => return Err(unknown(part)),
        };
    }
    // Another depth source has other keys: those of the old one would be unknown to it.
    if last == "source" {
        slots.retain(|key, _| key == "name" || key == "share");
    }
    slots.insert(last.to_owned(), value);
    Ok(())
}

fn anchor(table: &mut Table, key: &str, folder: &Path) {
    let (parent, last) = key.rsplit_once('.').unwrap_or(("", key));
    let slots = if parent.is_empty() { Some(table) } else { table.get_mut(parent).and_then(Value::as_table_mut) };
    let Some(Value::String(path)) = slots.and_then(|slots| slots.get_mut(last)) else { return };
    *path = absolute(&folder.join(&*path)).display().to_string();
}

/// Absolute and without `a/../`, whether or not the file exists.
fn absolute(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    // A file system resolves links first; only an existing path can be asked.
    absolute.canonicalize().unwrap_or_else(|_| {
        let mut plain = PathBuf::new();
        for part in absolute.components() {
            match part {
                std::path::Component::ParentDir => {
                    plain.pop();
                }
                part => plain.push(part),
            }
        }
        plain
    })
}
