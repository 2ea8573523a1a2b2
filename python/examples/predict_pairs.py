"""A walk through the Python package, in cells (VS Code, Spyder and Jupytext run `# %%` one by one).

Needs a trained model and its rendered street, which the first command of the README makes:

    relcov train --config configs/synthetic.toml
    python python/examples/predict_pairs.py checkpoints/synthetic data/synthetic
"""

# %% What is read
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import relcov

run, data = (Path(argument) for argument in (sys.argv[1:] or ["checkpoints/synthetic", "data/synthetic"]))
drive = data / "2026_01_01" / "2026_01_01_drive_0014_sync"
model = relcov.Model.load(run)
print(f"relcov {relcov.__version__}: network of {model.size}, covariances in axes of the {model.frame}")

# %% Intrinsics, images, depth
calibration = (data / "2026_01_01/calib_cam_to_cam.txt").read_text().splitlines()
projection = next(line for line in calibration if line.startswith("P_rect_02"))
K = np.array(projection.split()[1:], dtype=float).reshape(3, 4)[:, :3]


def image(frame: int) -> np.ndarray:
    return np.asarray(Image.open(drive / f"image_02/data/{frame:010}.png"))


def depth(frame: int) -> np.ndarray:
    return np.asarray(Image.open(drive / f"depth_02/data/{frame:010}.png"), dtype=np.float32) / 256


# %% Measured poses: visual odometry, axes of the left colour camera
def pose(x, y, z, qx, qy, qz, qw) -> np.ndarray:
    T = np.eye(4)
    cross = np.array([[0, -qz, qy], [qz, 0, -qx], [-qy, qx, 0]])
    T[:3, :3] += 2 * (qw * cross + cross @ cross)
    T[:3, 3] = x, y, z
    return T


rows = np.loadtxt(data / "measurements/vo/2026_01_01_drive_0014.csv", delimiter=",", skiprows=1)
measured = {(int(row[0]), int(row[1])): pose(*row[2:9]) for row in rows}

# %% One covariance
covariance = model.predict(image(0), image(1), K, measured[0, 1], depth(1))
names = ["x [m]", "y [m]", "z [m]", "roll [rad]", "pitch [rad]", "yaw [rad]"]
print("\nframes 0 and 1:")
for name, std in zip(names, np.sqrt(np.diag(covariance))):
    print(f"  {name:12} one sigma {std:.2e}")

# %% It moves with the measurement: the same images, a pose that is pitched by 1.5 degrees
half = np.radians(1.5) / 2
wrong = pose(0, 0, 0, np.sin(half), 0, 0, np.cos(half)) @ measured[0, 1]
worse = model.predict(image(0), image(1), K, wrong, depth(1))
print(f"\nsigma of pitch with a pose that is pitched by 1.5 degrees: {np.sqrt(worse[4, 4] / covariance[4, 4]):.1f} times as large")

# %% What the images show of the error itself, where the model says it
judgement = model.judge(image(0), image(1), K, wrong, depth(1))
if judgement.correction is not None:
    print(f"\nverdict on the pitched pose: {judgement.verdict}; of its pitch of 1.5 degrees the images show {np.degrees(abs(judgement.correction[4])):.2f}")
    better = np.sqrt(judgement.corrected_covariance[4, 4])
    print(f"  without it one sigma of pitch is {better:.1e} rad, for judgement.corrected_pose")

# %% For GTSAM: the right perturbation, rotation before translation
# The covariance is in axes of the vehicle, so is the pose: X T inv(X).
X = np.eye(4)
X[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # vehicle from camera, at the camera's place
right = relcov.left_to_right(covariance, X @ measured[0, 1] @ np.linalg.inv(X))
order = [3, 4, 5, 0, 1, 2]
print("\nfor gtsam.noiseModel.Gaussian.Covariance:")
print(np.array2string(right[np.ix_(order, order)], precision=1, max_line_width=100))

# %% A sequence
sigmas = []
for source, target in list(measured)[:20]:
    sigmas.append(np.sqrt(np.diag(model.predict(image(source), image(target), K, measured[source, target], depth(target)))))
print("\nmedian sigma of 20 pairs:", ", ".join(f"{name} {std:.1e}" for name, std in zip(names, np.median(sigmas, axis=0))))
