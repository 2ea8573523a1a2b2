#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy", "scipy", "gtsam==4.3.0", "graphslam==0.0.17", "rosbags==0.11.9", "evo==1.38.1"]
# ///
"""Checks every export of `relcov predict` by programs that know nothing of relcov.

    cargo build --release && uv run data_scripts/check_exports.py

Without uv: pip install numpy scipy gtsam graphslam rosbags evo, then run it with python.
Renders a short drive, trains a model with full covariances and one that predicts the error itself for a moment,
predicts in every format, measured poses by the one and corrected ones by the other, and asks GTSAM, a g2o reader
(graphslam), ROS' message definitions (rosbags) and evo what they understand. The yardstick is the
Mahalanobis distance `eᵀΣ⁻¹e` of a true pose that differs from the measured one by a known e = log(T̂ T⁻¹).
Exits with 1 and says why when something does not fit.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import gtsam
import numpy as np
from evo.tools import file_interface
from graphslam.graph import Graph
from rosbags.typesys import Stores, get_typestore
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parent.parent
CONFIG = """
name = "{name}"
checkpoints = "runs"
device = "flex"
[data]
root = "data"
train = [{{ drive = "2026_01_01_drive_0001_sync" }}]
validation = [{{ drive = "2026_01_01_drive_0002_sync" }}]
test = [{{ drive = "2026_01_01_drive_0003_sync" }}]
[[systems]]
name = "vo"
share = 1.0
source = "relative"
path = "measurements/vo/{{drive}}.csv"
frame = "camera2"
[depth]
source = "files"
path = "{{date}}/{{drive}}/depth_02/data/{{frame}}.png"
[model]
width = {width}
height = {height}
{model}
[training]
batch = 8
micro_batch = 8
learning_rate = 1e-3
epochs = 2
batches_per_epoch = 6
"""

RUNS = {
    "measured": {"width": 64, "height": 32, "model": 'head = "full"'},
    "corrected": {"width": 128, "height": 64, "model": 'evidence = "alignment"\nnetwork = "none"\nhead = "posterior"'},
}

failures = 0


def check(name: str, difference: float, bound: float) -> None:
    global failures
    holds = bool(difference <= bound)
    failures += not holds
    print(f"{'ok    ' if holds else 'FAILED'} {name}: {difference:.2e} (at most {bound:.0e})")


def hat(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def exponential(tangent: np.ndarray) -> np.ndarray:
    """exp of (rho, phi) by the matrix exponential."""
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = hat(tangent[3:]), tangent[:3]
    return expm(generator)


def matrix(translation, quaternion) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), translation
    return pose


def mahalanobis(covariance: np.ndarray, error: np.ndarray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def relative(found: float, expected: float) -> float:
    return abs(found / expected - 1.0)


def prepare(relcov: str, folder: Path) -> None:
    synth = ["synth", "--out", str(folder / "data"), "--drives", "3", "--frames", "24", "--size", "128x64"]
    commands = [synth + ["--lidar-steps", "0"]]
    for name, settings in RUNS.items():
        (folder / f"{name}.toml").write_text(CONFIG.format(name=name, **settings))
        commands.append(["train", "--config", str(folder / f"{name}.toml")])
    for arguments in commands:
        subprocess.run([relcov, *arguments, "--quiet"], check=True, stdout=subprocess.DEVNULL)


class Predictions:
    """The reference: JSON lines, poses and left covariances in axes of the vehicle; as measured, or corrected."""

    def __init__(self, relcov: str, folder: Path, run: str, *asked: str):
        self.command = [relcov, "predict", "--quiet", "--run", str(folder / "runs" / run), *asked, "--format"]
        lines = [json.loads(line) for line in self.text("jsonl").splitlines()]
        self.keys = [(line["source"], line["target"]) for line in lines]
        self.poses = [matrix(line["pose"]["translation"], line["pose"]["quaternion_xyzw"]) for line in lines]
        self.covariances = [np.array(line["covariance"]) for line in lines]
        self.times = [line["times"] for line in lines]
        random = np.random.default_rng(0)
        draw = [np.linalg.cholesky(covariance) @ random.normal(size=6) for covariance in self.covariances]
        self.errors = draw
        # T̂ = exp(e) T
        self.truths = [exponential(-error) @ pose for error, pose in zip(draw, self.poses)]
        self.distances = [mahalanobis(*pair) for pair in zip(self.covariances, draw)]
        off_diagonal = max(np.abs(c - np.diag(np.diag(c))).max() for c in self.covariances)
        assert off_diagonal > 0, "the check needs full covariances"

    def text(self, form: str, *options: str) -> str:
        return subprocess.run([*self.command, form, *options], check=True, capture_output=True, text=True).stdout


def check_corrections(corrected: Predictions, folder: Path, relcov: str) -> None:
    """What is corrected is what the lines of the measured poses say beside them, by another exponential map."""
    both = Predictions(relcov, folder, "corrected")
    lines = [json.loads(line) for line in both.text("jsonl").splitlines()]
    worst_pose = worst_moment = worst_right = 0.0
    right = [json.loads(line) for line in both.text("jsonl", "--perturbation", "right").splitlines()]
    for index, line in enumerate(lines):
        mean = np.array(line["correction"])
        expected = exponential(-mean) @ both.poses[index]
        worst_pose = max(worst_pose, np.abs(expected - corrected.poses[index]).max())
        moment = corrected.covariances[index] + np.outer(mean, mean)
        worst_moment = max(worst_moment, np.abs(moment - both.covariances[index]).max() / np.abs(moment).max())
        other_side = both.poses[index] @ exponential(-np.array(right[index]["correction"]))
        worst_right = max(worst_right, np.abs(other_side - corrected.poses[index]).max())
    verdicts = [line["verdict"] for line in lines]
    assert "ok" in verdicts, verdicts
    check("corrected: exp(-μ) T̂ by the matrix exponential", worst_pose, 1e-9)
    check("corrected: R is C + μ μᵀ", worst_moment, 1e-9)
    check("corrected: T̂ exp(-μ) with the μ of the right side", worst_right, 1e-9)


def check_gtsam(predictions: Predictions) -> None:
    rows = predictions.text("gtsam").splitlines()
    names = rows[0].split(",")
    assert names[9] == "rx_rx" and names[-1] == "z_z", names
    worst = 0.0
    for row, truth, distance in zip(rows[1:], predictions.truths, predictions.distances):
        numbers = [float(word) for word in row.split(",")]
        x, y, z, qx, qy, qz, qw = numbers[2:9]
        measured = gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))
        noise = gtsam.noiseModel.Gaussian.Covariance(np.array(numbers[9:]).reshape(6, 6))
        factor = gtsam.BetweenFactorPose3(0, 1, measured, noise)
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3())
        values.insert(1, gtsam.Pose3(truth))
        worst = max(worst, relative(2 * factor.error(values), distance))
    check("gtsam: twice the error of BetweenFactorPose3 at the true pose is our Mahalanobis distance", worst, 1e-9)


def check_g2o(predictions: Predictions, folder: Path) -> None:
    path = folder / "angle.g2o"
    path.write_text(predictions.text("g2o", "--g2o-rotation", "angle"))
    graph, _ = gtsam.readG2o(str(path), True)
    worst = 0.0
    factors = [graph.at(index) for index in range(graph.size())]
    factors = [factor for factor in factors if isinstance(factor, gtsam.BetweenFactorPose3)]
    assert len(factors) == len(predictions.keys)
    for factor, truth, distance in zip(factors, predictions.truths, predictions.distances):
        values = gtsam.Values()
        first, second = factor.keys()
        values.insert(first, gtsam.Pose3())
        values.insert(second, gtsam.Pose3(truth))
        worst = max(worst, relative(2 * factor.error(values), distance))
    check("g2o with --g2o-rotation angle: the same through GTSAM's g2o reader", worst, 1e-9)

    path = folder / "half.g2o"
    path.write_text(predictions.text("g2o"))
    edges = Graph.from_g2o(str(path))._edges
    assert len(edges) == len(predictions.keys)
    worst_pose = worst = 0.0
    for index, edge in enumerate(edges):
        measured = matrix(edge.estimate.to_array()[:3], edge.estimate.to_array()[3:])
        worst_pose = max(worst_pose, np.abs(measured - predictions.poses[index]).max())
        # g2o's error (t, q_xyz) is ours to first order: an error a thousand times smaller.
        small = 1e-3 * predictions.errors[index]
        between = np.linalg.inv(measured) @ exponential(-small) @ predictions.poses[index]
        quaternion = Rotation.from_matrix(between[:3, :3]).as_quat()
        error = np.concatenate([between[:3, 3], np.sign(quaternion[3]) * quaternion[:3]])
        found = 1e6 * float(error @ edge.information @ error)
        worst = max(worst, relative(found, predictions.distances[index]))
    check("g2o: its poses through graphslam's reader", worst_pose, 1e-9)
    check("g2o: its chi² of (t, q_xyz) with the half-angle rule is our distance", worst, 1e-4)
    vertices = [vertex for vertex in Graph.from_g2o(str(path))._vertices]
    check("g2o: a vertex for each frame", abs(len(vertices) - len(edges) - 1), 0)


def check_ros(predictions: Predictions) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    types = {name.split("/")[-1]: store.types[name] for name in store.types}
    worst = worst_floor = worst_cdr = 0.0
    lines = predictions.text("ros", "--floor", "0").splitlines()
    floored = predictions.text("ros", "--floor", "1.0,0.25").splitlines()
    for index, line in enumerate(lines):
        message = json.loads(line)
        stamp = types["Time"](**message["header"]["stamp"])
        header = types["Header"](stamp=stamp, frame_id=message["header"]["frame_id"])
        stated = message["pose"]
        pose = types["Pose"](
            position=types["Point"](**stated["pose"]["position"]),
            orientation=types["Quaternion"](**stated["pose"]["orientation"]),
        )
        covariance = np.array(stated["covariance"])
        stamped = types["PoseWithCovarianceStamped"](
            header=header, pose=types["PoseWithCovariance"](pose=pose, covariance=covariance)
        )
        back = store.deserialize_cdr(store.serialize_cdr(stamped, kind), kind)
        worst_cdr = max(worst_cdr, np.abs(back.pose.covariance - covariance).max())
        time = back.header.stamp.sec + 1e-9 * back.header.stamp.nanosec
        worst_cdr = max(worst_cdr, abs(time - predictions.times[index][1]) / 1e6)
        # Position and fixed-axis rotation of small errors, by finite differences of both poses.
        measured = predictions.poses[index]
        jacobian = np.zeros((6, 6))
        for component in range(6):
            step = np.zeros(6)
            step[component] = 1e-6
            for sign in (1, -1):
                moved = exponential(sign * step) @ measured
                rotation = Rotation.from_matrix(moved[:3, :3] @ measured[:3, :3].T).as_rotvec()
                jacobian[:, component] += sign * np.concatenate([moved[:3, 3] - measured[:3, 3], rotation]) / 2e-6
        expected = jacobian @ predictions.covariances[index] @ jacobian.T
        worst = max(worst, np.abs(covariance.reshape(6, 6) - expected).max() / np.abs(expected).max())
        diagonal = np.diag(np.array(json.loads(floored[index])["pose"]["covariance"]).reshape(6, 6))
        least = np.array([1.0] * 3 + [0.25] * 3)
        worst_floor = max(worst_floor, np.abs(diagonal - np.maximum(np.diag(covariance.reshape(6, 6)), least)).max())
    check("ros: geometry_msgs/PoseWithCovarianceStamped there and back through CDR", worst_cdr, 1e-9)
    check("ros: 36 values are the covariance of position and fixed-axis rotation", worst, 1e-6)
    check("ros: --floor lifts the diagonal", worst_floor, 0)


def check_trajectories(predictions: Predictions, folder: Path) -> None:
    chained = [np.eye(4)]
    accumulated = [np.zeros((6, 6))]
    for pose, covariance in zip(predictions.poses, predictions.covariances):
        rotation, translation = chained[-1][:3, :3], chained[-1][:3, 3]
        adjoint = np.block([[rotation, hat(translation) @ rotation], [np.zeros((3, 3)), rotation]])
        accumulated.append(accumulated[-1] + adjoint @ covariance @ adjoint.T)
        chained.append(chained[-1] @ pose)
    for form, read in (
        ("tum", file_interface.read_tum_trajectory_file),
        ("kitti", file_interface.read_kitti_poses_file),
    ):
        path = folder / f"plain.{form}"
        path.write_text(predictions.text(form, "--frame", "vehicle", "--covariance", "none"))
        trajectory = read(str(path))
        worst = max(np.abs(found - expected).max() for found, expected in zip(trajectory.poses_se3, chained))
        check(f"{form}: {trajectory.num_poses} poses through evo", worst, 1e-9)
        assert trajectory.num_poses == len(chained)
        columns = 8 if form == "tum" else 12
        for which, expected in (("relative", [np.zeros((6, 6))] + predictions.covariances), ("accumulated", accumulated)):
            path.write_text(predictions.text(form, "--frame", "vehicle", "--covariance", which))
            table = np.loadtxt(path)
            found = table[:, columns:].reshape(-1, 6, 6)
            worst = max(np.abs(a - b).max() for a, b in zip(found, expected))
            check(f"{form}: {which} covariances", worst, 1e-12)


def camera_from_vehicle(folder: Path) -> np.ndarray:
    """Of KITTI's calibration files: camera 2 from camera 0, rectification, LiDAR, IMU."""

    def values(name: str, key: str) -> np.ndarray:
        lines = (folder / "data/2026_01_01" / name).read_text().splitlines()
        return np.array(next(line for line in lines if line.startswith(key + ":")).split()[1:], dtype=float)

    def rigid(name: str) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = values(name, "R").reshape(3, 3), values(name, "T")
        return pose

    projection = values("calib_cam_to_cam.txt", "P_rect_02").reshape(3, 4)
    offset, rectification = np.eye(4), np.eye(4)
    offset[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    rectification[:3, :3] = values("calib_cam_to_cam.txt", "R_rect_00").reshape(3, 3)
    return offset @ rectification @ rigid("calib_velo_to_cam.txt") @ rigid("calib_imu_to_velo.txt")


def check_sides_and_axes(predictions: Predictions, folder: Path) -> None:
    X = camera_from_vehicle(folder)
    adjoint = np.block([[X[:3, :3], hat(X[:3, 3]) @ X[:3, :3]], [np.zeros((3, 3)), X[:3, :3]]])
    right = [json.loads(line) for line in predictions.text("jsonl", "--perturbation", "right").splitlines()]
    camera = [json.loads(line) for line in predictions.text("jsonl", "--frame", "camera").splitlines()]
    worst_right = worst_camera = 0.0
    for index, distance in enumerate(predictions.distances):
        measured, truth = predictions.poses[index], predictions.truths[index]
        error = np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(measured) @ truth)))
        error = np.concatenate([error[3:], error[:3]])
        worst_right = max(worst_right, relative(mahalanobis(np.array(right[index]["covariance"]), error), distance))
        # The same motion in axes of the camera: X T X⁻¹.
        stated = camera[index]["pose"]
        in_camera = matrix(stated["translation"], stated["quaternion_xyzw"])
        worst_camera = max(worst_camera, np.abs(in_camera - X @ measured @ np.linalg.inv(X)).max())
        found, expected = np.array(camera[index]["covariance"]), adjoint @ predictions.covariances[index] @ adjoint.T
        worst_camera = max(worst_camera, np.abs(found - expected).max() / np.abs(expected).max())
    check("jsonl: the right perturbation by GTSAM's logarithm", worst_right, 1e-9)
    check("jsonl: axes of the camera by KITTI's calibration files", worst_camera, 1e-6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--relcov", default=str(ROOT / "target/release/relcov"), help="the program")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(arguments.relcov, folder)
        for poses, asked in (("measured", ()), ("corrected", ("--corrected",))):
            print(f"{poses} poses")
            predictions = Predictions(arguments.relcov, folder, poses, *asked)
            check_gtsam(predictions)
            check_g2o(predictions, folder)
            check_ros(predictions)
            check_trajectories(predictions, folder)
            check_sides_and_axes(predictions, folder)
        check_corrections(predictions, folder, arguments.relcov)
    if failures:
        sys.exit(f"{failures} exports do not fit")
    print("every export is understood as it is meant")


if __name__ == "__main__":
    main()
