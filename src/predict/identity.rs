//! Whose request a line is: its id, which comes back as it was sent, also of lines that are no requests.

use std::fmt;

use serde::de::{self, IgnoredAny, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::value::RawValue;

/// Longest text that identifies a request, bytes.
const LONGEST_ID: usize = 1024;

/// What comes back with the answer, digit by digit: nothing, a number, or a text of bounded length.
#[derive(Clone, Default, Serialize)]
#[serde(transparent)]
pub(super) struct Id(Option<Box<RawValue>>);

impl<'de> Deserialize<'de> for Id {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let raw = Box::<RawValue>::deserialize(deserializer)?;
        let length = match raw.get().as_bytes().first() {
            Some(b'n') => return Ok(Self(None)),
            Some(b'"') => serde_json::from_str::<String>(raw.get()).map_err(de::Error::custom)?.len(),
            Some(b'-' | b'0'..=b'9') => raw.get().len(),
            _ => {
                return Err(de::Error::custom(
                    "found a list, an object or a truth for an id: a number, or text, comes back",
                ));
            }
        };
        match length <= LONGEST_ID {
            true => Ok(Self(Some(raw))),
            false => Err(de::Error::custom(format!("an id of {length} bytes; at most {LONGEST_ID} come back"))),
        }
    }
}

/// The id in a line that is no request, where it stands before what is wrong, or only numbers are.
pub(super) fn identity(line: &str) -> Id {
    let mut id = Id::default();
    let (line, _) = replace_no_numbers(line);
    let mut json = serde_json::Deserializer::from_str(&line);
    // What was found until then counts.
    let _ = json.deserialize_map(IdentityVisitor(&mut id));
    id
}

struct IdentityVisitor<'a>(&'a mut Id);

impl<'de> Visitor<'de> for IdentityVisitor<'_> {
    type Value = ();

    fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        formatter.write_str("an object with an id")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        while let Some(key) = map.next_key::<String>()? {
            match key == "id" {
                true => *self.0 = map.next_value()?,
                false => drop(map.next_value::<IgnoredAny>()?),
            }
        }
        Ok(())
    }
}

/// A line with `null` for values that stand for numbers and are none in JSON (`NaN`, `-inf`, `Infinity`, in any case),
/// and the first of them.
pub(super) fn replace_no_numbers(line: &str) -> (String, Option<&str>) {
    let (mut replaced, mut first) = (String::with_capacity(line.len()), None);
    let (mut in_text, mut escaped, mut value_may_come) = (false, false, false);
    let mut rest = line;
    while let Some(c) = rest.chars().next() {
        let word = if value_may_come { no_number(rest) } else { None };
        match word {
            Some(_) => replaced.push_str("null"),
            None => replaced.push(c),
        }
        if c == '"' && !escaped {
            in_text = !in_text;
        }
        escaped = c == '\\' && !escaped;
        value_may_come = !in_text && (matches!(c, ':' | ',' | '[') || value_may_come && c.is_whitespace());
        first = first.or(word);
        rest = &rest[word.map_or(c.len_utf8(), str::len)..];
    }
    (replaced, first)
}

/// The word with which a text begins, if it stands for a number that JSON does not have.
fn no_number(text: &str) -> Option<&str> {
    let unsigned = text.trim_start_matches(['-', '+']);
    let letters = unsigned.find(|c: char| !c.is_ascii_alphanumeric()).unwrap_or(unsigned.len());
    let word = &text[..text.len() - unsigned.len() + letters];
    let known = ["nan", "inf", "infinity"].iter().any(|name| unsigned[..letters].eq_ignore_ascii_case(name));
    known.then_some(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_values_are_no_numbers() {
        for (line, replaced, word) in [
            (r#"{"a": NaN, "b": [-inf,+Infinity , nan]}"#, r#"{"a": null, "b": [null,null , null]}"#, Some("NaN")),
            (r#"{"a": "x, NaN", "b": "\\", "c":-NAN}"#, r#"{"a": "x, NaN", "b": "\\", "c":null}"#, Some("-NAN")),
            ("{'source_image': 'nancy/0.png', infinite: 1}", "{'source_image': 'nancy/0.png', infinite: 1}", None),
            (r#"{"é": "\"", "n": nano}"#, r#"{"é": "\"", "n": nano}"#, None),
        ] {
            assert_eq!(replace_no_numbers(line), (replaced.to_owned(), word));
        }
    }
}
