"""Names of the array types that every room uses."""

import os
from typing import Any

import numpy as np

# what numpy.typing.NDArray stands for; from numpy 2.5 on that is an alias, which hides the array
Floats = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
Ints = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
Flags = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
PathLike = str | os.PathLike[str]
