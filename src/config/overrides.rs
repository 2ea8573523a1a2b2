//! Layers a configuration: the file it extends, file, environment, `--set key=value`; and anchors its
//! relative paths.

use std::path::{Path, PathBuf};

use toml::{Table, Value};

use crate::error::{Error, Place, Result};
use crate::files::{read_text, utf8_name};

/// Tables whose other keys depend on `source`, and the source they have when they name none.
const DEFAULT_SOURCES: [(&str, &str); 2] = [("depth", "ground_plane"), ("truth", "recording")];

/// The key of the file whose settings a configuration takes over.
const EXTENDS: &str = "extends";
/// Files that may extend one another in a row; more are a circle.
const MOST_LAYERS: usize = 8;

/// Keys whose values are paths.
const PATH_KEYS: [&str; 5] = ["data.root", "data.manifest", "checkpoints", "depth.weights", "depth.cache"];

/// The file's table with its paths made absolute and the overrides applied.
pub(super) fn merge(
    text: &str,
    path: &Path,
    folder: &Path,
    data_root: Option<&Path>,
    overrides: &[String],
) -> Result<Table> {
    let mut table = read_layers(text, path, folder, MOST_LAYERS)?;
    // A synthetic data set is made where the configuration says, not among recorded ones.
    let recorded = !table.get("data").and_then(Value::as_table).is_some_and(|data| data.contains_key("synthetic"))
        && !overrides.iter().any(|text| text.trim_start().starts_with("data.synthetic"));
    if let Some(root) = data_root.filter(|_| recorded) {
        assign(&mut table, "data.root", Value::String(utf8_name(root)?))?;
        anchor(&mut table, "data.root", Path::new(""))?;
    }
    name_default_sources(&mut table);
    let mut assignments = Vec::new();
    for text in overrides {
        let (key, value) = text
            .split_once('=')
            .ok_or_else(|| Error::config(text, "an override has the form key=value, such as training.epochs=3"))?;
        assignments.push((key.trim(), value.trim()));
    }
    // A source decides which keys stand beside it, so it comes first.
    assignments.sort_by_key(|(key, _)| !key.ends_with(".source"));
    for (key, value) in assignments {
        assign(&mut table, key, parse_value(value))?;
        if PATH_KEYS.contains(&key) {
            anchor(&mut table, key, Path::new(""))?;
        }
    }
    // Once more for tables that an override has begun.
    name_default_sources(&mut table);
    Ok(table)
}

/// A file's table over that of the file it extends; paths absolute.
fn read_layers(text: &str, path: &Path, folder: &Path, layers_left: usize) -> Result<Table> {
    let mut table: Table = text.parse().map_err(|error: toml::de::Error| {
        Error::malformed(path, Place::Whole, error.to_string().trim_end().to_owned(), "TOML")
    })?;
    for key in PATH_KEYS {
        anchor(&mut table, key, folder)?;
    }
    let Some(base) = table.remove(EXTENDS) else { return Ok(table) };
    let field = || Place::Field(EXTENDS.to_owned());
    let Value::String(base) = base else {
        return Err(Error::malformed(path, field(), base.to_string(), "the path of a configuration"));
    };
    if layers_left == 0 {
        let expected = format!("at most {MOST_LAYERS} files that extend one another, and none in a circle");
        return Err(Error::malformed(path, field(), base, expected));
    }
    let base = folder.join(base);
    let text = read_text(&base)
        .map_err(|error| Error::malformed(path, field(), error.to_string(), "a configuration that can be read"))?;
    let mut layered = read_layers(&text, &base, base.parent().unwrap_or(Path::new("")), layers_left - 1)?;
    name_default_sources(&mut layered);
    lay_over(&mut layered, table);
    Ok(layered)
}

/// Tables are merged key by key, but one with another source replaces the whole; lists and values are replaced.
fn lay_over(base: &mut Table, upper: Table) {
    for (key, value) in upper {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above))
                if above.get("source").is_none_or(|source| below.get("source") == Some(source)) =>
            {
                lay_over(below, above);
            }
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

fn name_default_sources(table: &mut Table) {
    for (key, source) in DEFAULT_SOURCES {
        if let Some(Value::Table(slots)) = table.get_mut(key) {
            slots.entry("source").or_insert_with(|| Value::String(source.to_owned()));
        }
    }
}

/// A TOML value, or else the text itself: `--set name=trial` needs no quotes.
fn parse_value(text: &str) -> Value {
    match format!("value = {text}").parse::<Table>() {
        Ok(mut table) => table.remove("value").expect("just parsed"),
        Err(_) => Value::String(text.to_owned()),
    }
}

fn assign(table: &mut Table, key: &str, value: Value) -> Result<()> {
    let parts: Vec<&str> = key.split('.').collect();
    let (last, parents) = parts.split_last().expect("split gives at least one part");
    let mut slot = table;
    let mut parents = parents.iter();
    while let Some(part) = parents.next() {
        let child = slot.entry(*part).or_insert_with(|| Value::Table(Table::new()));
        slot = match child {
            Value::Table(table) => table,
            Value::Array(items) => {
                let index = parents.next().unwrap_or(last);
                let count = items.len();
                let item = index.parse::<usize>().ok().and_then(|index| items.get_mut(index));
                item.and_then(Value::as_table_mut).ok_or_else(|| {
                    Error::config(key, format!("`{part}` is a list of {count}; {part}.0.KEY sets a key of its first"))
                })?
            }
            _ => return Err(Error::config(key, format!("`{part}` is a value and has no keys to set"))),
        };
    }
    // Another source has other keys: those of the old one would be unknown to it.
    if *last == "source" && slot.get("source") != Some(&value) {
        slot.retain(|key, _| key == "name" || key == "share");
    }
    slot.insert((*last).to_owned(), value);
    Ok(())
}

fn anchor(table: &mut Table, key: &str, folder: &Path) -> Result<()> {
    let (parent, last) = key.rsplit_once('.').unwrap_or(("", key));
    let slots = if parent.is_empty() { Some(table) } else { table.get_mut(parent).and_then(Value::as_table_mut) };
    let Some(Value::String(path)) = slots.and_then(|slots| slots.get_mut(last)) else { return Ok(()) };
    *path = utf8_name(&absolute(&folder.join(&*path)))?;
    Ok(())
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

#[cfg(test)]
mod tests {
    use super::*;

    fn merged(text: &str, overrides: &[&str]) -> Table {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        merge(text, Path::new("experiment.toml"), Path::new("/configs"), None, &overrides).unwrap()
    }

    #[test]
    fn a_source_override_comes_before_the_keys_beside_it() {
        let depth =
            &merged("[depth]\ncamera_height_m = 1.2", &["depth.fill_radius_px=3", "depth.source=lidar"])["depth"];
        assert_eq!(depth["fill_radius_px"].as_integer(), Some(3));
        assert!(depth.get("camera_height_m").is_none(), "LiDAR has no camera height");
    }

    #[test]
    fn naming_the_source_that_is_there_keeps_its_keys() {
        let depth = &merged("[depth]\ncamera_height_m = 1.2", &["depth.source=ground_plane"])["depth"];
        assert_eq!(depth["camera_height_m"].as_float(), Some(1.2));
        assert_eq!(merged("", &["depth.max_depth_m=50"])["depth"]["source"].as_str(), Some("ground_plane"));
    }

    #[test]
    fn paths_resolve_against_the_file_that_holds_them() {
        let text = "checkpoints = \"../runs\"\n[data]\nroot = \"kitti\"";
        let table = merged(text, &["data.root=/elsewhere"]);
        assert_eq!(table["checkpoints"].as_str(), Some("/runs"));
        assert_eq!(table["data"]["root"].as_str(), Some("/elsewhere"));
    }

    #[test]
    fn a_file_takes_over_what_it_extends_and_does_not_name() {
        let folder = tempfile::tempdir().unwrap();
        let base = "name = \"base\"\nseed = 3\n[data]\nroot = \"kitti\"\n[model]\nwidth = 64\nheight = 32";
        std::fs::create_dir(folder.path().join("below")).unwrap();
        std::fs::write(folder.path().join("base.toml"), base).unwrap();
        let text = "extends = \"../base.toml\"\nname = \"other\"\n[model]\nwidth = 96";
        let load = |text: &str| {
            merge(text, Path::new("other.toml"), &folder.path().join("below"), None, &["seed=4".to_owned()])
        };
        let table = load(text).unwrap();
        assert_eq!((table["name"].as_str(), table["seed"].as_integer()), (Some("other"), Some(4)));
        assert_eq!([&table["model"]["width"], &table["model"]["height"]].map(Value::as_integer), [Some(96), Some(32)]);
        let root = folder.path().canonicalize().unwrap().join("kitti");
        assert_eq!(table["data"]["root"].as_str(), root.to_str());

        std::fs::write(folder.path().join("base.toml"), "extends = \"base.toml\"").unwrap();
        let error = load(text).unwrap_err().to_string();
        assert!(error.contains("in a circle"), "{error}");
    }

    #[test]
    fn lists_take_an_index() {
        let table = merged("systems = [{ share = 0.75 }, { share = 0.25 }]", &["systems.1.share=0.5"]);
        assert_eq!(table["systems"][1]["share"].as_float(), Some(0.5));
    }
}
