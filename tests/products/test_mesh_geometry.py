"""Meshes of surfaces: walls stand where heights jump, nothing is open, and tiles fit together."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.products.mesh_geometry import surface_mesh

JUMP_M = 1.0


def around(z):
    """Heights of a tile with one cell of the same surface, or nothing, around it."""
    return np.pad(np.asarray(z, float), 1, constant_values=np.nan)


def area(outlines):
    """Areas (k,) of plane outlines (k, 4, 3), of cells of a metre."""
    diagonals = outlines[:, 2] - outlines[:, 0], outlines[:, 3] - outlines[:, 1]
    return np.linalg.norm(np.cross(*diagonals), axis=1) / 2


def test_a_slope_is_one_piece_without_walls():
    z = 0.3 * np.arange(6)[:, None] + 0.2 * np.arange(5)
    patches, walls = surface_mesh(around(z), JUMP_M)
    assert len(patches) == 30
    assert len(walls) == 0
    corners = {}
    for col, row, height in patches.outlines.reshape(-1, 3):
        assert corners.setdefault((col, row), height) == pytest.approx(height)
    inner = {at: height for at, height in corners.items() if 0 < at[0] < 5 and 0 < at[1] < 6}
    for (col, row), height in inner.items():
        assert height == pytest.approx(0.3 * (row - 0.5) + 0.2 * (col - 0.5))


@pytest.mark.parametrize(("turn", "outwards"), [(0, (1, 0)), (1, (0, -1)), (2, (-1, 0)), (3, (0, 1))])
def test_a_step_has_a_wall_on_the_line_between_the_cells(turn, outwards):
    z = np.zeros((6, 6))
    z[:, :3] = 10.0
    patches, walls = surface_mesh(around(np.rot90(z, turn)), JUMP_M)
    assert len(walls) == 6
    np.testing.assert_array_equal(walls.outwards, np.broadcast_to(outwards, (6, 2)))
    across = 0 if outwards[1] == 0 else 1
    np.testing.assert_array_equal(walls.outlines[:, :, across], 3.0)
    np.testing.assert_allclose(area(walls.outlines), 10.0)
    assert set(np.unique(patches.z)) == {0.0, 10.0}
    # Counter-clockwise from outside: the normal points outwards. Rows grow to the south.
    east_north_up = walls.outlines * [1.0, -1.0, 1.0]
    normal = np.cross(east_north_up[:, 1] - east_north_up[:, 0], east_north_up[:, 3] - east_north_up[:, 0])
    np.testing.assert_allclose(normal, np.broadcast_to([10.0 * outwards[0], -10.0 * outwards[1], 0.0], (6, 3)))


@pytest.mark.parametrize("turn", range(4))
def test_cells_that_hang_together_around_a_corner_share_it(turn):
    """Three cells rise by less than a jump from one to the next, the fourth is a tower."""
    z = np.rot90(np.array([[0.0, 0.9], [10.0, 1.8]]), turn)
    patches, walls = surface_mesh(around(z), JUMP_M)
    middle = patches.outlines[(patches.outlines[..., :2] == 1.0).all(axis=-1)]
    np.testing.assert_allclose(np.sort(middle[:, 2]), [0.9, 0.9, 0.9, 10.0])
    assert len(walls) == 2


def edges(outlines):
    """How often each edge of outlines (k, 4, 3) with a length occurs, counted by its direction."""
    counts = Counter()
    for outline in np.round(outlines, 9).tolist():
        for start, end in zip(outline, [*outline[1:], outline[0]], strict=True):
            if start != end:
                counts[min(tuple(start), tuple(end)), max(tuple(start), tuple(end))] += 1 if start < end else -1
    return counts


@given(st.lists(st.integers(0, 3), min_size=25, max_size=25))
def test_walls_close_what_jumps_open(heights):
    """All level edges of patches are met by another patch or by walls; what is open lies on the border."""
    z = 4.0 * np.array(heights, float).reshape(5, 5)
    patches, walls = surface_mesh(around(z), JUMP_M)
    counts = edges(np.concatenate([patches.outlines, walls.outlines]))
    for (start, end), count in counts.items():
        on_border = any(start[k] == end[k] and start[k] in (0.0, 5.0) for k in (0, 1))
        is_level = start[:2] != end[:2]
        assert count == 0 or on_border or not is_level, (start, end)
    vertical = np.abs(np.diff(z, axis=0)).sum() + np.abs(np.diff(z, axis=1)).sum()
    assert area(walls.outlines).sum() == pytest.approx(vertical)


def test_tiles_fit_together():
    rng = np.random.default_rng(0)
    z = np.where(rng.random((12, 14)) < 0.3, 8.0, 0.0) + rng.normal(0.0, 0.2, (12, 14))
    z[3, 4] = np.nan
    whole = surface_mesh(around(z), JUMP_M)
    padded = around(z)
    parts = [surface_mesh(padded[:, :8], JUMP_M), surface_mesh(padded[:, 6:], JUMP_M)]

    def places(mesh, shift):
        return sorted(map(tuple, np.round(mesh.outlines + np.array([shift, 0.0, 0.0]), 9).reshape(-1, 12).tolist()))

    for k in (0, 1):
        assert places(whole[k], 0) == sorted(places(parts[0][k], 0) + places(parts[1][k], 6))
    assert len(whole[0]) == 12 * 14 - 1


def test_missing_cells_have_neither_patches_nor_walls():
    z = np.full((3, 3), 5.0)
    z[1, 1] = np.nan
    patches, walls = surface_mesh(around(z), JUMP_M)
    assert len(patches) == 8
    assert len(walls) == 0
    assert np.isfinite(patches.outlines).all()
