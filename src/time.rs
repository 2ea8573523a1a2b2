//! Times of frames: whole nanoseconds, as recorders write them. A double of seconds since 1970 is wrong by up to 119 ns.

use std::fmt;

/// Nanoseconds in a second.
const SECOND: i64 = 1_000_000_000;
/// Digits of a nanosecond behind the point.
const DIGITS: i32 = 9;
/// What does not fit into 128 bits needs more digits than any clock has.
const MOST_DIGITS: usize = 37;

/// What times of texts look like, for messages.
pub(crate) const EXPECTED_SECONDS: &str = "seconds, at most 9.2e9; milli-, micro- or nanoseconds are to be divided";
/// The same of those that are written as they are kept.
pub(crate) const EXPECTED_NANOSECONDS: &str = "whole nanoseconds, such as 1403636579763555584";

/// A moment: nanoseconds since 1970 (UTC), or since whatever a recording counts from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Time(i64);

impl Time {
    /// A moment by its nanoseconds.
    pub fn from_nanoseconds(nanoseconds: i64) -> Self {
        Self(nanoseconds)
    }

    /// Its nanoseconds.
    pub fn nanoseconds(self) -> i64 {
        self.0
    }

    /// Seconds, as near as a double comes.
    pub fn seconds(self) -> f64 {
        self.0 as f64 / SECOND as f64
    }

    /// Seconds from an earlier moment to this one.
    pub fn since(self, earlier: Self) -> f64 {
        (i128::from(self.0) - i128::from(earlier.0)) as f64 / SECOND as f64
    }

    /// Whole seconds, and the nanoseconds that remain: a stamp of ROS.
    pub fn stamp(self) -> (i64, u32) {
        (self.0.div_euclid(SECOND), self.0.rem_euclid(SECOND) as u32)
    }

    /// Reads seconds, such as `1403636579.763555584` or `4.09e-1`, to the nanosecond. `None` for what is no number, or
    /// too large for seconds.
    pub fn parse_seconds(text: &str) -> Option<Self> {
        let (mantissa, exponent) = text.split_once(['e', 'E']).unwrap_or((text, "0"));
        let exponent: i32 = exponent.parse().ok().filter(|exponent: &i32| exponent.abs() <= 40)?;
        let (negative, unsigned) = match mantissa.strip_prefix('-') {
            Some(rest) => (true, rest),
            None => (false, mantissa.strip_prefix('+').unwrap_or(mantissa)),
        };
        let (whole, fraction) = unsigned.split_once('.').unwrap_or((unsigned, ""));
        let digits = format!("{whole}{fraction}");
        if digits.is_empty() || digits.len() > MOST_DIGITS || !digits.bytes().all(|byte| byte.is_ascii_digit()) {
            return None;
        }
        let value: i128 = digits.parse().ok()?;
        let shift = DIGITS + exponent - fraction.len() as i32;
        let nanoseconds = match 10_i128.checked_pow(shift.unsigned_abs()) {
            Some(power) if shift >= 0 => value.checked_mul(power)?,
            Some(power) => (value + power / 2) / power,
            None if shift < 0 || value == 0 => 0,
            None => return None,
        };
        i64::try_from(if negative { -nanoseconds } else { nanoseconds }).ok().map(Self)
    }

    /// Reads whole nanoseconds, such as `1403636579763555584`.
    pub fn parse_nanoseconds(text: &str) -> Option<Self> {
        text.parse().ok().map(Self)
    }

    /// Reads a date and a time: `2011-09-30 12:40:59.409428480`, with a blank or a `T` between them, and UTC unless an
    /// offset says otherwise (`Z`, `+02:00`).
    pub fn parse_date(text: &str) -> Option<Self> {
        let (date, time) = text.split_once(['T', 't', ' '])?;
        let mut date = date.splitn(3, '-').map(whole);
        let (year, month, day) = (date.next()??, date.next()??, date.next()??);
        let time = time.trim();
        let (time, offset_s) = match time.rfind(['Z', 'z', '+', '-']) {
            Some(place) => (time[..place].trim_end(), offset_s(&time[place..])?),
            None => (time, 0),
        };
        let mut time = time.splitn(3, ':');
        let (hours, minutes) = (whole(time.next()?)?, whole(time.next()?)?);
        let seconds = Self::parse_seconds(time.next()?).filter(|seconds| (0..=60 * SECOND).contains(&seconds.0))?;
        if !(1..=12).contains(&month) || !(1..=days_of(month, year)).contains(&day) || hours > 23 || minutes > 59 {
            return None;
        }
        // Days from the civil calendar, years counted from March.
        let year = if month <= 2 { year - 1 } else { year };
        let era = year.div_euclid(400);
        let year_of_era = year - era * 400;
        let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
        let days = era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year - 719_468;
        let minutes = (days * 24 + hours) * 60 + minutes;
        (minutes * 60 - offset_s).checked_mul(SECOND)?.checked_add(seconds.0).map(Self)
    }
}

fn days_of(month: i64, year: i64) -> i64 {
    match month {
        2 if year % 4 == 0 && (year % 100 != 0 || year % 400 == 0) => 29,
        2 => 28,
        4 | 6 | 9 | 11 => 30,
        _ => 31,
    }
}

/// A whole number of at most four digits.
fn whole(digits: &str) -> Option<i64> {
    ((1..=4).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_digit()))
        .then(|| digits.parse().ok())?
}

/// Seconds that a zone is ahead of UTC: of `Z`, `+02`, `+0200` or `-02:30`.
fn offset_s(text: &str) -> Option<i64> {
    let (sign, rest) = (if text.starts_with('-') { -1 } else { 1 }, &text[1..]);
    let digits = rest.replace(':', "");
    if !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return None;
    }
    match (text.starts_with(['Z', 'z']), digits.len()) {
        (true, 0) => Some(0),
        (false, 2 | 4) => {
            Some(sign * (3600 * whole(&digits[..2])? + if digits.len() == 4 { 60 * whole(&digits[2..])? } else { 0 }))
        }
        _ => None,
    }
}

/// Seconds with nine digits behind the point.
impl fmt::Display for Time {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (sign, positive) = (if self.0 < 0 { "-" } else { "" }, self.0.unsigned_abs());
        write!(formatter, "{sign}{}.{:09}", positive / SECOND.unsigned_abs(), positive % SECOND.unsigned_abs())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn dates_count_nanoseconds_since_1970() {
        let parse = |text| Time::parse_date(text).map(Time::nanoseconds);
        assert_eq!(parse("1970-01-01 00:00:00.000000000"), Some(0));
        // date -u -d '2011-09-30 12:40:59' +%s
        let expected = Some(1_317_386_459_409_428_480);
        for text in [
            "2011-09-30 12:40:59.409428480",
            "2011-09-30T12:40:59.409428480Z",
            "2011-09-30T14:40:59.40942848+02:00",
            "2011-09-30 10:10:59.409428480-0230",
            "2011-09-30T12:40:59.409428480+00",
        ] {
            assert_eq!(parse(text), expected, "{text}");
        }
        assert_eq!(parse("2012-02-29 00:00:00"), Some(1_330_473_600_000_000_000));
        for text in [
            "2011-02-29 00:00:00",
            "2011-09-30 24:00:00",
            "2011-09-30 12:40:59 -für",
            "2011-13-30 12:40:59.5",
            "yesterday",
            "2011-09-30",
            "2011-09-30 12:40",
            "2011-09-30T12:40:59+2",
            "30/09/2011 12:40:59",
        ] {
            assert_eq!(parse(text), None, "{text}");
        }
    }

    #[test]
    fn seconds_keep_their_nanoseconds() {
        for (text, nanoseconds) in [
            ("1403636579.763555584", Some(1_403_636_579_763_555_584)),
            ("1.403636579763555584e9", Some(1_403_636_579_763_555_584)),
            ("-0.5", Some(-500_000_000)),
            ("1e-9", Some(1)),
            ("0.00000000051", Some(1)),
            ("7.", Some(7_000_000_000)),
            ("0e99", None),
            ("1403636579763555584", None),
            ("1.4e18", None),
            ("nan", None),
            ("", None),
            (".", None),
            ("1,5", None),
        ] {
            assert_eq!(Time::parse_seconds(text).map(Time::nanoseconds), nanoseconds, "{text}");
        }
        for (text, nanoseconds) in [
            ("1403636579763555584", Some(1_403_636_579_763_555_584)),
            ("-1", Some(-1)),
            ("1403636579.76", None),
            ("1.403636579763555584e18", None),
            ("9223372036854775808", None),
            ("", None),
        ] {
            assert_eq!(Time::parse_nanoseconds(text).map(Time::nanoseconds), nanoseconds, "{text}");
        }
        assert_eq!(Time::from_nanoseconds(-1).stamp(), (-1, 999_999_999));
        assert_eq!(Time::from_nanoseconds(-1).to_string(), "-0.000000001");
    }

    proptest! {
        #[test]
        fn what_is_printed_comes_back(nanoseconds: i64) {
            let time = Time::from_nanoseconds(nanoseconds);
            prop_assert_eq!(Time::parse_seconds(&time.to_string()), Some(time));
            let (seconds, rest) = time.stamp();
            prop_assert_eq!(seconds as i128 * 1_000_000_000 + rest as i128, nanoseconds as i128);
        }

        #[test]
        fn no_text_makes_the_readers_panic(text in "[-+0-9.:TZe ]{0,40}", other in ".{0,20}") {
            let dated = format!("2011-09-30 1:2:3{other}");
            let _ = (Time::parse_seconds(&text), Time::parse_date(&text), Time::parse_date(&dated));
        }
    }
}
