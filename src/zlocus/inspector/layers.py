"""Layers of the map: title, legend, and the drawing of a patch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus.inspector.folder import Patch, PatchValues, SurfaceFolder, read_patch
from zlocus.inspector.reference import Reference
from zlocus.io.open_raster import cached_raster
from zlocus.matching.quality import flags_of
from zlocus.products.demo_figure import error_map
from zlocus.products.hillshade import hillshade
from zlocus.products.report import maps
from zlocus.products.report import text as words

Rgba = NDArray[np.uint8]
# The range of colours is computed from a sample of this many cells a side.
SAMPLED_SIDE = 800
MAX_CLASSES = 12
# Colours of heights above the DTM reach at least so far: on open ground there would be noise only.
LEAST_TOP_M = 2.0
OPAQUE = 255
# Rows of a picture that are composed at a time.
STRIP_PX = 256
# Cells outside the area have this grey, and their opacity is divided by this.
OUTSIDE_GREY, OUTSIDE_OPACITY_DIVISOR = 128, 3


@dataclass(frozen=True)
class Layer:
    """A layer of the map.

    legend : as the page draws it, None without one; draw : draws a patch of the grid as (r, c, 4) uint8: red, green,
    blue and opacity.
    """

    name: str
    title: str
    legend: dict[str, Any] | None
    draw: Callable[[Patch], Rgba]


def layers_of(folder: SurfaceFolder) -> dict[str, Layer]:
    """The layers of a surface by name, from the lowest to the highest."""
    layers = [_hillshade(folder)]
    layers += [_ortho(folder)] if folder.has("ortho") else []
    layers += [_height(folder), _sigma(folder), _views(folder), _quality(folder)]
    layers += [_terrain(folder), _above_terrain(folder)] if folder.has("dtm") else []
    return {layer.name: layer for layer in layers}


def difference_layer(folder: SurfaceFolder, reference: Reference) -> Layer:
    """Layer of the surface less the reference."""
    saturated_m = reference.saturated_m

    def draw(patch: Patch) -> Rgba:
        # One cell per pixel of both: means would differ at every edge.
        height, true = read_patch(folder.path("dsm"), patch, False), read_patch(reference.path, patch, False, folder)
        return with_opacity(error_map(height.values[0] - true.values[0], saturated_m), height.known & true.known)

    line = error_map(np.linspace(-saturated_m, saturated_m, maps.STOPS, dtype=np.float32)[None], saturated_m)[0]
    ticks = [f"{value:+g}" if value else "0" for value in np.linspace(-saturated_m, saturated_m, maps.TICKS)]
    legend = scale(f"surface less {reference.name}, m", ", ".join(maps.css(colour) for colour in line), ticks)
    return Layer("difference", "Difference to the reference", legend, draw)


def composed(layers: Sequence[tuple[Layer, float]], patch: Patch) -> Rgba:
    """Layers composed as the map shows them: the first is the lowest, and each has an opacity of 0 to 1."""
    strips = [_composed(layers, strip) for strip in patch.strips(STRIP_PX)]
    return np.concatenate(strips)


def _composed(layers: Sequence[tuple[Layer, float]], patch: Patch) -> Rgba:
    shape = (patch.height, patch.width)
    colours, opacity = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 1), np.float32)
    for layer, share in layers:
        drawn = layer.draw(patch).astype(np.float32)
        above = np.float32(share / OPAQUE) * drawn[..., 3:]
        total = above + opacity * (1 - above)
        mixed = drawn[..., :3] * above + colours * opacity * (1 - above)
        colours, opacity = mixed / np.maximum(total, np.float32(1e-6)), total
    return np.asarray(np.rint(np.concatenate([colours, OPAQUE * opacity], axis=-1)), np.uint8)


def png_of(picture: Rgba) -> bytes:
    """A picture as PNG, with fast compression."""
    swapped = cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA)
    return bytes(cv2.imencode(".png", swapped, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def with_opacity(colours: NDArray[Any], known: NDArray[np.bool_]) -> Rgba:
    """Colours (r, c, 3) in OpenCV's order as a picture that is transparent where values are unknown."""
    return np.dstack([colours[..., ::-1], np.where(known, OPAQUE, 0)]).astype(np.uint8)


def scale(title: str, gradient: str, ticks: Sequence[str]) -> dict[str, Any]:
    """Legend of a continuous quantity."""
    return {"kind": "scale", "title": title, "gradient": gradient, "ticks": list(ticks)}


def classes(title: str, items: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Legend of classes, each with a colour (CSS) and a meaning."""
    return {"kind": "classes", "title": title, "items": [{"colour": c, "meaning": m} for c, m in items]}


def sampled(folder: SurfaceFolder, name: str, average: bool = True) -> PatchValues:
    """A whole raster, reduced to at most `SAMPLED_SIDE` cells a side."""
    rows, cols = folder.shape
    share = min(SAMPLED_SIDE / max(rows, cols), 1.0)
    size = (max(round(rows * share), 1), max(round(cols * share), 1))
    return read_patch(folder.path(name), Patch(0, 0, rows, cols, *size), average)


def extent_of(folder: SurfaceFolder) -> tuple[int, int, int, int]:
    """First row and column, and those after the last, of the cells with heights, as far as a sample tells them; the
    whole grid where there are none."""
    known = sampled(folder, "dsm", average=False).known
    if not known.any():
        return 0, 0, *folder.shape
    ends = []
    for axis, n in ((1, folder.shape[0]), (0, folder.shape[1])):
        step, at = n / known.shape[1 - axis], np.flatnonzero(known.any(axis=axis))
        ends.append((int(at[0] * step), min(int(np.ceil((at[-1] + 1) * step)), n)))
    (top, bottom), (left, right) = ends
    return top, left, bottom, right


def _hillshade(folder: SurfaceFolder) -> Layer:
    light = folder.run["config"]["options"]["products"]
    sun_deg = light["sun_azimuth_deg"], light["sun_altitude_deg"]

    def draw(patch: Patch) -> Rgba:
        if folder.has("hillshade"):
            cells = read_patch(folder.path("hillshade"), patch, True)
            return with_opacity(np.dstack([cells.values[0]] * 3), cells.known)
        wide = read_patch(folder.path("dsm"), patch.widened(1), True).values[0].astype(np.float32)
        shaded = hillshade(wide, folder.cell_m * patch.cols / patch.width, *sun_deg)[1:-1, 1:-1]
        return with_opacity(np.dstack([shaded] * 3), np.isfinite(wide[1:-1, 1:-1]))

    return Layer("hillshade", "Hillshade", None, draw)


def _ortho(folder: SurfaceFolder) -> Layer:
    cells = sampled(folder, "ortho")
    shown = cells.values[:, cells.known].astype(np.float32)
    low, high = np.percentile(shown, maps.STRETCH_PERCENT) if shown.size else (0.0, 1.0)

    def draw(patch: Patch) -> Rgba:
        cells = read_patch(folder.path("ortho"), patch, True)
        grey = np.clip((cells.values.astype(np.float32) - low) / max(high - low, 1e-6), 0.0, 1.0)
        bands = grey[[2, 1, 0]] if len(grey) >= 3 else grey[[0, 0, 0]]
        return with_opacity(np.rint(OPAQUE * np.moveaxis(np.nan_to_num(bands), 0, -1)), cells.known)

    return Layer("ortho", "Ortho-image", None, draw)


def _height(folder: SurfaceFolder) -> Layer:
    low, high = maps.span(sampled(folder, "dsm").values[0])
    legend = scale(f"{folder.height_name}, m", maps.gradient(cv2.COLORMAP_VIRIDIS), maps.even_ticks(low, high))
    return Layer("height", "Height", legend, coloured(folder, "dsm", (low, high), cv2.COLORMAP_VIRIDIS))


def coloured(folder: SurfaceFolder, name: str, span: tuple[float, float], table: int) -> Callable[[Patch], Rgba]:
    """Draws a raster of heights with one of OpenCV's tables of colours. span : values of its first and last colour."""

    def draw(patch: Patch) -> Rgba:
        cells = read_patch(folder.path(name), patch, True)
        return with_opacity(on_ramp(cells.values[0], span, table), cells.known)

    return draw


def on_ramp(values: NDArray[Any], span: tuple[float, float], table: int) -> NDArray[np.uint8]:
    """Colours (r, c, 3) of values (r, c) in OpenCV's order; see `coloured`."""
    share = np.clip((np.nan_to_num(values) - span[0]) / max(span[1] - span[0], 1e-6), 0.0, 1.0)
    return np.asarray(cv2.applyColorMap((OPAQUE * share).astype(np.uint8), table), np.uint8)


def _terrain(folder: SurfaceFolder) -> Layer:
    """Layer of the DTM, in the colours of the surface's heights, so that the two can be compared."""
    low, high = maps.span(sampled(folder, "dsm").values[0])
    legend = scale(f"DTM, {folder.height_name}, m", maps.gradient(cv2.COLORMAP_VIRIDIS), maps.even_ticks(low, high))
    return Layer("dtm", "DTM (ground)", legend, coloured(folder, "dtm", (low, high), cv2.COLORMAP_VIRIDIS))


def _above_terrain(folder: SurfaceFolder) -> Layer:
    """Layer of the surface less the DTM: heights of buildings and trees."""
    above = sampled(folder, "dsm", average=False).values[0] - sampled(folder, "dtm", average=False).values[0]
    top = max(maps.span(above)[1], LEAST_TOP_M)

    def draw(patch: Patch) -> Rgba:
        # One cell per pixel of both: means would differ at every edge.
        surface, ground = (read_patch(folder.path(name), patch, False) for name in ("dsm", "dtm"))
        colours = on_ramp(surface.values[0] - ground.values[0], (0.0, top), cv2.COLORMAP_INFERNO)
        return with_opacity(colours, surface.known & ground.known)

    legend = scale("surface less DTM, m", maps.gradient(cv2.COLORMAP_INFERNO), maps.even_ticks(0.0, top))
    return Layer("above", "Height above the DTM", legend, draw)


def _sigma(folder: SurfaceFolder) -> Layer:
    top = maps.span(sampled(folder, "sigma").values[0])[1]

    def draw(patch: Patch) -> Rgba:
        cells = read_patch(folder.path("sigma"), patch, True)
        return with_opacity(maps.sigma_colours(cells.values[0], top), cells.known)

    ticks = [tick.replace(" m", "", 1) for tick in maps.sigma_ticks(top)]
    legend = scale("standard deviation, m", maps.gradient(cv2.COLORMAP_CIVIDIS), ticks)
    return Layer("sigma", "Standard deviation", legend, draw)


def _views(folder: SurfaceFolder) -> Layer:
    # The sample may miss a rare number of images; the statistics of the raster hold the largest one.
    with cached_raster(folder.path("views")) as file:
        top = max(int(float(file.tags(1).get("STATISTICS_MAXIMUM", 0))), 1)
    used = np.unique([*sampled(folder, "views", average=False).values[0].ravel(), top])
    used = used[used > 0]
    table = maps.ramp(cv2.COLORMAP_VIRIDIS, top)
    colours = np.vstack([[maps.WHITE], table]).astype(np.uint8)

    def draw(patch: Patch) -> Rgba:
        cells = read_patch(folder.path("views"), patch, False)
        return with_opacity(colours[np.minimum(cells.values[0], top)], cells.known)

    title = "number of images used"
    if used.size > MAX_CLASSES:
        ticks = [f"{n:.0f}" for n in np.linspace(1, top, maps.TICKS)]
        return Layer("views", "Number of images", scale(title, maps.gradient(cv2.COLORMAP_VIRIDIS), ticks), draw)
    items = [(maps.css(table[n - 1]), str(n)) for n in used.tolist()]
    return Layer("views", "Number of images", classes(title, items), draw)


def _quality(folder: SurfaceFolder) -> Layer:
    """Layer of the reasons; transparent where there is none, so that the layers below are visible."""
    colours = np.array([*(colour for *_, colour in maps.FLAG_GROUPS), maps.NO_FLAG[1]], np.uint8)[:, ::-1]
    colours[0] = OUTSIDE_GREY
    groups = maps.groups_of(np.arange(1 << 16))

    def draw(patch: Patch) -> Rgba:
        cells = read_patch(folder.path("quality"), patch, False)
        group = groups[cells.values[0]]
        drawn = with_opacity(colours[group], cells.known & (group < len(maps.FLAG_GROUPS)))
        # Cells outside the area, or without coverage, are only shaded.
        drawn[..., 3][group == 0] //= OUTSIDE_OPACITY_DIVISOR
        return drawn

    items = [(maps.css(colours[k]), meaning) for k, (meaning, *_) in enumerate(maps.FLAG_GROUPS)]
    return Layer("quality", "Quality flags", classes("flags of quality.tif, and what they mean", items), draw)


def reasons_of(code: int) -> list[Mapping[str, str]]:
    """Reasons in a value of quality.tif, in the words of the report."""
    return [
        {"name": str(flag.name), "meaning": words.MEANINGS[flag], "fate": words.fate(flag),
         "advice": words.ADVICE.get(flag, "")}
        for flag in flags_of(code)
    ]  # fmt: skip
