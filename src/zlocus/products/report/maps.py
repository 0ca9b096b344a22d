"""Maps of the report. The pictures hold no text, so that their legends can be read at any width."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from zlocus.io.open_raster import open_raster
from zlocus.matching.quality import Quality
from zlocus.products.demo_figure import error_map, relief
from zlocus.products.hillshade import hillshade
from zlocus.products.report.sampling import Survey
from zlocus.products.report.text import percent, size

if TYPE_CHECKING:
    from rasterio import DatasetReader

RELIEF_PX, MAP_PX = 1400, 800
SPAN_PERCENT, STRETCH_PERCENT = (2.0, 98.0), (1.0, 99.0)
# A scale bar takes at most this share of a map's width.
MAX_BAR_SHARE = 0.3
# Larger pictures of continuous quantities are JPEG, which takes a tenth of the space.
MAX_PNG_PX, JPEG_QUALITY = 400, 88
STOPS = 17
TICKS = 5
WHITE = (255, 255, 255)
# Groups of flags with the colours of Okabe and Ito, which colour-blind readers can distinguish. A cell belongs to the
# first group that has one of its flags; to those of MASKED and WATER where it has both bits.
FLAG_GROUPS: tuple[tuple[str, Quality, tuple[int, int, int]], ...] = (
    ("water, levelled (WATER)", Quality.WATER, (10, 30, 130)),
    ("no height: masks leave fewer than two images (UNSEEN with IMAGE_EXCLUDED)", Quality.MASKED, (120, 80, 170)),
    ("outside the area, or covered by fewer than two images", Quality.OUTSIDE | Quality.UNSEEN, WHITE),
    ("filled from its neighbours (FILLED)", Quality.FILLED, (86, 180, 233)),
    ("no height: tile failed (FAILED)", Quality.FAILED, (90, 60, 20)),
    ("no height: end of the height range (RANGE_END)", Quality.RANGE_END, (213, 94, 0)),
    ("no height: no agreement (NO_MATCH, INCONSISTENT)", Quality.NO_MATCH | Quality.INCONSISTENT, (0, 0, 0)),
    ("no height: occluded (OCCLUDED)", Quality.OCCLUDED, (0, 114, 178)),
    ("no height: not precise enough (IMPRECISE)", Quality.IMPRECISE, (120, 120, 120)),
    ("height to be checked: images contradict each other (DISPUTED)", Quality.DISPUTED, (204, 121, 167)),
    ("height to be checked (WEAK, AMBIGUOUS)", Quality.WEAK | Quality.AMBIGUOUS, (230, 159, 0)),
    ("height of a fitted plane (PLANE)", Quality.PLANE, (0, 158, 115)),
    ("height with another note (JUMP, UNREFINED, IMAGE_EXCLUDED)", Quality(0xFFFF), (240, 228, 66)),
)
# Contours: brown lines on pale grey relief; every so many multiples of the interval one is thick. More lines than this
# are not drawn, for they would hide the map.
CONTOUR_LAYER, CONTOUR_COLOUR, INDEX_EVERY, MAX_DRAWN_CONTOURS = "contours", (20, 60, 130), 5, 20_000
PALEST, PALENESS = np.float32(250.0), np.float32(0.45)
# Fractions of a pixel in OpenCV's coordinates of lines.
SHIFT_BITS = 4
TWO_BITS = (Quality.MASKED, Quality.WATER)
ERROR_ALT = "Error of height: red where the surface is too high, blue where it is too low; white where it is not known."
NO_FLAG = ("height without a warning", (225, 225, 225))


@dataclass(frozen=True)
class Picture:
    """An inlined picture. uri : data URI; alt : description for readers who cannot see it; width, height : px."""

    uri: str
    alt: str
    width: int
    height: int


@dataclass(frozen=True)
class ScaleBar:
    """A scale bar of a map. percent : of the map's width; words : its length."""

    percent: float
    words: str


@dataclass(frozen=True)
class Scale:
    """Legend of a continuous quantity.

    title : quantity and unit; gradient : CSS colours from lowest to highest; ticks : evenly spaced values.
    """

    title: str
    gradient: str
    ticks: tuple[str, ...]


@dataclass(frozen=True)
class Swatch:
    """A colour (CSS) of a legend, its meaning, and the share of cells that have it."""

    colour: str
    meaning: str
    share: str


def height_map(raster: Path, survey: Survey, sun_deg: tuple[float, float]) -> tuple[Picture, Scale]:
    """Map of heights, of the surface or the terrain, as colours with relief shading. sun_deg : azimuth and altitude of
    the sun."""
    height, cell_m = averaged(raster, RELIEF_PX)
    low, high = span(height)
    shaded = relief(height, cell_m, (low, high), sun_deg)
    scale = Scale(f"{survey.height_name}, m", viridis(), even_ticks(low, high))
    alt = f"Shaded relief coloured by height from {low:.1f} to {high:.1f} m; white where there is no height."
    return picture(shaded, alt), scale


def contour_map(contours: Path, raster: Path, sun_deg: tuple[float, float]) -> Picture | None:
    """Map of contours on the grey relief of the heights from which they were drawn; None where they are too many.

    Every fifth height has a thick line. contours : GeoPackage of the product; raster : of those heights.
    """
    import pyogrio
    import shapely

    if pyogrio.read_info(contours, layer=CONTOUR_LAYER)["features"] > MAX_DRAWN_CONTOURS:
        return None
    _, _, geometry, (level_m,) = pyogrio.raw.read(contours, layer=CONTOUR_LAYER, columns=["elevation_m"])
    height, cell_m = averaged(raster, RELIEF_PX)
    grow = max(1, MAP_PX // max(height.shape))
    grey = cv2.cvtColor(hillshade(height, cell_m, *sun_deg), cv2.COLOR_GRAY2BGR)
    grey = np.where(np.isfinite(height)[..., None], PALEST - (255 - grey.astype(np.float32)) * PALENESS, 255.0)
    canvas = np.asarray(cv2.resize(np.rint(grey).astype(np.uint8), None, fx=grow, fy=grow))
    with open_raster(raster, "raster") as file:
        to_pixels = file.transform.scale(height.shape[1] / file.width, height.shape[0] / file.height) * ~file.transform
    levels = np.unique(level_m)
    interval_m = float(np.diff(levels).min(initial=np.inf))  # of neighbouring levels, none of which is left out
    for line, level in zip(shapely.from_wkb(geometry), level_m, strict=True):
        x, y = to_pixels * tuple(shapely.get_coordinates(line).T)
        points = np.rint(np.column_stack([x, y]) * grow * (1 << SHIFT_BITS)).astype(np.int32)
        is_index = np.isfinite(interval_m) and round(level / interval_m) % INDEX_EVERY == 0
        cv2.polylines(canvas, [points], False, CONTOUR_COLOUR, 2 if is_index else 1, cv2.LINE_AA, SHIFT_BITS)
    return picture(canvas, "Contours on a grey relief of the heights from which they were drawn.")


def ortho_map(folder: Path) -> Picture | None:
    """The ortho-image with stretched contrast; None where the folder has none."""
    if not (folder / "ortho.tif").exists():
        return None
    with open_raster(folder / "ortho.tif", "raster") as file:
        shape = shape_within(file, MAP_PX)
        values = file.read(out_shape=(file.count, *shape), resampling=Resampling.average).astype(np.float32)
        known = file.dataset_mask(out_shape=shape) > 0
    shown = values[:, known]
    low, high = np.percentile(shown, STRETCH_PERCENT) if shown.size else (0.0, 1.0)
    stretched = np.clip((values - low) / max(high - low, 1e-6), 0.0, 1.0)
    # OpenCV orders colours as blue, green, red; a single grey value stands for all three.
    colours = np.rint(255 * np.moveaxis(stretched[::-1] if len(values) == 3 else stretched[[0, 0, 0]], 0, -1))
    colours[~known] = WHITE
    alt = "Ortho-image: the ground as it would look from straight above; white where there is no height."
    return picture(colours.astype(np.uint8), alt)


def scale_bar(width_m: float) -> ScaleBar:
    """Scale bar of the longest round length that takes at most `MAX_BAR_SHARE` of a map."""
    most = MAX_BAR_SHARE * width_m
    power = 10.0 ** math.floor(math.log10(most))
    length = power * max(k for k in (1, 2, 5) if k * power <= most * (1 + 1e-9))
    return ScaleBar(100 * length / width_m, f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m")


def sigma_map(folder: Path) -> tuple[Picture, Scale]:
    """Map of the standard deviations."""
    sigma, _ = averaged(folder / "sigma.tif", MAP_PX)
    top = span(sigma)[1]
    colours = sigma_colours(sigma, top)
    colours[~np.isfinite(sigma)] = WHITE
    ticks = sigma_ticks(top)
    alt = f"Standard deviation of height, dark at 0 m to bright at {size(top, 'm')}; white where there is no height."
    return picture(colours, alt), Scale("standard deviation, m", gradient(cv2.COLORMAP_CIVIDIS), ticks)


def sigma_colours(sigma: NDArray[np.float32], top: float) -> NDArray[np.uint8]:
    """Colours (r, c, 3) of standard deviations, m, the last one from `top` on."""
    # The square root gives the many small values different colours.
    share = np.sqrt(np.clip(np.nan_to_num(sigma) / max(top, 1e-6), 0.0, 1.0))
    return np.asarray(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS), np.uint8)


def sigma_ticks(top: float) -> tuple[str, ...]:
    """Values below the legend of standard deviations."""
    ticks = tuple(size(top * share**2, "m") for share in np.linspace(0, 1, TICKS))
    return (*ticks[:-1], f"{ticks[-1]} or more")


def even_ticks(low: float, high: float) -> tuple[str, ...]:
    """Evenly spaced numbers, with two significant digits of the distance between them."""
    step = (high - low) / (TICKS - 1)
    digits = max(1, 1 - math.floor(math.log10(step))) if step > 0 else 1
    return tuple(f"{value:.{digits}f}" for value in np.linspace(low, high, TICKS))


def views_map(survey: Survey) -> tuple[Picture, list[Swatch]]:
    """Map of the number of images with which each height was matched."""
    used = np.flatnonzero(survey.n_used[1:]) + 1
    top = int(used.max()) if used.size else 1
    # 0 is white, 1 the darkest colour.
    table = ramp(cv2.COLORMAP_VIRIDIS, top)
    colours = np.vstack([[WHITE], table]).astype(np.uint8)[np.minimum(survey.views, top)]
    total = int(survey.n_used[1:].sum())
    swatches = [
        Swatch(css(table[n - 1]), f"{n} image{'s' if n > 1 else ''}", percent(survey.n_used[n], total)) for n in used
    ]
    alt = f"Number of images used for each height, dark for few to bright for {top}; white where there is no height."
    return picture(shrunk(colours), alt, is_smooth=False), swatches


def reasons_map(survey: Survey) -> tuple[Picture, list[Swatch]]:
    """Map of the reasons; each cell has the colour of the first of `FLAG_GROUPS` to which it belongs."""
    group = groups_of(np.arange(1 << 16))
    colours = np.array([*(colour for *_, colour in FLAG_GROUPS), NO_FLAG[1]], np.uint8)[:, ::-1]
    counts = np.bincount(group, weights=survey.codes, minlength=len(FLAG_GROUPS) + 1)
    names = [*(name for name, *_ in FLAG_GROUPS), NO_FLAG[0]]
    swatches = [
        Swatch(css(colours[k]), names[k], percent(counts[k], counts.sum())) for k in range(len(names)) if counts[k]
    ]
    alt = "Reasons why cells have no height, or one to be checked; grey where a height has no warning."
    return picture(shrunk(colours[group[survey.quality]]), alt, is_smooth=False), swatches


def groups_of(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the first of `FLAG_GROUPS` to which values of quality.tif belong; `len(FLAG_GROUPS)` without one."""
    group = np.full(code.shape, len(FLAG_GROUPS))
    for k, (_, flags, _) in reversed(list(enumerate(FLAG_GROUPS))):
        group[(code & int(flags)) == int(flags) if flags in TWO_BITS else (code & int(flags)) != 0] = k
    return group


def error_picture(
    errors: NDArray[np.float32],
    saturated_m: float,
    title: str = "surface less reference, m",
    alt: str = ERROR_ALT,
) -> tuple[Picture, Scale]:
    """Map of errors (r, c) m, with colours that are saturated from `saturated_m` on. title : of the legend; alt :
    description of the picture."""
    colours = error_map(errors, saturated_m)
    line = error_map(np.linspace(-saturated_m, saturated_m, STOPS, dtype=np.float32)[None], saturated_m)[0]
    ticks = tuple(f"{value:+g}" if value else "0" for value in np.linspace(-saturated_m, saturated_m, TICKS))
    scale = Scale(title, ", ".join(css(colour) for colour in line), ticks)
    return picture(colours, alt), scale


def averaged(path: Path, side: int) -> tuple[NDArray[np.float32], float]:
    """A band (r, c) of at most `side` cells a side, NaN where it is empty, and the side of a cell, m."""
    with open_raster(path, "raster") as file:
        shape = shape_within(file, side)
        values = file.read(1, out_shape=shape, resampling=Resampling.average).astype(np.float32)
        return values, float(file.transform.a) * file.width / shape[1]


def shape_within(file: DatasetReader, side: int) -> tuple[int, int]:
    """Rows and columns of a raster, reduced where a side is longer than `side`."""
    scale = min(side / max(file.shape), 1.0)
    return max(round(file.height * scale), 1), max(round(file.width * scale), 1)


def span(values: NDArray[np.float32]) -> tuple[float, float]:
    """Range in which most values lie; 0 and 1 without values."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, SPAN_PERCENT) if known.size else (0.0, 1.0)
    return float(low), float(high)


def shrunk(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (r, c, 3) of at most `MAP_PX` a side; rows and columns are left out, because classes have no mean."""
    step = -(-max(colours.shape[:2]) // MAP_PX)
    return colours[step // 2 :: step, step // 2 :: step]


def picture(colours: NDArray[Any], alt: str, is_smooth: bool = True) -> Picture:
    """An inlined picture of colours (r, c, 3) uint8 in OpenCV's order; is_smooth : of a quantity, not classes."""
    if is_smooth and max(colours.shape) > MAX_PNG_PX:
        written = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        kind = "jpeg"
    else:
        written, kind = cv2.imencode(".png", colours)[1].tobytes(), "png"
    return Picture(data_uri(written, f"image/{kind}"), alt, colours.shape[1], colours.shape[0])


def data_uri(content: bytes, media_type: str) -> str:
    """A data URI that holds some content."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def ramp(table: int, n: int) -> NDArray[np.uint8]:
    """Colours (n, 3) of one of OpenCV's tables, from its start to its end."""
    at = np.linspace(0, 255, n).astype(np.uint8)[None]
    return np.asarray(cv2.applyColorMap(at, table)[0], np.uint8)


def gradient(table: int) -> str:
    """One of OpenCV's tables as CSS colours."""
    return ", ".join(css(colour) for colour in ramp(table, STOPS))


def viridis() -> str:
    """The colours of heights as CSS colours, from the lowest on."""
    return gradient(cv2.COLORMAP_VIRIDIS)


def css(colour: NDArray[np.uint8]) -> str:
    """CSS of a colour in OpenCV's order."""
    blue, green, red = (int(part) for part in colour)
    return f"#{red:02x}{green:02x}{blue:02x}"
