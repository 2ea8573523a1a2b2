"""Error bars for any relative-pose measurement.

Two camera images and the relative pose that some system measured between them go in; the 6x6 covariance of that
measurement comes out::

    import numpy as np
    import relcov

    model = relcov.Model.load("checkpoints/robot")
    covariance = model.predict(image0, image1, K, T)      # 6x6, m and rad

A model that also says what the images show of the error itself gives the measurement without it::

    judgement = model.judge(image0, image1, K, T)
    judgement.corrected_pose, judgement.corrected_covariance    # exp(-correction) T, and what is left of its error

Conventions, the same as everywhere in relcov:

* order ``x, y, z, roll, pitch, yaw`` (translation before rotation), variances in m² and rad²;
* the error is ``e = log(T_measured @ inv(T_true))``, a *left* perturbation, in axes of the source frame;
* ``T = source_from_target``: points of view i+1 into view i, axes of the camera (x right, y down, z forward), metres;
* covariances, corrections and evidence are in axes of ``model.frame``: ``vehicle`` (x forward, y left, z up), ``camera``
  or ``world``; a corrected pose is in axes of the camera, as ``T``, whose place it takes;
* pixel centres lie at integer coordinates.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Optional, Tuple

import numpy as np

from . import _relcov
from ._relcov import __version__

__all__ = ["Model", "Judgement", "Evidence", "adjoint", "left_to_right", "change_axes", "__version__"]


@dataclass(frozen=True, eq=False)
class Evidence:
    """What direct alignment of the two images found, at the finest level of its pyramid. Without a verdict
    (:attr:`Judgement.verdict`) its numbers are no evidence."""

    #: ``(6,)`` the estimate of the error ``e = log(T_measured @ inv(T_true))``, m and rad, axes of ``model.frame``.
    estimate: np.ndarray
    #: ``(6, 6)`` its information if residuals were independent, 1/m² and 1/rad², the same axes.
    information: np.ndarray
    #: Robust standard deviation of the residuals at the measured pose, intensities in 0…1.
    residual_before: float
    #: The same after alignment.
    residual_after: float
    #: Share of the pixels that have a known depth and lie inside the source image after alignment.
    valid_share: float
    #: ``image1 ≈ (1 + gain) image0 + bias`` after alignment, intensities in 0…1.
    gain: float
    #: See :attr:`gain`.
    bias: float


@dataclass(frozen=True, eq=False)
class Judgement:
    """All that a model says of a measurement. What a model does not say is ``None``: corrections need one trained with
    ``model.head = "posterior"``, verdict and evidence one with ``model.evidence = "alignment"``."""

    #: ``(6, 6)`` covariance R of the measurement as it is; what :meth:`Model.predict` returns.
    covariance: np.ndarray
    #: ``(6,)`` μ, the part of the error that the images show, m and rad, axes of ``model.frame``; zero without a verdict.
    correction: Optional[np.ndarray]
    #: ``(4, 4)`` the measurement without that error, ``source_from_target``, axes of the camera as ``T``, m.
    corrected_pose: Optional[np.ndarray]
    #: ``(6, 6)`` covariance C of the corrected measurement, axes of ``model.frame``; ``R = C + μ μᵀ``.
    corrected_covariance: Optional[np.ndarray]
    #: ``ok``, or why the images say nothing of the error: ``no_depth``, ``no_overlap``, ``no_texture``, ``diverged``.
    #: Covariances are then the prior's.
    verdict: Optional[str]
    #: The reason in words, where there is no verdict.
    reason: Optional[str]
    #: What direct alignment found.
    evidence: Optional[Evidence]


class Model:
    """A trained model, ready to predict. Made by :meth:`load`; may be used from several threads."""

    def __init__(self, native: "_relcov.NativeModel") -> None:
        self._native = native

    @classmethod
    def load(cls, path: "os.PathLike[str] | str", device: str = "auto") -> "Model":
        """Loads the best model of a run folder.

        :param path: a folder that ``relcov train`` made.
        :param device: ``auto``, ``flex`` (CPU), ``ndarray``, ``wgpu``, … as the command line has it.
        :raises ValueError: the folder holds no usable run.
        :raises RuntimeError: the device cannot be used.
        """
        return cls(_relcov.NativeModel(os.fspath(path), device))

    @property
    def frame(self) -> str:
        """Axes of the covariances: ``vehicle``, ``camera`` or ``world``."""
        return self._native.frame

    @property
    def size(self) -> Tuple[int, int]:
        """Height and width of the network's input, px; images of any size are brought to it."""
        return self._native.size

    @property
    def stereo(self) -> bool:
        """Whether the model looks at the right camera too."""
        return self._native.stereo

    def predict(
        self,
        image0: np.ndarray,
        image1: np.ndarray,
        K: np.ndarray,
        T: np.ndarray,
        depth: Optional[np.ndarray] = None,
        *,
        right: Optional[Tuple[np.ndarray, np.ndarray, np.ndarray]] = None,
        camera_from_vehicle: Optional[np.ndarray] = None,
    ) -> np.ndarray:
        """Predicts the covariance of a measured relative pose.

        :param image0: source image, ``(height, width, 3)`` RGB or ``(height, width)`` grey, ``uint8``, rectified.
        :param image1: target image, the same shape.
        :param K: ``(3, 3)`` intrinsics of both images at that size, px, no skew.
        :param T: ``(4, 4)`` or ``(3, 4)`` measured ``source_from_target``, axes of the camera, m.
        :param depth: depth of the target image, ``(h, w)`` of any size of its aspect, m along the optical axis, 0 or NaN =
            unknown. Without one the source that the model was trained with is asked, if it needs nothing but the image: a flat
            road, or a depth network whose scale is known.
        :param right: for stereo models: right source image, right target image, and ``(4, 4)`` ``right_from_left``.
        :param camera_from_vehicle: for models with evidence in axes of the vehicle: ``(4, 4)`` vehicle axes into those of
            the camera, m. Without: as on the drives that the model was trained on.
        :returns: ``(6, 6)`` ``float64``; order, side and axes as the module's text says.
        :raises ValueError: a shape, type or value is not as described; the message names the argument.
        """
        return np.array(self._judge(image0, image1, K, T, depth, right, camera_from_vehicle).covariance)

    def judge(
        self,
        image0: np.ndarray,
        image1: np.ndarray,
        K: np.ndarray,
        T: np.ndarray,
        depth: Optional[np.ndarray] = None,
        *,
        right: Optional[Tuple[np.ndarray, np.ndarray, np.ndarray]] = None,
        camera_from_vehicle: Optional[np.ndarray] = None,
    ) -> Judgement:
        """Judges a measured relative pose: its covariance, and where the model says it the error that the images show,
        the measurement without that error, and the evidence behind both. Parameters and errors as :meth:`predict`."""
        native = self._judge(image0, image1, K, T, depth, right, camera_from_vehicle)

        def array(numbers: Optional[list]) -> Optional[np.ndarray]:
            return None if numbers is None else np.array(numbers)

        found = native.evidence
        evidence = None if found is None else Evidence(
            estimate=np.array(found.estimate),
            information=np.array(found.information),
            residual_before=found.residual_before,
            residual_after=found.residual_after,
            valid_share=found.valid_share,
            gain=found.gain,
            bias=found.bias,
        )
        return Judgement(
            covariance=np.array(native.covariance),
            correction=array(native.correction),
            corrected_pose=array(native.corrected_pose),
            corrected_covariance=array(native.corrected_covariance),
            verdict=native.verdict,
            reason=native.reason,
            evidence=evidence,
        )

    def _judge(self, image0, image1, K, T, depth, right, camera_from_vehicle) -> "_relcov.NativeJudgement":
        source, target = _image("image0", image0), _image("image1", image1)
        intrinsics = _matrix("K", K, [(3, 3)])
        if intrinsics[0, 1] != 0.0 or not np.array_equal(intrinsics[2], [0.0, 0.0, 1.0]) or intrinsics[1, 0] != 0.0:
            raise ValueError("K: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; rectify the images first")
        if right is None:
            right_images = right_from_left = None
        elif not self.stereo:
            raise ValueError("right: this model looks at one camera; leave it out")
        elif not isinstance(right, (tuple, list)) or len(right) != 3:
            raise ValueError("right: expected right source image, right target image and right_from_left")
        else:
            right_images = (_image("right[0]", right[0]), _image("right[1]", right[1]))
            right_from_left = _pose("right[2]", right[2])
        numbers = (intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2])
        return self._native.judge(
            source,
            target,
            [float(number) for number in numbers],
            _pose("T", T),
            None if depth is None else _depth(depth),
            right_images,
            right_from_left,
            None if camera_from_vehicle is None else _pose("camera_from_vehicle", camera_from_vehicle),
        )


def adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoint of a pose for tangents of translation, then rotation: ``T exp(x) inv(T) = exp(adjoint(T) x)``."""
    pose = np.reshape(_pose("T", T), (4, 4))
    rotation, (x, y, z) = pose[:3, :3], pose[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[rotation, cross @ rotation], [np.zeros((3, 3)), rotation]])


def left_to_right(covariance: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Covariance of the right perturbation (GTSAM, g2o, manif) of the same measurement, in axes of the target frame.

    ``T`` is the measured pose in the axes of the covariance.
    """
    return change_axes(covariance, np.linalg.inv(np.reshape(_pose("T", T), (4, 4))))


def change_axes(covariance: np.ndarray, X: np.ndarray) -> np.ndarray:
    """The covariance in other axes; ``X = other_from_these``, ``(4, 4)``. The pose becomes ``X @ T @ inv(X)``."""
    transport = adjoint(X)
    return transport @ _matrix("covariance", covariance, [(6, 6)]) @ transport.T


def _image(name: str, image: np.ndarray) -> Tuple[int, int, bytes]:
    array = np.asarray(image)
    if array.dtype != np.uint8:
        raise ValueError(f"{name}: found {array.dtype}; expected uint8")
    if array.ndim == 2:
        array = np.repeat(array[:, :, None], 3, axis=2)
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ValueError(f"{name}: found shape {np.shape(image)}; expected (height, width, 3) or (height, width)")
    return array.shape[0], array.shape[1], array.tobytes()


def _depth(depth: np.ndarray) -> Tuple[int, int, bytes]:
    array = np.asarray(depth)
    if array.dtype.kind != "f":
        raise ValueError(f"depth: found {array.dtype}; expected floats in metres (KITTI's 16-bit PNG: divide by 256)")
    array = array.astype("<f4")
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(f"depth: found shape {array.shape}; expected (height, width)")
    if np.isinf(array).any() or (array < 0).any():
        raise ValueError("depth: found infinite or negative values; expected metres, 0 or NaN = unknown")
    return array.shape[0], array.shape[1], np.nan_to_num(array, nan=0.0).tobytes()


def _matrix(name: str, matrix: np.ndarray, shapes: "list[tuple[int, int]]") -> np.ndarray:
    if np.iscomplexobj(matrix):
        raise ValueError(f"{name}: found complex numbers; expected real ones")
    array = np.asarray(matrix, dtype=np.float64)
    if array.shape not in shapes:
        raise ValueError(f"{name}: found shape {array.shape}; expected {' or '.join(map(str, shapes))}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: found a value that is not finite")
    return array


def _pose(name: str, pose: np.ndarray) -> "list[float]":
    array = _matrix(name, pose, [(4, 4), (3, 4)])
    if array.shape == (4, 4) and not np.allclose(array[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9):
        raise ValueError(f"{name}: found {array[3]} as its last row; expected 0 0 0 1")
    if not np.allclose(array[:3, :3] @ array[:3, :3].T, np.eye(3), rtol=0.0, atol=1e-3) or np.linalg.det(array[:3, :3]) < 0:
        raise ValueError(f"{name}: its upper left 3x3 block is no rotation matrix")
    return np.vstack([array[:3], [0.0, 0.0, 0.0, 1.0]]).ravel().tolist()
