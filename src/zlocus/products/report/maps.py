"""Maps of the report: pictures without a word in them, so that their legends can be read at any width."""

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
from zlocus.products.report.sampling import Survey
from zlocus.products.report.text import percent, size

if TYPE_CHECKING:
    from rasterio import DatasetReader

RELIEF_PX, MAP_PX = 1400, 800
SPAN_PERCENT, STRETCH_PERCENT = (2.0, 98.0), (1.0, 99.0)
# Of a map's width, at most.
BAR_SHARE = 0.3
# Pictures of smooth quantities larger than this are kept as JPEG, which is a tenth as long.
MOST_PNG_PX, JPEG_QUALITY = 400, 88
STOPS = 17
TICKS = 5
WHITE = (255, 255, 255)
# Okabe and Ito's colours, told apart by all eyes, and grey where nothing is to be said; the first that fits is taken.
GROUPS: tuple[tuple[str, Quality, tuple[int, int, int]], ...] = (
    ("outside the area, or covered by fewer than two images", Quality.OUTSIDE | Quality.UNSEEN, WHITE),
    ("filled from its neighbours (FILLED)", Quality.FILLED, (86, 180, 233)),
    ("no height: tile failed (FAILED)", Quality.FAILED, (90, 60, 20)),
    ("no height: end of the height range (RANGE_END)", Quality.RANGE_END, (213, 94, 0)),
    ("no height: no agreement (NO_MATCH, INCONSISTENT)", Quality.NO_MATCH | Quality.INCONSISTENT, (0, 0, 0)),
    ("no height: occluded (OCCLUDED)", Quality.OCCLUDED, (0, 114, 178)),
    ("no height: not precise enough (IMPRECISE)", Quality.IMPRECISE, (120, 120, 120)),
    ("height to be checked: halves disagree (DISPUTED)", Quality.DISPUTED, (204, 121, 167)),
    ("height to be checked (WEAK, AMBIGUOUS)", Quality.WEAK | Quality.AMBIGUOUS, (230, 159, 0)),
    ("height of a fitted plane (PLANE)", Quality.PLANE, (0, 158, 115)),
    ("height with another note (JUMP, UNREFINED, IMAGE_EXCLUDED)", Quality(0xFFFF), (240, 228, 66)),
)
PLAIN = ("height without a warning", (225, 225, 225))


@dataclass(frozen=True)
class Picture:
    """An inlined picture. uri : data URI; alt : what it shows, for those who do not see it; width, height : px."""

    uri: str
    alt: str
    width: int
    height: int


@dataclass(frozen=True)
class ScaleBar:
    """A length on a map. percent : of the map's width; words : how long it is."""

    percent: float
    words: str


@dataclass(frozen=True)
class Scale:
    """Colours that run. gradient : CSS colours from the lowest to the highest; ticks : what stands below them, evenly
    spaced; title : quantity and unit."""

    title: str
    gradient: str
    ticks: tuple[str, ...]


@dataclass(frozen=True)
class Swatch:
    """One colour (CSS), what it means, and how many cells have it."""

    colour: str
    meaning: str
    share: str


def height_map(folder: Path, found: Survey, sun_deg: tuple[float, float]) -> tuple[Picture, Scale]:
    """Heights as colours, shaded by a sun (azimuth and altitude)."""
    height, cell_m = averaged(folder / "dsm.tif", RELIEF_PX)
    low, high = span(height)
    shaded = relief(height, cell_m, (low, high), sun_deg)
    scale = Scale(f"{found.above}, m", gradient(cv2.COLORMAP_VIRIDIS), even_ticks(low, high))
    alt = f"Shaded relief coloured by height from {low:.1f} to {high:.1f} m; white where there is no height."
    return picture(shaded, alt), scale


def ortho_map(folder: Path) -> Picture | None:
    """The ortho-image, its values stretched; None where there is none."""
    if not (folder / "ortho.tif").exists():
        return None
    with open_raster(folder / "ortho.tif", "raster") as file:
        shape = shape_within(file, MAP_PX)
        values = file.read(out_shape=(file.count, *shape), resampling=Resampling.average).astype(np.float32)
        known = file.dataset_mask(out_shape=shape) > 0
    shown = values[:, known]
    low, high = np.percentile(shown, STRETCH_PERCENT) if shown.size else (0.0, 1.0)
    stretched = np.clip((values - low) / max(high - low, 1e-6), 0.0, 1.0)
    # A single grey is all three colours, which OpenCV has the other way round.
    colours = np.rint(255 * np.moveaxis(stretched[::-1] if len(values) == 3 else stretched[[0, 0, 0]], 0, -1))
    colours[~known] = WHITE
    alt = "Ortho-image: the ground as it would look from straight above; white where there is no height."
    return picture(colours.astype(np.uint8), alt)


def scale_bar(width_m: float) -> ScaleBar:
    """The longest round length that takes at most `BAR_SHARE` of a map."""
    most = BAR_SHARE * width_m
    power = 10.0 ** math.floor(math.log10(most))
    length = power * max(k for k in (1, 2, 5) if k * power <= most * (1 + 1e-9))
    return ScaleBar(100 * length / width_m, f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m")


def sigma_map(folder: Path) -> tuple[Picture, Scale]:
    """Standard deviations as colours."""
    sigma, _ = averaged(folder / "sigma.tif", MAP_PX)
    top = span(sigma)[1]
    colours = sigma_colours(sigma, top)
    colours[~np.isfinite(sigma)] = WHITE
    ticks = sigma_ticks(top)
    alt = f"Standard deviation of height, dark at 0 m to bright at {size(top, 'm')}; white where there is no height."
    return picture(colours, alt), Scale("standard deviation, m", gradient(cv2.COLORMAP_CIVIDIS), ticks)


def sigma_colours(sigma: NDArray[np.float32], top: float) -> NDArray[np.uint8]:
    """Colours (r, c, 3) of standard deviations, m, the last one from `top` on."""
    # The square root keeps the many small ones apart.
    share = np.sqrt(np.clip(np.nan_to_num(sigma) / max(top, 1e-6), 0.0, 1.0))
    return np.asarray(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS), np.uint8)


def sigma_ticks(top: float) -> tuple[str, ...]:
    """What stands below the colours of standard deviations."""
    ticks = tuple(size(top * share**2, "m") for share in np.linspace(0, 1, TICKS))
    return (*ticks[:-1], f"{ticks[-1]} or more")


def even_ticks(low: float, high: float) -> tuple[str, ...]:
    """Evenly spaced numbers; two digits of the distance between them count."""
    step = (high - low) / (TICKS - 1)
    digits = max(1, 1 - math.floor(math.log10(step))) if step > 0 else 1
    return tuple(f"{value:.{digits}f}" for value in np.linspace(low, high, TICKS))


def views_map(found: Survey) -> tuple[Picture, list[Swatch]]:
    """How many images a height rests on."""
    used = np.flatnonzero(found.n_used[1:]) + 1
    top = int(used.max()) if used.size else 1
    # 0 is white; 1 is the darkest.
    table = ramp(cv2.COLORMAP_VIRIDIS, top)
    colours = np.vstack([[WHITE], table]).astype(np.uint8)[np.minimum(found.views, top)]
    total = int(found.n_used[1:].sum())
    swatches = [
        Swatch(css(table[n - 1]), f"{n} image{'s' if n > 1 else ''}", percent(found.n_used[n], total)) for n in used
    ]
    alt = f"Number of images each height rests on, dark for few to bright for {top}; white where there is no height."
    return picture(shrunk(colours), alt, is_smooth=False), swatches


def reasons_map(found: Survey) -> tuple[Picture, list[Swatch]]:
    """The reasons of the cells, each by the first of `GROUPS` it belongs to."""
    group = groups_of(np.arange(1 << 16))
    colours = np.array([*(colour for *_, colour in GROUPS), PLAIN[1]], np.uint8)[:, ::-1]
    counts = np.bincount(group, weights=found.codes, minlength=len(GROUPS) + 1)
    names = [*(name for name, *_ in GROUPS), PLAIN[0]]
    swatches = [
        Swatch(css(colours[k]), names[k], percent(counts[k], counts.sum())) for k in range(len(names)) if counts[k]
    ]
    alt = "Reasons why cells have no height, or one to be checked; grey where there is nothing to be said."
    return picture(shrunk(colours[group[found.quality]]), alt, is_smooth=False), swatches


def groups_of(code: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of the first of `GROUPS` that values of quality.tif belong to, `len(GROUPS)` for those without any."""
    group = np.full(code.shape, len(GROUPS))
    for k, (_, flags, _) in reversed(list(enumerate(GROUPS))):
        group[(code & int(flags)) != 0] = k
    return group


def error_picture(errors: NDArray[np.float32], full_m: float) -> tuple[Picture, Scale]:
    """Errors (r, c) m as colours that are full from `full_m` on."""
    colours = error_map(errors, full_m)
    line = error_map(np.linspace(-full_m, full_m, STOPS, dtype=np.float32)[None], full_m)[0]
    ticks = tuple(f"{value:+g}" if value else "0" for value in np.linspace(-full_m, full_m, TICKS))
    alt = "Error of height: red where the surface is too high, blue where it is too low; white where it cannot be told."
    scale = Scale("surface less reference, m", ", ".join(css(colour) for colour in line), ticks)
    return picture(colours, alt), scale


def averaged(path: Path, side: int) -> tuple[NDArray[np.float32], float]:
    """A band (r, c), at most `side` cells a side, NaN where there is nothing, and the side of a cell, m."""
    with open_raster(path, "raster") as file:
        shape = shape_within(file, side)
        values = file.read(1, out_shape=shape, resampling=Resampling.average).astype(np.float32)
        return values, float(file.transform.a) * file.width / shape[1]


def shape_within(file: DatasetReader, side: int) -> tuple[int, int]:
    """Rows and columns of a raster, made smaller where a side is longer than `side`."""
    scale = min(side / max(file.shape), 1.0)
    return max(round(file.height * scale), 1), max(round(file.width * scale), 1)


def span(values: NDArray[np.float32]) -> tuple[float, float]:
    """Between which most values lie; 0 and 1 without any."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, SPAN_PERCENT) if known.size else (0.0, 1.0)
    return float(low), float(high)


def shrunk(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (r, c, 3) at most `MAP_PX` a side, by leaving out rows and columns: classes are not averaged."""
    step = -(-max(colours.shape[:2]) // MAP_PX)
    return colours[step // 2 :: step, step // 2 :: step]


def picture(colours: NDArray[Any], alt: str, is_smooth: bool = True) -> Picture:
    """An inlined picture of colours (r, c, 3) uint8 in OpenCV's order; is_smooth : of a quantity, not of classes."""
    if is_smooth and max(colours.shape) > MOST_PNG_PX:
        written = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        kind = "jpeg"
    else:
        written, kind = cv2.imencode(".png", colours)[1].tobytes(), "png"
    return Picture(data_uri(written, f"image/{kind}"), alt, colours.shape[1], colours.shape[0])


def data_uri(content: bytes, media_type: str) -> str:
    """Content as an address that holds it."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode('ascii')}"


def ramp(table: int, n: int) -> NDArray[np.uint8]:
    """n colours (n, 3) of one of OpenCV's tables, from its start to its end."""
    at = np.linspace(0, 255, n).astype(np.uint8)[None]
    return np.asarray(cv2.applyColorMap(at, table)[0], np.uint8)


def gradient(table: int) -> str:
    """A table as CSS colours."""
    return ", ".join(css(colour) for colour in ramp(table, STOPS))


def css(colour: NDArray[np.uint8]) -> str:
    """A colour in OpenCV's order for CSS."""
    blue, green, red = (int(part) for part in colour)
    return f"#{red:02x}{green:02x}{blue:02x}"
