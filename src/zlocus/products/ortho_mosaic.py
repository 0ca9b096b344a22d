"""Mosaic of ortho-images: seams where neighbouring images differ least, and levelled colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.footprints import Bounds
from zlocus.core.grid import grid_from_bounds
from zlocus.core.parallel import run_all
from zlocus.core.progress import Progress
from zlocus.core.sensor_model import FloatArray
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.surface_heights import SurfaceHeights
from zlocus.matching.colour_levels import ColourLevels, colour_levels, overlap_of
from zlocus.matching.seams import preferred_images, seamed_images
from zlocus.products.number_names import IMAGES, number_tag
from zlocus.products.ortho_images import OrthoBlock, OrthoSource, blocks_of, ortho_block, raster_bands, stored

# A block of the mosaic, the cells around it that its seams depend on, how far seams may lie from the preferred border,
# and the distance of the nodes at which images are compared.
BLOCK_CELLS, HALO_CELLS, BAND_CELLS, NODE_CELLS = 512, 96, 64, 32
# So many images are looked at in each place: the best, and others that show what the surface hides from it.
MAX_IMAGES = 4
# Colours are compared in cells of so many pixels, and larger ones where there would be more than so many.
SAMPLE_CELLS, MAX_SAMPLES = 8, 200_000


@dataclass(frozen=True, eq=False)
class MosaicPlan:
    """A mosaic to be made.

    sources, areas : the images, and the ground that each shows; centrality : of each, see `ImageBands.centrality`;
    cell_m : side of a pixel, m; geobox : of the mosaic; levels : of the images' colours; contrast : of the levelled
    grey values.
    """

    sources: Sequence[OrthoSource]
    areas: Sequence[Bounds]
    centrality: Sequence[NDArray[np.float32]]
    surface: SurfaceHeights
    cell_m: float
    geobox: GeoBox
    levels: ColourLevels
    contrast: float

    def near(self, bounds: Bounds) -> list[int]:
        """Numbers of the images whose ground meets bounds."""
        west, south, east, north = bounds
        return [
            k for k, area in enumerate(self.areas)
            if area[0] < east and west < area[2] and area[1] < north and south < area[3]
        ]  # fmt: skip


def planned_mosaic(
    sources: Sequence[OrthoSource], areas: Sequence[Bounds], surface: SurfaceHeights, cell_m: float, is_levelled: bool,
    progress: Progress, workers: int,
) -> MosaicPlan:  # fmt: skip
    """Look at the images of a mosaic, and compare their colours where they overlap. is_levelled : whether to."""
    west, south, east, north = (end(np.array(areas)[:, k]) for k, end in enumerate((np.min, np.min, np.max, np.max)))
    bounds = float(west), float(south), float(east), float(north)
    geobox = grid_from_bounds(bounds, cell_m, surface.crs).geobox
    n_bands = len(sources[0].bands.bands)
    side = max(SAMPLE_CELLS * cell_m, float(np.sqrt((bounds[2] - bounds[0]) * (bounds[3] - bounds[1]) / MAX_SAMPLES)))
    coarse = grid_from_bounds(bounds, side, surface.crs).geobox
    samples = [
        _sampled(source, area, surface, coarse, progress, workers) for source, area in zip(sources, areas, strict=True)
    ]
    overlaps = []
    for i, j in np.ndindex(len(sources), len(sources)):
        shared = None if i >= j else _shared_values(samples[i], samples[j])
        found = None if shared is None else overlap_of(i, j, shared)
        if found is not None:
            overlaps.append(found)
    levels = colour_levels(len(sources), n_bands, overlaps) if is_levelled else ColourLevels.none(len(sources), n_bands)
    contrast = float(np.median([each.spread.mean() for each in overlaps])) if overlaps else 1.0
    centrality = [source.bands.centrality() for source in sources]
    return MosaicPlan(sources, areas, centrality, surface, cell_m, geobox, levels, contrast)


@dataclass(frozen=True, eq=False)
class _Samples:
    """A reduced ortho-image. row, col : of its first cell on the common grid; values : (b, r, c); valid : (r, c)."""

    row: int
    col: int
    values: NDArray[np.floating]
    valid: NDArray[np.bool_]


def _sampled(
    source: OrthoSource, area: Bounds, surface: SurfaceHeights, coarse: GeoBox, progress: Progress, workers: int
) -> _Samples:
    """The ortho-image of an image in large cells. coarse : their grid."""
    inverse, (rows, cols) = ~coarse.transform, coarse.shape
    (left, top), (right, bottom) = inverse * (area[0], area[3]), inverse * (area[2], area[1])
    first_row, first_col = max(int(top), 0), max(int(left), 0)
    part = coarse[first_row : min(int(bottom) + 1, rows), first_col : min(int(right) + 1, cols)]
    values = np.zeros((len(source.bands.bands), *part.shape), np.float32)
    valid = np.zeros(tuple(part.shape), bool)
    blocks = list(blocks_of(part, float(coarse.transform.a) / source.pixel_m))

    def make(block: tuple[int, int, GeoBox]) -> OrthoBlock | None:
        return ortho_block(source, surface, block[2])

    with progress.stage(f"Colours of {source.name}", len(blocks)) as stage:
        for (row, col, _), made in run_all(make, blocks, workers):
            if made is not None:
                inside = slice(row, row + made.valid.shape[0]), slice(col, col + made.valid.shape[1])
                values[:, *inside], valid[inside] = made.values, made.valid
            stage.advance()
    return _Samples(first_row, first_col, values, valid)


def _shared_values(one: _Samples, other: _Samples) -> NDArray[np.floating] | None:
    """Values (2, b, n) of the cells that two images show; None where there is none."""
    row, col = max(one.row, other.row), max(one.col, other.col)
    last_row = min(each.row + each.valid.shape[0] for each in (one, other))
    last_col = min(each.col + each.valid.shape[1] for each in (one, other))
    if row >= last_row or col >= last_col:
        return None
    parts = [(slice(row - each.row, last_row - each.row), slice(col - each.col, last_col - each.col))
             for each in (one, other)]  # fmt: skip
    both = one.valid[parts[0]] & other.valid[parts[1]]
    return np.stack([each.values[:, *part][:, both] for each, part in zip((one, other), parts, strict=True)])


def write_mosaic(path: Path, images_path: Path, plan: MosaicPlan, progress: Progress, workers: int) -> dict[str, int]:
    """Write a mosaic, and which image shows each of its pixels; return the number of pixels of each image by its name.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    first, (rows, cols) = plan.sources[0], plan.geobox.shape
    blocks = [(row, col) for row in range(0, rows, BLOCK_CELLS) for col in range(0, cols, BLOCK_CELLS)]
    names = number_tag([source.name for source in plan.sources])
    image_bands = RasterBands(np.uint16, 0, ("number of the image",), tags={IMAGES: names})
    total = np.zeros(len(plan.sources) + 1, np.int64)
    with (
        RasterSink(path, plan.geobox, raster_bands(first)) as sink,
        RasterSink(images_path, plan.geobox, image_bands) as images,
        progress.stage("Mosaic", len(blocks)) as stage,
    ):
        for (row, col), made in run_all(lambda block: _mosaic_block(plan, *block), blocks, workers):
            if made is not None:
                values, number = made
                sink.write(row, col, stored(values, first.bands.dtype), number > 0)
                images.write(row, col, number)
                total += np.bincount(number.ravel(), minlength=len(total))
            stage.advance()
    return {source.name: int(n) for source, n in zip(plan.sources, total[1:], strict=True)}


def _mosaic_block(plan: MosaicPlan, row: int, col: int) -> tuple[NDArray[np.floating], NDArray[np.uint16]] | None:
    """Values (b, r, c) of a block of the mosaic and the numbers (r, c) of its images, from 1; None where none shows
    it."""
    rows, cols = plan.geobox.shape
    top, left = max(row - HALO_CELLS, 0), max(col - HALO_CELLS, 0)
    bottom, right = (min(at + BLOCK_CELLS + HALO_CELLS, end) for at, end in ((row, rows), (col, cols)))
    part = plan.geobox[top:bottom, left:right]
    bounds = part.boundingbox.bbox
    near = plan.near((bounds[0], bounds[1], bounds[2], bounds[3]))
    if not near:
        return None
    scores = _node_scores(plan, near, part)
    order = np.sort(np.argsort(-scores, axis=0)[:MAX_IMAGES].reshape(-1))
    kept = [k for k in np.unique(order).tolist() if np.isfinite(scores[k]).any()]
    blocks = [(k, ortho_block(plan.sources[near[k]], plan.surface, part)) for k in kept]
    shown = [(k, block) for k, block in blocks if block is not None and block.valid.any()]
    if not shown:
        return None
    values = np.stack([plan.levels.levelled(block.values, near[k]) for k, block in shown])
    may_show = np.stack([block.valid for _, block in shown])
    score = np.stack([_on_cells(scores[k], (part.shape[0], part.shape[1])) for k, _ in shown])
    preferred = preferred_images(score, may_show)
    grey = values.mean(axis=1).astype(np.float32)
    labels = seamed_images(preferred, grey, may_show, BAND_CELLS, plan.contrast)
    inside = (
        slice(row - top, min(row + BLOCK_CELLS, rows) - top), slice(col - left, min(col + BLOCK_CELLS, cols) - left)
    )  # fmt: skip
    labels, values = labels[inside], values[:, :, *inside]
    numbers = np.array([near[k] + 1 for k, _ in shown], np.uint16)
    chosen = np.maximum(labels, 0)
    out = np.take_along_axis(values, chosen[None, None], axis=0)[0]
    return out, np.where(labels >= 0, numbers[chosen], 0).astype(np.uint16)


def _node_scores(plan: MosaicPlan, near: Sequence[int], part: GeoBox) -> FloatArray:
    """How well images show nodes of a block, (k, a, b): near the middle of the image, on small pixels; -inf outside."""
    rows, cols = part.shape
    row, col = (np.arange(0, n + NODE_CELLS, NODE_CELLS) for n in (rows, cols))
    nodes = GeoBox((len(row), len(col)), part.transform * part.transform.scale(NODE_CELLS), part.crs)
    z = plan.surface.read(nodes)
    usual = float(np.nanmedian(z)) if np.isfinite(z).any() else plan.surface.median
    z = np.where(np.isfinite(z), z, usual)
    west, north = part.transform * (0.5, 0.5)
    x, y = np.meshgrid(west + plan.cell_m * col, north - plan.cell_m * row)
    xyz = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    finest = min(source.pixel_m for source in plan.sources)
    scores = np.full((len(near), len(row), len(col)), -np.inf)
    for k, number in enumerate(near):
        source, known = plan.sources[number], plan.centrality[number]
        xy = source.sensor.image_from_ground(xyz)
        scale = np.array([known.shape[1] / source.bands.shape[1], known.shape[0] / source.bands.shape[0]])
        with np.errstate(invalid="ignore"):
            at = np.floor((xy + 0.5) * scale)
            inside = ((at >= 0) & (at < known.shape[::-1])).all(axis=1)
        where = np.where(inside[:, None], at, 0).astype(int)
        score = np.where(inside, known[where[:, 1], where[:, 0]] * finest / source.pixel_m, -np.inf)
        scores[k] = score.reshape(scores.shape[1:])
    return scores


def _on_cells(nodes: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Values of nodes (a, b) on the cells (r, c) of a block, bilinear; nodes outside of the image count as 0."""
    known = np.where(np.isfinite(nodes), nodes, 0.0)
    down, across = (
        np.column_stack([np.interp(np.arange(n) / NODE_CELLS, np.arange(k), one) for one in np.eye(k)])
        for n, k in zip(shape, nodes.shape, strict=True)
    )
    return np.asarray(down @ known @ across.T)
