"""How a layer is drawn, in terms that the style files of several programs can say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

# Red, green and blue, 0 to 255.
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class ValueColour:
    """A value of a raster, or a stop between which colours are interpolated, its colour and what it means."""

    value: float
    colour: Colour
    label: str


@dataclass(frozen=True)
class RampStyle:
    """A quantity: colours are interpolated between stops, from the lowest on, and stay the same beyond them.

    unit : of the values, for the legend; is_multiplied : the colours darken what lies below the layer, such as a
    hillshade.
    """

    stops: tuple[ValueColour, ...]
    unit: str = ""
    is_multiplied: bool = False


@dataclass(frozen=True)
class ClassStyle:
    """Values that stand for classes; all others are transparent."""

    classes: tuple[ValueColour, ...]


@dataclass(frozen=True)
class StretchStyle:
    """An image: one grey band, or red, green and blue.

    ranges : values of each band that are black and full; bands : numbers of these bands in the file, from 1;
    mask_band : number of the band that says where the image has values, None without one. QGIS shows a mask as one more
    band.
    """

    ranges: tuple[tuple[float, float], ...]
    bands: tuple[int, ...] = (1,)
    mask_band: int | None = None


RasterStyle = RampStyle | ClassStyle | StretchStyle


@dataclass(frozen=True)
class StyleRule:
    """How some features of a layer are drawn.

    size_mm : width of a line or an outline, or diameter of a point. ranges : the features have an attribute from the
    first number of one of these on, below its second; every : or, where it is given, one that is a multiple of it, and
    `ranges` says the same for programs that do not compute, empty where it cannot; value : or, where it is given, the
    attribute is this text. A rule with none of them is for all other features. is_labelled : whether the feature has a
    label. opacity : of the inside of a polygon, 0 to 1.
    """

    label: str
    colour: Colour
    size_mm: float
    ranges: tuple[tuple[float, float], ...] = ()
    every: float | None = None
    value: str | None = None
    is_labelled: bool = False
    opacity: float = 0.0


@dataclass(frozen=True)
class FeatureStyle:
    """Points, lines or polygons, drawn by rules on one attribute.

    decimals : of labels, which are the attribute; text_attribute : the one that labels are instead, "" for none.
    """

    attribute: str
    shape: Literal["point", "line", "polygon"]
    rules: tuple[StyleRule, ...]
    decimals: int = 0
    text_attribute: str = ""


@dataclass(frozen=True)
class PointCloudStyle:
    """A point cloud in its own colours, of 16 bits. size_mm : side of a point."""

    size_mm: float = 1.0


LayerStyle = RasterStyle | FeatureStyle | PointCloudStyle


def hexadecimal(colour: Colour) -> str:
    """A colour as #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def number(value: float) -> str:
    """A number as style files write it: without an exponent, and as short as it can be."""
    return str(int(value)) if math.isfinite(value) and value == int(value) else f"{value:.10f}".rstrip("0")
