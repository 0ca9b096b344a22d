"""Styles beside the products of a result: how QGIS and map servers draw them, and what their values mean."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags

from zlocus.core.options import ProductOptions
from zlocus.io.atomic_write import write_atomically
from zlocus.io.open_raster import open_raster
from zlocus.io.row_strips import BandReader
from zlocus.io.safe_documents import read_json
from zlocus.io.styles.file_names import OF_SURFACE, remove_styles, style_files
from zlocus.io.styles.layer_style import (
    ClassStyle,
    Colour,
    FeatureStyle,
    LayerStyle,
    PointCloudStyle,
    RampStyle,
    StretchStyle,
    StyleRule,
    ValueColour,
    number,
)
from zlocus.io.styles.qml import qml_of
from zlocus.io.styles.sld import sld_of
from zlocus.products.contours import contour_interval_m
from zlocus.products.flag_styles import FlagValues
from zlocus.products.rasters import WaterKind
from zlocus.products.report.maps import (
    CONTOUR_COLOUR,
    INDEX_EVERY,
    SPAN_PERCENT,
    STRETCH_PERCENT,
    ramp,
)
from zlocus.products.shade_kernel import BRIGHTEST, DARKEST

# Cells along the longer side from which the range of values is taken.
SAMPLE_CELLS = 512
N_STOPS = 9
# Grey values by which a hillshade is brightened.
SHADE_GREY = 40.0
# Colours of heights, which a hillshade below darkens: pale, from green lowlands to white tops.
HEIGHT_COLOURS: tuple[Colour, ...] = (
    (154, 200, 160), (191, 219, 165), (232, 232, 176), (240, 214, 150), (226, 183, 124), (203, 156, 117),
    (206, 181, 160), (228, 220, 213), (255, 255, 255),
)  # fmt: skip
# More images than this have no class each.
MAX_COUNTS = 32
MAX_INDEX_CONTOURS = 200
# Values of a smaller range are drawn as if it were 1.
MIN_SPAN = 1e-3
CONTOUR_MM, INDEX_CONTOUR_MM, POINT_MM, FOOTPRINT_MM = 0.15, 0.35, 1.6, 0.4
# Overlaps of all pairs of images above each other, and of one pair at least.
IMAGE_INK, ALL_OVERLAPS_OPACITY, MIN_OPACITY = (40, 40, 40), 0.85, 0.03
COLOURS = ("red", "green", "blue")
# Okabe and Ito.
BLUE, SKY_BLUE, ORANGE, VERMILION = (0, 114, 178), (86, 180, 233), (230, 159, 0), (213, 94, 0)
NAMES_OF_WATER = {
    WaterKind.LEVELLED: ("levelled inside a polygon", (10, 30, 130)),
    WaterKind.POSSIBLE_LEVELLED: ("possible water, levelled", BLUE),
    WaterKind.POSSIBLE: ("possible water, or a polygon without a level; heights are matched", SKY_BLUE),
}  # fmt: skip
RESIDUALS_PX = ((0.5, BLUE), (1.0, SKY_BLUE), (2.0, ORANGE), (math.inf, VERMILION))
GOOD_IMAGES = ((0, VERMILION), (1, ORANGE), (2, SKY_BLUE), (3, BLUE))


def write_styles(folder: Path, options: ProductOptions, renewed: Collection[str] = ()) -> None:
    """Write the style files of the products of a surface that have none, where the options ask for styles.

    A style is that of its product: it is made with it, and what users change in it stays until the product is made
    again. renewed : products that were made again, whose earlier styles are replaced, or removed.

    Raises
    ------
    InputError
        A product is damaged.
    OutputError
        A file cannot be written.
    """
    remove_styles(folder, [name for name in renewed if name in OF_SURFACE])
    if not options.styles:
        return
    for product in styled_products(folder):
        write_style(folder / product, MAKERS[product], options)


def missing_styles(folder: Path, options: ProductOptions) -> tuple[str, ...]:
    """Names of the style files that the products in a folder lack."""
    wanted = styled_products(folder) if options.styles else ()
    return tuple(name for product in wanted for name in style_files(product) if not (folder / name).exists())


def styled_products(folder: Path) -> tuple[str, ...]:
    """Names of the products of a surface in a folder that can have a style."""
    return tuple(name for name in OF_SURFACE if (folder / name).is_file())


Maker = Callable[[Path, ProductOptions], LayerStyle | FlagValues]


def write_style(path: Path, make: Maker, options: ProductOptions) -> list[str]:
    """Write the style files of a product that are missing, and return their names.

    make : its style, or the values of its flags.
    """
    missing = [name for name in style_files(path.name) if not (path.parent / name).exists()]
    if not missing:
        return []
    made = make(path, options)
    style = made.style() if isinstance(made, FlagValues) else made
    of_servers = () if isinstance(style, PointCloudStyle) else (sld_of(style, path.stem),)
    of_flags = (made.table(), made.reasons()) if isinstance(made, FlagValues) else ()
    texts = (qml_of(style), *of_servers, *of_flags)
    for name, text in zip(style_files(path.name), texts, strict=True):
        if name in missing:
            write_atomically(path.parent / name, partial(Path.write_text, data=text, encoding="utf-8"))
    return missing


def _heights(path: Path, options: ProductOptions) -> RampStyle:
    return even_ramp(*round_span(path), HEIGHT_COLOURS, "m", is_multiplied=True)


def round_span(path: Path) -> tuple[float, float]:
    """Round numbers around nearly all values of a raster."""
    low, high = percentiles(sampled(path), SPAN_PERCENT)
    step = 10.0 ** (math.floor(math.log10(high - low)) - 1)
    return math.floor(low / step) * step, math.ceil(high / step) * step


def _sigmas(path: Path, options: ProductOptions) -> RampStyle:
    high = rounded_up(percentiles(sampled(path), SPAN_PERCENT)[1])
    # Squares give the many small values different colours, as in the report.
    values = high * np.linspace(0.0, 1.0, N_STOPS) ** 2
    return _ramp(values, table_colours(cv2.COLORMAP_CIVIDIS), _decimals(high) + 1, "m")


def _hillshade(path: Path, options: ProductOptions) -> StretchStyle:
    # Grey in place of black, so that colours above it can be seen.
    return StretchStyle(((DARKEST - SHADE_GREY, BRIGHTEST - SHADE_GREY),))


def image_style(path: Path, options: ProductOptions) -> StretchStyle:
    """The style of an ortho-image: in its colours, or grey where it has fewer than three bands."""
    with open_raster(path, "raster") as file:
        bands = _colour_bands(file.colorinterp, file.descriptions)
        # QGIS shows a mask as one more band.
        mask_band = file.count + 1 if MaskFlags.per_dataset in file.mask_flag_enums[0] else None
    ranges = tuple(percentiles(sampled(path, band), STRETCH_PERCENT) for band in bands)
    return StretchStyle(ranges, bands, mask_band)


def _colour_bands(meanings: Sequence[ColorInterp], names: Sequence[str | None]) -> tuple[int, ...]:
    """Numbers of the bands of red, green and blue: by what the file says they mean, by their names, or the first."""
    if len(meanings) < len(COLOURS):
        return (1,)
    by_name = [(name or "").lower() for name in names]
    for known in ([meaning.name for meaning in meanings], by_name):
        if all(known.count(colour) == 1 for colour in COLOURS):
            return tuple(known.index(colour) + 1 for colour in COLOURS)
    return (1, 2, 3)


def _counts(path: Path, options: ProductOptions) -> ClassStyle | RampStyle:
    with BandReader(path) as reader:
        low, high = int(reader.statistic("MINIMUM") or 1), int(reader.statistic("MAXIMUM") or 1)
    if high - low >= MAX_COUNTS:
        return _ramp(np.linspace(low, high, N_STOPS), table_colours(cv2.COLORMAP_VIRIDIS), 0, "images")
    # The colours of the report, in which 1 is the darkest.
    colours = table_colours(cv2.COLORMAP_VIRIDIS, high)
    counts = range(low, high + 1)
    return ClassStyle(tuple(ValueColour(k, colours[k - 1], f"{k} image{'s' * (k > 1)}") for k in counts))


def flag_values(path: Path, options: ProductOptions) -> FlagValues:
    """The values of a raster of flags, which have a style, a table and groups."""
    return FlagValues.of(path)


def named_classes(names: Mapping[Any, tuple[str, Colour]]) -> Maker:
    """A style of classes with fixed names and colours. names : and colours, by the value of the class."""
    classes = tuple(ValueColour(int(value), colour, label) for value, (label, colour) in names.items())
    return lambda path, options: ClassStyle(classes)


def _contours(path: Path, options: ProductOptions) -> FeatureStyle:
    raster = path.parent / f"{options.contours_of}.tif"
    with BandReader(raster if raster.is_file() else path.parent / "dsm.tif") as reader:
        interval_m = contour_interval_m(reader, options)
        low, mean, high = (reader.statistic(name) or 0.0 for name in ("MINIMUM", "MEAN", "MAXIMUM"))
    index_m = INDEX_EVERY * interval_m
    # Programs without expressions get a list of heights, around the mean where blunders make it long.
    middle = round(mean / index_m)
    first = max(math.ceil(low / index_m), middle - MAX_INDEX_CONTOURS // 2)
    last = min(math.floor(high / index_m), middle + MAX_INDEX_CONTOURS // 2)
    multiples = range(first, last + 1)
    ranges = tuple((k * index_m - interval_m / 2, k * index_m + interval_m / 2) for k in multiples)
    blue, green, red = CONTOUR_COLOUR
    colour = (red, green, blue)
    decimals = len(number(index_m).partition(".")[2])
    index = StyleRule(f"every {number(index_m)} m", colour, INDEX_CONTOUR_MM, ranges, index_m, is_labelled=True)
    return FeatureStyle(
        "elevation_m", "line", (index, StyleRule(f"every {number(interval_m)} m", colour, CONTOUR_MM)), decimals
    )


def _ties(path: Path, options: ProductOptions) -> FeatureStyle:
    rules, low = [], -math.inf
    for high, colour in RESIDUALS_PX:
        label = f"residual below {high:g} px" if high < math.inf else f"residual of {low:g} px or more"
        rules.append(StyleRule(label, colour, POINT_MM, ((low, high),)))
        low = high
    return FeatureStyle("residual_px", "point", tuple(rules))


def _ranking(path: Path, options: ProductOptions) -> FeatureStyle:
    rules = []
    for n, colour in GOOD_IMAGES:
        is_last = n == GOOD_IMAGES[-1][0]
        label = f"{n}{' or more' * is_last} image{'s' * (n != 1)} that match well"
        ends = (n - 0.5 if n else -math.inf, math.inf if is_last else n + 0.5)
        rules.append(StyleRule(label, colour, POINT_MM, (ends,)))
    return FeatureStyle("n_good", "point", tuple(rules))


def _footprints(path: Path, options: ProductOptions) -> FeatureStyle:
    """Outlines with the names of the images; ground is the darker, the more pairs of images show it."""
    kinds = [feature["properties"]["kind"] for feature in read_json(path)["features"]]
    opacity = max(1.0 - (1.0 - ALL_OVERLAPS_OPACITY) ** (1.0 / max(kinds.count("overlap"), 3)), MIN_OPACITY)
    image = StyleRule("image", IMAGE_INK, FOOTPRINT_MM, value="image", is_labelled=True)
    overlap = StyleRule("overlap of two images", BLUE, 0.0, value="overlap", opacity=round(opacity, 4))
    return FeatureStyle("kind", "polygon", (overlap, image), text_attribute="name")


def point_cloud_style(path: Path, options: ProductOptions) -> PointCloudStyle:
    """Points in their own colours."""
    return PointCloudStyle()


def sampled(path: Path, band: int = 1) -> NDArray[np.float64]:
    """Known values (n,) of cells spread evenly over a raster, or of its overview."""
    with open_raster(path, "raster") as file:
        scale = min(SAMPLE_CELLS / max(file.shape), 1.0)
        shape = max(round(file.height * scale), 1), max(round(file.width * scale), 1)
        values = file.read(band, out_shape=shape, masked=True)
    known = np.asarray(values.compressed(), np.float64)
    return known[np.isfinite(known)]


def percentiles(sample: NDArray[np.float64], percent: tuple[float, float]) -> tuple[float, float]:
    """Two percentiles of values, the second one larger; 0 and 1 without any."""
    low, high = (float(value) for value in np.percentile(sample, percent)) if sample.size else (0.0, 1.0)
    return low, high if high > low + MIN_SPAN else low + 1.0


def rounded_up(value: float) -> float:
    """The next number with two digits that is not smaller, at least a millimetre."""
    step = 10.0 ** (math.floor(math.log10(max(value, 1e-3))) - 1)
    return math.ceil(max(value, 1e-3) / step - 1e-9) * step


def _decimals(span: float) -> int:
    """Decimals of values that fill a span, of two digits or more."""
    return max(0, 1 - math.floor(math.log10(span)))


def even_ramp(low: float, high: float, colours: Sequence[Colour], unit: str, is_multiplied: bool = False) -> RampStyle:
    """Colours at even distances between two values. unit : of their labels."""
    values = np.linspace(low, high, len(colours))
    return _ramp(values, colours, _decimals(high - low), unit, is_multiplied)


def _ramp(
    values: NDArray[np.float64], colours: Sequence[Colour], decimals: int, unit: str, is_multiplied: bool = False
) -> RampStyle:
    stops = tuple(
        ValueColour(round(float(value), 6), colour, f"{value:.{decimals}f} {unit}")
        for value, colour in zip(values, colours, strict=True)
    )
    return RampStyle(stops, unit, is_multiplied)


def table_colours(table: int, n: int = N_STOPS) -> list[Colour]:
    """Colours of one of OpenCV's tables, from its start to its end."""
    return [(int(red), int(green), int(blue)) for blue, green, red in ramp(table, n)]


MAKERS: dict[str, Maker] = {
    "dsm.tif": _heights, "dtm.tif": _heights, "sigma.tif": _sigmas, "quality.tif": flag_values, "views.tif": _counts,
    "ortho.tif": image_style, "water.tif": named_classes(NAMES_OF_WATER), "hillshade.tif": _hillshade,
    "contours.gpkg": _contours, "surface.laz": point_cloud_style, "surface.copc.laz": point_cloud_style,
    "ties.gpkg": _ties, "ranking.gpkg": _ranking, "footprints.geojson": _footprints,
}  # fmt: skip
