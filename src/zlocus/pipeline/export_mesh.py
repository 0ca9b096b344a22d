"""`zlocus export mesh`: a surface as a textured mesh with walls, tile by tile, so that memory does not grow with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from odc.geo.geobox import GeoBox

from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.export_request import ExportRequest
from zlocus.core.footprints import Bounds, ground_sample_distance
from zlocus.core.progress import Progress
from zlocus.core.request_checks import check_inputs
from zlocus.core.scene import View, is_local
from zlocus.io.scene_file import open_scene
from zlocus.io.staged_export import staged_export
from zlocus.io.surface_heights import SurfaceHeights, open_surface
from zlocus.pipeline.mesh_record import MeshFrame, write_mesh_record, write_mesh_tile
from zlocus.pipeline.ortho import SURFACE, oriented_run
from zlocus.pipeline.setup import opencv_in_one_thread, sorted_views
from zlocus.products.exported_images import grey_limits, shown_bands
from zlocus.products.glb import TexturedMesh
from zlocus.products.mesh_geometry import CellPatches, Walls, surface_mesh
from zlocus.products.mesh_sight import MAX_CELLS, SurfaceWindow
from zlocus.products.mesh_texture import TextureImage, TextureLayout, mesh_texture
from zlocus.products.mesh_tileset import MeshTile
from zlocus.products.report.file_names import RECORD

# Cells along the side of a tile, and texels of its texture: fewer cells where a cell shows many pixels.
MAX_TILE_CELLS, MIN_TILE_CELLS, TILE_TEXELS = 256, 32, 1024
# Texels along the side of a cell, at most.
MAX_TEXELS_PER_CELL = 8
# Neighbours that differ by more cells than this have a wall between them.
JUMP_CELLS = 2.0
# Points along each side of a tile that are projected to find the images that may show it.
BOX_POINTS = 9


@dataclass(frozen=True)
class MeshSetup:
    """What all tiles share. geobox : of the cells of the mesh; mesh_frame : of its coordinates."""

    surface: SurfaceHeights
    images: list[TextureImage]
    geobox: GeoBox
    mesh_frame: MeshFrame
    jump_m: float
    per_cell: int

    @property
    def side(self) -> int:
        """Cells along the side of a tile."""
        return int(np.clip(TILE_TEXELS // self.per_cell, MIN_TILE_CELLS, MAX_TILE_CELLS))

    @property
    def tiles(self) -> list[tuple[int, int]]:
        """First row and column of each tile."""
        rows, cols = self.geobox.shape
        return [(row, col) for row in range(0, rows, self.side) for col in range(0, cols, self.side)]


def export_mesh(request: ExportRequest, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Write the mesh of a surface, and return what was written, for people and as a record.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used or written.
    """
    with progress.stage("Opening images"):
        surface, views = _opened(request)
    setup = _setup(request, surface, views)
    tiles = []
    with (
        staged_export(request.out) as stage,
        progress.stage("Mesh", len(setup.tiles)) as counted,
        opencv_in_one_thread(),
    ):
        for row, col in setup.tiles:
            tile = _write_tile(stage, setup, row, col)
            counted.advance()
            if tile is not None:
                tiles.append(tile)
        if not tiles:
            raise GeometryError(f"{surface.path} has no height inside --bounds. Check them.")
        of_kind = {
            "surface": str(surface.path), "jump_m": setup.jump_m, "cell_m": float(setup.geobox.transform.a),
            "texel_m": float(setup.geobox.transform.a) / setup.per_cell,
        }  # fmt: skip
        return write_mesh_record(stage, request, setup.mesh_frame, tiles, of_kind)


def _opened(request: ExportRequest) -> tuple[SurfaceHeights, Sequence[View]]:
    """The surface, and the views with the cameras from which it is textured."""
    first, *others = request.inputs
    if not first.is_dir():
        surface = open_surface(first, may_be_local=True)
        if not others:
            raise InputError(f"{first} is a raster without images. Name the images, or a scene.yaml, behind it.")
        return surface, _named_views(tuple(others), surface)
    if not (first / SURFACE).is_file():
        raise InputError(
            f"{first} is the folder of neither a surface ({SURFACE}) nor a cloud ({RECORD} of `zlocus cloud`). Give "
            "one of these, or a raster of heights."
        )
    surface = open_surface(first / SURFACE, may_be_local=True)
    if others:
        return surface, _named_views(tuple(others), surface)
    if not (first / RECORD).is_file():
        raise InputError(f"{first} has no {RECORD} that tells its images. Name them, or a scene.yaml, behind it.")
    try:
        scene, _ = oriented_run(first)
    except (KeyError, AttributeError) as error:
        raise InputError(f"{first / RECORD} is not what a run writes. Make the surface again.") from error
    return surface, scene.views


def _named_views(inputs: tuple[Path, ...], surface: SurfaceHeights) -> Sequence[View]:
    check_inputs(inputs, may_be_single=True)
    return sorted_views(open_scene(inputs, None if is_local(surface.crs) else surface.crs, least=1)).views


def _setup(request: ExportRequest, surface: SurfaceHeights, views: Sequence[View]) -> MeshSetup:
    """Cells, origin and texture of the mesh."""
    cell_m = request.resolution or surface.cell_m
    if cell_m < surface.cell_m:
        raise ConfigError(
            f"--resolution {cell_m:g} is finer than the surface, whose cells are {surface.cell_m:g} m. Give that or "
            "more."
        )
    per_side = max(round(cell_m / surface.cell_m), 1)
    geobox, cell_m = _cells(surface, request.bounds, per_side), per_side * surface.cell_m
    west, south, east, north = geobox.boundingbox.bbox
    middle = np.array([(west + east) / 2, (south + north) / 2, surface.median])
    images = []
    for view in views:
        bands = shown_bands(view.image)
        images.append(TextureImage(view.sensor, bands, grey_limits(bands)))
    pixels = [ground_sample_distance(view, surface.median) for view in views]
    known = [pixel for pixel in pixels if np.isfinite(pixel)]
    per_cell = int(np.clip(round(cell_m / np.median(known)), 1, MAX_TEXELS_PER_CELL)) if known else 1
    return MeshSetup(
        surface, images, geobox, MeshFrame.around(surface.crs, middle), request.jump or JUMP_CELLS * cell_m, per_cell
    )


def _write_tile(stage: Path, setup: MeshSetup, row: int, col: int) -> MeshTile | None:
    """Write a tile; None where the surface has no height in it."""
    rows, cols = (min(setup.side, n - first) for n, first in zip(setup.geobox.shape, (row, col), strict=True))
    around = _read_around(setup, row - 1, col - 1, rows + 2, cols + 2)
    patches, walls = surface_mesh(around, setup.jump_m)
    if not len(patches):
        return None
    transform = setup.geobox.transform
    margin = _margin(setup, around)
    window = SurfaceWindow(
        _read_around(setup, row - margin, col - margin, rows + 2 * margin, cols + 2 * margin), margin, margin,
        transform * transform.translation(col, row),
    )  # fmt: skip
    layout = TextureLayout.of((rows, cols), walls, setup.per_cell, window.cell_m)
    texture = mesh_texture(_images_near(setup, patches, window), patches, walls, layout, window)
    mesh = _mesh(patches, walls, layout, window, setup)
    textured_mesh = TexturedMesh(*mesh[:3], texture.values, mesh[3])
    name = f"tile_{row // setup.side}_{col // setup.side}"
    n_unseen = texture.n_unseen_patches + texture.n_unseen_walls
    return write_mesh_tile(stage, name, setup.mesh_frame, textured_mesh, len(walls), n_unseen)


def _cells(surface: SurfaceHeights, bounds: Bounds | None, per_side: int) -> GeoBox:
    """The cells of the mesh: squares of so many cells of the surface, those within the bounds or all."""
    (rows, cols), t = surface.shape, surface.transform
    first, last = np.zeros(2, int), np.array([rows, cols])
    if bounds is not None:
        west, south, east, north = bounds
        first = np.clip(np.floor([(north - t.f) / t.e + 1e-6, (west - t.c) / t.a + 1e-6]).astype(int), 0, last)
        last = np.clip(np.ceil([(south - t.f) / t.e - 1e-6, (east - t.c) / t.a - 1e-6]).astype(int), first, last)
    if not (last > first).all():
        raise GeometryError(f"{surface.path} has no height inside --bounds. Check them.")
    n_rows, n_cols = (-(-(last - first) // per_side)).tolist()
    start = t.translation(int(first[1]), int(first[0])) * t.scale(per_side)
    return GeoBox((n_rows, n_cols), t * start, surface.crs)


def _read_around(setup: MeshSetup, row: int, col: int, rows: int, cols: int) -> Any:
    """Heights (rows, cols) m of cells of the mesh, also beyond it; NaN where there are none.

    A cell has the height of the middle one of the surface's cells in it, so that no height appears between those of a
    roof and the ground.
    """
    transform = setup.geobox.transform
    n = round(float(transform.a) / setup.surface.cell_m)
    fine = transform * transform.translation(col, row) * transform.scale(1.0 / n)
    heights = setup.surface.read(GeoBox((rows * n, cols * n), fine, setup.geobox.crs))
    if n == 1:
        return heights
    cells = np.sort(heights.reshape(rows, n, cols, n).transpose(0, 2, 1, 3).reshape(rows, cols, n * n), axis=-1)
    middle = np.maximum(np.isfinite(cells).sum(axis=-1) - 1, 0) // 2
    return np.take_along_axis(cells, middle[..., None], axis=-1)[..., 0]


def _images_near(setup: MeshSetup, patches: CellPatches, window: SurfaceWindow) -> list[TextureImage]:
    """The images that may show a tile, so that memory does not grow with the number of all images."""
    low, high = (end(patches.outlines, axis=(0, 1)) for end in (np.min, np.max))
    axes = [np.linspace(start, stop, n) for start, stop, n in zip(low, high, (BOX_POINTS, BOX_POINTS, 2), strict=True)]
    points = window.ground(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    near = []
    for image in setup.images:
        xy = image.sensor.image_from_ground(points)
        xy = xy[np.isfinite(xy).all(axis=1)]
        if len(xy) and (xy.max(axis=0) >= 0).all() and (xy.min(axis=0) < image.bands.shape[::-1]).all():
            near.append(image)
    return near


def _margin(setup: MeshSetup, around: Any) -> int:
    """Cells around a tile in which the surface can stand before it, for the most oblique image."""
    transform, (rows, cols) = setup.geobox.transform, around.shape
    rise = max(setup.surface.z_range[1] - float(np.nanmin(around)), 0.0)
    t = transform
    middle = np.array([[t.c, t.f, float(np.nanmedian(around))]])
    reach = 0.0
    for image in setup.images:
        xy = image.sensor.image_from_ground(middle)
        above = image.sensor.ground_from_image(xy, middle[:, 2] + 1.0)
        lean = float(np.hypot(*(above - middle)[0, :2])) / t.a
        reach = max(reach, lean * rise if np.isfinite(lean) else 0.0)
    return int(min(np.ceil(1.2 * reach) + 2, MAX_CELLS, max(rows, cols) * 4))


def _mesh(
    patches: CellPatches, walls: Walls, layout: TextureLayout, window: SurfaceWindow, setup: MeshSetup
) -> tuple[Any, Any, Any, tuple[float, float, float]]:
    """Vertices (n, 3) m from the tile's origin, their texture coordinates (n, 2), triangles (t, 3), and that origin."""
    # Patches that belong together share their corners, which lie at the same place of the texture.
    corners = patches.outlines.reshape(-1, 3)
    unique, number = np.unique(corners, axis=0, return_inverse=True)
    number = number.reshape(-1, 4)
    uv = np.empty((len(unique), 2))
    uv[number.ravel()] = layout.patch_corners(patches).reshape(-1, 2)
    wall_number = len(unique) + np.arange(4 * len(walls)).reshape(-1, 4)
    quads = np.concatenate([number, wall_number])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    points = np.concatenate([unique, walls.outlines.reshape(-1, 3)])
    uv = np.concatenate([uv, _wall_uv(walls, layout)])
    ground = window.ground(points) - setup.mesh_frame.origin
    origin = np.rint(ground.mean(axis=0))
    xyz = ground - origin
    # Walls that end in a point have a triangle without area.
    a, b, c = (xyz[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    x, y, z = map(float, origin)
    return xyz, uv, triangles[area > 1e-9], (x, y, z)


def _wall_uv(walls: Walls, layout: TextureLayout) -> Any:
    """Texture coordinates (4 k, 2) of the corners of walls: their rectangles are as tall as the tallest end."""
    uv = layout.wall_corners()
    z = walls.outlines[..., 2]
    low, high = z[:, :2].min(axis=1, keepdims=True), z[:, 2:].max(axis=1, keepdims=True)
    if not len(walls):
        return np.empty((0, 2))
    share = (z - low) / np.maximum(high - low, 1e-9)
    bottom, top = uv[:, :1, 1], uv[:, 2:3, 1]
    return np.stack([uv[..., 0], bottom + share * (top - bottom)], axis=-1).reshape(-1, 2)
