#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["pykitti==0.3.1", "numpy", "pillow", "opencv-python-headless", "pandas"]
# ///
"""Reads a rendered data set with pykitti, a KITTI reader that knows nothing of relcov, and checks that
images, calibration, poses, LiDAR and depth fit together.

    cargo build --release && uv run data_scripts/check_synthetic.py

Without uv: pip install pykitti numpy pillow opencv-python-headless pandas, then run it with python
(pykitti imports the last two without asking for them).
Renders two short drives into a temporary folder; exits with 1 and says why when something does not fit.
"""

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy
import pykitti
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
WIDTH, HEIGHT, FRAMES = 640, 200, 20

failures = 0


def check(name: str, holds: bool, found: str) -> None:
    global failures
    failures += not holds
    print(f"{'ok    ' if holds else 'FAILED'} {name}: {found}")


def rotation_from_quaternion(x: float, y: float, z: float, w: float) -> numpy.ndarray:
    return numpy.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def measured_motions(path: Path) -> list[numpy.ndarray]:
    motions = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            motion = numpy.eye(4)
            motion[:3, :3] = rotation_from_quaternion(*(float(row[key]) for key in ("qx", "qy", "qz", "qw")))
            motion[:3, 3] = [float(row[key]) for key in "xyz"]
            motions.append(motion)
    return motions


def check_drive(root: Path, drive: str) -> None:
    data = pykitti.raw(str(root), "2026_01_01", drive)
    check("frames", len(data) == FRAMES == len(data.timestamps), f"{len(data)} packets, {len(data.timestamps)} times")
    step = (data.timestamps[1] - data.timestamps[0]).total_seconds()
    check("ten frames a second", abs(step - 0.1) < 1e-6, f"{step} s")
    left, right = data.get_rgb(FRAMES - 1)
    check("image size", left.size == right.size == (WIDTH, HEIGHT), f"{left.size} and {right.size}")
    check("stereo baseline", abs(data.calib.b_rgb - 0.538) < 1e-3, f"{data.calib.b_rgb:.4f} m")

    # The odometry of this drive hardly errs: what it measured is the motion the images were rendered with.
    camera_from_imu = data.calib.T_cam2_imu
    imu_from_camera = numpy.linalg.inv(camera_from_imu)
    measured = measured_motions(root / f"measurements/vo/2026_01_01_drive_{drive}.csv")
    check("measured motions", len(measured) == FRAMES - 1, str(len(measured)))
    worst = [0.0, 0.0]
    for frame, motion in enumerate(measured):
        imu_motion = numpy.linalg.inv(data.oxts[frame].T_w_imu) @ data.oxts[frame + 1].T_w_imu
        difference = numpy.linalg.inv(camera_from_imu @ imu_motion @ imu_from_camera) @ motion
        turn = 0.5 * numpy.linalg.norm(difference[:3, :3] - difference[:3, :3].T) / numpy.sqrt(2)
        worst = [max(worst[0], numpy.linalg.norm(difference[:3, 3])), max(worst[1], turn)]
    check("poses", worst[0] < 1e-3 and worst[1] < 1e-5, f"off by {worst[0]:.1e} m and {worst[1]:.1e} rad at most")

    frame = FRAMES - 1
    points = data.get_velo(frame)
    points = points[points[:, 0] > 0]
    homogeneous = numpy.hstack([points[:, :3], numpy.ones((len(points), 1))])
    in_camera = (data.calib.T_cam2_velo @ homogeneous.T)[:3]
    pixels = data.calib.K_cam2 @ in_camera
    u, v = (numpy.round(pixels[axis] / pixels[2]).astype(int) for axis in (0, 1))
    inside = (in_camera[2] > 0) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    path = root / f"2026_01_01/2026_01_01_drive_{drive}_sync/depth_02/data/{frame:010}.png"
    depth = numpy.array(Image.open(path)).astype(float)[v[inside], u[inside]] / 256
    known = depth > 0
    errors = numpy.abs(in_camera[2][inside][known] - depth[known]) / depth[known]
    check("LiDAR in the image", known.sum() > 2000, f"{known.sum()} points on known depth")
    check("LiDAR and depth", numpy.median(errors) < 0.02, f"median difference {100 * numpy.median(errors):.2f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--relcov", type=Path, default=ROOT / "target/release/relcov", help="the program")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        size = f"{WIDTH}x{HEIGHT}"
        options = ["--drives", "2", "--frames", str(FRAMES), "--size", size, "--vo-pixel-noise", "1e-3"]
        command = [arguments.relcov, "synth", "--out", folder, "--quiet", "--vo-landmarks", "192", *options]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        for drive in ("0001", "0002"):
            print(f"drive {drive}")
            check_drive(Path(folder), drive)
    if failures:
        sys.exit(f"{failures} checks failed")


if __name__ == "__main__":
    main()
