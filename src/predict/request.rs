//! What a line of a stream may hold. Everything is read into types of bounded size, so that no line, however made, takes
//! more memory than its own length.

use std::fmt;
use std::path::{Path, PathBuf};

use base64::Engine;
use nalgebra::{Matrix3, Vector3};
use serde::de::{self, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::identity::Id;
use crate::error::{Error, Place, Result, excerpt};
use crate::geometry::Pose;
use crate::recordings::pose_from_quaternion;

/// Largest `|RᵀR − I|` of a rotation.
const ROTATION_TOLERANCE: f64 = 1e-3;
/// Longest translation, m.
const LARGEST_M: f64 = 1e6;
/// Numbers of a 4x4 matrix: no list is longer.
const MOST_NUMBERS: usize = 16;

/// A request, field by field as [`Stream`](super::Stream) documents it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Request {
    #[serde(default)]
    pub(super) id: Id,
    pub(super) source_image: Content,
    pub(super) target_image: Content,
    pub(super) intrinsics: [f64; 4],
    pub(super) pose: Numbers,
    #[serde(default)]
    pub(super) pose_frame: PoseFrame,
    pub(super) camera_from_vehicle: Option<Numbers>,
    pub(super) depth: Option<Content>,
    pub(super) right_source_image: Option<Content>,
    pub(super) right_target_image: Option<Content>,
    pub(super) right_from_left: Option<Numbers>,
}

/// Whose motion a pose describes.
#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum PoseFrame {
    #[default]
    Camera,
    Vehicle,
}

/// A file, or what would stand in it, base64.
pub(super) enum Content {
    File(PathBuf),
    Base64(String),
}

impl Content {
    /// Reads and decodes it; `field` names it in errors.
    pub(super) fn read<T>(
        &self,
        field: &str,
        from_file: impl FnOnce(&Path) -> Result<T>,
        from_bytes: impl FnOnce(&[u8], &Path) -> Result<T>,
    ) -> Result<T> {
        match self {
            Self::File(path) if !path.exists() => {
                let found = excerpt(&path.to_string_lossy());
                let expected = "a file, or {\"base64\": \"…\"}";
                Err(Error::Data(format!("field `{field}`: found no file {found}; expected {expected}")))
            }
            Self::File(path) => from_file(path),
            Self::Base64(text) => {
                let encoded = encoded_part(text).ok_or_else(|| {
                    let found = excerpt(text);
                    Error::Data(format!("field `{field}`: found {found}; expected base64, alone or in a data URL"))
                })?;
                // Lines of 76 characters, as mail and many encoders have them (RFC 2045).
                let joined: Vec<u8> = encoded.bytes().filter(|byte| !byte.is_ascii_whitespace()).collect();
                let bytes = base64::engine::general_purpose::STANDARD.decode(joined).map_err(|error| {
                    Error::Data(format!("field `{field}`: found {error}; expected base64 with padding"))
                })?;
                from_bytes(&bytes, &PathBuf::from(format!("field `{field}`")))
            }
        }
    }
}

/// How the content of a file begins where it stands in a URL (RFC 2397).
const DATA_URL: &str = "data:";
/// Longer texts are no paths, bytes.
const LONGEST_PATH: usize = 4096;

/// The base64 of a text: all of it, or what follows the head of a data URL.
fn encoded_part(text: &str) -> Option<&str> {
    match text.trim_start().strip_prefix(DATA_URL) {
        None => Some(text),
        Some(rest) => rest.split_once(',').filter(|(head, _)| head.ends_with(";base64")).map(|(_, encoded)| encoded),
    }
}

impl<'de> Deserialize<'de> for Content {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ContentVisitor;
        impl<'de> Visitor<'de> for ContentVisitor {
            type Value = Content;
            fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
                formatter.write_str("an image or depth map: a path, or an object with its `base64` alone")
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<Content, E> {
                match (text.starts_with(DATA_URL), text.len() > LONGEST_PATH) {
                    (true, _) => Ok(Content::Base64(text.to_owned())),
                    (false, false) => Ok(Content::File(PathBuf::from(text))),
                    (false, true) => {
                        let length = text.len();
                        Err(E::custom(format!("{length} bytes are no path; base64 is written {{\"base64\": \"…\"}}")))
                    }
                }
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Content, A::Error> {
                let mut content = None;
                while let Some(key) = map.next_key::<String>()? {
                    match key.as_str() {
                        "base64" => content = Some(map.next_value()?),
                        other => {
                            map.next_value::<IgnoredAny>()?;
                            return Err(de::Error::unknown_field(other, &["base64"]));
                        }
                    }
                }
                content.map(Content::Base64).ok_or_else(|| de::Error::missing_field("base64"))
            }
        }
        deserializer.deserialize_any(ContentVisitor)
    }
}

/// At most sixteen numbers, in a list or in lists of a list.
#[derive(Default)]
pub(super) struct Numbers(Vec<f64>);

impl Numbers {
    /// The pose of 7 numbers `x y z qx qy qz qw`, or of the 12 or 16 of a matrix; `field` names it in errors.
    pub(super) fn pose(&self, field: &str) -> Result<Pose> {
        let wrong =
            |found: String, expected: &str| Error::Data(format!("field `{field}`: found {found}; expected {expected}"));
        let pose = match self.0.as_slice() {
            &[x, y, z, qx, qy, qz, qw] => {
                let origin = PathBuf::from(format!("field `{field}`"));
                pose_from_quaternion(Vector3::new(x, y, z), [qx, qy, qz, qw], &origin, &Place::Whole)?
            }
            rows
            @ ([_, _, _, _, _, _, _, _, _, _, _, _] | [_, _, _, _, _, _, _, _, _, _, _, _, 0.0, 0.0, 0.0, 1.0]) => {
                let rotation = Matrix3::from_fn(|row, column| rows[4 * row + column]);
                Pose::from_rounded_parts(rotation, Vector3::new(rows[3], rows[7], rows[11]), ROTATION_TOLERANCE)
                    .map_err(|deviation| wrong(format!("|RᵀR − I| = {deviation:.1e}"), "a rotation matrix"))?
            }
            other => {
                let last_row = if other.len() == MOST_NUMBERS { ", the last row not 0 0 0 1" } else { "" };
                let found = format!("{} numbers{last_row}", other.len());
                return Err(wrong(found, "7 (x y z qx qy qz qw), 12 (3x4) or 16 (4x4)"));
            }
        };
        match pose.is_finite() && pose.translation.norm() <= LARGEST_M {
            true => Ok(pose),
            false => Err(wrong(format!("a translation of {:.1e} m", pose.translation.norm()), "at most a million")),
        }
    }
}

impl<'de> Deserialize<'de> for Numbers {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NumbersVisitor;
        impl<'de> Visitor<'de> for NumbersVisitor {
            type Value = Numbers;
            fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
                formatter.write_str("a pose: 7 numbers x y z qx qy qz qw, or a 3x4 or 4x4 matrix")
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Numbers, A::Error> {
                let mut numbers = Vec::new();
                while let Some(entry) = list.next_element::<Entry>()? {
                    match entry {
                        Entry::Number(number) => numbers.push(number),
                        Entry::Row(row) => numbers.extend(row),
                    }
                    if numbers.len() > MOST_NUMBERS {
                        return Err(de::Error::invalid_length(numbers.len(), &self));
                    }
                }
                Ok(Numbers(numbers))
            }
        }
        deserializer.deserialize_seq(NumbersVisitor)
    }
}

/// A number of a list, or a row of numbers.
enum Entry {
    Number(f64),
    Row([f64; 4]),
}

impl<'de> Deserialize<'de> for Entry {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct EntryVisitor;
        impl<'de> Visitor<'de> for EntryVisitor {
            type Value = Entry;
            fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
                formatter.write_str("a number, or a row of four")
            }
            fn visit_f64<E>(self, number: f64) -> Result<Entry, E> {
                Ok(Entry::Number(number))
            }
            fn visit_i64<E>(self, number: i64) -> Result<Entry, E> {
                Ok(Entry::Number(number as f64))
            }
            fn visit_u64<E>(self, number: u64) -> Result<Entry, E> {
                Ok(Entry::Number(number as f64))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<Entry, A::Error> {
                <[f64; 4]>::deserialize(de::value::SeqAccessDeserializer::new(list)).map(Entry::Row)
            }
        }
        deserializer.deserialize_any(EntryVisitor)
    }
}
