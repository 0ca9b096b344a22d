from __future__ import annotations

import numpy as np
import pytest

from kernel_scene import ragged_lattice


@pytest.mark.parametrize(("shape", "block"), [((37, 70), 16), ((32, 32), 32), ((5, 3), 8), ((33, 65), 32)])
def test_every_cell_has_a_place_of_its_own(shape, block):
    """Cells follow each other row by row without gap or overlap, each with its own count."""
    lattice = ragged_lattice(shape, block, seed=1, counts=(16, 32, 48))
    first, count = lattice.cell_ranges()
    assert lattice.size == count.sum()
    taken = np.zeros(lattice.size, int)
    expected = 0
    for r in range(shape[0]):
        for c in range(shape[1]):
            b, d = r // block, c // block
            base, length, start = lattice.address[:, b, d]
            at = base + (r - b * block) * length + start + (c - d * block) * lattice.count[b, d]
            assert at == expected
            taken[at : at + count[r, c]] += 1
            expected += count[r, c]
            assert (first[r, c], count[r, c]) == (lattice.first[b, d], lattice.count[b, d])
    assert (taken == 1).all()
    np.testing.assert_array_equal(lattice.ranges, [lattice.first, lattice.count])


def test_metres_of_indices():
    lattice = type(ragged_lattice())(412.5, 0.3, (1, 1), 8, np.zeros((1, 1), int), np.ones((1, 1), int))
    metres = lattice.metres(np.array([0.0, 10.5], np.float32))
    assert metres.dtype == np.float32
    np.testing.assert_allclose(metres, [412.5, 415.65], rtol=0, atol=1e-4)
