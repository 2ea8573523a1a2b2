//! `relcov predict --stream`: lines in, lines out.

use std::io::{self, BufRead, Write};

use anyhow::Context;

use super::arguments::PredictArguments;
use crate::cli::choices::FrameArgument;
use crate::config::Config;
use crate::error::Error;
use crate::export::Format;
use crate::predict::{Model, Stream, StreamSettings};

/// Longest request of a stream: two images of some 20 megapixels in base64.
const LONGEST_REQUEST_BYTES: usize = 64 << 20;

/// Answers requests until stdin ends, or nobody listens any more.
pub(super) fn stream(arguments: &PredictArguments, config: &Config, model: &Model) -> anyhow::Result<()> {
    if arguments.format != Format::Jsonl {
        return Err(Error::Data("--stream answers in JSON lines; leave --format out".to_owned()).into());
    }
    let settings = StreamSettings {
        depth: Some(config.depth.clone()),
        frame: arguments.frame.map(FrameArgument::frame),
        perturbation: arguments.perturbation,
        floor: arguments.floor,
        poses: arguments.poses(),
    };
    let stream = Stream::new(model, &settings)?;
    let (mut requests, mut answers) = (io::stdin().lock(), io::stdout().lock());
    let mut line = Vec::new();
    loop {
        let answer = match read_request(&mut requests, &mut line).context("cannot read stdin")? {
            Request::End => return Ok(()),
            Request::Line if line.iter().all(u8::is_ascii_whitespace) => continue,
            Request::Line => match std::str::from_utf8(&line) {
                Ok(text) => stream.answer(text),
                Err(error) => Stream::refuse(&String::from_utf8_lossy(&line), &format!("not UTF-8: {error}")),
            },
            Request::TooLong => {
                let most = LONGEST_REQUEST_BYTES >> 20;
                Stream::refuse("", &format!("a line of more than {most} MiB; send paths, or smaller images"))
            }
        };
        match writeln!(answers, "{answer}").and_then(|()| answers.flush()) {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(()),
            written => written.context("cannot write to stdout")?,
        }
    }
}

enum Request {
    Line,
    TooLong,
    End,
}

/// Reads up to a line end; what is longer than a request may be is passed over, so that memory stays bounded.
fn read_request(input: &mut impl BufRead, line: &mut Vec<u8>) -> io::Result<Request> {
    line.clear();
    line.shrink_to(1 << 20);
    let mut too_long = false;
    loop {
        let available = input.fill_buf()?;
        if available.is_empty() {
            return Ok(match (line.is_empty(), too_long) {
                (_, true) => Request::TooLong,
                (true, false) => Request::End,
                (false, false) => Request::Line,
            });
        }
        let end = available.iter().position(|&byte| byte == b'\n');
        let part = &available[..end.unwrap_or(available.len())];
        too_long |= line.len() + part.len() > LONGEST_REQUEST_BYTES;
        if too_long {
            line.clear();
        } else {
            line.extend_from_slice(part);
        }
        let taken = part.len() + usize::from(end.is_some());
        input.consume(taken);
        if end.is_some() {
            return Ok(if too_long { Request::TooLong } else { Request::Line });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_lines_and_long_ones_are_passed_over() {
        let long = vec![b'x'; LONGEST_REQUEST_BYTES + 1];
        let bytes = [b"first\n".as_slice(), &long, b"\nlast"].concat();
        let mut input = io::BufReader::with_capacity(4096, bytes.as_slice());
        let mut line = Vec::new();
        let mut next = || (read_request(&mut input, &mut line).unwrap(), line.clone());
        assert!(matches!(next(), (Request::Line, text) if text == b"first"));
        assert!(matches!(next(), (Request::TooLong, _)));
        assert!(matches!(next(), (Request::Line, text) if text == b"last"));
        assert!(matches!(next(), (Request::End, _)));
    }
}
