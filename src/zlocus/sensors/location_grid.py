"""Location grids: where the pixels of a line scanner's image lie on the ground, tabulated at some heights.

The vendor's software computes them with the physical model (position, attitude and detectors), and hands out the table
in place of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.earth_frame import EarthSpace, between
from zlocus.sensors.location_grid_kernel import GridNumbers, ground_positions, image_places

# Last step of Newton's method.
TOLERANCE_PX = 1e-7
# The grid is extended by this much, linearly, because tiles and corrections reach beyond the image.
MARGIN_PX = 4096.0
# Nodes along each axis of which the first guess is made.
GUESS_NODES = 8
# Coefficients before and after its own that an equation of a spline contains.
BAND = 4


@dataclass(frozen=True, eq=False)
class LocationGrid:
    """Ground coordinates of the nodes of a regular grid in the image, at some heights.

    heights : (h,) float64 m above the ellipsoid, increasing; xy : (h, r, c, 2) float64, horizontal coordinates in
    `crs`, longitude first where it is geographic; first_node, step : (column, row) px, of the first node and from node
    to node.
    """

    heights: FloatArray
    xy: FloatArray
    first_node: tuple[float, float]
    step: tuple[float, float]
    crs: CRS

    @property
    def last_node(self) -> tuple[float, float]:
        """Column and row of the last node, px."""
        n_rows, n_cols = self.xy.shape[1:3]
        return self.first_node[0] + (n_cols - 1) * self.step[0], self.first_node[1] + (n_rows - 1) * self.step[1]

    def folded_cell(self) -> tuple[int, int, int] | None:
        """Numbers of the height, the row and the column of a cell that is turned over or flat; None without any.

        All cells of a grid turn from its columns to its rows the same way. Where one does not, two places in the image
        see the same ground, or a node is wrong.
        """
        along, down = np.diff(self.xy, axis=2), np.diff(self.xy, axis=1)
        # At each corner of a cell: the sides that meet there.
        turns = np.stack(
            [_cross(a, d) for a in (along[:, :-1], along[:, 1:]) for d in (down[:, :, :-1], down[:, :, 1:])]
        )
        direction = np.sign(np.median(turns))
        wrong = (turns * direction <= 0).any(axis=0) if direction else np.ones(turns.shape[1:], bool)
        cells = np.argwhere(wrong)
        return (int(cells[0, 0]), int(cells[0, 1]), int(cells[0, 2])) if len(cells) else None

    def in_crs(self, crs: CRS) -> LocationGrid:
        """The grid with its coordinates in another CRS; NaN where that has none."""
        to_crs = between(self.crs.to_2d(), crs.to_2d())
        x, y = to_crs.transform(self.xy[..., 0].ravel(), self.xy[..., 1].ravel())
        xy = np.stack([x, y], axis=-1).reshape(self.xy.shape)
        xy[~np.isfinite(xy).all(axis=-1)] = np.nan
        return replace(self, xy=xy, crs=crs)

    def with_middle_height(self) -> LocationGrid:
        """The grid of two heights with a third one between them, where straight rays from node to node meet it.

        Horizontal coordinates along a straight ray are not linear in the height, because the Earth is round: by 0.1 m
        in the middle of 3 km at 17 degrees from the vertical.
        """
        shape, space = self.xy.shape[1:], EarthSpace(self.crs)
        low, high = (
            space.cartesian_from_ground(np.column_stack([xy.reshape(-1, 2), np.full(xy[..., 0].size, z)]))
            for xy, z in zip(self.xy, self.heights, strict=True)
        )
        middle = float(self.heights.mean())
        between_them = space.meet(high, low - high, np.full(len(high), middle))[:, :2].reshape(shape)
        xy = np.stack([self.xy[0], between_them, self.xy[1]])
        return replace(self, heights=np.insert(self.heights, 1, middle), xy=xy)


@dataclass(frozen=True, eq=False)
class LocationGridModel:
    """A location grid as a `SensorModel` in the CRS of the scene.

    Between nodes the coordinates follow a cubic spline in the image, and a polynomial of up to the third degree through
    the nearest heights. They go on linearly up to `MARGIN_PX` outside of the nodes, and by the same polynomial below
    and above the heights, as far as the two outermost are apart. Points further outside are NaN.
    """

    location_grid: LocationGrid
    crs: CRS
    _numbers: GridNumbers = field(init=False, repr=False)

    def __post_init__(self) -> None:
        given = self.location_grid if len(self.location_grid.heights) > 2 else self.location_grid.with_middle_height()
        own, step = given.in_crs(self.crs), np.array(given.step)
        coefficients = spline_coefficients(spline_coefficients(own.xy, 1), 2)
        numbers = GridNumbers(
            np.ascontiguousarray(coefficients), own.heights, _guess(own), MARGIN_PX / step,
            np.diff(self.location_grid.heights)[[0, -1]], TOLERANCE_PX / step,
        )  # fmt: skip
        object.__setattr__(self, "_numbers", numbers)

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`; Newton's method looks for the place in the image that sees the point."""
        xyz = np.ascontiguousarray(xyz, float)
        places = np.empty((len(xyz), 2))
        image_places(self._numbers, xyz, places)
        return np.asarray(places * self.location_grid.step + self.location_grid.first_node)

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xy = np.asarray(xy, float)
        xyz = np.empty((len(xy), 3))
        xyz[:, 2] = z
        places, found = (xy - self.location_grid.first_node) / self.location_grid.step, np.empty((len(xy), 2))
        ground_positions(self._numbers, places, np.ascontiguousarray(xyz[:, 2]), found)
        xyz[:, :2] = found
        xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
        return xyz

    def height_bounds(self) -> tuple[float, float]:
        """See `SensorModel`: the lowest and the highest height of the grid."""
        heights = self.location_grid.heights
        return float(heights[0]), float(heights[-1])

    def height_limits(self) -> tuple[float, float]:
        """See `Tabulated`."""
        heights = self.location_grid.heights
        return float(2 * heights[0] - heights[1]), float(2 * heights[-1] - heights[-2])


def spline_coefficients(values: FloatArray, axis: int) -> FloatArray:
    """Coefficients of the uniform cubic B-splines through values along an axis, which becomes longer by two.

    The third derivative is continuous one node inside of each end ("not a knot"). Three values give a parabola, two a
    straight line. Source: de Boor 1978, A Practical Guide to Splines, chapters IV and IX.
    """
    from scipy.linalg import solve_banded  # a tenth of a second that runs without such cameras do not need

    n = values.shape[axis]
    # The condition at the first end; that at the last one is its mirror image.
    end = {2: [1.0, -2.0, 1.0], 3: [1.0, -3.0, 3.0, -1.0]}.get(n, [1.0, -4.0, 6.0, -4.0, 1.0])
    # Element (i, j) of the equations is kept at (BAND + i - j, j), as LAPACK wants it.
    equations = np.zeros((2 * BAND + 1, n + 2))
    equations[BAND + 1, :-2], equations[BAND, 1:-1], equations[BAND - 1, 2:] = 1 / 6, 2 / 3, 1 / 6
    for k, factor in enumerate(end):
        equations[BAND - k, k] = equations[BAND + k, n + 1 - k] = factor
    moved = np.moveaxis(values, axis, 0)
    known = np.zeros((n + 2, moved[0].size))
    known[1:-1] = moved.reshape(n, -1)
    found = solve_banded((BAND, BAND), equations, known).reshape(n + 2, *moved.shape[1:])
    return np.asarray(np.moveaxis(found, 0, axis))


def _guess(location_grid: LocationGrid) -> FloatArray:
    """The affine map (2, 4) from x, y, z and 1 to column and row, in nodes, that fits some of the nodes best."""
    n_heights, n_rows, n_cols, _ = location_grid.xy.shape
    k, i, j = np.meshgrid(*(_spread(n) for n in (n_heights, n_rows, n_cols)), indexing="ij")
    points = np.column_stack([location_grid.xy[k, i, j].reshape(-1, 2), location_grid.heights[k].ravel()])
    middle = points.mean(axis=0)
    places = np.column_stack([j.ravel(), i.ravel()]).astype(float)
    slopes = np.linalg.lstsq(points - middle, places - places.mean(axis=0), rcond=None)[0].T
    return np.column_stack([slopes, places.mean(axis=0) - slopes @ middle])


def _spread(n: int) -> NDArray[np.intp]:
    """Some of n numbers, with the first and the last one."""
    return np.unique(np.linspace(0, n - 1, GUESS_NODES).round().astype(np.intp))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
