"""Check, before any work, that the disk has room for a surface; from the headers of the images and the grid."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zlocus.core.errors import GeometryError, OutputError
from zlocus.core.footprints import shared_ground
from zlocus.core.grid import Grid
from zlocus.core.resources import DEFAULT_MEMORY_SHARE, free_bytes
from zlocus.core.scene import ColourSource, Scene, is_local
from zlocus.matching.ground_pixels import cell_side
from zlocus.matching.match_scene import MatchScene
from zlocus.pipeline.execution.checkpoint import FOLDER
from zlocus.pipeline.height_range import possible_heights
from zlocus.products.rasters import COLOURS

# Bytes of a cell in a finished tile: height and sigma (float32), quality (uint16), images used (uint8); and of each
# band of its ortho-image (float32). Finished tiles are kept, not compressed, until the surface is complete.
TILE_CELL_BYTES, TILE_BAND_BYTES = 11, 4
# Bytes of a cell in the rasters, which are kept on disk until each raster is complete; the ortho-image has a mask, and
# bands of the images' own data type.
RASTER_CELL_BYTES = 12
# Bytes of a pixel of a cloud on disk beside its finished tile: the heights and flags of all images, before and after
# the check across images.
CLOUD_PIXEL_BYTES = 21
# Bytes of a point while COPC is written: sorted on disk, and in the file.
COPC_POINT_BYTES = 47
# Smaller surfaces are started whatever the space: they take little time, and finished tiles are kept if the disk fills.
LEAST_REFUSED_BYTES = 1e9
# Before the tie points are known, a surface is refused only where it needs this many times the free space.
MARGIN_BEFORE_TIES = 2.0


def check_room(out: Path, grid: Grid, match_scene: MatchScene, has_colours: bool) -> None:
    """Refuse a surface that cannot be kept on the disk of `out` while it is made.

    has_colours : of the ortho-image. What an earlier run of the same kept in `out` needs no more room.

    Raises
    ------
    OutputError
        It takes more than the disk has free.
    """
    asked, matched = grid.window, grid.window.within(match_scene.overlap_window)
    n_bytes = surface_bytes(
        asked.rows * asked.cols, matched.rows * matched.cols, match_scene.views[0].image.dtype, has_colours
    )
    kept = sum(path.stat().st_size for path in (out / FOLDER).glob("*.npz")) if (out / FOLDER).is_dir() else 0
    _check(out, (asked.rows, asked.cols), grid.cell_m, n_bytes - kept, 1.0)


def check_room_before_ties(
    out: Path, scene: Scene, resolution: float | None, bounds: Sequence[float] | None, like: tuple[int, int] | None
) -> None:
    """Refuse, before images are read, a surface for which the disk of `out` is far too small wherever the ground lies.

    resolution : cell size, m, None is the images' ground pixel; bounds : (xmin, ymin, xmax, ymax) m of the area, None
    is the ground that two images see; like : rows and columns of the grid, where another raster gives it.

    Raises
    ------
    OutputError
        It takes several times what the disk has free.
    """
    if is_local(scene.crs):  # where the area is found from the tie points
        return
    has_colours = all(isinstance(view.image, ColourSource) and view.image.has_colours for view in scene.views)
    least: tuple[float, tuple[int, int], float] | None = None
    for z in possible_heights(scene, scene.heights):
        try:
            shared = shared_ground(scene, (z, z))
        except GeometryError:  # at this height nothing may be left to match
            return
        cell_m = cell_side(resolution, scene, z)
        low, high = np.array(bounds or scene.bounds or shared).reshape(2, 2)
        asked = (high - low) / cell_m
        matched = np.maximum(np.minimum(high, shared[2:]) - np.maximum(low, shared[:2]), 0.0) / cell_m
        if not np.isfinite([*asked, *matched]).all():
            return
        shape = (round(asked[1]), round(asked[0])) if like is None else like
        n_asked = math.prod(shape)
        n_matched = min(math.prod(matched.tolist()), n_asked)
        n_bytes = surface_bytes(n_asked, n_matched, scene.views[0].image.dtype, has_colours)
        if least is None or n_bytes < least[0]:
            least = n_bytes, shape, cell_m
    if least is not None:
        _check(out, least[1], least[2], least[0], MARGIN_BEFORE_TIES)


def check_room_for_pixels(out: Path, scene: Scene, references: Sequence[str]) -> None:
    """Refuse to match the pixels of images for which memory, and the disk of `out` beside it, have no room.

    references : names of the images whose pixels get heights.

    Raises
    ------
    OutputError
        They take more than both have free.
    """
    n_pixels = n_pixels_of(scene, references)
    needed, room = float(n_pixels) * (TILE_CELL_BYTES + TILE_BAND_BYTES), DEFAULT_MEMORY_SHARE * free_bytes()
    disk = _disk_of(out)
    if needed < LEAST_REFUSED_BYTES or disk is None or needed <= room + disk.free_bytes:
        return
    raise OutputError(
        f"To match the {n_pixels:.3g} pixels of {len(references)} images takes at least {needed / 1e9:.0f} GB, and "
        f"memory has {room / 1e9:.0f} GB for it and the disk of {disk.folder} {disk.free_bytes / 1e9:.0f} GB. Name "
        "fewer images with --reference, choose another disk with -o, or make a surface on the ground: zlocus dsm."
    )


def n_pixels_of(scene: Scene, names: Sequence[str]) -> int:
    """Number of the pixels of some images."""
    return sum(math.prod(view.image.shape) for view in scene.views if view.name in names)


def check_room_for_cloud(out: Path, n_pixels: int, n_images: int, has_copc: bool = False) -> None:
    """Refuse a cloud whose finished tiles and heights the disk of `out` has no room for; memory holds none of them.

    n_pixels : to be matched, of n_images reference images. What an earlier run of the same kept needs no more room.
    has_copc : whether COPC is written, too.

    Raises
    ------
    OutputError
        They take more than the disk has free.
    """
    kept = sum(path.stat().st_size for path in (out / FOLDER).glob("*.npz")) if (out / FOLDER).is_dir() else 0
    pixel_bytes = TILE_CELL_BYTES + TILE_BAND_BYTES + CLOUD_PIXEL_BYTES + has_copc * COPC_POINT_BYTES
    needed = float(n_pixels) * pixel_bytes - kept
    disk = _disk_of(out)
    if needed < LEAST_REFUSED_BYTES or disk is None or needed <= disk.free_bytes:
        return
    raise OutputError(
        f"To match the {n_pixels:.3g} pixels of {n_images} images takes at least {needed / 1e9:.0f} GB on disk, and "
        f"the disk of {disk.folder} has {disk.free_bytes / 1e9:.0f} GB free. Name fewer images with --reference, give "
        "a smaller area with --bounds, or choose another disk with -o."
    )


def surface_bytes(n_cells: float, n_matched: float, dtype: str, has_colours: bool) -> float:
    """Bytes on disk that a surface needs at least while it is made.

    n_cells : of its grid; n_matched : of them on ground that two images see; dtype : of the images.
    """
    n_bands = len(COLOURS) if has_colours else 1
    in_tiles = TILE_CELL_BYTES + TILE_BAND_BYTES * n_bands
    in_rasters = RASTER_CELL_BYTES + np.dtype(dtype).itemsize * n_bands
    return float(n_cells) * in_rasters + float(n_matched) * in_tiles


def _check(out: Path, shape: tuple[int, int], cell_m: float, n_bytes: float, margin: float) -> None:
    """Refuse what takes `margin` times the room on the disk of `out`. shape : rows and columns of the surface."""
    disk = _disk_of(out)
    if n_bytes < LEAST_REFUSED_BYTES or disk is None or n_bytes <= margin * disk.free_bytes:
        return
    raise OutputError(
        f"The surface would have {shape[0]} x {shape[1]} cells of {cell_m:.3g} m and needs at least "
        f"{n_bytes / 1e9:.0f} GB on disk while it is made, and the disk of {disk.folder} has "
        f"{disk.free_bytes / 1e9:.0f} GB free. Give smaller --bounds, a coarser --resolution, or another disk with -o."
    )


@dataclass(frozen=True)
class _Disk:
    """A disk. folder : an existing folder on it; free_bytes : free space."""

    folder: Path
    free_bytes: int


def _disk_of(out: Path) -> _Disk | None:
    """The disk of a folder that exists or will be made; None where its size is unknown."""
    folder = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    try:
        found = shutil.disk_usage(folder)
    except OSError:
        return None
    return _Disk(folder, found.free) if found.total else None
