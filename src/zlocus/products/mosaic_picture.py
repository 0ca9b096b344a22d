"""seams.png: which run each cell of a mosaic was taken from, and where runs contradict each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from zlocus.io.atomic_write import write_atomically
from zlocus.io.open_raster import open_raster
from zlocus.io.surface_inputs import DSM
from zlocus.products.blending import SeamKind
from zlocus.products.hillshade import hillshade
from zlocus.products.mosaic_rasters import SEAMS, SOURCE

PICTURE = "seams.png"
# Longest side of the map, px; runs that the legend names.
MAP_PX, MAX_NAMED, DPI = 900, 12, 110
SUN_DEG = (315.0, 45.0)
# Red, green, blue of runs, after Okabe and Ito; of cells where runs contradict each other.
RUN_COLOURS = np.array(
    [(86, 180, 233), (230, 159, 0), (0, 158, 115), (240, 228, 66), (0, 114, 178), (204, 121, 167)], float
)  # fmt: skip
CONTRADICTED = np.array((200, 30, 0), float)


def write_picture(folder: Path, names: Sequence[str]) -> None:
    """Write `PICTURE` beside the rasters of a mosaic. names : of the runs.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    with open_raster(folder / DSM) as file:
        step = max(1.0, max(file.shape) / MAP_PX)
        shape = max(1, round(file.height / step)), max(1, round(file.width / step))
        left, bottom, right, top = file.bounds
        height = file.read(1, out_shape=shape, resampling=Resampling.average).astype(np.float32)
    source, kind = (_read(folder / name, shape) for name in (SOURCE, SEAMS))
    light = hillshade(height, abs(right - left) / shape[1], *SUN_DEG).astype(float)[..., None] / 255.0
    colours = RUN_COLOURS[(source.astype(int) - 1) % len(RUN_COLOURS)]
    colours = np.where((kind == SeamKind.CHOSEN)[..., None], CONTRADICTED, colours) * (0.35 + 0.65 * light)
    colours = np.where((source > 0)[..., None], colours, 255.0)
    n_lines = min(len(names), MAX_NAMED + 1) + 1
    figure = Figure(figsize=(9.0, 1.0 + 0.17 * n_lines + 8.3 * shape[0] / shape[1]), layout="constrained")
    axes = figure.subplots()
    axes.imshow(colours.astype(np.uint8), extent=(left, right, bottom, top), interpolation="nearest")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.tick_params(labelsize=7)
    patches = [
        Patch(color=_css(RUN_COLOURS[number % len(RUN_COLOURS)]), label=f"{number + 1}: {name}")
        for number, name in enumerate(names[:MAX_NAMED])
    ]
    if len(names) > MAX_NAMED:
        patches.append(Patch(color="white", label=f"and {len(names) - MAX_NAMED} more"))
    patches.append(Patch(color=_css(CONTRADICTED), label="surfaces contradict each other"))
    figure.legend(handles=patches, loc="outside lower left", fontsize=7, frameon=False)
    axes.set_title("surface that each cell follows", loc="left", fontsize=9)
    write_atomically(folder / PICTURE, lambda part: figure.savefig(part, format="png", dpi=DPI))


def _css(colour: NDArray[np.float64]) -> str:
    return "#" + "".join(f"{int(part):02x}" for part in colour)


def _read(path: Path, shape: tuple[int, int]) -> NDArray[Any]:
    with open_raster(path) as file:
        return np.asarray(file.read(1, out_shape=shape, resampling=Resampling.nearest))
