"""One cell explained: what the rasters say of it, and its match, by the functions that the run is made of."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.options import RunConfig, large_window_side
from zlocus.core.sensor_model import FloatArray
from zlocus.inspector.folder import SurfaceFolder
from zlocus.inspector.layers import reasons_of
from zlocus.inspector.profile import reference_at
from zlocus.inspector.reference import Reference
from zlocus.inspector.restored_run import Restored
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.point_match import PlaceCurves, curves_at
from zlocus.pipeline.report_inputs import NOT_SHOWN, SHOWN_WITHIN_CELLS, place_of_cell
from zlocus.products.match_curve_figures import STRETCH_PERCENT
from zlocus.products.point_report import Locus, PointReport, loci, point_record, what_order_rests_on, where_it_stops
from zlocus.products.report.maps import data_uri

# Cells a side that are shown around a window, most first: an image's end may cut the larger ones.
SHOWN_SIDES = (25, 15)
BLACK, BRIGHT = 1, 255  # 0: not shown by the image


@dataclass(frozen=True)
class WhatIf:
    """What is place_curves at otherwise than in the run. left_out : names of images; reference : name of the image to be it;
    window : side of the window, cells; selection : options of `SelectionOptions` by name."""

    left_out: frozenset[str] = frozenset()
    reference: str | None = None
    window: int | None = None
    selection: Mapping[str, Any] = field(default_factory=dict)

    def config(self, config: RunConfig) -> RunConfig:
        """The options of the run with those that are changed.

        Raises
        ------
        ConfigError
            One is out of range.
        """
        changed = replace(config, selection=replace(config.selection, **self.selection))
        if self.window is None:
            return changed
        return replace(changed, cost=replace(changed.cost, large_window=self.window))

    def scene(self, match_scene: MatchScene) -> MatchScene:
        """The scene without the images left out.

        Raises
        ------
        ConfigError
            An image that is not in it.
        """
        names = [view.name for view in match_scene.views]
        unknown = (self.left_out | ({self.reference} if self.reference else set())) - set(names)
        if unknown:
            raise ConfigError(f"This surface has no image {min(unknown)[:60]!r}.")
        if self.reference in self.left_out:
            raise ConfigError(f"{self.reference} is the reference, and switched off. Choose another reference.")
        kept = [i for i, name in enumerate(names) if name not in self.left_out]
        return replace(match_scene, views=tuple(match_scene.views[i] for i in kept), grey_scales=tuple(match_scene.grey_scales[i] for i in kept))


def cell_record(folder: SurfaceFolder, reference: Reference | None, row: int, col: int) -> dict[str, Any]:
    """What the rasters say of a cell; heights are NaN where there is none."""
    cell = folder.cell(row, col)
    x, y = folder.middle_of(row, col)
    record = {
        "row": row, "col": col, "x": float(x), "y": float(y), "height_m": cell["dsm"],
        "sigma_m": cell["sigma"], "n_images": cell["views"], "quality": cell["quality"],
        "reasons": reasons_of(cell["quality"]), "difference_m": None,
    }  # fmt: skip
    if reference is not None:
        record["difference_m"] = cell["dsm"] - float(reference_at(folder, reference, np.array([[row, col]]))[0])
    return record


def match_record(restored: Restored, xy: FloatArray, height_m: float, what_if: WhatIf) -> dict[str, Any]:
    """How a cell is matched, with all that the page draws of it.

    xy : (2,) m, its middle; height_m : of the surface there, NaN without one. All heights are above what those of the
    surface are.

    Raises
    ------
    GeometryError
        Fewer than two of the images show it.
    ConfigError
        See `WhatIf`.
    """
    matched, config = restored.run, what_if.config(restored.config)
    place = place_of_cell(xy, height_m, matched)
    match_scene = what_if.scene(matched.match_scene)
    if len(match_scene.views) < 2:
        raise GeometryError("Two images are needed at least. Switch another one on.")
    try:
        place_curves = curves_at("The cell", what_if.reference, match_scene, place, config, SHOWN_WITHIN_CELLS)
    except GeometryError as error:
        raise GeometryError(why_not_shown(what_if)) from error
    report = PointReport.of("the cell", place_curves, match_scene, matched.scene.crs)
    images = image_records(place_curves, loci(place_curves.views, report))
    below = float(matched.undulation(xy[None])[0])
    report = replace(
        report, heights_m=report.heights_m - below, peak_m=report.peak_m - below, xyz=report.xyz - (0.0, 0.0, below)
    )
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
        "neighbours": neighbour_records(place_curves, match_scene, config),
    }


def why_not_shown(what_if: WhatIf) -> str:
    """Why a cell has no curves, in a sentence."""
    if what_if.reference is not None:
        return f"{what_if.reference} does not show this cell, or no other image does. Choose another reference."
    return NOT_SHOWN + (" Some are switched off." if what_if.left_out else "")


def image_records(place_curves: PlaceCurves, found: list[Locus]) -> list[dict[str, Any]]:
    """What each image shows of a place, the reference first: a crop with the locus, and windows at every height."""
    names = [view.name for view in place_curves.views]
    middle, large, less = len(place_curves.heights_m) // 2, place_curves.patches(SHOWN_SIDES[0]), None
    records = []
    for locus in found:
        i = names.index(locus.name)
        side, patches = SHOWN_SIDES[0], large[i]
        if not np.isfinite(patches[middle]).all():
            less = place_curves.patches(SHOWN_SIDES[1]) if less is None else less
            side, patches = SHOWN_SIDES[1], less[i]
        records.append(
            {
                "image": locus.name, "crop": data_uri(encoded(stretched(locus.grey)), "image/png"),
                "row": locus.first[0], "col": locus.first[1], "rows": locus.grey.shape[0], "cols": locus.grey.shape[1],
                "line": locus.line.round(2).tolist(),
                "side": side, "patches": base64.b64encode(stretched(patches).tobytes()).decode("ascii"),
            }
        )  # fmt: skip
    return records


def neighbour_records(place_curves: PlaceCurves, match_scene: MatchScene, config: RunConfig) -> dict[str, Any]:
    """The tie points that order the images, on the ground, with their labels."""
    order, options = place_curves.curves.order, config.selection
    xy = match_scene.anchor + order.xy * match_scene.cell_size * (1.0, -1.0)
    return {
        "by": options.neighbours, "radius_m": options.radius_px * match_scene.cell_size,
        "points": [
            {"x": float(x), "y": float(y), "distance_m": float(away * match_scene.cell_size), "labels": labels.tolist()}
            for (x, y), away, labels in zip(xy, order.distance, order.labels, strict=True)
        ],
    }  # fmt: skip


def stretched(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Grey values of any shape as uint8 from `BLACK` to `BRIGHT`, 0 where not known."""
    known = np.isfinite(values)
    low, high = np.percentile(values[known], STRETCH_PERCENT) if known.any() else (0.0, 1.0)
    share = np.clip((np.nan_to_num(values) - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    return np.where(known, np.rint(BLACK + (BRIGHT - BLACK) * share), 0).astype(np.uint8)


def encoded(grey: NDArray[np.uint8]) -> bytes:
    """A grey picture as PNG."""
    return bytes(cv2.imencode(".png", grey)[1].tobytes())
