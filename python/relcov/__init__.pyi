import os
from typing import Optional, Tuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__version__: str

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
    ) -> NDArray[np.float64]: ...

def adjoint(T: ArrayLike) -> NDArray[np.float64]: ...
def left_to_right(covariance: ArrayLike, T: ArrayLike) -> NDArray[np.float64]: ...
def change_axes(covariance: ArrayLike, X: ArrayLike) -> NDArray[np.float64]: ...
