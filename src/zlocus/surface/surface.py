"""What a tile yields."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Surface:
    """Height, reasons, images used and ortho-image of a block of cells, all (r, c).

    height : float32, ellipsoidal m at the cell's centre, NaN where empty; quality : uint16, see `Quality`; views :
    uint8, images used, 0 where empty; ortho : float32, grey values of the image, NaN where there is none.
    """

    height: NDArray[np.float32]
    quality: NDArray[np.uint16]
    views: NDArray[np.uint8]
    ortho: NDArray[np.float32]
