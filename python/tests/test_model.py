"""The package against the command line: same run, same pairs, same numbers.

RELCOV names the program (default: relcov on the PATH, or ../target/release/relcov).
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import relcov

ROOT = Path(__file__).resolve().parents[2]
DRIVE = "2026_01_01_drive_0003_sync"
CONFIG = """
name = "python"
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
source = "{depth}"
{path}
[model]
width = 64
height = 32
head = "full"
[training]
batch = 8
micro_batch = 8
learning_rate = 1e-3
epochs = 2
batches_per_epoch = 6
"""


def program() -> str:
    built = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/relcov"
    found = os.environ.get("RELCOV") or shutil.which("relcov") or (str(built) if built.is_file() else None)
    if found is None:
        pytest.skip("the program relcov is not there: cargo build --release, or RELCOV=/path")
    return found


def command(*arguments: str) -> str:
    return subprocess.run([program(), *arguments], check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A rendered data set, and a run for each of two sources of depth."""
    folder = tmp_path_factory.mktemp("world")
    command("synth", "--out", str(folder / "data"), "--drives", "3", "--frames", "10", "--size", "128x64", "--lidar-steps", "0")
    for depth, path in (("files", 'path = "{date}/{drive}/depth_02/data/{frame}.png"'), ("ground_plane", "horizon_px = 30.5")):
        config = folder / f"{depth}.toml"
        config.write_text(CONFIG.format(depth=depth, path=path))
        command("train", "--quiet", "--config", str(config), "--set", f"name={depth}")
    return folder


def intrinsics(folder: Path) -> np.ndarray:
    lines = (folder / "data/2026_01_01/calib_cam_to_cam.txt").read_text().splitlines()
    values = next(line for line in lines if line.startswith("P_rect_02")).split()[1:]
    return np.array(values, dtype=float).reshape(3, 4)[:, :3]


def predicted(folder: Path, run: str, *options: str):
    return [json.loads(line) for line in command("predict", "--quiet", "--run", str(folder / "runs" / run), *options).splitlines()]


def pose(line: dict) -> np.ndarray:
    x, y, z, w = line["pose"]["quaternion_xyzw"]
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = line["pose"]["translation"]
    return T


def image(folder: Path, frame: int) -> np.ndarray:
    return np.asarray(Image.open(folder / f"data/2026_01_01/{DRIVE}/image_02/data/{frame:010}.png"))


def depth(folder: Path, frame: int) -> np.ndarray:
    path = folder / f"data/2026_01_01/{DRIVE}/depth_02/data/{frame:010}.png"
    return np.asarray(Image.open(path), dtype=np.float32) / 256


@pytest.mark.parametrize("run", ["files", "ground_plane"])
def test_numbers_are_those_of_the_command_line(world, run):
    model = relcov.Model.load(world / "runs" / run, device="flex")
    assert (model.frame, model.size, model.stereo) == ("vehicle", (32, 64), False)
    K = intrinsics(world)
    vehicle, camera = predicted(world, run), predicted(world, run, "--frame", "camera")
    assert len(vehicle) == 9
    for line, in_camera in zip(vehicle, camera):
        frames = line["source"], line["target"]
        map_of_target = depth(world, frames[1]) if run == "files" else None
        covariance = model.predict(*(image(world, frame) for frame in frames), K, pose(in_camera), map_of_target)
        expected = np.array(line["covariance"])
        assert covariance.shape == (6, 6) and covariance.dtype == np.float64
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((covariance - expected) / scale).max() < 1e-6


def test_conventions_are_those_of_the_command_line(world):
    for line, right in zip(predicted(world, "files"), predicted(world, "files", "--perturbation", "right")):
        found = relcov.left_to_right(np.array(line["covariance"]), pose(line))
        np.testing.assert_allclose(found, right["covariance"], rtol=1e-9, atol=1e-15)


def test_what_is_wrong_is_named(world):
    model = relcov.Model.load(world / "runs/files", device="flex")
    good = dict(image0=image(world, 0), image1=image(world, 1), K=intrinsics(world), T=np.eye(4), depth=depth(world, 1))
    model.predict(**good)
    for change, words in [
        (dict(image0=good["image0"].astype(float)), "image0: found float64"),
        (dict(image1=good["image1"][:, :, :2]), "image1: found shape"),
        (dict(image0=good["image0"][1:]), "source image has 128x63"),
        (dict(K=np.ones((3, 3))), "K: expected"),
        (dict(K=np.diag([-1.0, 1.0, 1.0])), "focal lengths positive"),
        (dict(T=2 * np.eye(4)[:3]), "T: its upper left"),
        (dict(T=np.full((4, 4), np.nan)), "T: found a value"),
        (dict(T=np.ones((2, 2))), "T: found shape"),
        (dict(depth=-good["depth"]), "depth: found infinite or negative"),
        (dict(depth=(256 * good["depth"]).astype(np.uint16)), "depth: found uint16"),
        (dict(K=good["K"] + 1j), "K: found complex"),
        (dict(right=(good["image0"], good["image1"])), "right: this model looks at one camera"),
        (dict(depth=np.zeros((3, 3))), "not one pixel"),
        (dict(depth=None), "no depth was given"),
    ]:
        with pytest.raises(ValueError, match=words):
            model.predict(**{**good, **change})
    with pytest.raises(ValueError, match="no such folder"):
        relcov.Model.load(world / "nothing")
    with pytest.raises(RuntimeError, match="unknown"):
        relcov.Model.load(world / "runs/files", device="abacus")


def test_grey_images_and_unknown_depth_are_taken(world):
    model = relcov.Model.load(world / "runs/files", device="flex")
    grey = [image(world, frame)[:, :, 1] for frame in (0, 1)]
    holes = depth(world, 1).copy()
    holes[:8] = np.nan
    covariance = model.predict(*grey, intrinsics(world), np.eye(4), holes)
    assert np.linalg.eigvalsh(covariance).min() > 0
