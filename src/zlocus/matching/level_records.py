"""Records that the stages of a tile pass on: the tile's inputs, a pyramid level, the search prior, and a level's
result.

How heights are indexed in them: see `zlocus.matching.height_lattice`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.matching.height_lattice import HeightLattice, by_block
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.occlusion import PAIR, covers
from zlocus.matching.semiglobal import SemiGlobalHeights
from zlocus.matching.slope_surface import CoarserSlope, SlopeSurface
from zlocus.matching.tile_views import TileViews
from zlocus.matching.view_pixels import ViewPixels, read_pixels, unseen, window_showing

# Points along each side of a window of cells whose projections say which pixels are read.
READ_POINTS_PER_SIDE = 9
# Before a surface is used as an occluder it is eroded, because matching widens roofs: by about two cells where the
# surface comes from the coarser level, by one cell where it comes from an earlier round of the same level.
ERODE_COARSER_SURFACE = np.ones((5, 5), np.uint8)
ERODE_OWN_SURFACE = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class TileInputs:
    """Everything that a tile is matched from.

    match_scene : the scene; core_window : finest cells whose surface is wanted, without halo; view_numbers : the views
    of the scene that take part, the reference image first; method : mvll-sgm, mvll without the semi-global constraint,
    or gc3-sgm in image space; choose_images : whether each block is matched with a choice of the images, else with all
    of them.
    """

    match_scene: MatchScene
    core_window: CellWindow
    config: RunConfig
    view_numbers: Sequence[int]
    method: str = "mvll-sgm"
    choose_images: bool = False

    @property
    def handles_occlusion(self) -> bool:
        """Whether images can be excluded where a surface occludes them, which takes three images.

        A height that is wrong occludes as much as one that is right. If one of two images were excluded for it, no
        comparison would be left to correct the error.
        """
        return len(self.view_numbers) > PAIR

    def read(self, window: CellWindow, level: int, z_range: tuple[float, float]) -> list[ViewPixels]:
        """Pixels of a level of all views, as far as they show a window of its cells between two heights (m)."""
        match_scene, ground = self.match_scene, self.match_scene.points_of(window, level, READ_POINTS_PER_SIDE)
        found = []
        for number in self.view_numbers:
            view, scale = match_scene.views[number], match_scene.grey_scales[number]
            part = window_showing(view, ground, z_range, level)
            found.append(unseen(view, scale, level) if part is None else read_pixels(view, part, scale, level))
        return found

    def level(self, number: int, limit_window: CellWindow | None = None) -> PyramidLevel:
        """A pyramid level of this tile with its halo. limit_window : cells of that level beyond which nothing is
        matched; None: the cells that two views of the scene may see."""
        match_scene, options = self.match_scene, self.config.pyramid
        limit_window = match_scene.overlap_window.at_level(number, 0) if limit_window is None else limit_window
        window = level_window(self.core_window, number, options.halo, options.block, limit_window)
        return PyramidLevel.of(match_scene, self.core_window, number, window)


def level_window(core_window: CellWindow, number: int, halo: int, block: int, limit_window: CellWindow) -> CellWindow:
    """Cells of a level: those of a tile's core and `halo` more on each side, inside `limit_window`.

    The window begins a whole number of blocks before the core, so that the blocks lie at the same places whatever the
    halo; it may therefore begin before `limit_window`.
    """
    window = core_window.at_level(number, halo).within(limit_window)
    row, col = (
        first - (first - own) % block
        for first, own in ((window.row, core_window.row >> number), (window.col, core_window.col >> number))
    )
    return CellWindow(row, col, window.rows + window.row - row, window.cols + window.col - col)


@dataclass(frozen=True)
class PyramidLevel:
    """One level of the pyramid over a tile.

    number : 0 is the finest; window : its cells, halo included; core : rows and columns of the window that belong to
    the tile's core (decisions for the whole tile are computed from these cells only, so that they do not depend on the
    halo); transform : from cell corners to the ground; cell_size : side of a cell; height_origin, height_step : height
    of level index 0, and height step of the level; n_steps : steps of the scene's height range.
    """

    number: int
    window: CellWindow
    core: tuple[slice, slice]
    transform: Affine
    cell_size: float
    height_origin: float
    height_step: float
    n_steps: int

    @classmethod
    def of(cls, match_scene: MatchScene, core_window: CellWindow, number: int, window: CellWindow) -> PyramidLevel:
        """A level of a scene over a window of its cells."""
        return cls(
            number=number,
            window=window,
            core=core_window.at_level(number, 0).within(window).slices_in(window),
            transform=match_scene.transform(window, number),
            cell_size=match_scene.cell_size * 2**number,
            height_origin=match_scene.height_origin,
            height_step=match_scene.height_step * 2**number,
            n_steps=-(-match_scene.n_steps // 2**number),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        return self.window.rows, self.window.cols


@dataclass(frozen=True)
class SearchPrior:
    """What is known of the heights of a level before it is matched; level indices, all arrays (r, c) float32.

    surface : heights of the coarser level, or of an earlier round of this level; None where nothing is known. low, high
    : search range of each cell, NaN where no range is known. coarser_result : the coarser level, None at the coarsest.
    erosion : structuring element by which `surface` is eroded before it counts as an occluder.
    """

    surface: NDArray[np.float32] | None
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    coarser_result: LevelResult | None = None
    erosion: NDArray[np.uint8] = field(default_factory=lambda: ERODE_COARSER_SURFACE)

    def coarser_slope(self, window: CellWindow) -> CoarserSlope | None:
        """The slanted support surface of the coarser level under a window of this level; None at the coarsest."""
        if self.coarser_result is None:
            return None
        coarser_window = self.coarser_result.level.window
        row, col = coarser_window.row - window.row / 2, coarser_window.col - window.col / 2
        return CoarserSlope(self.coarser_result.slope_surface, row, col)


@dataclass(frozen=True)
class LevelSearch:
    """What is searched at one level.

    tile_views : projections of level indices; smooth : (r, c) float32 level indices, the surface known before,
    smoothed, None where nothing is known; slope_surface : slanted support surface; slope_views : projections of slope
    indices; lattice : search range of each block, slope indices.
    """

    tile_views: TileViews
    smooth: NDArray[np.float32] | None
    slope_surface: SlopeSurface
    slope_views: TileViews
    lattice: HeightLattice


@dataclass(frozen=True)
class LevelResult:
    """What one pyramid level hands to the next.

    slope_surface : the slanted support surface along which the level was searched; of the coarsest level, the one that
    follows from its heights. lattice : the search range of each block, in slope indices. visible : level
    indices, the visible height ranges of all views that help, see `occlusion`. heights : level indices.
    winner_takes_all : (r, c) int32 level indices of the least cost of each cell without the semi-global constraint;
    None at the finest level. evaluations : cells x heights x images that were compared, with those that the choice of
    images took; all_images : the same if every image that covers a cell had been used. agreement : (i,) see
    `local_contrast.agreement`; None where no surface was known yet. is_planar : (r, c) bool, cells whose heights are
    those of planes through segments without texture.
    """

    level: PyramidLevel
    tile_views: TileViews
    slope_surface: SlopeSurface
    lattice: HeightLattice
    visible: VisibleHeights
    heights: SemiGlobalHeights
    winner_takes_all: NDArray[np.int32] | None
    evaluations: int
    all_images: int
    agreement: NDArray[np.float64] | None
    is_planar: NDArray[np.bool_] | None = None

    def with_evaluations_of(self, earlier_result: LevelResult) -> LevelResult:
        """The result with the evaluations of an earlier pass over the same level added."""
        return replace(
            self,
            evaluations=earlier_result.evaluations + self.evaluations,
            all_images=earlier_result.all_images + self.all_images,
        )


def count_evaluations(visible: VisibleHeights, lattice: HeightLattice) -> int:
    """Cells x heights x views that are compared."""
    n_covering = covers(visible).sum(axis=0, dtype=np.int32)
    return int((by_block(n_covering, lattice.block, np.add) * lattice.count).sum())
