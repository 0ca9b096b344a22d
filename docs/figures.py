"""Figures of the pages on the method: `python docs/figures.py [FOLDER]` renders a scene, matches it and draws them.

All but one come from one rendered town with exact truth; the same code gives the same figures. The errors with a
growing number of images are those of the results file of that row.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import rasterio
from matplotlib.axes import Axes
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

import zlocus
import zlocus.pipeline.dsm
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import CurvesRequest, DsmRequest
from zlocus.pipeline.match_curves import run_curves
from zlocus.synthetic.files import RenderedScene, render_scene
from zlocus.synthetic.scenes import city_spec

HERE = Path(__file__).parent
RESULTS = HERE.parent / "benchmarks" / "results"
MARKERS = "os^vD"
SEED, SIZE_PX, CELL_M = 6, 200, 0.5
THREE, SIX = ("n1", "f1", "b1"), ("n1", "f1", "b1", "n2", "f2", "b2")
# A place of the scene, on open ground beside a road.
PLACE = (462_050.0, 5_246_950.0)
COLOURS = 128
INK, ACCENT, SECOND, PALE = "#222222", "#c0392b", "#1f618d", "#888888"
STYLE = {
    "figure.dpi": 100, "savefig.dpi": 100, "font.size": 9, "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": INK, "svg.hashsalt": "zlocus",
}  # fmt: skip
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Town:
    """The rendered scene and its truth, (r, c) m on cells of `CELL_M`, north-west corner first."""

    scene: RenderedScene
    truth: FloatArray
    west: float
    north: float

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Of the truth: xmin, ymin, xmax, ymax, m."""
        rows, cols = self.truth.shape
        return self.west, self.north - rows * CELL_M, self.west + cols * CELL_M, self.north

    def height(self, xy: tuple[float, float]) -> float:
        """True height of the cell that holds a place, m."""
        return float(self.truth[int((self.north - xy[1]) / CELL_M), int((xy[0] - self.west) / CELL_M)])

    def images(self, names: tuple[str, ...]) -> tuple[Path, ...]:
        """Files of some views."""
        return tuple(self.scene.images[name] for name in names)


def rendered_town(folder: Path) -> Town:
    """Render the scene into a new folder."""
    spec = replace(city_spec(SEED), size=SIZE_PX)
    scene = render_scene(replace(spec, views=tuple(view for view in spec.views if view.name in SIX)), folder)
    with rasterio.open(scene.truth_dsm) as source:
        fine, step = source.read(1).astype(float), source.transform.a
        n = round(CELL_M / step)
        rows, cols = (size // n for size in fine.shape)
        truth = fine.reshape(rows, n, cols, n).mean(axis=(1, 3))
        return Town(scene, truth, source.bounds.left, source.bounds.top)


def locus(town: Town) -> Figure:
    """Figure of a cell's vertical line in three images."""
    scene, z = zlocus.open_scene(*town.images(THREE)), town.height(PLACE)
    figure, axes = plt.subplots(1, 3, figsize=(7.6, 2.9), layout="constrained")
    heights = z + np.arange(-20.0, 20.1, 5.0)
    for view, ax in zip(scene.views, axes, strict=True):
        xyz = np.column_stack([np.full_like(heights, PLACE[0]), np.full_like(heights, PLACE[1]), heights])
        xy = view.sensor.image_from_ground(xyz)
        at = view.sensor.image_from_ground(np.array([[*PLACE, z]]))[0]
        first = np.maximum(np.round(at).astype(int) - 32, 0)
        part = view.image.read(int(first[1]), int(first[0]), 64, 64).pixels
        ax.imshow(part, cmap="gray", extent=(first[0] - 0.5, first[0] + 63.5, first[1] + 63.5, first[1] - 0.5))
        ax.plot(xy[:, 0], xy[:, 1], "-o", color=ACCENT, ms=3, lw=1)
        ax.plot(*at, "o", color="#f1c40f", ms=6, mec=INK)
        # Of a line that is seen from its end there is no room for words.
        for k in (0, len(heights) - 1) if np.ptp(xy, axis=0).max() > 10 else ():
            ax.annotate(f"{heights[k] - z:+.0f} m", xy[k], xytext=(5, 0), textcoords="offset points", color="white")
        ax.set_title(view.name)
        ax.set_xticks([])
        ax.set_yticks([])
    return figure


@dataclass(frozen=True)
class PointCurves:
    """Results of `zlocus curves` for a point. table : columns of curves.csv, (h,) each, the heights first; judged : the
    entries of point.json, by search image."""

    table: dict[str, FloatArray]
    judged: dict[str, dict[str, Any]]

    @property
    def heights_m(self) -> FloatArray:
        """Heights of the samples, (h,)."""
        return next(iter(self.table.values()))


def point_curves(town: Town, folder: Path) -> PointCurves:
    """Match curves of all images against n1, at `PLACE`."""
    request = CurvesRequest(inputs=town.images(SIX), out=folder, at=PLACE, reference="img_n1", resolution=CELL_M)
    run_curves(request, RunConfig(), SilentProgress())
    table = np.genfromtxt(folder / "curves.csv", delimiter=",", names=True, deletechars="")
    report = json.loads((folder / "point.json").read_text(encoding="utf-8"))
    return PointCurves({name: table[name] for name in table.dtype.names}, {c["image"]: c for c in report["curves"]})


def curves(town: Town, point: PointCurves) -> Figure:
    """Figure of the match curves of two search images: the peak rho1 and the secondary peak rho2."""
    figure, axes = plt.subplots(1, 2, figsize=(7.6, 2.7), sharey=True, layout="constrained")
    z = point.heights_m
    for name, ax in zip(("img_f1", "img_b1"), axes, strict=True):
        ncc, judged = point.table[f"ncc_{name}"], point.judged[name]
        ax.plot(z, ncc, color=INK, lw=1.2)
        for words, colour in (("rho1", ACCENT), ("rho2", SECOND)):
            k = int(np.nanargmin(np.abs(ncc - judged[words])))
            ax.plot(z[k], ncc[k], "o", color=colour)
            ax.annotate(
                f"{words} = {ncc[k]:.2f}", (z[k], ncc[k]), xytext=(0, 7), textcoords="offset points", color=colour,
                ha="center",
            )  # fmt: skip
        ax.axvline(town.height(PLACE), color=PALE, lw=0.8, ls=":")
        title = f"n1 and {name.removeprefix('img_')}: ratio {judged['ratio']:.2f}, label {judged['label']:+d}"
        ax.set(title=title, xlabel="height, m", ylim=(-0.8, 1.25))
    axes[0].set_ylabel("correlation")
    return figure


def means(town: Town, point: PointCurves) -> Figure:
    """Figure of SNCC, the mean of the match curves of the first 1, 2, ... search images."""
    figure, ax = plt.subplots(figsize=(7.6, 2.8), layout="constrained")
    columns = [name for name in point.table if name.startswith("sncc_")]
    for k, name in enumerate(columns):
        share = k / max(len(columns) - 1, 1)
        ax.plot(
            point.heights_m,
            point.table[name],
            label=str(k + 1),
            color=plt.cm.viridis_r(0.1 + 0.9 * share),
            lw=0.9 + 0.9 * share,
        )
    ax.axvline(town.height(PLACE), color=PALE, lw=0.8, ls=":")
    ax.set(xlabel="height, m", ylabel="mean correlation")
    ax.legend(title="images", frameon=False, ncols=2)
    return figure


def surface(town: Town, method: str) -> dict[str, FloatArray]:
    """Height and sigma from three views, (r, c) m on the cells of the truth."""
    options = {"bounds": town.bounds, "resolution": CELL_M, "method": method, "partial": True}
    with tempfile.TemporaryDirectory() as scratch:
        request = DsmRequest(inputs=town.images(THREE), out=Path(scratch) / "out", **options)
        zlocus.pipeline.dsm.run_dsm(request, RunConfig(), SilentProgress())
        found = {}
        for name in ("dsm", "sigma"):
            with rasterio.open(request.out / f"{name}.tif") as source:
                found[name] = source.read(1).astype(float)
    return found


def semiglobal(town: Town, winner_takes_all: FloatArray, constrained: FloatArray) -> Figure:
    """Figure of surfaces without and with the semi-global constraint, and of their errors."""
    figure, axes = plt.subplots(2, 3, figsize=(7.6, 5.0), layout="constrained")
    light = LightSource(315, 45)
    low, high = np.percentile(town.truth, (1, 99))
    panels = (("winner takes all", winner_takes_all), ("semi-global constraint", constrained), ("truth", town.truth))
    for (title, height), (top, bottom) in zip(panels, axes.T, strict=True):
        shown = np.clip(np.where(np.isfinite(height), height, low), low, high)
        shaded = light.shade(shown, plt.cm.viridis, vmin=low, vmax=high, dx=CELL_M, dy=CELL_M, blend_mode="soft")
        top.imshow(shaded)
        top.set_title(title)
        if height is not town.truth:
            error = height - town.truth
            drawn = bottom.imshow(error, cmap="RdBu_r", vmin=-2, vmax=2)
            bottom.set_xlabel(f"within 1 m: {100 * np.mean(np.abs(error) < 1):.1f} %")
    axes[1, 2].set_axis_off()
    figure.colorbar(drawn, cax=axes[1, 2].inset_axes((0.05, 0.1, 0.08, 0.8)), label="error, m")
    for ax in (*axes[0], *axes[1, :2]):
        _bare(ax)
    return figure


def _bare(ax: Axes) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)


def precision(town: Town, found: dict[str, FloatArray]) -> Figure:
    """Figure of true errors against standard deviations, in twenty groups of cells sorted by sigma."""
    error = np.abs(found["dsm"] - town.truth)
    known = np.isfinite(error) & np.isfinite(found["sigma"])
    error, sigma = error[known], found["sigma"][known]
    order = np.argsort(sigma, kind="stable")
    groups = np.array_split(order, 20)
    middle = np.array([np.median(sigma[group]) for group in groups])
    figure, ax = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    ax.loglog(
        middle, [np.quantile(error[group], 0.683) for group in groups], "o-", color=ACCENT, label="68 % of errors"
    )
    ax.loglog(
        middle, [np.quantile(error[group], 0.954) for group in groups], "s-", color=SECOND, label="95 % of errors"
    )
    ax.loglog(middle, middle, color=ACCENT, lw=0.8, ls=":")
    ax.loglog(middle, 2 * middle, color=SECOND, lw=0.8, ls=":")
    ax.set(xlabel="sigma, m", ylabel="true error smaller than, m")
    ax.legend(frameon=False)
    return figure


def more_images(results: Path) -> Figure:
    """Figure of the errors with a growing number of images over those with two, for every scene of a results file."""
    errors: dict[str, dict[int, float]] = {}
    for one in json.loads(results.read_text(encoding="utf-8"))["figures"]:
        scene, _, what = one["what"].rpartition(": ")
        if what.endswith(" images"):
            errors.setdefault(scene.partition(",")[0], {})[int(what.split()[0])] = one["value"]
    figure, ax = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    for (scene, of_scene), marker in zip(errors.items(), MARKERS, strict=False):
        counts = sorted(of_scene)
        ax.plot(counts, [of_scene[n] / of_scene[counts[0]] for n in counts], f"{marker}-", ms=4, lw=1.0, label=scene)
    ticks = sorted({n for of_scene in errors.values() for n in of_scene})
    ax.axhline(1.0, color=PALE, lw=0.8, ls=":")
    ax.set(xscale="log", xlabel="images", ylabel="error over that of two images")
    ax.set_xticks(ticks, [str(n) for n in ticks])
    ax.minorticks_off()
    ax.legend(frameon=False)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG with 128 colours, which takes a third of the space."""
    drawn = BytesIO()
    figure.savefig(drawn, format="png", metadata={"Software": None})
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def make_figures(folder: Path) -> list[Path]:
    """Draw all figures into a folder and return their files."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, plt.rc_context(STYLE):
        town = rendered_town(Path(scratch) / "scene")
        point = point_curves(town, Path(scratch) / "point")
        found = {method: surface(town, method) for method in ("mvll", "mvll-sgm")}
        figures = {
            "locus": locus(town),
            "curves": curves(town, point),
            "means": means(town, point),
            "semiglobal": semiglobal(town, found["mvll"]["dsm"], found["mvll-sgm"]["dsm"]),
            "precision": precision(town, found["mvll-sgm"]),
            "more_images": more_images(RESULTS / "more-images.json"),
        }
        for name, figure in figures.items():
            save(figure, folder / f"{name}.png")
    return [folder / f"{name}.png" for name in figures]


if __name__ == "__main__":
    print(*make_figures(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "figures"), sep="\n")
