"""Object space and image space: the same matching cost and semi-global constraint on a ground grid and in the images.

    python benchmarks/spaces.py [SCENE_FOLDER ...] [-o OUT] [--views N ...]

SCENE_FOLDER holds img_*.tif with RPC, truth_dsm.tif and truth_class.tif; the default is the rendered town. For two (n1
f1), three (b1 too) and six views (n2 f2 b2 too) at 0.5 m it runs

- object space: `zlocus dsm --method mvll-sgm`;
- image space: `--method gc3-sgm`, every image matched in its own space, and the heights of all put on the grid;
- nadir only: the same with `--reference`, so that only the pixels of n1 give heights (the others check them).

Surfaces are compared with the truth by class and by place, as shares of all blocks of half a metre; a block without a
height is not within 1 m. Places: edges (at most two blocks from a height jump of 2 m), hidden (away from edges,
occluded in at least one view), dark (away from both, less than half the median grey value in n1: shadows), open (the
rest). Writes spaces.csv and, for the first folder, spaces.png; prints tables.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import rasterio
from matplotlib.colors import BoundaryNorm

from judging import RENDERED_TOWN, matched, rendered_scene, table_head, table_row, write_table
from workplace import CannotRun, ended
from zlocus.core.options import RunConfig
from zlocus.evaluation.heights import read_heights
from zlocus.evaluation.truth import TruthBlocks, read_classes, truth_blocks
from zlocus.io.scene_file import open_scene
from zlocus.matching.kernels.occlusion import lowest_visible
from zlocus.matching.match_scene import parallax_rate

mpl.use("Agg")
import matplotlib.pyplot as plt

CELL_M, MARGIN_M = 0.5, 10.0
VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
NUMBERS = (2, 3, 6)
METHODS = {
    "object space": ["--method", "mvll-sgm"],
    "image space": ["--method", "gc3-sgm"],
    "nadir only": ["--method", "gc3-sgm", "--reference", "img_n1"],
}
CLASSES, PLACES = ("all", "ground", "building", "tree"), ("edges", "hidden", "dark", "open")
JUMP_M, NEAR_CELLS, HIDDEN_M, DARK = 2.0, 2, 1.0, 0.5
ERRORS_M, NO_HEIGHT = (-20, -5, -1, -0.5, 0.5, 1, 5, 20), "gold"
COLUMNS = {
    "scene": "{scene}", "views": "{views}", "matched in": "{method}", "complete": "{complete:.1%}",
    **{name: f"{{{name}:.1%}}" for name in (*CLASSES, *PLACES)},
    "roofs inside": "{roofs:.1%}", "NMAD ground, m": "{nmad:.3f}", "RMSE, m": "{rmse:.2f}",
    "1 sigma": "{sigma_1:.0%}", "2 sigma": "{sigma_2:.0%}", "CPU, s": "{cpu_s:.1f}",
}  # fmt: skip


@dataclass(frozen=True)
class Truth:
    """Blocks of the truth and the places they belong to.

    shape : rows and columns of the blocks; places : (n,) bool each, by `PLACES`, and `roofs` (buildings in none of the
    first three).
    """

    blocks: TruthBlocks
    shape: tuple[int, int]
    places: dict[str, np.ndarray]


def truth_of(folder: Path, views: tuple[str, ...]) -> Truth:
    """Read the truth and find the places that are hard for these views."""
    reference = read_heights(folder / "truth_dsm.tif")
    blocks = truth_blocks(reference, MARGIN_M, read_classes(folder / "truth_class.tif", reference))
    shape = (len(np.unique(blocks.xy[:, 1])), len(np.unique(blocks.xy[:, 0])))
    if shape[0] * shape[1] != len(blocks.xy):
        raise CannotRun(f"`{folder}/truth_dsm.tif` has gaps: this benchmark needs a scene with a height everywhere.")
    z = blocks.mean.reshape(shape).astype(np.float32)
    near = np.ones((2 * NEAR_CELLS + 1,) * 2, np.uint8)
    edges = cv2.dilate(z, near) - cv2.erode(z, near) > JUMP_M
    scene = open_scene([folder / f"img_{name}.tif" for name in views])
    middle, hidden = float(np.median(z)), np.zeros(shape, bool)
    for view in scene.views:
        east, north = parallax_rate(view, middle) / CELL_M
        lowest = np.empty_like(z)
        lowest_visible(z, east, -north, lowest)
        hidden |= lowest > z + HIDDEN_M
    xy = scene.views[0].sensor.image_from_ground(np.column_stack([blocks.xy, blocks.mean]))
    image = scene.views[0].image
    grey = image.read(0, 0, *image.shape).pixels
    shown = cv2.remap(grey, *xy.T.reshape(2, *shape).astype(np.float32), cv2.INTER_LINEAR)
    hidden &= ~edges
    dark = (shown < DARK * np.median(shown)) & ~edges & ~hidden
    rest = ~(edges | hidden | dark)
    places = {"edges": edges, "hidden": hidden, "dark": dark, "open": rest}
    places["roofs"] = rest & blocks.members("building").reshape(shape)
    return Truth(blocks, shape, {name: where.ravel() for name, where in places.items()})


def looked_up(path: Path, xy: np.ndarray) -> np.ndarray:
    """Values (n,) of a raster at points (n, 2), NaN outside."""
    with rasterio.open(path) as file:
        values, (col, row) = file.read(1), ~file.transform * tuple(xy.T)
    row, col = np.floor(row).astype(int), np.floor(col).astype(int)
    inside = (row >= 0) & (row < values.shape[0]) & (col >= 0) & (col < values.shape[1])
    return np.where(inside, values[np.where(inside, row, 0), np.where(inside, col, 0)], np.nan)


def run(
    folder: Path, views: tuple[str, ...], method: str, truth: Truth, out: Path
) -> tuple[dict[str, Any], np.ndarray]:
    """One run: figures by the names of `COLUMNS`, and errors (r, c) m."""
    place = out / f"{folder.name}-{len(views)}-{method.replace(' ', '-')}"
    with rasterio.open(folder / "truth_dsm.tif") as file:
        box, crs = file.bounds, file.crs
    grid = ["--crs", str(crs), "--resolution", str(CELL_M), "--bounds", *map(str, box)]
    images = [folder / f"img_{name}.tif" for name in views]
    work = matched(images, place, RunConfig(), [*grid, "--partial", *METHODS[method]])
    xy = truth.blocks.xy
    error, sigma = truth.blocks.errors(looked_up(place / "dsm.tif", xy)), looked_up(place / "sigma.tif", xy)
    known, within = np.isfinite(error), np.abs(error) < 1.0
    of = {name: truth.blocks.members(name) for name in CLASSES[1:]} | truth.places | {"all": np.ones(len(xy), bool)}
    ground = error[of["ground"] & known]
    return {
        "scene": folder.name, "views": len(views), "method": method, "complete": known.mean(),
        **{name: within[where].mean() for name, where in of.items()},
        "nmad": 1.4826 * np.median(np.abs(ground - np.median(ground))), "rmse": np.sqrt((error[known] ** 2).mean()),
        **{f"sigma_{k}": (np.abs(error) <= k * sigma)[known].mean() for k in (1, 2)}, "cpu_s": work.cpu_s,
    }, error.reshape(truth.shape)  # fmt: skip


def picture(truth: Truth, errors: dict[tuple[int, str], np.ndarray], path: Path) -> None:
    """Draw the places and the errors in object and image space, one row for each number of views."""
    numbers = sorted({n for n, _ in errors})
    shown = ["object space", "image space"]
    figure, axes = plt.subplots(len(numbers), 2, figsize=(7.4, 3.7 * len(numbers) + 0.6), squeeze=False)
    figure.set_layout_engine("constrained")
    colours = mpl.colormaps["RdBu_r"].resampled(len(ERRORS_M) + 1).with_extremes(bad=NO_HEIGHT)
    norm = BoundaryNorm(ERRORS_M, len(ERRORS_M) + 1, extend="both")
    for row, n in zip(axes, numbers, strict=True):
        for axis, method in zip(row, shown, strict=True):
            drawn = axis.imshow(errors[n, method], cmap=colours, norm=norm, interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{method}, {n} views", fontsize=9)
    bar = figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.8, aspect=40, ticks=ERRORS_M)
    bar.set_label(f"height - truth, m ({NO_HEIGHT}: no height)", fontsize=9)
    figure.savefig(path, dpi=75)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, default=[RENDERED_TOWN])
    parser.add_argument("-o", "--out", type=Path, default=Path("spaces"))
    parser.add_argument("--views", type=int, nargs="*", default=NUMBERS, choices=range(2, len(VIEWS) + 1), metavar="N")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(table_head(COLUMNS), flush=True)
    found = []
    for folder in map(rendered_scene, arguments.folders):
        errors = {}
        for n in arguments.views:
            truth = truth_of(folder, VIEWS[:n])
            for method in METHODS:
                figures, errors[n, method] = run(folder, VIEWS[:n], method, truth, arguments.out)
                found.append(figures)
                print(table_row(COLUMNS, figures), flush=True)
        if folder == arguments.folders[0]:
            picture(truth, errors, arguments.out / "spaces.png")
        print({name: f"{where.mean():.1%}" for name, where in truth.places.items()}, flush=True)
    write_table(found, arguments.out / "spaces.csv")


if __name__ == "__main__":
    ended(main)
