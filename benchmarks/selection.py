"""Choice of the views that match a cell: all, some by geometry, or by labels at tie points and match curves.

    python benchmarks/selection.py [SCENE_FOLDER] [-o OUT] [--only NAME ...] [--curves N]

SCENE_FOLDER holds img_*.tif with RPC, truth_dsm.tif and truth_class.tif. The default is the rendered town, where two of
the eight views are bad: d1 (another date) and d2 (haze, blur, clouds). Each choice is one run of `zlocus dsm`:

- all images: the default, what the choices below are to be compared with;
- six good images: without the bad ones (names that begin with d);
- k best by geometry: the most nadir view and k - 1 others by `candidate_images` (angles and overlap alone);
- guided: `--selection guided`, ranked at tie points, added until match curves are distinct and precise;
- guided, rule of the paper: adding stops when the label of 95 % of the cells is good; no view is excluded for its
  labels.

Compared with the truth: share of the cells within 1 m (empty cells are not within), NMAD. Cost: evaluated correlations
as a share of those of all images, and CPU of the matching. As in the paper, the final match curves are judged too: at
about N regularly spaced cells (2000), the mean correlation over the views used there, along a fixed range around the
resulting height; reported are the medians of its largest value and of its ratio to the second peak. Writes
selection.csv and selection.png and prints a table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from pyproj import CRS

from judging import RENDERED_TOWN, judged, matched, rendered_scene, table_head, table_row, write_table
from workplace import CannotRun, ended
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.io.scene_file import open_scene
from zlocus.matching import tile
from zlocus.matching.kernels.shared_records import VisibleHeights
from zlocus.matching.locus_windows import CurveSamples
from zlocus.matching.match_curve import GOOD, ProgressiveMean, curve_peaks, quality_labels
from zlocus.matching.match_scene import parallax_rate, reference_first
from zlocus.matching.occlusion import covers
from zlocus.matching.subpixel import smoothed
from zlocus.matching.view_directions import cells_per_step
from zlocus.matching.view_ranking import SearchGeometry, candidate_images

SPOILED = "d"
CURVES = 2000
OF_THE_PAPER = RunConfig(
    selection=SelectionOptions(
        max_sigma_steps=1000.0,
        stopped_share=0.95,
        min_label_share=0.0,
        order="labels",
        max_images=254,
    )
)


@dataclass(frozen=True)
class Choice:
    """One run. images : names of its images; selection : value of `--selection`."""

    images: tuple[str, ...]
    selection: str
    config: RunConfig


def choices(names: list[str], by_geometry: list[str]) -> dict[str, Choice]:
    """The runs, by their names in the table."""
    good = tuple(name for name in names if not name.startswith(SPOILED))
    every = tuple(names)
    best = {f"{k} best by geometry": Choice(tuple(by_geometry[:k]), "default", RunConfig()) for k in (3, 4, 5, 6)}
    return {
        "all images": Choice(every, "default", RunConfig()),
        "six good images": Choice(good, "default", RunConfig()),
        **best,
        "guided": Choice(every, "guided", RunConfig()),
        "guided, rule of the paper": Choice(every, "guided", OF_THE_PAPER),
    }


def ranked_by_geometry(images: dict[str, Path], crs: str, z: float) -> list[str]:
    """The view nearest to the nadir, then the others in the order of `candidate_images` for full overlap."""
    views = reference_first(open_scene(tuple(images.values()), CRS.from_user_input(crs)), z, None)
    rays = np.array([(*parallax_rate(view, z), 1.0) for view in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle_deg = np.degrees(np.arccos(np.clip(rays[1:] @ rays[0], -1.0, 1.0)))
    unknown = np.full(len(angle_deg), np.nan)
    geometry = SearchGeometry(np.ones(len(angle_deg)), angle_deg, unknown)
    best = candidate_images(geometry, SelectionOptions(max_candidates=len(views)))
    by_path = {path: name for name, path in images.items()}
    return [by_path[views[i].path] for i in (0, *(best + 1))]


@contextmanager
def watched(tiles: list[tuple[Any, VisibleHeights, RunConfig]]) -> Iterator[None]:
    """While active, record the finest level of every matched tile, for `final_curves`."""
    matched_heights: list[VisibleHeights] = []
    costs, refine = tile.cost_volume, tile.refined_surface

    def cost_volume(*arguments: Any, **options: Any) -> Any:
        matched_heights[:] = [a for a in (*arguments, *options.values()) if isinstance(a, VisibleHeights)]
        return costs(*arguments, **options)

    def refined_surface(tile_inputs: Any, result: Any, *rest: Any) -> Any:
        tiles.append((result, matched_heights[0], tile_inputs.config))
        return refine(tile_inputs, result, *rest)

    tile.cost_volume, tile.refined_surface = cost_volume, refined_surface
    try:
        yield
    finally:
        tile.cost_volume, tile.refined_surface = costs, refine


def final_curves(result: Any, matched_heights: VisibleHeights, config: RunConfig, spacing: int) -> np.ndarray:
    """Largest correlation, ratio of the peaks, label and number of views of mean match curves, (n, 4).

    They are taken at one cell in `spacing`. The reference is the first (most nadir) view used at a cell.
    """
    half, options = large_window_side(config.cost) // 2, config.selection
    surface = smoothed(result.heights.vertex, config.refine.jump_steps)
    rows, cols = (np.arange(half + spacing // 2, n - half, spacing) for n in surface.shape)
    cells = np.stack([v.ravel() for v in np.meshgrid(rows, cols, indexing="ij")], axis=1)
    takes = covers(matched_heights)[:, cells[:, 0], cells[:, 1]].T
    cells, takes = cells[takes.sum(axis=1) > 1], takes[takes.sum(axis=1) > 1]
    row, col = cells.T
    here = surface[row, col]
    around = [surface[row + i, col + j] - here for i in range(-half, half + 1) for j in range(-half, half + 1)]
    samples = CurveSamples(cells, here - float(options.reach_steps), 2 * options.reach_steps + 1,
                      np.ascontiguousarray(np.stack(around, axis=1), np.float32))  # fmt: skip
    index = samples.first[:, None] + np.arange(samples.n_heights)
    windows = []
    for view in range(takes.shape[1]):
        found = samples.windows(result.tile_views, view, slice(None))
        found[index < result.visible.lowest_unoccluded[view, row, col][:, None]] = np.nan
        windows.append(found)
    reference, everyone = takes.argmax(axis=1), np.arange(len(cells))
    per_step = np.array([cells_per_step(result.tile_views, i) for i in range(takes.shape[1])])
    mean, widest_px = ProgressiveMean.empty(len(cells), samples.n_heights), np.zeros(len(cells))
    first = np.stack(windows)[reference, everyone]
    for view, found in enumerate(windows):
        which = np.flatnonzero(takes[:, view] & (reference != view))
        mean.add(which, np.einsum("nhk,nhk->nh", first[which], found[which]))
        px = np.hypot(*(per_step[reference[which]] - per_step[view]).T)
        widest_px[which] = np.maximum(widest_px[which], px)
    peaks = curve_peaks(mean.of(everyone), widest_px, options)
    labels = quality_labels(peaks.rho1, peaks.ratio, peaks.is_open, options)
    return np.stack([peaks.rho1, peaks.ratio, labels, takes.sum(axis=1)], axis=1)


def run(name: str, choice: Choice, folder: Path, out: Path, curves: int = CURVES) -> dict[str, Any]:
    """Run one choice and return its figures by the names of `COLUMNS` (evaluations in millions).

    curves : approximate number of cells whose match curves are judged.
    """
    truth, classes = folder / "truth_dsm.tif", folder / "truth_class.tif"
    with rasterio.open(truth) as file:
        bounds, crs, cell = file.bounds, str(file.crs), 2 * file.res[0]
    spacing = max(int(np.sqrt((bounds.right - bounds.left) * (bounds.top - bounds.bottom) / curves) / cell), 1)
    place = out / name.replace(",", "").replace(" ", "-")
    images = [folder / f"img_{image}.tif" for image in choice.images]
    tiles: list[tuple[Any, VisibleHeights, RunConfig]] = []
    with watched(tiles):
        work = matched(
            images, place, choice.config,
            ["--crs", crs, "--resolution", str(cell), "--selection", choice.selection, "--bounds", *map(str, bounds),
             # The run takes place in this process, so that `watched` can record the tiles.
             "--workers", "1"],
        )  # fmt: skip
    figures = judged(place / "dsm.tif", truth, classes)
    of_curves = np.concatenate([final_curves(*one, spacing) for one in tiles])
    known = of_curves[np.isfinite(of_curves[:, 0])]
    within = {f"within_{kind}": figures[kind]["within"] for kind in ("all", "ground", "building", "tree")}
    return {
        "choice": name, "images": len(images), **within, "nmad_ground": figures["ground"]["nmad"],
        "evaluations": work.evaluations, "share": work.share, "cpu_s": work.cpu_s,
        "views_used": float(known[:, 3].mean()), "rho1": float(np.median(known[:, 0])),
        "ratio": float(np.median(known[:, 1])), "good": float((known[:, 2] == GOOD).mean()),
    }  # fmt: skip


COLUMNS = {
    "choice": "{choice}", "within 1 m": "{within_all:.1%}", "ground": "{within_ground:.1%}",
    "building": "{within_building:.1%}", "tree": "{within_tree:.1%}", "NMAD, ground, m": "{nmad_ground:.3f}",
    "evaluations, M": "{evaluations:.0f}", "of all": "{share:.0%}", "CPU, s": "{cpu_s:.1f}",
    "views a cell": "{views_used:.1f}", "rho1": "{rho1:.3f}", "ratio": "{ratio:.2f}", "label 1": "{good:.0%}",
}  # fmt: skip


def picture(found: list[dict[str, Any]], path: Path) -> None:
    """Plot accuracy and largest correlation against the cost."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    panels = (("within_all", "cells within 1 m"), ("within_building", "building cells within 1 m"),
              ("rho1", "median rho1 of the final curves"))  # fmt: skip
    markers = ("o", "s", "^", "v", "<", ">", "D", "P", "X")
    for axis, (name, label) in zip(axes, panels, strict=True):
        for one, marker in zip(found, markers, strict=False):
            axis.plot(one["evaluations"], one[name], marker, label=one["choice"], markersize=9, alpha=0.7)
        axis.set(xlabel="NCC evaluations, millions", ylabel=label)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=9)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=RENDERED_TOWN)
    parser.add_argument("-o", "--out", type=Path, default=Path("selection"))
    parser.add_argument("--only", nargs="*", help="names of the choices to run")
    parser.add_argument("--curves", type=int, default=CURVES, metavar="N", help="cells whose match curves are judged")
    arguments = parser.parse_args()
    folder = rendered_scene(arguments.folder)
    arguments.out.mkdir(parents=True, exist_ok=True)
    images = {path.stem.removeprefix("img_"): path for path in sorted(folder.glob("img_*.tif"))}
    with rasterio.open(folder / "truth_dsm.tif") as file:
        crs, z = str(file.crs), float(np.median(file.read(1)))
    known = choices(list(images), ranked_by_geometry(images, crs, z))
    if unknown := [name for name in arguments.only or () if name not in known]:
        raise CannotRun(f"There is no choice `{unknown[0]}`: --only takes {', '.join(f'`{name}`' for name in known)}.")
    found = []
    print(table_head(COLUMNS), flush=True)
    for name, choice in known.items():
        if arguments.only is None or name in arguments.only:
            found.append(run(name, choice, folder, arguments.out, arguments.curves))
            print(table_row(COLUMNS, found[-1]), flush=True)
    write_table(found, arguments.out / "selection.csv")
    picture(found, arguments.out / "selection.png")


if __name__ == "__main__":
    ended(main)
