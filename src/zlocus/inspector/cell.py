"""Explanation of one cell: its values in the rasters, and its match, computed by the functions of the run."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.options import RunConfig, large_window_side
from zlocus.core.sensor_model import FloatArray
from zlocus.inspector.folder import SurfaceFolder
from zlocus.inspector.image_accounts import LookedAtCell, image_accounts, summary_of
from zlocus.inspector.layers import reasons_of
from zlocus.inspector.profile import cells_of, reference_at, values_at
from zlocus.inspector.reference import Reference
from zlocus.inspector.restored_run import Restored
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.point_match import PlaceCurves, curves_at
from zlocus.pipeline.report_inputs import NOT_SHOWN, SHOWN_WITHIN_CELLS, place_of_cell
from zlocus.products.match_curve_figures import STRETCH_PERCENT
from zlocus.products.point_report import (
    LABELS,
    Locus,
    PointReport,
    loci,
    point_record,
    what_order_rests_on,
    where_it_stops,
)
from zlocus.products.report.maps import data_uri
from zlocus.products.report.text import listed

# Sides of the patch shown around a correlation window, in cells. The smaller one is used near the edge of an image.
SHOWN_SIDES = (25, 15)
DARKEST_GREY, BRIGHTEST_GREY = 1, 255  # 0: not covered by the image


@dataclass(frozen=True)
class WhatIf:
    """Settings with which a cell is matched, where they differ from the run.

    left_out : names of images that are not used; reference : name of the reference image; window : side of the
    correlation window, cells; selection : changed options of `SelectionOptions` by name.
    """

    left_out: frozenset[str] = frozenset()
    reference: str | None = None
    window: int | None = None
    selection: Mapping[str, Any] = field(default_factory=dict)

    def config(self, config: RunConfig) -> RunConfig:
        """The options of the run, with the changes.

        Raises
        ------
        ConfigError
            A changed option is out of range.
        """
        changed = replace(config, selection=replace(config.selection, **self.selection))
        if self.window is None:
            return changed
        return replace(changed, cost=replace(changed.cost, large_window=self.window))

    def scene(self, match_scene: MatchScene) -> MatchScene:
        """The match scene without the images that are left out.

        Raises
        ------
        ConfigError
            An image is not in the scene, or the reference image is left out.
        """
        names = [view.name for view in match_scene.views]
        unknown = (self.left_out | ({self.reference} if self.reference else set())) - set(names)
        if unknown:
            raise ConfigError(f"This surface has no image {min(unknown)[:60]!r}.")
        if self.reference in self.left_out:
            raise ConfigError(
                f"{self.reference} is the reference image, and it is switched off. Choose another reference image."
            )
        kept = [i for i, name in enumerate(names) if name not in self.left_out]
        views = tuple(match_scene.views[i] for i in kept)
        return replace(match_scene, views=views, grey_scales=tuple(match_scene.grey_scales[i] for i in kept))


def cell_record(folder: SurfaceFolder, reference: Reference | None, row: int, col: int) -> dict[str, Any]:
    """Values of a cell in the rasters; heights are NaN where there is none."""
    cell = folder.cell(row, col)
    x, y = folder.centre_of(row, col)
    record = {
        "row": row, "col": col, "x": float(x), "y": float(y), "height_m": cell["dsm"],
        "sigma_m": cell["sigma"], "n_images": cell["views"], "quality": cell["quality"],
        "reasons": reasons_of(cell["quality"]), "difference_m": None, "above_terrain_m": None,
    }  # fmt: skip
    at = np.array([[row, col]])
    if reference is not None:
        record["difference_m"] = cell["dsm"] - float(reference_at(folder, reference, at)[0])
    if folder.has("dtm"):
        record["above_terrain_m"] = cell["dsm"] - float(values_at(folder, "dtm", at)[0])
    return record


def match_record(
    folder: SurfaceFolder, restored: Restored, xy: FloatArray, height_m: float, what_if: WhatIf
) -> dict[str, Any]:
    """Accounts of the images at a cell, and its match with everything that the page draws.

    xy : (2,) m, its centre; height_m : of the surface there, NaN without one. All heights of the record have the
    vertical datum of the surface. Keys: accounts, see `image_accounts`; accounts_say, see `summary_of`; and match, or
    error, the reason why there is none.

    Raises
    ------
    ConfigError
        See `WhatIf`.
    """
    run, config = restored.run, what_if.config(restored.config)
    place = place_of_cell(xy, height_m, run)
    match_scene = what_if.scene(run.match_scene)
    place_curves, error = None, ""
    try:
        if len(match_scene.views) < 2:
            raise GeometryError("At least two images are needed. Switch on another one.")
        place_curves = curves_at("The cell", what_if.reference, match_scene, place, config, SHOWN_WITHIN_CELLS)
    except GeometryError as failure:
        error = why_not_shown(what_if) if len(match_scene.views) >= 2 else str(failure)
    undulation_m = float(run.undulation(xy[None])[0])
    accounts = image_accounts(LookedAtCell(folder, match_scene, config, place, undulation_m, place_curves))
    record = {"accounts": accounts, "accounts_say": summary_of(accounts, len(match_scene.views))}
    if place_curves is None:
        return record | {"error": error}
    return record | {"match": curves_record(folder, restored, match_scene, config, place_curves)}


def curves_record(
    folder: SurfaceFolder, restored: Restored, match_scene: MatchScene, config: RunConfig, place_curves: PlaceCurves
) -> dict[str, Any]:
    """The match curves of a cell, and what the images show there. match_scene, config : with which it was matched."""
    run = restored.run
    report = PointReport.of("the cell", place_curves, match_scene, run.scene.crs)
    images = image_records(place_curves, loci(place_curves.views, report))
    undulation_m = float(run.undulation(place_curves.place.middle[None])[0])
    report = report.above(undulation_m)
    curves, options = report.curves, config.selection
    return {
        **point_record(report, options),
        "heights_m": report.heights_m.round(4).tolist(),
        "ncc": curves.single_curves.values.round(5).tolist(),
        "sncc": curves.mean_curves.values.round(5).tolist(),
        "sigma_m": (curves.sigma_steps * report.step_m).tolist(),
        "says": {"order": what_order_rests_on(report, options), "stop": where_it_stops(report, options)},
        "images": images,
        "window": large_window_side(config.cost),
        "neighbours": neighbour_records(folder, place_curves, match_scene, config, undulation_m),
    }


def why_not_shown(what_if: WhatIf) -> str:
    """Why a cell has no match curves, in a sentence."""
    if what_if.reference is not None:
        return f"{what_if.reference} does not show this cell, or no other image does. Choose another reference image."
    return NOT_SHOWN + (" Some are switched off." if what_if.left_out else "")


def image_records(place_curves: PlaceCurves, loci_of_images: list[Locus]) -> list[dict[str, Any]]:
    """Crop with the locus, and patches at every height, of each image; the reference image first."""
    names = [view.name for view in place_curves.views]
    middle, large, small = len(place_curves.heights_m) // 2, place_curves.patches(SHOWN_SIDES[0]), None
    records = []
    for locus in loci_of_images:
        i = names.index(locus.name)
        side, patches = SHOWN_SIDES[0], large[i]
        if not np.isfinite(patches[middle]).all():
            small = place_curves.patches(SHOWN_SIDES[1]) if small is None else small
            side, patches = SHOWN_SIDES[1], small[i]
        records.append(
            {
                "image": locus.name, "crop": data_uri(encoded(stretched(locus.grey)), "image/png"),
                "row": locus.first[0], "col": locus.first[1], "rows": locus.grey.shape[0], "cols": locus.grey.shape[1],
                "line": locus.line.round(2).tolist(),
                "side": side, "patches": base64.b64encode(stretched(patches).tobytes()).decode("ascii"),
            }
        )  # fmt: skip
    return records


def neighbour_records(
    folder: SurfaceFolder, place_curves: PlaceCurves, match_scene: MatchScene, config: RunConfig, undulation_m: float
) -> dict[str, Any]:
    """The tie points on which the order of the images rests: positions, labels and heights, and what they say."""
    order, options = place_curves.curves.order, config.selection
    xy = match_scene.anchor + order.xy * match_scene.cell_size * (1.0, -1.0)
    height_m = match_scene.ties[place_curves.ties, 2] - undulation_m
    above_m = height_m - values_at(folder, "dsm", cells_of(folder, xy))
    away_m = order.distance * match_scene.cell_size
    names = [place_curves.views[i].name for i in order.search]
    points = [
        {
            "x": float(xy[f, 0]), "y": float(xy[f, 1]), "distance_m": float(away_m[f]),
            "height_m": float(height_m[f]), "above_surface_m": float(above_m[f]), "labels": order.labels[f].tolist(),
            "says": tie_says(float(away_m[f]), float(height_m[f]), float(above_m[f])),
            "labels_say": labels_say(place_curves.views[order.reference].name, names, order.labels[f].tolist()),
        }
        for f in range(len(xy))
    ]  # fmt: skip
    says = "No tie point is near enough to order the images."
    if points:
        says = nearest_says(float(away_m[0]), float(above_m[0]))
    return {
        "by": options.neighbours, "radius_m": options.radius_px * match_scene.cell_size, "says": says, "points": points,
    }  # fmt: skip


def nearest_says(away_m: float, above_m: float) -> str:
    """How far away the nearest tie point lies, and whether its height fits the surface."""
    text = f"The nearest tie point lies {away_m:.1f} m away"
    if not np.isfinite(above_m):
        return f"{text}; the surface has no height there."
    return f"{text}; its height differs by {abs(above_m):.2f} m from the surface there."


def tie_says(away_m: float, height_m: float, above_m: float) -> str:
    """A tie point in sentences."""
    text = f"This tie point lies {away_m:.1f} m from the cell. Its height is {height_m:.2f} m"
    if not np.isfinite(above_m):
        return f"{text}; the surface has none there."
    return f"{text}, {abs(above_m):.2f} m {'above' if above_m >= 0 else 'below'} the surface."


def labels_say(reference: str, names: Sequence[str], labels: Sequence[int]) -> str:
    """How well the reference image matches the others at a tie point, in a sentence."""
    groups = {word: [name for name, label in zip(names, labels, strict=True) if label == value]
              for value, word in LABELS.items()}  # fmt: skip
    parts = [f"{word} with {listed(group)}" for word, group in groups.items() if group]
    return f"There the match of {reference} is {'; '.join(parts)}."


def stretched(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Grey values of any shape as uint8 from `DARKEST_GREY` to `BRIGHTEST_GREY`, 0 where unknown."""
    known = np.isfinite(values)
    low, high = np.percentile(values[known], STRETCH_PERCENT) if known.any() else (0.0, 1.0)
    share = np.clip((np.nan_to_num(values) - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    return np.where(known, np.rint(DARKEST_GREY + (BRIGHTEST_GREY - DARKEST_GREY) * share), 0).astype(np.uint8)


def encoded(grey: NDArray[np.uint8]) -> bytes:
    """A grey picture (r, c) as PNG."""
    return bytes(cv2.imencode(".png", grey)[1].tobytes())
