"""Names of the array types that every room uses."""

import os

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
PathLike = str | os.PathLike[str]
