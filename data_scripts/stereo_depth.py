#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["opencv-python-headless>=4.8", "numpy"]
# ///
"""Depth maps from stereo pairs, by OpenCV's semi-global matching (Hirschmüller 2008).

    uv run data_scripts/stereo_depth.py --root /data/kitti --out /data/kitti_stereo_depth

For every drive below ROOT (KITTI raw layout) with image_02 and image_03: OUT/DATE/DRIVE/FRAME.png, depth of the left
colour camera at full size, 16-bit PNG, metres x 256, 0 = unknown (no match, or seen by one camera only). In a
configuration:

    [depth]
    source = "files"
    path = "/data/kitti_stereo_depth/{date}/{drive}/{frame}.png"

Maps that are there are kept, so an interrupted run goes on where it stopped.
Without uv: pip install opencv-python-headless numpy, then python data_scripts/stereo_depth.py.
"""

import argparse
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy

STEPS_PER_METRE = 256
# Nearest depth that is looked for, m; nearer things are left unknown.
NEAREST_M = 3.5


def projections(path):
    """P_rect_02 and P_rect_03 of a calib_cam_to_cam.txt, 3x4."""
    try:
        text = path.read_text()
    except OSError as error:
        sys.exit(f"{path}: cannot be read: {error.strerror}; a date's folder holds the calibration of its drives")
    matrices = []
    for key in ("P_rect_02", "P_rect_03"):
        found = re.search(rf"^{key}:(.*)$", text, re.MULTILINE)
        numbers = found[1].split() if found else []
        if len(numbers) != 12:
            sys.exit(f"{path}: expected {key} with 12 numbers, found {len(numbers)}")
        matrices.append(numpy.array(numbers, float).reshape(3, 4))
    return matrices


def focal_and_baseline(date_folder):
    left, right = projections(date_folder / "calib_cam_to_cam.txt")
    focal_px = left[0, 0]
    baseline_m = (left[0, 3] - right[0, 3]) / focal_px
    if not numpy.allclose(left[:, :3], right[:, :3]) or baseline_m <= 0:
        sys.exit(f"{date_folder}/calib_cam_to_cam.txt: P_rect_02 and P_rect_03 are no rectified pair with camera 2 on the left")
    return focal_px, baseline_m


def matcher(disparities):
    block = 5
    return cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=disparities, blockSize=block, P1=8 * 3 * block**2, P2=32 * 3 * block**2,
        disp12MaxDiff=1, uniquenessRatio=5, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)


def read(path):
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path}: cannot be read as an image")
    return image


def depth_map(left, right, focal_px, baseline_m):
    """Metres; 0 where unknown. Columns that the right camera's image does not reach are matched with a copy of its edge."""
    disparities = int(numpy.ceil(focal_px * baseline_m / NEAREST_M / 16)) * 16
    padded = [cv2.copyMakeBorder(image, 0, 0, disparities, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher(disparities).compute(*padded)[:, disparities:].astype(numpy.float32) / 16
    columns = numpy.arange(left.shape[1])[None]
    seen_by_both = (disparity > 0) & (columns - disparity >= 0)
    return numpy.where(seen_by_both, focal_px * baseline_m / numpy.maximum(disparity, 1e-6), 0)


def write(path, depth_m):
    steps = numpy.round(depth_m * STEPS_PER_METRE)
    steps[steps > 65535] = 0
    partial = path.with_suffix(".partial.png")
    if not cv2.imwrite(str(partial), steps.astype(numpy.uint16)):
        raise OSError(f"{partial}: cannot be written")
    os.replace(partial, path)


def frames(drive):
    """Left and right image of every frame that has both."""
    sides = [{path.stem: path for path in sorted((drive / camera / "data").glob("*")) if path.suffix in (".png", ".jpg", ".jpeg")}
             for camera in ("image_02", "image_03")]
    return [(stem, sides[0][stem], sides[1][stem]) for stem in sides[0] if stem in sides[1]]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder in the KITTI raw layout")
    parser.add_argument("--out", type=Path, required=True, help="folder of the depth maps")
    parser.add_argument("--drive", action="append", help="only this drive; repeatable")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    drives = [drive for drive in sorted(arguments.root.glob("*/*_drive_*")) if frames(drive)]
    if arguments.drive:
        unknown = set(arguments.drive) - {drive.name for drive in drives}
        if unknown:
            sys.exit(f"{arguments.root}: no drive {', '.join(sorted(unknown))} with images of both cameras (image_02 and image_03)")
        drives = [drive for drive in drives if drive.name in arguments.drive]
    if not drives:
        sys.exit(f"{arguments.root}: no drive with images of both cameras (ROOT/DATE/DRIVE/image_02/data and image_03/data)")
    failures = 0
    for drive in drives:
        focal_px, baseline_m = focal_and_baseline(drive.parent)
        folder = arguments.out / drive.parent.name / drive.name
        folder.mkdir(parents=True, exist_ok=True)

        def make(frame):
            stem, left, right = frame
            path = folder / f"{stem}.png"
            if path.exists():
                return 0
            try:
                left, right = read(left), read(right)
                if left.shape != right.shape:
                    raise ValueError(f"{drive} frame {stem}: images of different sizes")
                write(path, depth_map(left, right, focal_px, baseline_m))
                return 1
            except (ValueError, OSError, cv2.error) as error:
                print(f"no depth map: {error}", file=sys.stderr)
                return -1

        with ThreadPoolExecutor(arguments.threads) as pool:
            done = list(pool.map(make, frames(drive)))
        failures += done.count(-1)
        print(f"{drive.name}: {done.count(1)} maps made, {done.count(0)} kept", flush=True)
    if failures:
        sys.exit(f"{failures} frames have no depth map; their messages stand above")


if __name__ == "__main__":
    main()
