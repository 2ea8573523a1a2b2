#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["opencv-python-headless>=4.8", "numpy", "pyyaml"]
# ///
"""Depth maps from stereo pairs, by OpenCV's semi-global matching (Hirschmüller 2008).

    uv run data_scripts/stereo_depth.py --root /data/kitti --out /data/kitti_stereo_depth
    uv run data_scripts/stereo_depth.py --root /data/euroc --out /data/euroc
    uv run data_scripts/stereo_depth.py --self-test

For every drive below ROOT in the KITTI raw layout with image_02 and image_03: OUT/DATE/DRIVE/FRAME.png, depth of the left
colour camera. For every recording in the EuRoC layout with mav0/cam0 and mav0/cam1: OUT/NAME/mav0/depth/FRAME.png, depth
of the left camera as relcov undistorts it. Each at full size, 16-bit PNG, metres x 256, 0 = unknown (no match, or seen by
one camera only). In a configuration, a path below data.root or an absolute one:

    [depth]
    source = "files"
    path = "/data/kitti_stereo_depth/{date}/{drive}/{frame}.png"      # KITTI raw
    path = "{drive}/mav0/depth/{frame}.png"                           # EuRoC, with OUT = ROOT

EuRoC's cameras have lenses and are not rectified: the pair is rectified by its sensor.yaml, matched, and the depth brought
back into the left camera by the nearest pixel (both have one centre, so nothing is hidden). Of rendered planes it is off by
0.2 % for each metre of depth in the median and by 0.5 % in 95 of 100 pixels (0.08 and 0.2 px of disparity with EuRoC's
0.11 m): 1 % at 2 m, 3 % at 6 m. Real images are not as kind, and wrong matches are worse.

Maps that are there are kept, so an interrupted run goes on where it stopped.
Without uv: pip install opencv-python-headless numpy pyyaml, then python data_scripts/stereo_depth.py.
"""

import argparse
import os
import re
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Callable, NamedTuple

import cv2
import numpy
import yaml

STEPS_PER_METRE = 256
# Nearest depth that is looked for, m; nearer things are left unknown.
KITTI_NEAREST_M = 3.5
EUROC_NEAREST_M = 0.5
# EuRoC's pairs are matched at this multiple of their size: disparities that semi-global matching finds lie too near to whole
# pixels, by up to a quarter of one.
EUROC_ENLARGEMENT = 2
# Smaller disparities say nothing of the depth, px.
LEAST_DISPARITY_PX = 1
# Largest distance in time between images of both EuRoC cameras, ns.
STEREO_DISTANCE_NS = 1_000_000


class Recording(NamedTuple):
    """What depth maps are made of, and where."""
    name: str
    out: Path
    # Stem of the map, left and right image of every frame that has both.
    frames: list
    # Reads the calibration; gives what makes metres of a left and a right image, 0 where unknown.
    load_rig: Callable


# Matching


def matcher(disparities):
    block = 5
    return cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=disparities, blockSize=block, P1=8 * 3 * block**2, P2=32 * 3 * block**2,
        disp12MaxDiff=1, uniquenessRatio=5, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)


def depth_map(left, right, focal_px, baseline_m, nearest_m, right_seen=None):
    """Metres of a rectified pair; 0 where unknown. Columns that the right camera's image does not reach are matched with a
    copy of its edge. `right_seen`: which of the right image's pixels show something; all of them."""
    disparities = int(numpy.ceil(focal_px * baseline_m / nearest_m / 16)) * 16
    padded = [cv2.copyMakeBorder(image, 0, 0, disparities, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher(disparities).compute(*padded)[:, disparities:].astype(numpy.float32) / 16
    right_columns = numpy.arange(left.shape[1])[None] - disparity
    seen_by_both = (disparity >= LEAST_DISPARITY_PX) & (right_columns >= 0)
    if right_seen is not None:
        nearest = numpy.clip(numpy.rint(right_columns), 0, left.shape[1] - 1).astype(int)
        seen_by_both &= numpy.take_along_axis(right_seen, nearest, axis=1)
    return numpy.where(seen_by_both, focal_px * baseline_m / numpy.maximum(disparity, 1e-6), 0)


def read(path):
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path}: cannot be read as an image")
    return image


def write(path, depth_m):
    steps = numpy.round(depth_m * STEPS_PER_METRE)
    steps[steps > 65535] = 0
    partial = path.with_suffix(".partial.png")
    if not cv2.imwrite(str(partial), steps.astype(numpy.uint16)):
        raise OSError(f"{partial}: cannot be written")
    os.replace(partial, path)


def text_of(path, why):
    try:
        return path.read_text()
    except OSError as error:
        sys.exit(f"{path}: cannot be read: {error.strerror}; {why}")


# KITTI raw: rectified already


def projections(path):
    """P_rect_02 and P_rect_03 of a calib_cam_to_cam.txt, 3x4."""
    text = text_of(path, "a date's folder holds the calibration of its drives")
    matrices = []
    for key in ("P_rect_02", "P_rect_03"):
        found = re.search(rf"^{key}:(.*)$", text, re.MULTILINE)
        numbers = found[1].split() if found else []
        if len(numbers) != 12:
            sys.exit(f"{path}: expected {key} with 12 numbers, found {len(numbers)}")
        matrices.append(numpy.array(numbers, float).reshape(3, 4))
    return matrices


def load_kitti_rig(date_folder):
    left, right = projections(date_folder / "calib_cam_to_cam.txt")
    focal_px = left[0, 0]
    baseline_m = (left[0, 3] - right[0, 3]) / focal_px
    if not numpy.allclose(left[:, :3], right[:, :3]) or baseline_m <= 0:
        sys.exit(f"{date_folder}/calib_cam_to_cam.txt: P_rect_02 and P_rect_03 are no rectified pair with camera 2 on the left")
    return lambda left, right: depth_map(left, right, focal_px, baseline_m, KITTI_NEAREST_M)


def kitti_frames(drive):
    sides = [{path.stem: path for path in sorted((drive / camera / "data").glob("*")) if path.suffix in (".png", ".jpg", ".jpeg")}
             for camera in ("image_02", "image_03")]
    return [(stem, sides[0][stem], sides[1][stem]) for stem in sides[0] if stem in sides[1]]


def kitti_recordings(root, out):
    for drive in sorted(root.glob("*/*_drive_*")):
        yield Recording(drive.name, out / drive.parent.name / drive.name, kitti_frames(drive),
                        lambda date_folder=drive.parent: load_kitti_rig(date_folder))


# EuRoC: two lenses somewhere on a body


class Lens(NamedTuple):
    matrix: numpy.ndarray  # 3x3, px
    distortion: numpy.ndarray  # k1 k2 p1 p2, and k3
    size: tuple  # width and height, px
    body_from_camera: numpy.ndarray  # 4x4


def load_lens(path):
    text = text_of(path, "it holds the calibration of the camera")
    try:
        values = yaml.safe_load(text)
        model, distortion_model = values["camera_model"], values.get("distortion_model") or "none"
        if model != "pinhole" or distortion_model not in ("radial-tangential", "radtan", "none"):
            sys.exit(f"{path}: camera_model {model} and distortion_model {distortion_model}; expected pinhole and radial-tangential")
        fx, fy, cx, cy = map(float, values["intrinsics"])
        distortion = numpy.array(values.get("distortion_coefficients") or [0] * 4, float)
        width, height = map(int, values["resolution"])
        body_from_camera = numpy.array(values["T_BS"]["data"], float).reshape(4, 4)
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        sys.exit(f"{path}: no calibration of a camera: {type(error).__name__} {error}")
    return Lens(numpy.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), distortion, (width, height), body_from_camera)


def rays(lens, pixels):
    """Normalised coordinates, two a row, of pixels of the distorted image: OpenCV's iteration, until it rests (which versions
    of its own can be told so differs)."""
    k1, k2, p1, p2, k3 = numpy.pad(lens.distortion, (0, 5 - len(lens.distortion)))
    distorted = (numpy.asarray(pixels, float) - lens.matrix[:2, 2]) / lens.matrix.diagonal()[:2]
    found = distorted
    for _ in range(200):
        x, y = found.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        tangential = numpy.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)
        before, found = found, (distorted - tangential) / radial[:, None]
        if numpy.abs(found - before).max() < 1e-12:
            break
    return found


def undistorted_camera(lens):
    """The camera to whose images relcov takes those of a lens (its `Lens::rectified`): it sees the largest rectangle between
    the innermost places of the four undistorted borders, whose corners are the centres of its corner pixels."""
    if not lens.distortion.any():
        return lens.matrix
    right_px, bottom_px = lens.size[0] - 1, lens.size[1] - 1
    column = lambda u: rays(lens, [(u, v) for v in range(bottom_px + 1)])[:, 0]
    row = lambda v: rays(lens, [(u, v) for u in range(right_px + 1)])[:, 1]
    left, right, top, bottom = column(0).max(), column(right_px).min(), row(0).max(), row(bottom_px).min()
    fx, fy = right_px / (right - left), bottom_px / (bottom - top)
    return numpy.array([[fx, 0, -fx * left], [0, fy, -fy * top], [0, 0, 1]])


def pixel_grid(width, height):
    """Homogeneous pixels, 3 x (width * height), row by row."""
    u, v = numpy.meshgrid(numpy.arange(width), numpy.arange(height))
    return numpy.stack([u.ravel(), v.ravel(), numpy.ones(u.size)])


def load_euroc_rig(rig):
    left, right = [load_lens(rig / camera / "sensor.yaml") for camera in ("cam0", "cam1")]
    if left.size != right.size:
        sys.exit(f"{rig}/cam1/sensor.yaml: resolution {list(right.size)}; expected {list(left.size)} as of cam0")
    right_from_left = numpy.linalg.inv(right.body_from_camera) @ left.body_from_camera
    rotation, translation = right_from_left[:3, :3].copy(), right_from_left[:3, 3:].copy()
    turns = cv2.stereoRectify(left.matrix, left.distortion, right.matrix, right.distortion, left.size, rotation, translation)[:2]
    baseline_m = numpy.linalg.norm(translation)
    offset = (turns[1] @ translation)[:, 0]
    if not numpy.allclose(offset, [-baseline_m, 0, 0], atol=1e-6):
        sys.exit(f"{rig}: cam1 is {offset} m from cam0 after rectification; expected it on the right")

    # The rectified pair is as large as what relcov's camera sees needs.
    camera = undistorted_camera(left)
    focal_px = EUROC_ENLARGEMENT * camera[0, 0]
    rectified_rays = turns[0] @ numpy.linalg.inv(camera) @ pixel_grid(*left.size)
    seen = focal_px * rectified_rays[:2] / rectified_rays[2]
    corner = numpy.floor(seen.min(axis=1))
    width, height = (numpy.ceil(seen.max(axis=1)) - corner).astype(int) + 1
    rectified = numpy.array([[focal_px, 0, -corner[0]], [0, focal_px, -corner[1]], [0, 0, 1]])
    places = [cv2.initUndistortRectifyMap(lens.matrix, lens.distortion, turn, rectified, (int(width), int(height)), cv2.CV_32FC1)
              for lens, turn in zip((left, right), turns)]
    (right_u, right_v), (last_u, last_v) = places[1], numpy.array(right.size) - 1
    right_seen = (right_u >= 0) & (right_u <= last_u) & (right_v >= 0) & (right_v <= last_v)

    # Where relcov's pixels lie in the rectified image, and their depth by that of there: both along their own z axes.
    columns, rows = numpy.rint(seen - corner[:, None]).astype(int).reshape(2, left.size[1], left.size[0])
    of_rectified = 1 / rectified_rays[2].reshape(columns.shape)

    def depth_of_pair(*images):
        for image in images:
            if image.shape[1::-1] != left.size:
                raise ValueError(f"an image of {image.shape[1]}x{image.shape[0]} pixels; expected {left.size[0]}x{left.size[1]} by sensor.yaml")
        pair = [cv2.remap(image, *place, cv2.INTER_LINEAR) for image, place in zip(images, places)]
        depth_m = depth_map(*pair, focal_px, baseline_m, EUROC_NEAREST_M, right_seen)
        return depth_m[rows, columns] * of_rectified

    return depth_of_pair


def timed_images(folder):
    """Times, ns, and paths of a camera's list."""
    rows = [line.split(",") for line in text_of(folder / "data.csv", "it lists the images").splitlines()
            if line.strip() and not line.lstrip().startswith("#")]
    try:
        return numpy.array([int(time) for time, _ in rows]), [folder / "data" / name.strip() for _, name in rows]
    except ValueError as error:
        sys.exit(f"{folder}/data.csv: expected lines of a time in nanoseconds, a comma and the name of a file: {error}")


def euroc_frames(rig):
    """Frames are rows of cam0's list, counted from 0; each with the right image nearest in time."""
    if not (rig / "cam0/data.csv").is_file() or not (rig / "cam1/data.csv").is_file():
        return []
    (times, left), (right_times, right) = timed_images(rig / "cam0"), timed_images(rig / "cam1")
    frames = []
    for frame, time in enumerate(times):
        nearest = int(numpy.abs(right_times - time).argmin()) if right else None
        if right and abs(right_times[nearest] - time) <= STEREO_DISTANCE_NS and left[frame].is_file() and right[nearest].is_file():
            frames.append((f"{frame:010}", left[frame], right[nearest]))
    return frames


def euroc_recordings(root, out):
    for rig in sorted(root.glob("*/mav0")):
        name = rig.parent.name
        yield Recording(name, out / name / "mav0/depth", euroc_frames(rig), lambda rig=rig: load_euroc_rig(rig))


# All of them


def make_maps(recording, threads):
    """How many frames have no map afterwards."""
    depth_of_pair = recording.load_rig()
    recording.out.mkdir(parents=True, exist_ok=True)

    def make(frame):
        stem, left, right = frame
        path = recording.out / f"{stem}.png"
        if path.exists():
            return 0
        try:
            images = read(left), read(right)
            if images[0].shape != images[1].shape:
                raise ValueError("images of different sizes")
            write(path, depth_of_pair(*images))
            return 1
        except (ValueError, OSError, cv2.error) as error:
            print(f"no depth map: {recording.name} frame {stem}: {error}", file=sys.stderr)
            return -1

    with ThreadPoolExecutor(threads) as pool:
        done = list(pool.map(make, recording.frames))
    print(f"{recording.name}: {done.count(1)} maps made, {done.count(0)} kept", flush=True)
    return done.count(-1)


# The check


# Calibration of EuRoC's MH_01: intrinsics, distortion, T_BS; and the camera that relcov makes of the left one.
EUROC_CAM0 = ([458.654, 457.296, 367.215, 248.375], [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05], [
    0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975, 0.999557249008, 0.0149672133247, 0.025715529948,
    -0.064676986768, -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949, 0.0, 0.0, 0.0, 1.0])
EUROC_CAM1 = ([457.587, 456.134, 379.999, 255.238], [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05], [
    0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556, 0.999598781151, 0.0130119051815, 0.0251588363115,
    0.0453689425024, -0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038, 0.0, 0.0, 0.0, 1.0])
EUROC_CAMERA = [356.01725, 418.23593, 362.99195, 250.27199]
# Planes that the check looks at, in axes of the left camera: normal and distance from it, m.
PLANES = {"a wall 2 m away": ([0, 0, 1], 2.0), "a slanted floor": ([0.05, 0.5, 0.86], 1.6), "a wall 6 m away": ([-0.2, 0, 0.98], 6.0)}


def self_test():
    """Renders planes through EuRoC's lenses, and compares the maps made of them with what they are."""
    failures = 0

    def check(name, holds, found):
        nonlocal failures
        failures += not holds
        print(f"{'ok    ' if holds else 'FAILED'} {name}: {found}")

    random = numpy.random.default_rng(7)
    texture = cv2.GaussianBlur(random.integers(0, 256, (2048, 2048)).astype(numpy.float32), (0, 0), 1.2)
    texture = numpy.clip(128 + 4 * (texture - 128), 0, 255).astype(numpy.uint8)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        rig = root / "planes/mav0"
        for camera, (intrinsics, distortion, body_from_camera) in (("cam0", EUROC_CAM0), ("cam1", EUROC_CAM1)):
            (rig / camera / "data").mkdir(parents=True)
            values = {"T_BS": {"cols": 4, "rows": 4, "data": body_from_camera}, "camera_model": "pinhole", "intrinsics": intrinsics,
                      "distortion_model": "radial-tangential", "distortion_coefficients": distortion, "resolution": [752, 480]}
            (rig / camera / "sensor.yaml").write_text(yaml.safe_dump(values))
            names = [f"{time},{time}.png\n" for time in range(len(PLANES))]
            (rig / camera / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(names))
        left, right = [load_lens(rig / camera / "sensor.yaml") for camera in ("cam0", "cam1")]
        for time, (normal, distance_m) in enumerate(PLANES.values()):
            for camera, lens in (("cam0", left), ("cam1", right)):
                left_from_camera = numpy.linalg.inv(left.body_from_camera) @ lens.body_from_camera
                directions = numpy.vstack([rays(lens, pixel_grid(752, 480)[:2].T).T, numpy.ones(752 * 480)])
                directions = left_from_camera[:3, :3] @ directions
                start = left_from_camera[:3, 3]
                points = start[:, None] + directions * (distance_m - normal @ start) / (normal @ directions)
                # A pixel of the texture is about one of the image; it is laid out again and again.
                u, v = (points[:2] * 400 / distance_m % 2040).astype(numpy.float32).reshape(2, 480, 752)
                cv2.imwrite(str(rig / camera / f"data/{time}.png"), cv2.remap(texture, u, v, cv2.INTER_LINEAR))
        (recording,) = euroc_recordings(root, root)
        check("maps", make_maps(recording, 1) == 0, f"of {len(recording.frames)} pairs")
        camera = undistorted_camera(left)
        found = camera[[0, 1, 0, 1], [0, 1, 2, 2]]
        check("relcov's camera", numpy.allclose(found, EUROC_CAMERA, atol=1e-3), numpy.round(found, 4))
        pixels = numpy.linalg.inv(camera) @ pixel_grid(752, 480)
        for time, (name, (normal, distance_m)) in enumerate(PLANES.items()):
            true_m = (distance_m / (normal @ pixels)).reshape(480, 752)
            depth_m = cv2.imread(str(recording.out / f"{time:010}.png"), cv2.IMREAD_UNCHANGED) / STEPS_PER_METRE
            known = depth_m > 0
            off = numpy.abs(depth_m[known] / true_m[known] - 1)
            median, most = numpy.percentile(off, [50, 95])
            check(name, known.mean() > 0.8 and median < 0.02 and most < 0.05,
                  f"{100 * known.mean():.0f} % known, off by {100 * median:.2f} % in the median, 95 % of them by less than {100 * most:.2f} %")
    if failures:
        sys.exit(f"{failures} checks failed")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, help="folder in the KITTI raw layout, or of EuRoC recordings")
    parser.add_argument("--out", type=Path, help="folder of the depth maps")
    parser.add_argument("--drive", action="append", help="only this drive or recording; repeatable")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--self-test", action="store_true", help="compare maps of rendered planes with what they are")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.self_test:
        return self_test()
    if not (arguments.root and arguments.out):
        parser.error("--root and --out are needed")
    found = [*kitti_recordings(arguments.root, arguments.out), *euroc_recordings(arguments.root, arguments.out)]
    recordings = [recording for recording in found if recording.frames]
    if arguments.drive:
        unknown = set(arguments.drive) - {recording.name for recording in recordings}
        if unknown:
            sys.exit(f"{arguments.root}: no drive {', '.join(sorted(unknown))} with images of both cameras (image_02 and image_03, or mav0/cam0 and mav0/cam1)")
        recordings = [recording for recording in recordings if recording.name in arguments.drive]
    if not recordings:
        sys.exit(f"{arguments.root}: no drive with images of both cameras (ROOT/DATE/DRIVE/image_02/data and image_03/data, or ROOT/NAME/mav0/cam0 and cam1)")
    failures = sum(make_maps(recording, arguments.threads) for recording in recordings)
    if failures:
        sys.exit(f"{failures} frames have no depth map; their messages stand above")


if __name__ == "__main__":
    main()
