"""The surface on which a signed distance is zero, as quadrilaterals: a vertex in each cell of the lattice that it
crosses, and a quadrilateral on each edge.

Source: Gibson (1998), Constrained elastic surface nets, section 3, without the relaxation: a vertex is the mean of the
places at which the edges of its cell are crossed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from zlocus.core.sensor_model import FloatArray

# Pieces of a surface with fewer quadrilaterals are dust: single wrong pixels.
MIN_PIECE = 40


@dataclass(frozen=True)
class QuadSurface:
    """A surface of quadrilaterals.

    vertices : (n, 3); quads : (k, 4) numbers of vertices, counter-clockwise from the positive side; edges : (k, 3)
    lower node of the edge that each quadrilateral crosses, by which it belongs to a part of the lattice.
    """

    vertices: FloatArray
    quads: NDArray[np.int64]
    edges: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.quads)

    def kept(self, keep: NDArray[np.bool_]) -> QuadSurface:
        """The part with some of the quadrilaterals. keep : (k,)."""
        used, quads = np.unique(self.quads[keep], return_inverse=True)
        return QuadSurface(self.vertices[used], quads.reshape(-1, 4), self.edges[keep])

    def without_dust(self) -> QuadSurface:
        """The surface without pieces of fewer than `MIN_PIECE` quadrilaterals."""
        if not len(self):
            return self
        ends = np.repeat(self.quads[:, 0], 3), self.quads[:, 1:].ravel()
        n = len(self.vertices)
        _, piece = connected_components(coo_matrix((np.ones(len(ends[0]), bool), ends), (n, n)), directed=False)
        of_quad = piece[self.quads[:, 0]]
        return self.kept(np.bincount(of_quad)[of_quad] >= MIN_PIECE)


def zero_surface(values: NDArray[np.float32]) -> QuadSurface:
    """The surface between negative and positive nodes of a lattice (a, b, c), in units of its nodes.

    values : NaN where unknown; no surface passes there. Edges at the border of the lattice, which have no cells on all
    sides, take no part.
    """
    crossings, owners, cells_of_quads = [], [], []
    shape = np.array(values.shape)
    for axis in range(3):
        step = np.eye(3, dtype=np.int64)[axis]
        first, second = (np.roll((1, 2, 0), -axis)[k] for k in range(2))
        lower = np.moveaxis(np.moveaxis(values, axis, 0)[:-1], 0, axis)
        upper = np.moveaxis(np.moveaxis(values, axis, 0)[1:], 0, axis)
        with np.errstate(invalid="ignore"):
            crossed = np.isfinite(lower) & np.isfinite(upper) & ((lower < 0) != (upper < 0))
        node = np.argwhere(crossed)
        inside = ((node[:, [first, second]] > 0) & (node[:, [first, second]] < shape[[first, second]] - 1)).all(axis=1)
        node = node[inside]
        low, high = lower[tuple(node.T)].astype(float), upper[tuple(node.T)].astype(float)
        share = low / (low - high)
        crossings.append(node + share[:, None] * step)
        owners.append(node)
        one, other = np.eye(3, dtype=np.int64)[[first, second]]
        around = np.stack([node - one - other, node - other, node, node - one], axis=1)
        around[low >= 0] = around[low >= 0][:, ::-1]
        cells_of_quads.append(around)
    cells = np.concatenate(cells_of_quads).reshape(-1, 3)
    unique, number = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)
    number = number.ravel()
    places = np.repeat(np.concatenate(crossings), 4, axis=0)
    count = np.bincount(number, minlength=len(unique))
    vertices = np.stack([np.bincount(number, places[:, k], len(unique)) / count for k in range(3)], axis=-1)
    return QuadSurface(vertices, number.reshape(-1, 4), np.concatenate(owners))
