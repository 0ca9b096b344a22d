"""Gain of the semi-global constraint and of the resolution levels on three terrain features, on rendered crops.

    python benchmarks/terrain_features.py [-o OUT] [--only FEATURE ...] [--views N] [--size CELLS]

The crops are 200 m square (400 cells, unless CELLS says otherwise), rendered at 0.5 m with exact truth:

- uneven: a relief of 120 m, half of it steeper than 46 degrees, with some trees;
- similar: crops in straight rows that repeat every 1.6 to 4 m, roads, houses;
- occlusion: towers of 25 to 60 m and houses that hide the ground behind them.

Each crop is matched by MVLL without and with the semi-global constraint (`--method mvll`, `mvll-sgm`), with one
resolution level (`pyramid.max_levels = 1`: the whole height range on the finest cells) and with several; all else is
equal. All cells and those that show the feature (`feature_cells`) are compared with the truth. Writes features.csv,
FEATURE.png and features.png, prints a table.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import PIL.Image
import rasterio
from matplotlib.colors import BoundaryNorm, LightSource, to_rgba
from matplotlib.layout_engine import ConstrainedLayoutEngine
from scipy.ndimage import distance_transform_edt

from judging import judged, matched, table_head, table_row, write_table
from workplace import ended
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.objects import Objects
from zlocus.synthetic.render import visible_ground_points
from zlocus.synthetic.scenes import (
    SATELLITE_VIEWS,
    Exposure,
    SceneSpec,
    build_ground,
    city_spec,
    exposures_of,
    hills_spec,
)
from zlocus.synthetic.terrain import PATTERN_ROWS, ROAD, TREE, SyntheticGround

mpl.use("Agg")
import matplotlib.pyplot as plt

CELLS = 400
VIEWS, MOST_VIEWS = 3, 6
STEEP = 0.6
HIDDEN_M = 1.0
APART_M = 8.0
FEATURE, REST = 0, 2  # as classes of the judges, to which 0 is ground and 2 building
FEATURES = {
    "uneven": partial(hills_spec, 71, objects=Objects(0.0, 0.0, 0.0, 5.0)),
    "similar": partial(
        city_spec, 72, relief_m=12.0, objects=Objects(110.0, 4.0, 0.0, 3.0, plain_roofs=0.0, crop_side_m=45.0)
    ),
    "occlusion": partial(city_spec, 73, objects=Objects(110.0, 6.0, 2.5, 5.0)),
}
NO_HEIGHT = "gold"
ERRORS_M = (-20, -5, -1, -0.5, 0.5, 1, 5, 20)
GREY = {"cmap": mpl.colormaps["gray"].with_extremes(bad=NO_HEIGHT), "vmin": 0, "vmax": 1, "interpolation": "nearest"}
DPI, SMALL_PX, LARGE_PX, GREYS = 100, 170, 440, 24
ONE_LEVEL = RunConfig(pyramid=PyramidOptions(max_levels=1))
METHODS = {"MVLL": "mvll", "MVLL + SGM": "mvll-sgm"}
RESOLUTIONS = {"one resolution": ONE_LEVEL, "many resolutions": RunConfig()}
COLUMNS = {
    "crop": "{crop}", "method": "{method}", "matched at": "{levels}", "within 1 m": "{within_1:.1%}",
    "where it shows": "{feature_1:.1%}", "within 0.5 m": "{within_05:.1%}", "RMSE, m": "{rmse:.2f}",
    "NMAD, m": "{nmad:.3f}", "LE90, m": "{le90:.2f}", "complete": "{completeness:.1%}",
    "evaluations, M": "{evaluations:.0f}", "CPU, s": "{cpu_s:.1f}",
}  # fmt: skip


@dataclass(frozen=True)
class Crop:
    """A rendered crop.

    views : names of the views that are matched; mask : raster of `FEATURE` and `REST`; share : of the cells that show
    the feature.
    """

    name: str
    spec: SceneSpec
    views: tuple[str, ...]
    folder: Path
    mask: Path
    share: float

    @property
    def truth(self) -> Path:
        """Exact heights."""
        return self.folder / "truth_dsm.tif"

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        side = self.spec.size * self.spec.gsd_m
        return self.spec.west_m, self.spec.north_m - side, self.spec.west_m + side, self.spec.north_m


def rendered(name: str, n_views: int, out: Path, size: int = CELLS) -> Crop:
    """The crop, rendered if it does not exist yet, always with all views, because the ground depends on them.

    size : cells along a side.
    """
    spec = FEATURES[name](size=size, views=SATELLITE_VIEWS[:MOST_VIEWS])
    folder = out / (f"{name}-scene" if size == CELLS else f"{name}-{size}-scene")
    if not folder.exists():
        render_scene(spec, folder)
    seen_by = exposures_of(spec)
    ground, used = build_ground(spec, seen_by), seen_by[:n_views]
    with rasterio.open(folder / "truth_class.tif") as file:
        profile = file.profile
    shows = feature_cells(name, ground, spec, used)
    with rasterio.open(mask := out / f"{name}-feature.tif", "w", **profile) as file:
        file.write(np.where(shows, FEATURE, REST).astype(np.uint8), 1)
    return Crop(name, spec, tuple(exposure.view.name for exposure in used), folder, mask, float(shows.mean()))


def feature_cells(name: str, ground: SyntheticGround, spec: SceneSpec, seen_by: tuple[Exposure, ...]) -> np.ndarray:
    """Cells (r, c) of the truth that show the feature of a crop.

    uneven: ground steeper than `STEEP`; similar: crops at least `APART_M` away from objects, which cast shadows and
    occlude; occlusion: cells that at least one view does not see.
    """
    n = round(spec.size * spec.gsd_m / spec.step_m)
    cells = ground.cells(spec.west_m, spec.north_m, (n, n))
    if name == "uneven":
        return (np.hypot(*np.moveaxis(ground.slopes[cells], -1, 0)) > STEEP * spec.step_m) & (
            ground.classes[cells] != TREE
        )
    if name == "similar":
        in_rows = (ground.materials["pattern"] == PATTERN_ROWS)[ground.material[cells]]
        apart = distance_transform_edt(ground.classes[cells] <= ROAD) > APART_M / spec.step_m
        return in_rows & apart
    row, col = np.mgrid[:n, :n].reshape(2, -1)
    east, north = spec.west_m + (col + 0.5) * spec.step_m, spec.north_m - (row + 0.5) * spec.step_m
    xyz = np.column_stack([east, north, ground.heights[cells].ravel()])
    hidden = np.zeros(len(xyz), bool)
    for exposure in seen_by:
        seen = visible_ground_points(ground, exposure.sensor, exposure.sensor.image_from_ground(xyz))
        hidden |= seen[:, 2] > xyz[:, 2] + HIDDEN_M
    return hidden.reshape(n, n)


def run(crop: Crop, method: str, levels: str, out: Path) -> tuple[dict[str, Any], Path]:
    """One of the four runs: figures by the names of `COLUMNS`, and the surface."""
    place = out / f"{crop.name}-{METHODS[method]}-{levels.split()[0]}"
    images = [crop.folder / f"img_{view}.tif" for view in crop.views]
    grid = ["--crs", f"EPSG:{crop.spec.epsg}", "--resolution", str(crop.spec.gsd_m), "--bounds", *map(str, crop.bounds)]
    work = matched(images, place, RESOLUTIONS[levels], [*grid, "--method", METHODS[method]])
    dsm = place / "dsm.tif"
    within_1, within_05 = (judged(dsm, crop.truth, crop.mask, threshold) for threshold in (1.0, 0.5))
    figures = {key: within_1["all"][key] for key in ("rmse", "nmad", "le90", "completeness")}
    return {
        "crop": crop.name, "method": method, "levels": levels, "within_1": within_1["all"]["within"],
        "feature_1": within_1["ground"]["within"], "within_05": within_05["all"]["within"], **figures,
        "feature_share": crop.share, "evaluations": work.evaluations, "cpu_s": work.cpu_s,
    }, dsm  # fmt: skip


def heights(path: Path, cells: int) -> np.ndarray:
    """A surface on `cells` x `cells` cells of the crop, (r, c) m; finer surfaces are averaged."""
    with rasterio.open(path) as file:
        z = file.read(1, masked=True).astype(float).filled(np.nan)
    size = z.shape[0] // cells
    return z.reshape(cells, size, cells, size).mean(axis=(1, 3))


def picture(crops: list[tuple[Crop, dict[str, Path]]], path: Path, panel_px: int) -> None:
    """Draw two rows for each crop: hillshades of the truth and the surfaces; the image and the errors."""
    n_columns = 1 + len(crops[0][1])
    panel = panel_px / DPI
    width, height = n_columns * panel, 2.1 * len(crops) * panel + 0.9
    figure, axes = plt.subplots(2 * len(crops), n_columns, figsize=(width, height), squeeze=False)
    titled = (0.0, 0.0, 1.0, 1.0 - 0.2 / height)
    figure.set_layout_engine(ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01, wspace=0.0, hspace=0.0, rect=titled))
    colours = mpl.colormaps["RdBu_r"].resampled(len(ERRORS_M) + 1).with_extremes(bad=NO_HEIGHT)
    norm = BoundaryNorm(ERRORS_M, len(ERRORS_M) + 1, extend="both")
    font = {"fontsize": 9 if panel_px > SMALL_PX else 7}
    for (crop, surfaces), (shades, errors) in zip(crops, axes.reshape(-1, 2, n_columns), strict=True):
        true = heights(crop.truth, crop.spec.size)
        shades[0].imshow(hillshade(true, crop.spec.gsd_m), **GREY)
        shades[0].set_title("truth, and an image", **font)
        shades[0].set_ylabel(f"{crop.name}: relief", **font)
        errors[0].imshow(nadir_image(crop), **GREY)
        errors[0].set_ylabel(f"{crop.name}: errors", **font)
        for (name, dsm), shade, error in zip(surfaces.items(), shades[1:], errors[1:], strict=True):
            found = heights(dsm, crop.spec.size)
            shade.imshow(hillshade(found, crop.spec.gsd_m), **GREY)
            shade.set_title(name, **font)
            drawn = error.imshow(found - true, cmap=colours, norm=norm, interpolation="nearest")
    for axis in axes.ravel():
        axis.set(xticks=[], yticks=[])
    bar = figure.colorbar(drawn, ax=axes[-1, :], location="bottom", shrink=0.6, aspect=50, ticks=ERRORS_M)
    bar.set_label(f"height - truth, m ({NO_HEIGHT}: no height)", **font)
    bar.ax.tick_params(labelsize=font["fontsize"])
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    used = [
        *colours(np.arange(len(ERRORS_M) + 1)),
        to_rgba(NO_HEIGHT),
        *mpl.colormaps["gray"](np.linspace(0, 1, GREYS)),
    ]
    palette = PIL.Image.new("P", (1, 1))
    palette.putpalette((np.array(used)[:, :3] * 255).round().astype(np.uint8).tobytes())
    with PIL.Image.open(path) as picture:
        few = picture.convert("RGB").quantize(palette=palette, dither=PIL.Image.Dither.NONE)
    few.save(path, optimize=True)


def hillshade(z: np.ndarray, cell_m: float) -> np.ndarray:
    """Hillshade of a surface (r, c) lit from the north-west, in [0, 1]; NaN where there is no height."""
    return np.where(np.isfinite(z), LightSource(315, 45).hillshade(np.nan_to_num(z), dx=cell_m, dy=cell_m), np.nan)


def nadir_image(crop: Crop) -> np.ndarray:
    """The image nearest to the nadir, cut to the size of the crop and stretched."""
    with rasterio.open(crop.folder / f"img_{crop.views[0]}.tif") as file:
        grey = file.read(1).astype(float)
    size = crop.spec.size
    first = [(n - size) // 2 for n in grey.shape]
    grey = grey[first[0] : first[0] + size, first[1] : first[1] + size]
    low, high = np.percentile(grey, (1, 99))
    return np.clip((grey - low) / (high - low), 0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=Path("features"))
    parser.add_argument("--only", nargs="*", choices=list(FEATURES), default=list(FEATURES), help="crops to match")
    parser.add_argument("--views", type=int, default=VIEWS, choices=range(2, MOST_VIEWS + 1), metavar="N",
                        help="the first N of the six views of one date")  # fmt: skip
    parser.add_argument(
        "--size", type=int, default=CELLS, metavar="CELLS", help="cells of 0.5 m along a side of a crop"
    )
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with kernels_compiling():
        crops = [rendered(name, arguments.views, arguments.out, arguments.size) for name in arguments.only]
    for crop in crops:
        print(f"{crop.name}: {crop.share:.0%} of the cells show it", flush=True)
    print(table_head(COLUMNS), flush=True)
    found, pictures = [], []
    for crop in crops:
        surfaces = {}
        for method, levels in product(METHODS, RESOLUTIONS):
            figures, surfaces[f"{method},\n{levels}"] = run(crop, method, levels, arguments.out)
            found.append(figures)
            print(table_row(COLUMNS, figures), flush=True)
        pictures.append((crop, surfaces))
        picture(pictures[-1:], arguments.out / f"{crop.name}.png", LARGE_PX)
    write_table(found, arguments.out / "features.csv")
    picture(pictures, arguments.out / "features.png", SMALL_PX)


if __name__ == "__main__":
    ended(main)
