//! How many predictions the images had no part in, for the summary on stderr.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use crate::alignment::NoVerdict;
use crate::export::{MeasuredMotions, Poses, Verdict};

/// How many pairs got no verdict, by reason, the most frequent first; nothing where all got one.
pub(super) fn describe_verdicts(predicted: &[MeasuredMotions], poses: Poses) -> String {
    let mut counts: BTreeMap<NoVerdict, usize> = BTreeMap::new();
    for motion in predicted.iter().flat_map(|measured| &measured.motions) {
        if let Some(Verdict::Withheld(reason)) = motion.verdict {
            *counts.entry(reason).or_default() += 1;
        }
    }
    let mut reasons: Vec<(NoVerdict, usize)> = counts.into_iter().collect();
    reasons.sort_by_key(|&(_, count)| Reverse(count));
    let lost: usize = reasons.iter().map(|(_, count)| count).sum();
    if lost == 0 {
        return String::new();
    }
    let reasons: Vec<String> = reasons.iter().map(|(reason, count)| format!("{} {count}", reason.name())).collect();
    let written = match poses {
        Poses::Measured => "with the covariance that is expected without them",
        Poses::Corrected => "as they are, with the covariance that is expected without them",
    };
    format!("; {lost} got no verdict from the images ({}) and are written {written}", reasons.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::MeasuredMotion;
    use crate::geometry::{Covariance6, ErrorFrame, Pose};

    #[test]
    fn reasons_are_counted_the_most_frequent_first() {
        let motion = |verdict| MeasuredMotion {
            source: 0,
            target: 1,
            times: None,
            source_from_target: Pose::identity(),
            covariance: Covariance6::zero(),
            posterior: None,
            verdict,
        };
        let measured = |reasons: &[Option<NoVerdict>]| MeasuredMotions {
            system: "vo".to_owned(),
            drive: "lab".to_owned(),
            frame: ErrorFrame::Vehicle,
            motions: reasons.iter().map(|reason| motion(Some(Verdict::of(*reason)))).collect(),
        };
        let (depth, texture) = (Some(NoVerdict::NoDepth), Some(NoVerdict::NoTexture));
        let text = describe_verdicts(&[measured(&[depth, None]), measured(&[texture, texture])], Poses::Corrected);
        assert_eq!(
            text,
            "; 3 got no verdict from the images (no_texture 2, no_depth 1) and are written as they are, with the covariance that is expected without them"
        );
        assert_eq!(describe_verdicts(&[measured(&[None])], Poses::Measured), "");
    }
}
