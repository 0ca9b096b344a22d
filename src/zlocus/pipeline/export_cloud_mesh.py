"""`zlocus export mesh` of a cloud: the maps of its images become one surface with walls, cube by cube."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.export_request import ExportRequest
from zlocus.core.footprints import Bounds
from zlocus.core.grid import CellWindow
from zlocus.core.progress import Progress
from zlocus.core.sensor_model import FloatArray, bare
from zlocus.io.staged_export import staged_export
from zlocus.pipeline.mesh_record import MeshFrame, write_mesh_record, write_mesh_tile
from zlocus.pipeline.opened_cloud import OpenedCloud, open_cloud
from zlocus.pipeline.setup import opencv_in_one_thread
from zlocus.products.cloud_maps import ImageMap, pixels_per_metre
from zlocus.products.exported_images import grey_limits, shown_bands
from zlocus.products.glb import TexturedMesh
from zlocus.products.mesh_charts import SurfaceViews, charted
from zlocus.products.mesh_texture import TextureImage
from zlocus.products.mesh_tileset import MeshTile
from zlocus.products.range_fusion import BLOCK, RangeMap, VoxelCube, close_below, fused
from zlocus.products.voxel_surface import QuadSurface, zero_surface
from zlocus.sensors.frame import FrameModel

# Of fewer points of a box with a pixel the window that shows the box is not told.
MIN_KNOWN_POINTS = 8
# Nodes along the side of a tile, in whole blocks; fewer where an image would show it on more than so many pixels.
MAX_TILE_NODES, MIN_TILE_NODES, TILE_PIXELS = 128, 32, 1024
# Nodes of a tile with all its heights and those around it: tall ones are narrower.
MAX_NODES = 8_000_000
# Nodes around a tile, so that tiles fit together and dust is told from a piece of a neighbour's surface.
MARGIN_NODES = BLOCK
# Side of a cell by default, in ground pixels.
CELL_PIXELS = 1.5
# Heights of different images are averaged where they differ by less than so many cells, or steps of the matching.
BAND_CELLS, BAND_STEPS = 3.0, 2.0
# A map that is finer is read in steps of several pixels.
PIXELS_PER_CELL, MAX_TEXELS_PER_CELL = 2.0, 8
# Rows of a map that tell the size of its pixels; all rows are looked at in so large parts and steps to find the tiles.
SAMPLED_ROWS, ROWS_AT_ONCE, SEARCH_STRIDE = 16, 256, 4
# Places along each side of a tile that are projected to find the part of an image that shows it, and a margin, px.
BOX_POINTS, MARGIN_PX = 5, 4
# A face that lies farther behind what its pixel shows is occluded, in parts of the band.
OCCLUDED_BANDS = 0.5
# Faces in squares of so many cells occlude each other.
OCCLUDER_CELLS = 1.5
# Faces are walls where they are this steep: the largest vertical part of their normal.
WALL_COSINE = 0.5


@dataclass(frozen=True)
class ColumnTile:
    """A tile of a mesh: a column of nodes.

    x, y : numbers of the tile on both axes; side : nodes along both; low, high : first node on the axis of heights, and
    the one behind the last.
    """

    x: int
    y: int
    side: int
    low: int
    high: int

    @property
    def n_nodes(self) -> int:
        """Nodes of the tile with those around it."""
        return (self.side + 2 * MARGIN_NODES) ** 2 * (self.high - self.low)

    @property
    def middle(self) -> tuple[float, float, float]:
        """Its middle, in nodes."""
        return (self.x + 0.5) * self.side, (self.y + 0.5) * self.side, (self.low + self.high) / 2

    def meets(self, bounds: Bounds, cell_m: float) -> bool:
        """Whether it overlaps bounds (m)."""
        side, (west, south, east, north) = self.side * cell_m, bounds
        return (
            self.x * side < east
            and (self.x + 1) * side > west
            and self.y * side < north
            and (self.y + 1) * side > south
        )

    def cube(self, cell_m: float) -> VoxelCube:
        """Its nodes with those around it."""
        side = self.side + 2 * MARGIN_NODES
        first = np.array([self.x * self.side - MARGIN_NODES, self.y * self.side - MARGIN_NODES, self.low])
        return VoxelCube(first, (side, side, self.high - self.low), cell_m)


@dataclass(frozen=True)
class CloudMeshSetup:
    """What all tiles share.

    per_cell : pixels of each image along the side of a cell; largest_side : nodes along the side of a tile that is not
    tall; band_m : distance from a map's surface within which it counts; bounds : of the mesh, m, None where it is not
    cut.
    """

    opened_cloud: OpenedCloud
    images: list[TextureImage]
    per_cell: list[float]
    cell_m: float
    band_m: float
    largest_side: int
    bounds: Bounds | None

    def nodes_between(self, low_m: float, high_m: float) -> tuple[int, int]:
        """First node for surfaces between two heights, and the one behind the last: whole blocks of them."""
        reach = self.band_m + 2 * self.cell_m
        block_m = BLOCK * self.cell_m
        return int(np.floor((low_m - reach) / block_m)) * BLOCK, int(np.ceil((high_m + reach) / block_m)) * BLOCK

    @property
    def strides(self) -> list[int]:
        """Pixels from one that is read of each map to the next."""
        return [max(int(n / PIXELS_PER_CELL), 1) for n in self.per_cell]

    @property
    def factors(self) -> list[int]:
        """Pixels of each image along the side of a texel."""
        return [max(int(np.ceil(n / MAX_TEXELS_PER_CELL)), 1) for n in self.per_cell]


def export_cloud_mesh(request: ExportRequest, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Write the mesh of a cloud, and return what was written, for people and as a record.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used or written.
    """
    folder, *others = request.inputs
    if others:
        raise InputError(f"{folder} is a cloud, which tells its images. Leave {others[0]} out.")
    if request.jump is not None:
        raise ConfigError("--jump says nothing to the mesh of a cloud, whose walls are measured. Leave it out.")
    with progress.stage("Opening images"):
        opened_cloud = open_cloud(folder, progress)
        setup = _setup(request, opened_cloud)
    tiles = _tiles(setup, _columns(setup, progress))
    if not tiles:
        raise GeometryError(f"The maps of {folder} have no height inside --bounds. Check them.")
    mesh_frame = MeshFrame.around(opened_cloud.crs, np.mean([tile.middle for tile in tiles], axis=0) * setup.cell_m)
    left, top = min(tile.x for tile in tiles), max(tile.y for tile in tiles)
    written = []
    with (
        staged_export(request.out) as stage,
        progress.stage("Mesh", len(tiles)) as counted,
        opencv_in_one_thread(),
    ):
        for tile in tiles:
            mesh_tile = _write_tile(stage, f"tile_{top - tile.y}_{tile.x - left}", setup, mesh_frame, tile)
            counted.advance()
            if mesh_tile is not None:
                written.append(mesh_tile)
        if not written:
            raise GeometryError(f"The maps of {folder} show no surface. Make the cloud with more images.")
        of_kind = {"cloud": str(folder), "cell_m": setup.cell_m, "band_m": setup.band_m}
        return write_mesh_record(stage, request, mesh_frame, written, of_kind)


def _setup(request: ExportRequest, opened_cloud: OpenedCloud) -> CloudMeshSetup:
    """Cells and images of the mesh."""
    densities = [_density(image_map) for image_map in opened_cloud.image_maps]
    known = [density for density in densities if np.isfinite(density)]
    if not known:
        raise GeometryError(f"The maps of {opened_cloud.folder} have no heights. Make the cloud with more images.")
    cell_m = request.resolution or CELL_PIXELS / float(np.median(known))
    images = []
    for image_map in opened_cloud.image_maps:
        bands = shown_bands(image_map.view.image)
        images.append(TextureImage(image_map.view.sensor, bands, grey_limits(bands)))
    per_cell = [cell_m * density if np.isfinite(density) else 1.0 for density in densities]
    band_m = max(BAND_CELLS * cell_m, BAND_STEPS * float(np.median(opened_cloud.step_m)))
    side = int(np.clip(TILE_PIXELS / max(per_cell), MIN_TILE_NODES, MAX_TILE_NODES))
    side = 2 ** int(np.log2(side))
    return CloudMeshSetup(opened_cloud, images, per_cell, cell_m, band_m, side, request.bounds)


def _density(image_map: ImageMap) -> float:
    """Median number of pixels per metre of what an image shows, perpendicular to its rays; NaN where its map has no
    height."""
    rows, cols = image_map.shape
    found = []
    for row in np.unique(np.linspace(0, rows - 1, SAMPLED_ROWS).astype(int)):
        points = image_map.read(CellWindow(int(row), 0, 1, cols)).points[0]
        found.append(pixels_per_metre(image_map.view, points[np.isfinite(points[:, 0])]))
    known = np.concatenate(found)
    return float(np.nanmedian(known)) if np.isfinite(known).any() else float("nan")


def _columns(setup: CloudMeshSetup, progress: Progress) -> dict[tuple[int, int], tuple[float, float]]:
    """Lowest and greatest height (m) of what may be seen in columns of `MIN_TILE_NODES` nodes along each side, by their
    numbers on both axes, and around it."""
    side_m, reach = MIN_TILE_NODES * setup.cell_m, MARGIN_NODES * setup.cell_m
    maps = setup.opened_cloud.image_maps
    found: dict[tuple[int, int], tuple[float, float]] = {}
    with progress.stage("Looking for tiles", len(maps)) as stage:
        for image_map in maps:
            rows, cols = image_map.shape
            for row in range(0, rows, ROWS_AT_ONCE):
                window = CellWindow(row, 0, min(ROWS_AT_ONCE, rows - row), cols)
                points = image_map.read(window, SEARCH_STRIDE).points.reshape(-1, 3)
                points = points[np.isfinite(points).all(axis=1)]
                for corner in ((-reach, -reach), (-reach, reach), (reach, -reach), (reach, reach)):
                    at = np.floor((points[:, :2] + corner) / side_m).astype(np.int64)
                    keys, number = np.unique(at, axis=0, return_inverse=True)
                    low, high = np.full(len(keys), np.inf), np.full(len(keys), -np.inf)
                    np.minimum.at(low, number.ravel(), points[:, 2])
                    np.maximum.at(high, number.ravel(), points[:, 2])
                    for (x, y), *ends in zip(keys.tolist(), low.tolist(), high.tolist(), strict=True):
                        known = found.get((x, y), (np.inf, -np.inf))
                        found[x, y] = min(known[0], ends[0]), max(known[1], ends[1])
            stage.advance()
    return found


def _tiles(setup: CloudMeshSetup, columns: dict[tuple[int, int], tuple[float, float]]) -> list[ColumnTile]:
    """The tiles of a mesh, in their order, as large as memory allows."""
    n = setup.largest_side // MIN_TILE_NODES
    while True:
        merged: dict[tuple[int, int], tuple[float, float]] = {}
        for (x, y), ends in columns.items():
            known = merged.get((x // n, y // n), ends)
            merged[x // n, y // n] = min(known[0], ends[0]), max(known[1], ends[1])
        tiles = [ColumnTile(x, y, n * MIN_TILE_NODES, *setup.nodes_between(*ends)) for (x, y), ends in merged.items()]
        tiles = [tile for tile in tiles if setup.bounds is None or tile.meets(setup.bounds, setup.cell_m)]
        largest = max(tiles, key=lambda tile: tile.n_nodes, default=None)
        if largest is not None and n == 1 and largest.n_nodes > MAX_NODES:
            low_m, high_m = merged[largest.x, largest.y]
            raise GeometryError(
                f"A part of the mesh reaches from {low_m:.0f} to {high_m:.0f} m, which is too high for its resolution "
                f"of {setup.cell_m:g} m. Give a larger --resolution, or --bounds without what lies far away."
            )
        if n == 1 or largest is None or largest.n_nodes <= MAX_NODES:
            return sorted(tiles, key=lambda tile: (-tile.y, tile.x))
        n //= 2


def _write_tile(
    stage: Path, name: str, setup: CloudMeshSetup, mesh_frame: MeshFrame, column_tile: ColumnTile
) -> MeshTile | None:
    """Write a tile; None where it has no surface."""
    cube = column_tile.cube(setup.cell_m)
    numbers, range_maps = _range_maps(setup, cube)
    values = fused(range_maps, cube, setup.band_m)
    close_below(values, range_maps, cube, setup.band_m)
    surface = zero_surface(values).without_dust()
    del values
    surface = surface.kept(_belongs(setup, surface, cube))
    if not len(surface):
        return None
    ground = (surface.vertices + cube.first) * setup.cell_m
    pixels = np.stack([one.image_map.view.sensor.image_from_ground(ground) for one in range_maps])
    middle = ground[surface.quads].mean(axis=1)
    seen = np.stack(
        [_is_seen(one, middle, setup, setup.per_cell[k]) for one, k in zip(range_maps, numbers, strict=True)]
    )
    images, factors = [setup.images[k] for k in numbers], [setup.factors[k] for k in numbers]
    surface_views = SurfaceViews.of(pixels, seen, surface.quads, images)
    chart = charted(images, surface_views, surface.quads, factors)
    xyz = ground[chart.vertex] - mesh_frame.origin
    origin = np.rint(xyz.mean(axis=0))
    corners = xyz[chart.quads]
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    n_walls = int((np.abs(across[:, 2]) < WALL_COSINE * np.linalg.norm(across, axis=1)).sum())
    x, y, z = map(float, origin)
    textured_mesh = TexturedMesh(xyz - origin, chart.uv, _triangles(corners, chart.quads), chart.texture, (x, y, z))
    return write_mesh_tile(stage, name, mesh_frame, textured_mesh, n_walls, chart.n_unseen)


def _is_seen(range_map: RangeMap, middles: FloatArray, setup: CloudMeshSetup, per_cell: float) -> NDArray[np.bool_]:
    """Whether faces are seen from a map's image: what its pixel shows is not nearer, or, where it has no height, no
    other face of the tile is. middles : (k, 3) m."""
    distance, _ = range_map.signed_distances(middles)
    nearness, side = range_map.image_map.nearness(middles), max(OCCLUDER_CELLS * per_cell, 1.0)
    at = np.floor(range_map.image_map.view.sensor.image_from_ground(middles) / side)
    known = np.isfinite(at).all(axis=1) & np.isfinite(nearness)
    _, number = np.unique(at[known], axis=0, return_inverse=True)
    nearest = np.full(int(known.sum()), -np.inf)
    np.maximum.at(nearest, number.ravel(), nearness[known])
    is_first = np.zeros(len(middles), bool)
    is_first[known] = nearness[known] > nearest[number.ravel()] - setup.band_m
    return np.where(np.isfinite(distance), distance > -OCCLUDED_BANDS * setup.band_m, is_first)


def _range_maps(setup: CloudMeshSetup, cube: VoxelCube) -> tuple[list[int], list[RangeMap]]:
    """The windows of the maps that may show a cube, with the numbers of their images."""
    ends = np.stack([cube.first, cube.first + cube.shape]) * setup.cell_m
    axes = np.linspace(ends[0] - setup.band_m, ends[1] + setup.band_m, BOX_POINTS).T
    box = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    numbers, range_maps = [], []
    for number, (image_map, stride) in enumerate(zip(setup.opened_cloud.image_maps, setup.strides, strict=True)):
        window = _window_of(image_map, box, MARGIN_PX * stride)
        if window is None:
            continue
        range_map = RangeMap.read(image_map, window, stride)
        if np.isfinite(range_map.cosine).any():
            numbers.append(number)
            range_maps.append(range_map)
    return numbers, range_maps


def _window_of(image_map: ImageMap, box: FloatArray, margin: int) -> CellWindow | None:
    """The pixels that may show a box, of which points (n, 3) m are given; None where there are none."""
    xy, (rows, cols) = image_map.view.sensor.image_from_ground(box), image_map.shape
    known = np.isfinite(xy).all(axis=1)
    if not known.any():
        return None
    low, high = xy[known].min(axis=0), xy[known].max(axis=0)
    if not known.all():
        # Beyond the disc in which a lens is one to one a point has no pixel. The edge of the disc lies between two
        # points of the box. A camera that has a part of the box behind it may see the rest anywhere.
        sensor = bare(image_map.view.sensor)
        is_in_front = isinstance(sensor, FrameModel) and bool((sensor.depth(box) > 0).all())
        if is_in_front and known.sum() >= MIN_KNOWN_POINTS:
            spacing = (high - low) / max(known.sum() ** (1 / 3) - 1.0, 1.0)
            low, high = low - spacing, high + spacing
        else:
            low, high = np.zeros(2), np.array([cols, rows]) - 1.0
    left, top = np.clip(np.floor(low).astype(np.int64) - margin, 0, [cols, rows])
    right, bottom = np.clip(np.ceil(high).astype(np.int64) + margin + 1, 0, [cols, rows])
    if left >= right or top >= bottom:
        return None
    return CellWindow(int(top), int(left), int(bottom - top), int(right - left))


def _belongs(setup: CloudMeshSetup, quad_surface: QuadSurface, cube: VoxelCube) -> NDArray[np.bool_]:
    """Which faces (k,) belong to the tile in the middle of a cube, and lie inside the bounds."""
    at = quad_surface.edges[:, :2] - MARGIN_NODES
    inside = ((at >= 0) & (at < np.array(cube.shape[:2]) - 2 * MARGIN_NODES)).all(axis=1)
    if setup.bounds is not None:
        place = (quad_surface.edges[:, :2] + cube.first[:2]) * setup.cell_m
        west, south, east, north = setup.bounds
        inside &= ((place >= [west, south]) & (place < [east, north])).all(axis=1)
    return np.asarray(inside)


def _triangles(corners: FloatArray, quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (2 k, 3) of quadrilaterals, cut along the shorter diagonal. corners : (k, 4, 3) m."""
    is_first = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=1) <= np.linalg.norm(
        corners[:, 3] - corners[:, 1], axis=1
    )
    turned = np.where(is_first[:, None], quads, np.roll(quads, -1, axis=1))
    triangles = np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]])
    return triangles
