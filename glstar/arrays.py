"""Types of arrays, by what their elements are."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Integer = NDArray[np.int64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
