"""Projection tables: image positions of a grid of ground cells as polynomials in height, at the corners of blocks.

Exact sensor models are never evaluated per cell. A table evaluates them at the corners of blocks of cells and at a few
heights; kernels interpolate between these. `projection_table` tabulates each block over all heights.
`projection_table_where_shown` tabulates each block over the heights at which the image shows it, for cameras so close
to the ground that a block leaves the image from one height to the next. Close cameras and lenses with distortion also
bend the rows and columns of a block; a table of bent blocks holds for blocks many times larger.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from itertools import product
from typing import Any

import numpy as np
from affine import Affine
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.mask_box import box_of
from zlocus.core.sensor_model import FloatArray, SensorModel

BoolArray = NDArray[np.bool_]
# A part of an image: first row, first column, number of rows, number of columns, px.
ImagePart = tuple[int, int, int, int]
# Rows and columns of one node of all blocks, for each node of a block.
NodeSlices = tuple[tuple[slice, slice], ...]

TOLERANCE_PX = 0.01
DEGREE = 3
# For cameras so close that their scale changes a lot from the lowest to the highest ground.
HIGHER_DEGREE, HIGHEST_DEGREE = 7, 11
# For raw lines of an unsteady flight, in which each height on an oblique ray belongs to another exposure. Above a
# degree of about 35 the coefficients lose their significant digits.
UNSTEADY_DEGREE = 31
# Position of corners that the sensor cannot map: outside of every image, and finite, because the kernels need that.
NOWHERE_PX = -1e9
# Heights t at which a table over all heights is compared with the exact model.
CHECKED_T = (-1.0, -0.7, 0.0, 0.7, 1.0)
# Heights of a block at which it is found out whether an image may show it.
HEIGHTS_LOOKED_AT = 5
# Number of heights at which the visibility of blocks is sampled. At these and between them a table is compared with the
# exact model.
N_SAMPLED_HEIGHTS = 17
# Chebyshev coefficients below this share of the tolerance are set to zero: as polynomials over a short part of the
# heights they would be large numbers that cancel.
NEGLIGIBLE_SHARE = 0.02
# Places within a block, as shares of its sides, at which a table is compared with the exact model: bilinear positions
# are worst in the middle, those that are bent through the middle between it and the corners, and at the edges.
CHECKED_PLACES, CHECKED_PLACES_IF_BENT = ((0.5, 0.5),), ((0.25, 0.25), (0.75, 0.75), (0.0, 0.5), (0.5, 1.0))


@dataclass(frozen=True)
class TableRequest:
    """What a projection table covers, and how exact it must be.

    transform : of the ground grid, from (column, row) of cell corners to x and y; shape : rows and columns of cells;
    block : cells along the side of a block; z_range : lowest and highest height, m; tolerance_px : largest distance
    from the exact model; degree : of the polynomials in height; is_bent : whether rows and columns of a block may bend.
    """

    transform: Affine
    shape: tuple[int, int]
    block: int
    z_range: tuple[float, float]
    tolerance_px: float = TOLERANCE_PX
    degree: int = DEGREE
    is_bent: bool = False

    @property
    def per_side(self) -> int:
        """Distances between nodes along the side of a block: nodes are its corners, and if it is bent the middles."""
        return 2 if self.is_bent else 1

    @property
    def node_rows(self) -> FloatArray:
        """(p,) rows of the cells at the nodes of all blocks."""
        return self._nodes(self.shape[0])

    @property
    def node_cols(self) -> FloatArray:
        """(q,) columns of the cells at the nodes of all blocks."""
        return self._nodes(self.shape[1])

    def _nodes(self, n_cells: int) -> FloatArray:
        return self.block / self.per_side * np.arange(-(-n_cells // self.block) * self.per_side + 1, dtype=np.float64)

    @property
    def nodes_of_blocks(self) -> NodeSlices:
        """Each of the nodes of all blocks, as slices of an array of nodes."""
        along = [slice(i, i - self.per_side or None, self.per_side) for i in range(self.per_side + 1)]
        return tuple(product(along, along))

    @property
    def checked_places(self) -> tuple[tuple[float, float], ...]:
        """Shares of the sides of a block at which the table is compared with the exact model."""
        return CHECKED_PLACES_IF_BENT if self.is_bent else CHECKED_PLACES

    @property
    def z_mid(self) -> float:
        """Middle of the heights, m."""
        return (self.z_range[0] + self.z_range[1]) / 2

    @property
    def z_half(self) -> float:
        """Half the range of heights, at least 0.5 m."""
        return max((self.z_range[1] - self.z_range[0]) / 2, 0.5)

    def error(self, gap_px: float) -> GeometryError:
        """The error of a table that is `gap_px` from the exact model."""
        return GeometryError(
            f"A projection table of {self.block} cells is {gap_px:.3g} px from the exact model (allowed "
            f"{self.tolerance_px} px) between heights {self.z_range[0]:.0f} and {self.z_range[1]:.0f} m. Use a smaller "
            "block or fewer heights."
        )


@dataclass(frozen=True)
class ProjectionTable:
    """Image positions at the corners of blocks of cells, as polynomials in height.

    nodes : (b + 1, d + 1, 2, n) float64, px: corner row, corner column, (x, y), coefficients of 1, t, t^2, ... with
    t = (z - z_mid) / z_half. The corner (b, d) is the centre of cell (b block, d block); between corners positions are
    bilinear. bends : (b, d, 2, 2, n) float64, px by squares of cells: what is added to them is r (r - block) times the
    first and c (c - block) times the second, r and c the row and the column within the block; n = 0 where nothing is.
    holds : (b, d) bool, blocks in which these positions are exact to the tolerance; the other blocks are not
    in the image, or the sensor cannot map all of them, and they count as not visible. lost : (b, d) bool, blocks that
    the image may show, at some of the heights, although the table does not hold there. ends : (b, d, 2), lowest and
    highest t at which the polynomials of a block hold.
    """

    nodes: FloatArray
    bends: FloatArray
    z_mid: float
    z_half: float
    holds: BoolArray
    lost: BoolArray
    ends: FloatArray


def projection_table(
    sensor: SensorModel, request: TableRequest, window: ImagePart | None = None, max_lost_share: float = 0.0
) -> ProjectionTable:
    """Projection table of a sensor in which each block is tabulated over all heights.

    window : the part of the image that counts, None is all that the sensor maps; max_lost_share : share of the blocks
    in which the table need not hold.

    Raises
    ------
    GeometryError
        The table is further than the tolerance from the exact model, at the centres of more blocks that the window
        shows than `max_lost_share` allows. A smaller block or a shorter range of heights is needed.
    """
    rows, cols, z_mid, z_half = request.node_rows, request.node_cols, request.z_mid, request.z_half
    degree, nodes_of_blocks = request.degree, request.nodes_of_blocks
    t = np.cos((np.arange(degree + 1) + 0.5) * np.pi / (degree + 1))
    fit = np.linalg.inv(np.vander(t, increasing=True))
    positions = _project_at_heights(sensor, request.transform, rows, cols, np.array([z_mid + z_half * v for v in t]))
    shown = np.zeros(positions.shape[:2], bool) if window is None else _shows_any(positions, window)
    known = np.asarray(np.isfinite(positions).all(axis=(2, 3)))
    nodes = positions @ fit.T
    nodes[~known] = NOWHERE_PX * (np.arange(degree + 1) == 0)
    whole = _over_nodes(np.logical_and, known, nodes_of_blocks)
    shows = _over_nodes(np.logical_or, shown, nodes_of_blocks)
    ends = np.broadcast_to((-np.inf, np.inf), (*whole.shape, 2))
    table = ProjectionTable(*_corners_and_bends(nodes, request), z_mid, z_half, whole, ~whole & shows, ends)
    gaps = _gaps_at_heights(table.nodes, table.bends, sensor, request, np.array(CHECKED_T)).max(axis=-1)
    unmapped = (~whole | np.isnan(gaps)) & shows
    bad = table.holds & (gaps > request.tolerance_px)
    if bad.any() and window is not None:
        bad &= may_show(table, window, request.block, gaps[..., None])
    if bad.sum() > max_lost_share * bad.size:
        raise request.error(float(gaps[bad].max()))
    return replace(table, holds=table.holds & (gaps <= request.tolerance_px), lost=bad | unmapped)


def projection_table_where_shown(
    sensor: SensorModel, request: TableRequest, window: ImagePart, max_lost_share: float, may_drop_heights: bool
) -> ProjectionTable:
    """Projection table of a sensor in which each block is tabulated over the heights at which the image shows it.

    Heights at which the table is further than the tolerance from the exact model are dropped, and with them the heights
    beyond. window : the part of the image that counts; max_lost_share : share of what the window shows (blocks times
    heights) that may be dropped or not be mapped; may_drop_heights : False refuses to drop any.

    Raises
    ------
    GeometryError
        More is dropped than `max_lost_share` or `may_drop_heights` allow.
    """
    rows, cols, z_mid, z_half = request.node_rows, request.node_cols, request.z_mid, request.z_half
    nodes_of_blocks, t = request.nodes_of_blocks, np.linspace(-1.0, 1.0, N_SAMPLED_HEIGHTS)
    positions = _project_at_heights(sensor, request.transform, rows, cols, z_mid + z_half * t)
    shown = shown_blocks(positions, window, nodes_of_blocks)
    first, last = _node_runs(shown, nodes_of_blocks)
    nodes = _fitted_nodes(sensor, request, np.stack([t[first], t[last]], axis=-1))
    fine = np.linspace(-1.0, 1.0, 2 * N_SAMPLED_HEIGHTS - 1)
    corners, bends = _corners_and_bends(nodes, request)
    gaps = _gaps_where_shown(corners, bends, sensor, request, fine, shown.around)
    begins, stops = (2 * f([k[node] for node in nodes_of_blocks], axis=0) for f, k in ((np.max, first), (np.min, last)))
    at = np.arange(len(fine))
    holds = _with_midpoints(shown.around) & (at >= begins[..., None]) & (at <= stops[..., None])
    holds &= gaps <= request.tolerance_px
    low, high = longest_run(holds)
    some = holds.any(axis=-1)
    kept = some[..., None] & (at >= low[..., None]) & (at <= high[..., None])
    bent = shown.near & ~kept[..., ::2]
    is_too_much = (shown.missed | bent).sum() > max_lost_share * (shown.near | shown.missed).sum()
    if (bent.any() and not may_drop_heights) or is_too_much:
        raise request.error(float(np.nanmax(gaps[..., ::2][shown.near], initial=0.0)))
    # A block that is shown at the lowest or highest height is shown beyond it too.
    low_t, high_t = np.where(low == 0, -np.inf, fine[low]), np.where(high == at[-1], np.inf, fine[high])
    ends = np.stack([np.where(some, low_t, np.inf), np.where(some, high_t, -np.inf)], axis=-1)
    lost = np.asarray((shown.missed | bent).any(axis=-1))
    return ProjectionTable(corners, bends, z_mid, z_half, some, lost, ends)


def project_cells(sensor: SensorModel, transform: Affine, rows: FloatArray, cols: FloatArray, z: float) -> FloatArray:
    """Image positions of cell centres at one height: (b, d, 2) px."""
    col, row = np.meshgrid(cols + 0.5, rows + 0.5)
    x, y = transform.a * col + transform.b * row + transform.c, transform.d * col + transform.e * row + transform.f
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return sensor.image_from_ground(xyz).reshape(len(rows), len(cols), 2)


def _project_at_heights(
    sensor: SensorModel, transform: Affine, rows: FloatArray, cols: FloatArray, heights: FloatArray
) -> FloatArray:
    """Image positions (b, d, 2, s) px of cells at heights (s,) m."""
    return np.stack([project_cells(sensor, transform, rows, cols, float(z)) for z in heights], axis=-1)


def _corners_and_bends(nodes: FloatArray, request: TableRequest) -> tuple[FloatArray, FloatArray]:
    """`ProjectionTable.nodes` and `bends` of polynomials (p, q, 2, n) at the nodes of all blocks."""
    if not request.is_bent:
        n_b, n_d = np.subtract(nodes.shape[:2], 1)
        return nodes, np.empty((n_b, n_d, 2, 2, 0))
    middle = nodes[1::2, 1::2]
    beside = (nodes[:-1:2, 1::2], nodes[2::2, 1::2]), (nodes[1::2, :-1:2], nodes[1::2, 2::2])
    bends = [(middle - 0.5 * (before + after)) * (-4.0 / request.block**2) for before, after in beside]
    known = nodes[..., 0, 0] > NOWHERE_PX
    is_whole = np.logical_and.reduce([known[node] for node in request.nodes_of_blocks])
    return nodes[::2, ::2], np.where(is_whole[..., None, None, None], np.stack(bends, axis=2), 0.0)


def polynomials_at(nodes: FloatArray, bends: FloatArray, block: int, place: tuple[float, float]) -> FloatArray:
    """Polynomials (b, d, 2, n) px of a table at a place within each block, as shares of the block's sides."""
    u, v = place
    top = (1 - v) * nodes[:-1, :-1] + v * nodes[:-1, 1:]
    low = (1 - v) * nodes[1:, :-1] + v * nodes[1:, 1:]
    straight = (1 - u) * top + u * low
    if not bends.shape[-1]:
        return np.asarray(straight)
    return np.asarray(straight + block**2 * (u * (u - 1) * bends[:, :, 0] + v * (v - 1) * bends[:, :, 1]))


def _gaps_at_heights(
    nodes: FloatArray, bends: FloatArray, sensor: SensorModel, request: TableRequest, t: FloatArray
) -> FloatArray:
    """Largest distance (b, d, s) px of a table from the exact model, over places within blocks, at heights t (s,); NaN
    where the sensor cannot map one."""
    powers, heights = np.vander(t, request.degree + 1, increasing=True).T, request.z_mid + request.z_half * t
    rows, cols = request.node_rows[: -1 : request.per_side], request.node_cols[: -1 : request.per_side]
    worst = np.zeros((len(rows), len(cols), len(t)))
    for u, v in request.checked_places:
        exact = _project_at_heights(
            sensor, request.transform, rows + u * request.block, cols + v * request.block, heights
        )  # fmt: skip
        found = polynomials_at(nodes, bends, request.block, (u, v)) @ powers
        worst = np.maximum(worst, np.linalg.norm(found - exact, axis=2))
    return worst


def _gaps_where_shown(
    nodes: FloatArray, bends: FloatArray, sensor: SensorModel, request: TableRequest, t: FloatArray, shown: BoolArray
) -> FloatArray:
    """`_gaps_at_heights` (b, d, s), found only in the rows and columns of blocks that are shown at some height.

    They are infinite in the others. shown : (b, d, k).
    """
    gaps = np.full((*shown.shape[:2], len(t)), np.inf)
    if not shown.any():
        return gaps
    rows, cols = box_of(np.asarray(shown.any(axis=-1)))
    part = replace(
        request,
        transform=request.transform @ Affine.translation(cols.start * request.block, rows.start * request.block),
        shape=((rows.stop - rows.start) * request.block, (cols.stop - cols.start) * request.block),
    )
    corners = nodes[rows.start : rows.stop + 1, cols.start : cols.stop + 1]
    gaps[rows, cols] = _gaps_at_heights(corners, bends[rows, cols], sensor, part, t)
    return gaps


def _shows_any(positions: FloatArray, window: ImagePart) -> BoolArray:
    """Corners (b, d) of which any of the n positions (b, d, 2, n) px lies in a window."""
    row, col, n_rows, n_cols = window
    x, y = positions[:, :, 0], positions[:, :, 1]
    inside = (x >= col) & (x <= col + n_cols - 1) & (y >= row) & (y <= row + n_rows - 1)
    return np.asarray(inside.any(axis=-1))


def may_show(
    table: ProjectionTable, window: ImagePart, block: int, margin_px: FloatArray | float, margin_cells: float = 0.0
) -> BoolArray:
    """Blocks (b, d) that a window may show.

    The box around their corners and middles, at the heights at which the table holds, meets the window. margin_px,
    margin_cells : by which the box is widened on each side, px (of any shape that fits (b, d, 2)) and cells.
    """
    places = ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0), (0.5, 0.5))
    # Tables are made over -1 to 1; some hold beyond.
    first, last = np.moveaxis(np.clip(table.ends, -1.0, 1.0), -1, 0)[..., None]
    t = first + np.linspace(0.0, 1.0, HEIGHTS_LOOKED_AT) * (last - first)
    powers = t[..., None] ** np.arange(table.nodes.shape[-1])
    at = [
        np.einsum("bdxn,bdtn->bdxt", polynomials_at(table.nodes, table.bends, block, place), powers) for place in places
    ]
    low, high = np.min(at, axis=(0, -1)), np.max(at, axis=(0, -1))
    margin = margin_px + margin_cells / block * (high - low)
    row, col, n_rows, n_cols = window
    with np.errstate(invalid="ignore"):
        meets = (high + margin >= (col, row)) & (low - margin <= (col + n_cols - 1, row + n_rows - 1))
    return np.asarray(meets.all(axis=-1))


@dataclass(frozen=True)
class ShownBlocks:
    """Which blocks an image shows at s heights, (b, d, s) bool each.

    near : blocks that may be in the image and whose nodes the sensor maps; around : these, and the same blocks
    at the heights before and after, between which a block enters or leaves the image; missed : blocks that may be in
    the image although the sensor does not map one of their nodes.
    """

    near: BoolArray
    around: BoolArray
    missed: BoolArray


def shown_blocks(positions: FloatArray, window: ImagePart, nodes_of_blocks: NodeSlices) -> ShownBlocks:
    """Which blocks a window shows: those whose box around the known nodes meets the window.

    positions : (p, q, 2, s) px, of the nodes at s heights, NaN where unknown; nodes_of_blocks : see `TableRequest`.
    """
    row, col, n_rows, n_cols = window
    known = np.asarray(np.isfinite(positions).all(axis=2))
    here = known[:, :, None]
    low = _over_nodes(np.minimum, np.where(here, positions, np.inf), nodes_of_blocks)
    high = _over_nodes(np.maximum, np.where(here, positions, -np.inf), nodes_of_blocks)
    first, last = np.array([col, row])[:, None], np.array([col + n_cols - 1, row + n_rows - 1])[:, None]
    meets = ((high >= first) & (low <= last)).all(axis=2)
    whole = _over_nodes(np.logical_and, known, nodes_of_blocks)
    near = meets & whole
    around = near.copy()
    around[..., 1:] |= near[..., :-1]
    around[..., :-1] |= near[..., 1:]
    return ShownBlocks(near, around & whole, meets & ~whole)


def _over_nodes(reduced: np.ufunc, values: NDArray[Any], nodes_of_blocks: NodeSlices) -> NDArray[Any]:
    """Values (p, q, ...) of nodes reduced over the nodes of each block, (b, d, ...): along rows, then along columns."""
    rows, cols = ({(at.start, at.stop, at.step) for at in along} for along in zip(*nodes_of_blocks, strict=True))
    of_rows = reduce(reduced, (values[slice(*part)] for part in rows))
    return np.asarray(reduce(reduced, (of_rows[:, slice(*part)] for part in cols)))


def _with_midpoints(flags: BoolArray) -> BoolArray:
    """Flags (..., s) at heights with one more flag between each two heights, set where both are: (..., 2 s - 1)."""
    out = np.empty((*flags.shape[:-1], 2 * flags.shape[-1] - 1), bool)
    out[..., ::2], out[..., 1::2] = flags, flags[..., :-1] & flags[..., 1:]
    return out


def _node_runs(shown_blocks: ShownBlocks, nodes_of_blocks: NodeSlices) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last height index (p, q) of the longest run of heights at which a block around each node is shown.

    Where there is none, the first index is the larger one.
    """
    n_b, n_d, n = shown_blocks.around.shape
    per_side = max(rows.start for rows, _ in nodes_of_blocks)
    around = np.zeros((per_side * n_b + 1, per_side * n_d + 1, n), bool)
    for node in nodes_of_blocks:
        around[node] |= shown_blocks.around
    first, last = longest_run(around)
    some = around.any(axis=-1)
    return np.where(some, first, n - 1), np.where(some, last, 0)


def longest_run(flags: BoolArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last index (...) of the longest run of set flags (..., s); zeros where there is none."""
    run = np.zeros(flags.shape[:-1], np.int64)
    longest, last = run.copy(), run.copy()
    for k in range(flags.shape[-1]):
        run = np.where(flags[..., k], run + 1, 0)
        is_longer = run > longest
        longest, last = np.where(is_longer, run, longest), np.where(is_longer, k, last)
    return np.maximum(last - longest + 1, 0), last


def _fitted_nodes(sensor: SensorModel, request: TableRequest, ends: FloatArray) -> FloatArray:
    """Polynomials in t (p, q, 2, n) px through Chebyshev nodes between the ends of each node of the blocks.

    ends : (p, q, 2), lowest and highest t of each node; where the lowest is larger, the node has none and its
    polynomial is the constant NOWHERE_PX.
    """
    rows, cols, transform, degree = request.node_rows, request.node_cols, request.transform, request.degree
    nodes = np.zeros((len(rows), len(cols), 2, degree + 1))
    nodes[..., 0] = NOWHERE_PX
    at = ends[..., 0] <= ends[..., 1]
    low, high = ends[at].T
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-3)
    s = np.cos((np.arange(degree + 1) + 0.5) * np.pi / (degree + 1))
    b, d = np.nonzero(at)
    col, row = cols[d] + 0.5, rows[b] + 0.5
    x, y = transform.a * col + transform.b * row + transform.c, transform.d * col + transform.e * row + transform.f
    z = request.z_mid + request.z_half * (middle[:, None] + half[:, None] * s)
    xyz = np.column_stack([np.repeat(x, len(s)), np.repeat(y, len(s)), z.ravel()])
    values = sensor.image_from_ground(xyz).reshape(-1, len(s), 2)
    waves = np.linalg.inv(chebyshev.chebvander(s, degree)) @ values
    tail = np.cumsum(np.abs(waves)[:, ::-1], axis=1)[:, ::-1].max(axis=2)
    waves[tail < NEGLIGIBLE_SHARE * request.tolerance_px] = 0.0
    local = np.einsum("cnx,np->cxp", waves, _powers_from_chebyshev(degree))
    nodes[at] = in_powers_of_t(local, middle, half)
    nodes[at] = np.where(np.isfinite(nodes[at]).all(axis=(1, 2), keepdims=True), nodes[at], NOWHERE_PX)
    return nodes


def _powers_from_chebyshev(degree: int) -> FloatArray:
    """(n, n) coefficients of 1, s, s^2, ... of each Chebyshev polynomial up to a degree."""
    return np.array([np.pad(chebyshev.cheb2poly(np.eye(k + 1)[k]), (0, degree - k)) for k in range(degree + 1)])


def in_powers_of_t(local: FloatArray, middle: FloatArray, half: FloatArray) -> FloatArray:
    """Polynomials (c, 2, n) in (t - middle) / half as polynomials in t, by Horner's scheme. middle, half : (c,)."""
    out = np.zeros_like(local)
    a, b = (1.0 / half)[:, None, None], (-middle / half)[:, None, None]
    for k in range(local.shape[-1] - 1, -1, -1):
        raised = b * out
        raised[..., 1:] += a * out[..., :-1]
        out = raised
        out[..., 0] += local[..., k]
    return out
