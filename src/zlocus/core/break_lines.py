"""Break lines that an operator gives: where a surface may jump, and where its height is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class BreakLines:
    """Break lines in the frame of a scene.

    jumps : (n, 2, 2) m, ends (x, y) of the segments across which heights may jump; held : (k, 3) m, points along the
    lines whose heights are known, ellipsoidal, closer together than cells.
    """

    jumps: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2, 2)), repr=False)
    held: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)), repr=False)
