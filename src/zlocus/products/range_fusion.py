"""Depth maps of several images as one signed distance on a lattice of voxels.

Source: Curless and Levoy (1996), A volumetric method for building complex models from range images, sections 2 and 3.
Departures: distances are measured to the plane of the nearest pixel of a map instead of along its ray, because a wall
that an image sees askew crosses several pixels from one voxel to the next; what an image sees through is free space
there only where a map has a surface nearby.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.sensor_model import FloatArray
from zlocus.products.cloud_maps import ImageMap, RayPoints

# Neighbouring pixels belong to one surface where it is seen at less than this tangent of an angle from its normal.
MAX_SLANT = 5.0
# Weight below which a node counts as unknown.
MIN_WEIGHT = 0.05
# Two columns of nodes are neighbours up to this distance, nodes.
NEARBY_NODES = 2
# Nodes along the side of a block: only blocks near a surface are computed. And nodes that are projected at once.
BLOCK, NODES_AT_ONCE = 8, 200_000


@dataclass(frozen=True)
class RangeMap:
    """A window of a map with the orientation of what it shows.

    image_map : of the image; window : its pixels, of which every `stride`-th is there; points, normals : (r, c, 3) m
    and unit vectors towards the camera, NaN where a pixel has no neighbour on its surface; cosine : (r, c) of the
    angle between normal and ray.
    """

    image_map: ImageMap
    window: CellWindow
    stride: int
    points: FloatArray
    normals: FloatArray
    cosine: FloatArray

    @classmethod
    def read(cls, image_map: ImageMap, window: CellWindow, stride: int) -> RangeMap:
        """The map of a window. A pixel needs a neighbour on its surface in its row or column; where it has none in one
        of them, the surface is taken to stand across the ray in that direction."""
        ray_points = image_map.read(window, stride)
        towards = ray_points.towards
        right, down = (_joined(ray_points, axis) for axis in (1, 0))
        with np.errstate(invalid="ignore", divide="ignore"):
            normals = np.cross(right, down)
            for step, other in ((right, down), (down, right)):
                alone = np.isfinite(step[..., 0]) & ~np.isfinite(other[..., 0])
                along = step[alone] / np.linalg.norm(step[alone], axis=-1, keepdims=True)
                normals[alone] = towards[alone] - (towards[alone] * along).sum(axis=-1, keepdims=True) * along
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
            cosine = (normals * towards).sum(axis=-1)
            normals *= np.sign(cosine)[..., None]
        return cls(image_map, window, stride, ray_points.points, normals, np.abs(cosine))

    def signed_distances(self, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (n,) m of ground points (n, 3) before the surface that the map shows in their pixel, negative
        behind it, and the cosines (n,) there; NaN where it shows none."""
        distance, cosine = np.full(len(xyz), np.nan), np.full(len(xyz), np.nan)
        xy = (self.image_map.view.sensor.image_from_ground(xyz) - [self.window.col, self.window.row]) / self.stride
        rows, cols = self.cosine.shape
        with np.errstate(invalid="ignore"):
            col, row = np.rint(xy).T
            inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        at = row[inside].astype(np.int64), col[inside].astype(np.int64)
        distance[inside] = ((xyz[inside] - self.points[at]) * self.normals[at]).sum(axis=-1)
        cosine[inside] = self.cosine[at]
        return distance, cosine


def _joined(ray_points: RayPoints, axis: int) -> FloatArray:
    """Mean step (r, c, 3) m from a pixel to its next one along an axis, and from the one before it to itself, over
    those that lie on one surface; NaN where neither does."""
    points = np.moveaxis(ray_points.points, axis, 0)
    towards = np.moveaxis(ray_points.towards, axis, 0)[:-1]
    step = np.diff(points, axis=0)
    along = (step * towards).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.linalg.norm(step - along[..., None] * towards, axis=-1)
        belongs = np.abs(along) <= MAX_SLANT * across
        total, count = np.zeros(points.shape), np.zeros(points.shape[:2])
        for part in (slice(None, -1), slice(1, None)):
            total[part] += np.where(belongs[..., None], step, 0.0)
            count[part] += belongs
        return np.moveaxis(total / np.where(count > 0, count, np.nan)[..., None], 0, axis)


@dataclass(frozen=True)
class VoxelCube:
    """A box of the lattice, whose nodes lie at whole multiples of `cell_m` on each axis of the scene.

    first : (3,) number of its first node on each axis; shape : nodes on each axis, whole blocks of them.
    """

    first: NDArray[np.int64]
    shape: tuple[int, int, int]
    cell_m: float

    def nodes_near(self, range_maps: list[RangeMap], band_m: float) -> NDArray[np.int64]:
        """Flat numbers (n,) of the nodes in blocks that lie within a band around a point of the maps."""
        n_blocks = np.array(self.shape) // BLOCK
        near = np.zeros(tuple(n_blocks), bool)
        reach = band_m / self.cell_m + 1.0
        # Points that share half a block need to be looked at once.
        half = BLOCK // 2
        offsets = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * (reach + half / 2)
        for one in range_maps:
            points = one.points[np.isfinite(one.cosine)]
            at = np.unique(np.floor((points / self.cell_m - self.first) / half).astype(np.int64), axis=0)
            for offset in offsets:
                block = np.floor((at * half + half / 2 + offset) / BLOCK).astype(np.int64)
                block = block[((block >= 0) & (block < n_blocks)).all(axis=1)]
                near[tuple(block.T)] = True
        return np.flatnonzero(near.repeat(BLOCK, 0).repeat(BLOCK, 1).repeat(BLOCK, 2))

    def ground(self, nodes: NDArray[np.int64]) -> FloatArray:
        """Ground points (n, 3) m of nodes by their flat numbers."""
        return np.asarray((np.stack(np.unravel_index(nodes, self.shape), axis=-1) + self.first) * self.cell_m, float)


def fused(range_maps: list[RangeMap], cube: VoxelCube, band_m: float) -> NDArray[np.float32]:
    """Signed distances at the nodes of a cube, float32 of its shape: weighted means over the maps, in units of
    `band_m`, beyond which they are not told apart; NaN where no map tells.

    A map weighs by the cosine at which it sees its surface. Behind the surface its weight goes down to nothing at the
    band's end, because there may be another surface, which it does not see.
    """
    values = np.full(cube.shape, np.nan, np.float32)
    set_distances(values, cube.nodes_near(range_maps, band_m), range_maps, cube, band_m)
    return values


def set_distances(
    values: NDArray[np.float32], nodes: NDArray[np.int64], range_maps: list[RangeMap], cube: VoxelCube, band_m: float
) -> None:
    """Set the signed distances of some nodes, as `fused` defines them.

    values : float32 of the cube's shape, changed in place; nodes : (n,) flat numbers.
    """
    for first in range(0, len(nodes), NODES_AT_ONCE):
        part = nodes[first : first + NODES_AT_ONCE]
        xyz = cube.ground(part)
        total, weight = np.zeros(len(part)), np.zeros(len(part))
        for one in range_maps:
            distance, cosine = one.signed_distances(xyz)
            share = distance / band_m
            with np.errstate(invalid="ignore"):
                own = np.where(share > -1.0, cosine * np.minimum(1.0 + share, 1.0), 0.0)
            counts = np.isfinite(share) & (own > 0)
            weight[counts] += own[counts]
            total[counts] += own[counts] * np.minimum(share[counts], 1.0)
        known = weight > MIN_WEIGHT
        values.reshape(-1)[part[known]] = total[known] / weight[known]


def close_below(values: NDArray[np.float32], range_maps: list[RangeMap], cube: VoxelCube, band_m: float) -> None:
    """Close a surface where it ends above lower ground; changes the values (a, b, c), whose last axis is the height.

    Walls are often not matched. Down to the lowest surface nearby, what no image shows is taken to be solid below solid
    and free below what images see through, so that a wall stands between them. Gaps of few nodes count as free.
    """
    inside = values < 0
    n = values.shape[2]
    top = n - 1 - inside[:, :, ::-1].argmax(axis=2).astype(np.float32)
    any_inside = inside.any(axis=2)
    kernel = np.ones((2 * NEARBY_NODES + 1,) * 2, np.uint8)
    low = cv2.erode(np.where(any_inside, top, np.float32(n)), kernel)[..., None]
    high = cv2.dilate(np.where(any_inside, top, np.float32(-n)), kernel)[..., None]
    height = np.arange(n)
    between = np.isnan(values) & (height > low) & (height <= high + NEARBY_NODES)
    set_distances(values, np.flatnonzero(between), range_maps, cube, band_m)
    above = np.full(values.shape[:2], np.nan, np.float32)  # -1 solid, 1 free
    for level in range(n - 1, -1, -1):
        layer = values[:, :, level]
        # Solid goes on below what is free but close to a measured surface: walls are rough.
        above[layer < 0] = -1.0
        above[(layer >= 1.0) | ((layer >= 0) & ~(above < 0))] = 1.0
        unseen = between[:, :, level] & np.isnan(layer)
        layer[unseen] = above[unseen]
        # Columns of which nothing is known, between a solid and a free one: maps have gaps at edges.
        near_both = np.logical_and(
            *(cv2.dilate(part.astype(np.uint8), kernel) > 0 for part in (layer < 0, layer >= 1.0))
        )
        layer[unseen & np.isnan(layer) & near_both] = 1.0
