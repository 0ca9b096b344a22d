"""The blocks of a mosaic, and the rasters that they are written to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox

from zlocus.core.grid import CellWindow
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.surface_cells import PlacedSurface, SurfaceCells, read_cells
from zlocus.io.surface_inputs import DSM, ORTHO, QUALITY, SIGMA, VIEWS, WATER
from zlocus.matching.quality import EMPTY, Quality
from zlocus.products.blending import BlendedCells, RunRelations, SeamKind, blended, halo_cells
from zlocus.products.number_names import RUNS, number_tag, short_names
from zlocus.products.rasters import COLOURS, flag_tags
from zlocus.products.run_offsets import PairSample, sampled_pairs

SOURCE, SEAMS = "source.tif", "seams.tif"
RASTERS = (DSM, SIGMA, QUALITY, VIEWS, WATER, ORTHO, SOURCE, SEAMS)


@dataclass(frozen=True)
class MosaicBlock:
    """Cells of a mosaic. layers : (r, c) of each raster, (bands, r, c) of the ortho-image, by the name of the file;
    ortho_mask : (r, c) bool, None without an ortho-image."""

    layers: Mapping[str, NDArray[Any]]
    ortho_mask: NDArray[np.bool_] | None = None

    def count(self, kind: SeamKind) -> int:
        """Number of cells of a kind."""
        return int((self.layers[SEAMS] == kind).sum())


@dataclass(frozen=True)
class OffsetJob:
    """Samples the differences of runs in windows of the grid. Called by workers."""

    placed: tuple[PlacedSurface, ...]
    windows: tuple[CellWindow, ...]

    def __call__(self, window: CellWindow) -> dict[tuple[int, int], PairSample]:
        """Differences of all pairs of runs in a window."""
        runs = {n: read_cells(self.placed[n], window) for n in reaching(self.windows, window)}
        return sampled_pairs(runs, window.row, window.col)


@dataclass(frozen=True)
class MosaicJob:
    """Makes blocks of a mosaic. Called by workers.

    placed : the runs, in the order in which they were named; windows : of the grid that each may reach; relations : of
    the runs; feather_cells : see `blended`; ortho_bands : type and number of bands of the ortho-image, None without
    one; has : which of views.tif and water.tif are made; whole_window : all cells of the grid.
    """

    placed: tuple[PlacedSurface, ...]
    windows: tuple[CellWindow, ...]
    relations: RunRelations
    feather_cells: int
    ortho_bands: tuple[str, int] | None
    has: tuple[str, ...]
    whole_window: CellWindow

    def __call__(self, window: CellWindow) -> MosaicBlock:
        """The cells of a block, read and joined with those around it on which it depends."""
        halo = halo_cells(self.feather_cells)
        wide = CellWindow(window.row - halo, window.col - halo, window.rows + 2 * halo, window.cols + 2 * halo)
        wide = wide.within(self.whole_window)
        numbers = reaching(self.windows, wide)
        core = window.slices_in(wide)
        runs = [read_cells(self.placed[n], wide) for n in numbers]
        cells = blended(runs, self.relations.of(numbers), self.feather_cells)
        cells = BlendedCells(*(getattr(cells, name)[core] for name in ("height", "sigma", "chosen", "kind")))
        return self._block(numbers, [_part(run, core) for run in runs], cells, window)

    def _block(
        self, numbers: Sequence[int], surface_cells: Sequence[SurfaceCells], cells: BlendedCells, window: CellWindow
    ) -> MosaicBlock:
        shape = (window.rows, window.cols)
        source = np.zeros(shape, np.uint16)
        for place, number in enumerate(numbers):
            source[cells.chosen == place] = number + 1
        layers: dict[str, NDArray[Any]] = {
            DSM: cells.height, SIGMA: cells.sigma, SOURCE: source, SEAMS: cells.kind,
            QUALITY: _quality(surface_cells, cells),
        }  # fmt: skip
        for name in self.has:
            layers[name] = np.zeros(shape, np.uint8)
            for place, run in enumerate(surface_cells):
                if name in run.flags:
                    here = cells.chosen == place
                    layers[name][here] = np.minimum(run.flags[name], 255)[here]
        if self.ortho_bands is None:
            return MosaicBlock(layers)
        dtype, n_bands = self.ortho_bands
        layers[ORTHO], mask = np.zeros((n_bands, *shape), dtype), np.zeros(shape, bool)
        for place, number in enumerate(numbers):
            if ORTHO in self.placed[number].source.layers and (cells.chosen == place).any():
                image = read_cells(self.placed[number], window, with_images=True)
                assert image.ortho is not None, "the run has an ortho-image"
                assert image.ortho_mask is not None, "the run has an ortho-image"
                here = (cells.chosen == place) & image.ortho_mask
                layers[ORTHO][:, here], mask[here] = image.ortho[:, here], True
        return MosaicBlock(layers, mask)


class MosaicRasters:
    """Writer of the rasters of a mosaic. The files appear when the context ends without an error.

    spatial_geobox : grid with the vertical datum, for the heights; geobox : without it, for the others; description :
    of the heights; has : which of views.tif and water.tif are made; ortho_bands : see `MosaicJob`; runs : their paths.
    """

    def __init__(
        self,
        folder: Path,
        geobox: GeoBox,
        spatial_geobox: GeoBox,
        description: str,
        has: Sequence[str],
        ortho_bands: tuple[str, int] | None,
        runs: Sequence[str],
    ) -> None:
        nan = float("nan")
        bands = {
            DSM: RasterBands("float32", nan, (description,), "m"),
            SIGMA: RasterBands("float32", nan, ("standard deviation of height",), "m"),
            QUALITY: RasterBands("uint16", None, ("quality bit flags",), tags=flag_tags()),
            VIEWS: RasterBands("uint8", 0, ("images used by the run in source.tif",)),
            WATER: RasterBands("uint8", None, ("water surface",)),
            SOURCE: RasterBands(
                "uint16", 0, ("number of the run that was chosen, from 1",), tags={RUNS: number_tag(short_names(runs))}
            ),
            SEAMS: RasterBands("uint8", 0, ("how the height was made",), tags=_seam_tags()),
        }
        names = [DSM, SIGMA, QUALITY, SOURCE, SEAMS, *has]
        if ortho_bands is not None:
            dtype, n_bands = ortho_bands
            is_coloured = n_bands == len(COLOURS)
            described = COLOURS if is_coloured else tuple("" if n_bands > 1 else "grey value" for _ in range(n_bands))
            bands[ORTHO] = RasterBands(
                dtype, descriptions=described, has_mask=True, has_colours=is_coloured and dtype == "uint8"
            )
            names.append(ORTHO)
        self._stack, self._sinks = ExitStack(), dict[str, RasterSink]()
        with ExitStack() as undo:
            undo.push(self._stack)
            for name in names:
                box = spatial_geobox if name == DSM else geobox
                self._sinks[name] = self._stack.enter_context(RasterSink(folder / name, box, bands[name]))
            undo.pop_all()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files."""
        return tuple(name for name in RASTERS if name in self._sinks)

    def write(self, window: CellWindow, block: MosaicBlock) -> None:
        """Write a block of the mosaic."""
        for name, sink in self._sinks.items():
            sink.write(window.row, window.col, block.layers[name], block.ortho_mask if name == ORTHO else None)

    def write_empty(self, window: CellWindow) -> None:
        """Write a block that no run reaches."""
        self._sinks[QUALITY].write(
            window.row, window.col, np.full((window.rows, window.cols), Quality.OUTSIDE, np.uint16)
        )

    def __enter__(self) -> MosaicRasters:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


def reaching(windows: Sequence[CellWindow], window: CellWindow) -> list[int]:
    """Numbers of the runs that may reach a window. windows : of each run."""
    common = [each.within(window) for each in windows]
    return [number for number, each in enumerate(common) if each.rows > 0 and each.cols > 0]


def _part(surface_cells: SurfaceCells, core: tuple[slice, slice]) -> SurfaceCells:
    flags = {name: values[core] for name, values in surface_cells.flags.items()}
    height, sigma = surface_cells.height[core], surface_cells.sigma[core]
    return SurfaceCells(height, sigma, surface_cells.is_inside[core], flags)


def _quality(surface_cells: Sequence[SurfaceCells], cells: BlendedCells) -> NDArray[np.uint16]:
    """Flags (r, c): those of the chosen run, DISPUTED where runs contradict each other; of empty cells the reason of
    the first run that reaches them."""
    quality = np.full(cells.chosen.shape, Quality.OUTSIDE, np.uint16)
    for run in reversed(surface_cells):
        reasons = (
            run.flags[QUALITY].astype(np.uint16) & np.uint16(EMPTY | Quality.IMAGE_EXCLUDED)
            if QUALITY in run.flags
            else np.full(quality.shape, Quality.NO_MATCH, np.uint16)
        )
        known = run.is_inside & (reasons != 0) & ((reasons & np.uint16(Quality.OUTSIDE)) == 0)
        quality = np.where(known, reasons, quality)
    for place, run in enumerate(surface_cells):
        own = run.flags[QUALITY].astype(np.uint16) if QUALITY in run.flags else np.zeros_like(quality)
        quality = np.where(cells.chosen == place, own, quality)
    contradicted = cells.kind == SeamKind.CHOSEN
    return np.where(contradicted, quality | np.uint16(Quality.DISPUTED), quality)


def _seam_tags() -> dict[str, str]:
    """Tags that name the values of seams.tif, for other programs."""
    return {
        "flag_values": ", ".join(str(int(kind)) for kind in SeamKind),
        "flag_meanings": " ".join(kind.name for kind in SeamKind),
    }
