"""Types of the arrays that retrieval uses."""

import numpy as np
from numpy.typing import NDArray

#: An image, (H, W, 3), in the order blue, green, red.
ImageArray = NDArray[np.uint8]
#: CEDD levels 0..7, (144,) or (n, 144).
LevelArray = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
#: Single or double precision.
RealArray = NDArray[np.floating]
IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
