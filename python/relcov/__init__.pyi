import os
from dataclasses import dataclass
from typing import Optional, Tuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__version__: str

@dataclass(frozen=True, eq=False)
class Evidence:
    """What direct alignment found."""

    estimate: NDArray[np.float64]
    information: NDArray[np.float64]
    residual_before: float
    residual_after: float
    valid_share: float
    gain: float
    bias: float

@dataclass(frozen=True, eq=False)
class Judgement:
    """All that a model says of a measurement."""

    covariance: NDArray[np.float64]
    correction: Optional[NDArray[np.float64]]
    corrected_pose: Optional[NDArray[np.float64]]
    corrected_covariance: Optional[NDArray[np.float64]]
    verdict: Optional[str]
    reason: Optional[str]
    evidence: Optional[Evidence]

class Model:
    """A trained model, ready to predict."""

    @classmethod
    def load(cls, path: "os.PathLike[str] | str", device: str = ...) -> Model: ...
    @property
    def frame(self) -> str: ...
    @property
    def size(self) -> Tuple[int, int]: ...
    @property
    def stereo(self) -> bool: ...
    def predict(
        self,
        image0: NDArray[np.uint8],
        image1: NDArray[np.uint8],
        K: ArrayLike,
        T: ArrayLike,
        depth: Optional[ArrayLike] = ...,
        *,
        right: Optional[Tuple[NDArray[np.uint8], NDArray[np.uint8], ArrayLike]] = ...,
        camera_from_vehicle: Optional[ArrayLike] = ...,
    ) -> NDArray[np.float64]: ...
    def judge(
        self,
        image0: NDArray[np.uint8],
        image1: NDArray[np.uint8],
        K: ArrayLike,
        T: ArrayLike,
        depth: Optional[ArrayLike] = ...,
        *,
        right: Optional[Tuple[NDArray[np.uint8], NDArray[np.uint8], ArrayLike]] = ...,
        camera_from_vehicle: Optional[ArrayLike] = ...,
    ) -> Judgement: ...

def adjoint(T: ArrayLike) -> NDArray[np.float64]: ...
def left_to_right(covariance: ArrayLike, T: ArrayLike) -> NDArray[np.float64]: ...
def change_axes(covariance: ArrayLike, X: ArrayLike) -> NDArray[np.float64]: ...
