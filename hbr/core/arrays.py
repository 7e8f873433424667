"""The kinds of arrays that retrieval works on."""

import numpy as np
from numpy.typing import NDArray

#: Pixels, (H, W, 3), blue, green, red.
ImageArray = NDArray[np.uint8]
#: CEDD levels 0..7, (144,) or (n, 144).
LevelArray = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
#: In single or double precision.
RealArray = NDArray[np.floating]
IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
