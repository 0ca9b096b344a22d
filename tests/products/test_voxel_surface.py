"""Surfaces of zero distance: a sphere and a plane, whose places are known, and single wrong nodes."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from zlocus.products.voxel_surface import MIN_PIECE, zero_surface

RADIUS, MIDDLE = 6.3, np.array([9.2, 10.1, 8.7])
# Nodes by which a vertex, the mean of places on the edges of its cell, may lie inside of a bent surface.
BENT = 0.06


def sphere(shape=(20, 21, 19)):
    at = np.stack(np.indices(shape), axis=-1) - MIDDLE
    return (np.linalg.norm(at, axis=-1) - RADIUS).astype(np.float32)


def test_a_sphere_is_closed_and_looks_outwards():
    surface = zero_surface(sphere())
    out = surface.vertices - MIDDLE
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), RADIUS, atol=BENT)
    corners = surface.vertices[surface.quads]
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    assert ((across * (corners.mean(axis=1) - MIDDLE)).sum(axis=1) > 0).all()
    # Each side of a face is a side of one other face, which runs the other way.
    sides = Counter(
        zip(surface.quads.ravel().tolist(), np.roll(surface.quads, -1, axis=1).ravel().tolist(), strict=True)
    )
    assert set(sides.values()) == {1}
    assert all((b, a) in sides for a, b in sides)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_plane_is_where_it_is(axis):
    values = (np.moveaxis(np.indices((9, 9, 9)), 0, -1)[..., axis] - 4.25).astype(np.float32)
    surface = zero_surface(values)
    np.testing.assert_allclose(surface.vertices[:, axis], 4.25, atol=1e-6)
    assert len(surface) == 7 * 7  # edges at the border have no cells on all sides
    assert (surface.edges[:, axis] == 4).all()


def test_unknown_nodes_are_holes_and_dust_is_removed():
    values = sphere((40, 21, 19))
    values[:, :, :3] = np.nan
    values[30:32, 5:7, 5:7] = 1.0
    values[30, 5, 5] = -1.0
    whole = zero_surface(values)
    kept = whole.without_dust()
    assert len(whole) == len(kept) + 6
    assert 6 < MIN_PIECE < len(kept)
    assert kept.vertices[:, 0].max() < 20
    assert kept.quads.max() == len(kept.vertices) - 1
    assert len(zero_surface(np.full((4, 4, 4), np.nan, np.float32)).without_dust()) == 0
