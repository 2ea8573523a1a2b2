"""The package against the command line: same run, same pairs, same numbers.

RELCOV names the program (default: relcov on the PATH, or ../target/release/relcov).
"""

import json
import os
import shutil
import subprocess
import sys
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
{model}
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
    """A rendered data set; a run for each of two sources of depth, and one that predicts the error itself."""
    folder = tmp_path_factory.mktemp("world")
    command("synth", "--out", str(folder / "data"), "--drives", "3", "--frames", "10", "--size", "128x64", "--lidar-steps", "0")
    files = 'path = "{date}/{drive}/depth_02/data/{frame}.png"'
    posterior = 'evidence = "alignment"\nnetwork = "none"\nhead = "posterior"'
    for name, depth, path, model in (
        ("files", "files", files, 'head = "full"'),
        ("ground_plane", "ground_plane", "horizon_px = 30.5", 'head = "full"'),
        ("posterior", "files", files, posterior),
    ):
        config = folder / f"{name}.toml"
        config.write_text(CONFIG.format(depth=depth, path=path, model=model))
        command("train", "--quiet", "--config", str(config), "--set", f"name={name}")
    return folder


def intrinsics(folder: Path) -> np.ndarray:
    lines = (folder / "data/2026_01_01/calib_cam_to_cam.txt").read_text().splitlines()
    values = next(line for line in lines if line.startswith("P_rect_02")).split()[1:]
    return np.array(values, dtype=float).reshape(3, 4)[:, :3]


def predicted(folder: Path, run: str, *options: str):
    return [json.loads(line) for line in command("predict", "--quiet", "--run", str(folder / "runs" / run), *options).splitlines()]


def pose(line: dict, field: str = "pose") -> np.ndarray:
    x, y, z, w = line[field]["quaternion_xyzw"]
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = line[field]["translation"]
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


def test_judgements_are_those_of_the_command_line(world):
    model = relcov.Model.load(world / "runs/posterior", device="flex")
    K = intrinsics(world)
    verdicts = []
    for line, in_camera in zip(predicted(world, "posterior"), predicted(world, "posterior", "--frame", "camera")):
        frames = line["source"], line["target"]
        arguments = *(image(world, frame) for frame in frames), K, pose(in_camera), depth(world, frames[1])
        judgement = model.judge(*arguments)
        np.testing.assert_array_equal(model.predict(*arguments), judgement.covariance)
        verdicts.append(judgement.verdict)
        assert (judgement.verdict, judgement.reason) == (line["verdict"], line.get("reason"))
        for found, field in (
            (judgement.covariance, "covariance"),
            (judgement.correction, "correction"),
            (judgement.corrected_covariance, "corrected_covariance"),
        ):
            expected = np.array(line[field])
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(judgement.corrected_pose, pose(in_camera, "corrected_pose"), rtol=0, atol=1e-9)
        evidence = judgement.evidence
        assert (evidence.estimate.shape, evidence.information.shape) == ((6,), (6, 6))
        if judgement.verdict == "ok":
            assert 0 < evidence.residual_after <= 1.3 * evidence.residual_before and 0 < evidence.valid_share <= 1
            assert np.isfinite([evidence.gain, evidence.bias]).all()
    assert "ok" in verdicts


def test_the_place_of_the_vehicle_moves_the_correction_and_not_the_corrected_pose(world):
    model = relcov.Model.load(world / "runs/posterior", device="flex")
    in_camera = predicted(world, "posterior", "--frame", "camera")[0]
    arguments = image(world, 0), image(world, 1), intrinsics(world), pose(in_camera), depth(world, 1)
    # A vehicle whose axes are those of the camera.
    judgement = model.judge(*arguments, camera_from_vehicle=np.eye(4))
    assert judgement.verdict == "ok"
    generator = judgement.correction
    assert np.linalg.norm(generator) > 0
    assert np.abs(generator - model.judge(*arguments).correction).max() > 0
    # exp(-μ) T to first order, in axes of the camera.
    x, y, z = generator[3:]
    step = np.eye(4)
    step[:3] -= np.column_stack([[[0, -z, y], [z, 0, -x], [-y, x, 0]], generator[:3]])
    np.testing.assert_allclose(judgement.corrected_pose, step @ pose(in_camera), rtol=0, atol=10 * np.linalg.norm(generator) ** 2)


def test_images_that_show_nothing_are_answered(world):
    model = relcov.Model.load(world / "runs/posterior", device="flex")
    T = pose(predicted(world, "posterior", "--frame", "camera")[0])
    black = np.zeros_like(image(world, 0))
    far = T.copy()
    far[2, 3] = -1000
    for images, pose_of, map_of_target, verdict in [
        ((image(world, 0), image(world, 1)), T, np.zeros_like(depth(world, 1)), "no_depth"),
        ((black, black), T, depth(world, 1), "no_texture"),
        ((image(world, 0), image(world, 1)), far, depth(world, 1), "no_overlap"),
    ]:
        judgement = model.judge(*images, intrinsics(world), pose_of, map_of_target)
        assert judgement.verdict == verdict and judgement.reason
        assert not judgement.correction.any()
        np.testing.assert_array_equal(judgement.covariance, judgement.corrected_covariance)
        np.testing.assert_allclose(judgement.corrected_pose, pose_of, rtol=0, atol=1e-12)
        assert np.linalg.eigvalsh(judgement.covariance).min() > 0


def test_a_model_without_evidence_says_nothing_of_corrections(world):
    model = relcov.Model.load(world / "runs/files", device="flex")
    judgement = model.judge(image(world, 0), image(world, 1), intrinsics(world), np.eye(4), depth(world, 1))
    assert judgement.covariance.shape == (6, 6)
    rest = judgement.correction, judgement.corrected_pose, judgement.corrected_covariance
    assert all(value is None for value in (*rest, judgement.verdict, judgement.reason, judgement.evidence))


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
        (dict(camera_from_vehicle=np.ones((4, 4))), "camera_from_vehicle: found"),
        (dict(right=(good["image0"], good["image1"])), "right: this model looks at one camera"),
        (dict(depth=np.zeros_like(good["depth"])), "not one pixel"),
        (dict(depth=good["depth"].T), "found a depth map of .* for an image of"),
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


def test_the_command_comes_along():
    def run(*arguments):
        return subprocess.run([sys.executable, "-m", "relcov", *arguments], capture_output=True, text=True)

    version = run("--version")
    assert version.returncode == 0
    assert version.stdout.startswith(f"relcov {relcov.__version__}\n")
    wrong = run("trian")
    assert wrong.returncode == 2
    assert "train" in wrong.stderr
