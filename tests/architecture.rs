//! The plan of the house: which room may use which, and no circle among the files of a room.
//!
//! A room is a folder or file right below `src`; it uses another where its code, tests and comments aside, names
//! `crate::ROOM`, or leads there by `super`. The table is exact: what stands in it is used, what is used stands in it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Each room uses only rooms above it in this table.
const ROOMS: [(&str, &str); 27] = [
    ("error", ""),
    ("time", ""),
    ("loss", ""),
    ("geometry", ""),
    ("files", "error"),
    ("kernels", "error"),
    ("device", "error kernels"),
    ("recordings", "error files geometry time"),
    ("systems", "error files geometry recordings"),
    ("depth", "error files geometry kernels recordings"),
    ("alignment", "geometry kernels"),
    ("warp", "kernels"),
    ("network", "geometry kernels"),
    ("synthetic", "depth error files geometry recordings systems"),
    ("pairs", "alignment depth error geometry recordings synthetic systems"),
    ("model", "alignment error geometry loss network pairs warp"),
    ("schedule", "depth pairs"),
    ("config", "alignment depth error files model network pairs recordings schedule synthetic systems"),
    ("evaluation", "alignment config depth error files geometry model pairs recordings systems warp"),
    (
        "training",
        "config depth device error evaluation files geometry kernels model pairs recordings schedule systems warp",
    ),
    ("fusion", "error evaluation files geometry recordings synthetic systems"),
    ("export", "alignment error fusion geometry recordings systems time"),
    ("report", "alignment error evaluation files fusion geometry pairs recordings training"),
    (
        "predict",
        "alignment config depth error evaluation export files geometry model network pairs recordings systems training",
    ),
    (
        "cli",
        "alignment config depth device error evaluation export files fusion geometry kernels model network pairs predict recordings report synthetic systems training",
    ),
    ("lib", ""),
    ("main", ""),
];

/// A file's code, without comments and without its tests.
fn code(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap();
    let text = text.split("#[cfg(test)]\nmod ").next().unwrap();
    let lines = text.lines().map(|line| if line.trim_start().starts_with("//") { "" } else { line });
    lines.collect::<Vec<_>>().join("\n")
}

fn files_below(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files_below(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// Every file below `src`, its path from there in parts without `.rs`: `["pairs", "reader"]`.
fn sources() -> Vec<(Vec<String>, PathBuf)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    files_below(&root, &mut files);
    files.sort();
    let parts = |path: &Path| {
        let path = path.strip_prefix(&root).unwrap().with_extension("");
        path.iter().map(|part| part.to_str().unwrap().to_owned()).collect()
    };
    files.into_iter().map(|path| (parts(&path), path)).collect()
}

fn word(text: &str) -> &str {
    let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(text.len());
    &text[..end]
}

/// What a path such as `super::` goes on with: one name, or the first names of a group in braces.
fn continuations<'t>(code: &'t str, path: &'t str) -> impl Iterator<Item = &'t str> {
    code.match_indices(path).flat_map(move |(place, _)| {
        let rest = &code[place + path.len()..];
        match rest.strip_prefix('{') {
            None => vec![word(rest)],
            Some(group) => {
                let mut depth = 0;
                let end = group.find(|c| {
                    depth += i32::from(c == '{') - i32::from(c == '}');
                    depth < 0
                });
                let mut names = Vec::new();
                let mut nested = 0;
                for part in group[..end.unwrap_or(group.len())].split(',') {
                    if nested == 0 {
                        names.push(word(part.trim_start()));
                    }
                    nested += part.matches('{').count() as i32 - part.matches('}').count() as i32;
                }
                names
            }
        }
    })
}

#[test]
fn rooms_use_those_below_them_alone() {
    let planned: BTreeMap<&str, BTreeSet<&str>> =
        ROOMS.into_iter().map(|(room, uses)| (room, uses.split_whitespace().collect())).collect();
    let mut known = BTreeSet::new();
    for (room, _) in ROOMS {
        let above: Vec<_> = planned[room].difference(&known).collect();
        assert!(above.is_empty(), "`{room}` uses {above:?}, which stand below it in the table");
        known.insert(room);
    }
    let mut used: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
    for (parts, path) in sources() {
        let uses = used.entry(parts[0].clone()).or_default();
        let code = code(&path);
        // `super` once for each part of a module's path leads out of all rooms.
        let outside = "super::".repeat(module(&parts).len());
        let names = continuations(&code, "crate::").chain(continuations(&code, &outside));
        for name in names.filter(|name| known.contains(name) && **name != parts[0]) {
            uses.entry(name.to_owned()).or_insert_with(|| path.display().to_string());
        }
    }
    for (room, uses) in &used {
        let Some(planned) = planned.get(room.as_str()) else { panic!("`{room}` does not stand in the table of rooms") };
        for (other, path) in uses {
            let known = planned.contains(other.as_str());
            assert!(known, "{path}: `{room}` uses `{other}`, which the table of tests/architecture.rs does not allow");
        }
        let idle: Vec<_> = planned.iter().filter(|other| !uses.contains_key(**other)).collect();
        assert!(idle.is_empty(), "`{room}` does not use {idle:?}; take them out of the table");
    }
    let empty: Vec<_> = known.iter().filter(|room| !used.contains_key(**room)).collect();
    assert!(empty.is_empty(), "no such rooms: {empty:?}");
}

/// A module by its path from `src`, `mod` left out: `["pairs"]` of `pairs/mod.rs`.
fn module(parts: &[String]) -> Vec<String> {
    let parts = parts.strip_suffix(&["mod".to_owned()]).unwrap_or(parts);
    parts.to_vec()
}

/// What a module hands on of its children: name → child.
fn handed_on(code: &str, children: &BTreeSet<String>) -> BTreeMap<String, String> {
    let mut names = BTreeMap::new();
    for child in children {
        for name in continuations(code, &format!("use {child}::")) {
            names.insert(name.to_owned(), child.clone());
        }
        for name in continuations(code, &format!("use self::{child}::")) {
            names.insert(name.to_owned(), child.clone());
        }
    }
    names
}

#[test]
fn files_of_a_room_make_no_circle() {
    let codes: BTreeMap<Vec<String>, String> =
        sources().into_iter().map(|(parts, path)| (module(&parts), code(&path))).collect();
    let children = |parent: &[String]| -> BTreeSet<String> {
        codes
            .keys()
            .filter(|path| path.len() == parent.len() + 1 && path.starts_with(parent))
            .map(|path| path.last().unwrap().clone())
            .collect()
    };
    let mut uses: BTreeMap<Vec<String>, BTreeSet<Vec<String>>> = BTreeMap::new();
    for (path, code) in &codes {
        let Some((_, parent)) = path.split_last() else { continue };
        if parent.is_empty() {
            continue;
        }
        let siblings = children(parent);
        let handed_on = handed_on(codes.get(parent).map_or("", String::as_str), &siblings);
        let through_room = format!("crate::{}::", parent.join("::"));
        let names = continuations(code, "super::").chain(continuations(code, &through_room));
        for name in names {
            let sibling = if siblings.contains(name) { Some(name) } else { handed_on.get(name).map(String::as_str) };
            if let Some(sibling) = sibling.filter(|sibling| Some(*sibling) != path.last().map(String::as_str)) {
                let target = parent.iter().cloned().chain([sibling.to_owned()]).collect();
                uses.entry(path.clone()).or_default().insert(target);
            }
        }
    }
    // What is left when files that use none of those left are taken away, again and again, is circles and what leads
    // into them.
    let mut left: BTreeSet<&Vec<String>> = uses.keys().collect();
    loop {
        let free: Vec<&Vec<String>> =
            left.iter().copied().filter(|path| !uses[*path].iter().any(|other| left.contains(other))).collect();
        if free.is_empty() {
            break;
        }
        left.retain(|path| !free.contains(path));
    }
    let circles: Vec<String> = left
        .iter()
        .map(|path| {
            let others: Vec<String> =
                uses[*path].iter().filter(|other| left.contains(other)).map(|other| other.join("/")).collect();
            format!("{} -> {}", path.join("/"), others.join(", "))
        })
        .collect();
    assert!(circles.is_empty(), "files that use one another:\n{}", circles.join("\n"));
}
