"""What every sensor can do: ground to image and, at a given height, image to ground."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@runtime_checkable
class SensorModel(Protocol):
    """Ground <-> image for one exposure.

    Image points are `xy` = (column, row) in pixels; (0, 0) is the centre of the first pixel.
    Ground points are `xyz` in the scene's frame: easting, northing and ellipsoidal height in metres.
    Points the model cannot map are NaN in the result, never an exception.
    """

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """Image position of ground points. xyz : (n, 3) m -> (n, 2) px."""
        ...

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """Ground points seen by image positions at given heights. xy : (n, 2) px, z : (n,) m -> (n, 3) m."""
        ...

    def height_bounds(self) -> tuple[float, float] | None:
        """Lowest and highest ellipsoidal height (m) the model was made for; None where it holds at any height."""
        ...
