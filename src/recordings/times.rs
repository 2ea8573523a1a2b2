//! Times of a drive's frames, by the line of a text file.

use std::collections::BTreeMap;
use std::path::Path;

use super::recording::FrameFiles;
use crate::error::{Error, Place, excerpt};
use crate::files::read_text;
use crate::time::Time;

/// Frame times of the first file that is there, each beside the frames it was written for.
pub(super) fn load_times<'a>(
    files: impl IntoIterator<Item = (&'a Path, &'a FrameFiles)>,
    problems: &mut Vec<String>,
) -> BTreeMap<usize, Time> {
    let Some((path, frames)) = files.into_iter().find(|(path, _)| path.is_file()) else { return BTreeMap::new() };
    match read_text(path) {
        Ok(text) => parse_times(&text, path, frames, problems),
        Err(error) => {
            problems.push(error.to_string());
            BTreeMap::new()
        }
    }
}

fn read_time(line: &str) -> Option<Time> {
    Time::parse_date(line.trim()).or_else(|| Time::parse_seconds(line.trim()))
}

/// The lines of frames: their numbers from 0 and their texts. Remarks are none, nor is a header, the one line more than
/// frames that is no time; blank lines are, of frames without a time.
fn lines_of_frames<'t>(text: &'t str, frames: &FrameFiles) -> Vec<(usize, &'t str)> {
    let numbered = text.trim_end().lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with('#'));
    let lines: Vec<(usize, &str)> = numbered.collect();
    match lines.as_slice() {
        [(_, header), rest @ ..]
            if rest.len() == frames.len() && !header.trim().is_empty() && read_time(header).is_none() =>
        {
            rest.to_vec()
        }
        _ => lines,
    }
}

/// A time a line: the k-th of frame k, or of the k-th frame where a cut drive has as many frames as lines, from a later
/// one on.
fn parse_times(text: &str, path: &Path, frames: &FrameFiles, problems: &mut Vec<String>) -> BTreeMap<usize, Time> {
    let lines = lines_of_frames(text, frames);
    let cut = frames.len() == lines.len() && frames.last_key_value().is_some_and(|(&last, _)| last >= lines.len());
    let mut refuse = |place, found: String, expected: &str| {
        problems.push(Error::malformed(path, place, found, expected).to_string());
    };
    if let Some((last, _)) = frames.last_key_value().filter(|(last, _)| !cut && **last >= lines.len()) {
        refuse(Place::Whole, format!("{} lines", lines.len()), &format!("a time for each frame to {last}"));
    }
    let frame_of: Vec<usize> = if cut { frames.keys().copied().collect() } else { (0..lines.len()).collect() };
    let mut times = BTreeMap::<usize, Time>::new();
    let mut disorder = None;
    for (index, (number, line)) in lines.into_iter().enumerate().filter(|(_, (_, line))| !line.trim().is_empty()) {
        let place = Place::Line(number + 1);
        let Some(time) = read_time(line) else {
            refuse(place, excerpt(line.trim()), "a time like 2011-09-30 12:40:59.409, or seconds");
            continue;
        };
        if let Some((_, last)) = times.last_key_value().filter(|(_, last)| **last >= time) {
            disorder.get_or_insert((place, format!("{time} after {last}")));
        }
        times.insert(frame_of[index], time);
    }
    if let Some((place, found)) = disorder {
        refuse(place, found, "increasing times");
    }
    times
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn the_times_of_a_cut_drive_are_those_of_its_frames() {
        let frames = |range: std::ops::Range<usize>| range.map(|frame| (frame, PathBuf::new())).collect::<FrameFiles>();
        let text = "# times\n2011-09-30 12:40:59.000000001\n\n1317386459.1\nyesterday\n";
        let read = |frames| {
            let mut problems = Vec::new();
            let times = parse_times(text, Path::new("timestamps.txt"), &frames, &mut problems);
            (times.into_keys().collect::<Vec<_>>(), problems)
        };
        assert_eq!((read(frames(0..4)).0, read(frames(10..14)).0), (vec![0, 2], vec![10, 12]));
        // Five frames, and a line more that is no time.
        let headed = format!("time\n{}\n{text}", "2011-09-30 12:40:58");
        let mut problems = Vec::new();
        let times = parse_times(&headed, Path::new("timestamps.txt"), &frames(0..5), &mut problems);
        assert_eq!(times.into_keys().collect::<Vec<_>>(), [0, 1, 3]);
        assert_eq!(problems.len(), 1, "{problems:?}");
        let (known, problems) = read(frames(10..99));
        assert_eq!(known, [0, 2]);
        assert_eq!(problems[0], "timestamps.txt: found 4 lines; expected a time for each frame to 98");
        assert_eq!(
            problems[1..],
            ["timestamps.txt, line 5: found `yesterday`; expected a time like 2011-09-30 12:40:59.409, or seconds"]
        );
    }
}
