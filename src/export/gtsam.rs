//! Factors for GTSAM: what `BetweenFactorPose3` takes, as CSV.
//!
//! GTSAM's tangent is rotation before translation, its error `Logmap(T̂⁻¹T)`: a right perturbation in axes of the target.

use super::motion::MeasuredMotions;
use super::numbers::{join, pose_numbers, rotation_first, rows};
use super::perturbation::Perturbation;

pub(super) fn render(measured: &MeasuredMotions, floor: Option<[f64; 2]>) -> String {
    let names = ["rx", "ry", "rz", "x", "y", "z"];
    let entries: Vec<String> = (0..36).map(|entry| format!("{}_{}", names[entry / 6], names[entry % 6])).collect();
    let mut text = format!("key1,key2,x,y,z,qx,qy,qz,qw,{}\n", entries.join(","));
    for motion in &measured.motions {
        let covariance = rotation_first(motion.covariance_on(Perturbation::Right, floor).matrix());
        let numbers = pose_numbers(&motion.source_from_target).into_iter().chain(rows(&covariance));
        text += &format!("{},{},{}\n", motion.source, motion.target, join(numbers, ","));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::tests::measured;
    use super::*;

    #[test]
    fn rotations_come_first() {
        let measured = measured();
        let text = render(&measured, None);
        let row: Vec<f64> = text.lines().nth(1).unwrap().split(',').map(|word| word.parse().unwrap()).collect();
        let right = measured.motions[0].covariance.right_of(&measured.motions[0].source_from_target);
        assert_eq!(row[9], right.matrix()[(3, 3)]);
        assert_eq!(row[9 + 35], right.matrix()[(2, 2)]);
        assert_eq!(row[9 + 3], right.matrix()[(3, 0)]);
    }
}
