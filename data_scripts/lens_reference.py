#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["opencv-python-headless>=5", "numpy"]
# ///
"""Undistortion by OpenCV: the numbers that relcov's lenses are compared with.

    uv run data_scripts/lens_reference.py > tests/data/lens.json

For the lenses of TUM's fr1 and of EuRoC's cam0: the normalised points of pixels all over the image
(undistortPoints, iterated until it rests), OpenCV's own camera of the undistorted image without black borders
(getOptimalNewCameraMatrix, alpha = 0), and an image of ramps seen by another camera (initUndistortRectifyMap and
remap), of which every 40th pixel along both axes is kept. Ramps, because remap knows places to 1/32 px only.

Without uv: pip install opencv-python-headless numpy, then python data_scripts/lens_reference.py.
"""

import json

import cv2
import numpy

# fx fy cx cy, k1 k2 p1 p2 k3, width height; the calibrations published with the data sets.
LENSES = {
    "TUM fr1": ([517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633], (640, 480)),
    "EuRoC cam0": ([458.654, 457.296, 367.215, 248.375], [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0], (752, 480)),
}
# Pixels between those kept.
STEP = 40


def matrix(fx, fy, cx, cy):
    return numpy.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def ramps(width, height):
    """Triangle waves along three directions, at most 6 levels a pixel: r, g, b."""
    u, v = numpy.meshgrid(numpy.arange(width), numpy.arange(height))
    wave = lambda phase: numpy.abs(phase % 510 - 255)
    return numpy.stack([wave(4 * u + 2 * v), wave(u + 5 * v), wave(6 * u)], axis=-1).astype(numpy.uint8)


def points(camera, distortion, size):
    """Rows of pixel and normalised point: u, v, x, y."""
    width, height = size
    u, v = numpy.meshgrid(numpy.linspace(0, width - 1, 6), numpy.linspace(0, height - 1, 5))
    pixels = numpy.stack([u.ravel(), v.ravel()], axis=-1)
    until_it_rests = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-13)
    normalised = cv2.undistortPoints(pixels[:, None], camera, distortion, criteria=until_it_rests)[:, 0]
    rays = numpy.concatenate([normalised, numpy.ones((len(normalised), 1))], axis=1)
    again = cv2.projectPoints(rays, numpy.zeros(3), numpy.zeros(3), camera, distortion)[0][:, 0]
    assert numpy.abs(again - pixels).max() < 1e-7, "undistortPoints did not converge"
    return numpy.concatenate([pixels, normalised], axis=1)


def remapped(camera, distortion, size, target):
    """Rows of pixel and colour of the ramps as the target camera sees them: u, v, r, g, b."""
    maps = cv2.initUndistortRectifyMap(camera, distortion, None, matrix(*target), size, cv2.CV_32FC1)
    image = cv2.remap(ramps(*size), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    # Within a pixel of the border OpenCV mixes with black, and relcov does not.
    outside_px = numpy.maximum(*[numpy.maximum(-place, place - (side - 1)) for place, side in zip(maps, size)])
    v, u = numpy.nonzero((outside_px <= 0) | (outside_px >= 1))
    kept = (u % STEP == 0) & (v % STEP == 0)
    u, v = u[kept], v[kept]
    return numpy.concatenate([numpy.stack([u, v], axis=-1), image[v, u]], axis=1)


def main():
    lenses = []
    for name, (intrinsics, distortion, size) in LENSES.items():
        camera, distortion = matrix(*intrinsics), numpy.array(distortion)
        optimal = cv2.getOptimalNewCameraMatrix(camera, distortion, size, 0)[0]
        fx, fy, cx, cy = intrinsics
        target = [0.9 * fx, 0.95 * fy, cx + 3.25, cy - 2.5]
        lenses.append({
            "name": name,
            "intrinsics": intrinsics,
            "size": size,
            "distortion": distortion.tolist(),
            "points": points(camera, distortion, size).tolist(),
            "optimal": [optimal[0, 0], optimal[1, 1], optimal[0, 2], optimal[1, 2]],
            "target": target,
            "colours": remapped(camera, distortion, size, target).tolist(),
        })
    lines = ",\n".join(json.dumps(lens, separators=(",", ":")) for lens in lenses)
    print(f'{{"opencv":"{cv2.__version__}","lenses":[\n{lines}\n]}}')


if __name__ == "__main__":
    main()
