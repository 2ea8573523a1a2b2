//! Which raw drive a KITTI odometry sequence was cut from (KITTI odometry development kit, readme.txt).

/// An odometry sequence and its place in a raw drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OdometrySequence {
    /// `00` … `10`.
    pub number: &'static str,
    /// Raw drive without `_sync`.
    pub drive: &'static str,
    /// Raw frame of the sequence's frame 0.
    pub first_frame: usize,
    /// How many frames it has.
    pub frames: usize,
}

const SEQUENCES: [OdometrySequence; 11] = [
    OdometrySequence { number: "00", drive: "2011_10_03_drive_0027", first_frame: 0, frames: 4541 },
    OdometrySequence { number: "01", drive: "2011_10_03_drive_0042", first_frame: 0, frames: 1101 },
    OdometrySequence { number: "02", drive: "2011_10_03_drive_0034", first_frame: 0, frames: 4661 },
    OdometrySequence { number: "03", drive: "2011_09_26_drive_0067", first_frame: 0, frames: 801 },
    OdometrySequence { number: "04", drive: "2011_09_30_drive_0016", first_frame: 0, frames: 271 },
    OdometrySequence { number: "05", drive: "2011_09_30_drive_0018", first_frame: 0, frames: 2761 },
    OdometrySequence { number: "06", drive: "2011_09_30_drive_0020", first_frame: 0, frames: 1101 },
    OdometrySequence { number: "07", drive: "2011_09_30_drive_0027", first_frame: 0, frames: 1101 },
    OdometrySequence { number: "08", drive: "2011_09_30_drive_0028", first_frame: 1100, frames: 4071 },
    OdometrySequence { number: "09", drive: "2011_09_30_drive_0033", first_frame: 0, frames: 1591 },
    OdometrySequence { number: "10", drive: "2011_09_30_drive_0034", first_frame: 0, frames: 1201 },
];

/// The odometry sequence cut from a raw drive, if there is one; takes the name without `_sync`.
pub fn odometry_sequence(drive: &str) -> Option<OdometrySequence> {
    SEQUENCES.into_iter().find(|sequence| sequence.drive == drive)
}
