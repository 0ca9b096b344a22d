"""The box of a mask against a search of all cells."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from zlocus.core.mask_box import box_of


@given(arrays(np.bool_, st.tuples(st.integers(1, 6), st.integers(1, 6))))
def test_the_box_holds_all_cells_and_touches_some_on_each_side(mask):
    cells = [(r, c) for r in range(mask.shape[0]) for c in range(mask.shape[1]) if mask[r, c]]
    rows, cols = box_of(mask)
    if not cells:
        assert mask[rows, cols].size == 0
        return
    assert (rows.start, rows.stop) == (min(r for r, _ in cells), max(r for r, _ in cells) + 1)
    assert (cols.start, cols.stop) == (min(c for _, c in cells), max(c for _, c in cells) + 1)
