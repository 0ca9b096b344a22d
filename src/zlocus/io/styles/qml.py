"""Styles of QGIS 3.22 and later (QML). QGIS reads `dsm.qml` with `dsm.tif`."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from zlocus.io.styles.layer_style import (
    ClassStyle,
    FeatureStyle,
    LayerStyle,
    PointCloudStyle,
    RampStyle,
    RasterStyle,
    StretchStyle,
    StyleRule,
    ValueColour,
    hexadecimal,
    number,
)
from zlocus.io.styles.xml_nodes import document, node

VERSION = "3.22.0"
# Numbers that QGIS gives to these.
NORMAL, MULTIPLY = 0, 6
PLACED_ALONG_LINE, PLACED_INSIDE, PLACED_ALONG_OUTLINE = 3, 4, 7
ON_LINE, BELOW_LINE = 1, 4
COLOUR_BANDS = ("red", "green", "blue")
BRIGHTEST_POINT = 65535
# Attributes this close to a multiple are one, in shares of it.
MULTIPLE_TOLERANCE = 1e-6
LABEL_POINTS, BUFFER_MM, OUTLINE_MM = 7, 0.6, 0.1
# Without it QGIS takes the thinnest font; QGIS with Qt 6 counts otherwise, and goes by the name of the style.
NORMAL_WEIGHT = "50"
# Points of a cloud that are closer together on the screen are left out.
POINT_DISTANCE_MM = 0.3


def qml_of(style: LayerStyle) -> str:
    """The text of a style file."""
    if isinstance(style, FeatureStyle):
        return document(_feature_root(style))
    if isinstance(style, PointCloudStyle):
        return document(_cloud_root(style))
    return document(_raster_root(style))


def _cloud_root(style: PointCloudStyle) -> Element:
    """The same for all point clouds: QGIS would take the brightest point for white."""
    names = {name: name.title() for name in COLOUR_BANDS}
    white = (_enhancement(f"{name}ContrastEnhancement", 0, BRIGHTEST_POINT) for name in COLOUR_BANDS)
    renderer = node(
        "renderer", *white, type="rgb", **names, pointSize=number(style.size_mm), pointSizeUnit="MM", pointSymbol="0",
        maximumScreenError=number(POINT_DISTANCE_MM), maximumScreenErrorUnit="MM",
    )  # fmt: skip
    return node(
        "qgis", renderer, node("blendMode", text=str(NORMAL)), node("layerOpacity", text="1"), version=VERSION,
        styleCategories="Symbology",
    )  # fmt: skip


def _raster_root(style: RasterStyle) -> Element:
    if isinstance(style, RampStyle):
        renderer = _ramp(style)
    elif isinstance(style, ClassStyle):
        renderer = _classes(style)
    else:
        renderer = _stretch(style)
    # Means of classes would be other classes.
    resampling = "nearest" if isinstance(style, ClassStyle) else "bilinear"
    resampler = node("rasterresampler", zoomedOutResampler=resampling, maxOversampling="2")
    is_multiplied = isinstance(style, RampStyle) and style.is_multiplied
    return node(
        "qgis", node("pipe", renderer, node("brightnesscontrast"), node("huesaturation"), resampler),
        node("blendMode", text=str(MULTIPLY if is_multiplied else NORMAL)),
        version=VERSION, styleCategories="Symbology",
    )  # fmt: skip


def _renderer(kind: str, *parts: Element, alphaBand: str = "-1", **attributes: str) -> Element:
    return node(
        "rasterrenderer", node("rasterTransparency"), *parts, type=kind, opacity="1", alphaBand=alphaBand,
        nodataColor="", **attributes,
    )  # fmt: skip


def _ramp(style: RampStyle) -> Element:
    low, high = number(style.stops[0].value), number(style.stops[-1].value)
    items = (_entry("item", stop) for stop in style.stops)
    # The legend is one bar with the values of its ends.
    legend = node("rampLegendSettings", useContinuousLegend="1", suffix=f" {style.unit}" if style.unit else "")
    shader = node(
        "colorrampshader", *items, legend, colorRampType="INTERPOLATED", classificationMode="1", clip="0",
        minimumValue=low, maximumValue=high,
    )  # fmt: skip
    return _renderer(
        "singlebandpseudocolor", node("rastershader", shader), band="1", classificationMin=low, classificationMax=high
    )


def _classes(style: ClassStyle) -> Element:
    entries = (_entry("paletteEntry", each) for each in style.classes)
    return _renderer("paletted", node("colorPalette", *entries), band="1")


def _entry(name: str, colour: ValueColour) -> Element:
    return node(name, value=number(colour.value), color=hexadecimal(colour.colour), alpha="255", label=colour.label)


def _stretch(style: StretchStyle) -> Element:
    alpha = "-1" if style.mask_band is None else str(style.mask_band)
    if len(style.ranges) == 1:
        stretched, band = _enhancement("contrastEnhancement", *style.ranges[0]), str(style.bands[0])
        return _renderer("singlebandgray", stretched, alphaBand=alpha, grayBand=band, gradient="BlackToWhite")
    bands = {f"{name}Band": str(band) for name, band in zip(COLOUR_BANDS, style.bands, strict=True)}
    parts = (
        _enhancement(f"{name}ContrastEnhancement", *span) for name, span in zip(COLOUR_BANDS, style.ranges, strict=True)
    )
    return _renderer("multibandcolor", *parts, alphaBand=alpha, **bands)


def _enhancement(name: str, low: float, high: float) -> Element:
    return node(
        name, node("minValue", text=number(low)), node("maxValue", text=number(high)),
        node("algorithm", text="StretchToMinimumMaximum"),
    )  # fmt: skip


def _feature_root(style: FeatureStyle) -> Element:
    rules, symbols = [], []
    for k, rule in enumerate(style.rules):
        rules.append(node("rule", key=f"rule{k}", symbol=str(k), label=rule.label, filter=_filter(style, rule)))
        symbols.append(_symbol(style, rule, str(k)))
    renderer = node(
        "renderer-v2", node("rules", *rules, key="rules"), node("symbols", *symbols), type="RuleRenderer",
        forceraster="0", symbollevels="0", enableorderby="0",
    )  # fmt: skip
    labelled = [rule for rule in style.rules if rule.is_labelled]
    labels = [_labels(style, rule, k) for k, rule in enumerate(labelled)]
    labeling = node("labeling", node("rules", *labels, key="labels"), type="rule-based") if labels else None
    categories = "Symbology|Labeling" if labels else "Symbology"
    return node(
        "qgis", renderer, labeling, node("blendMode", text=str(NORMAL)), version=VERSION, styleCategories=categories,
        labelsEnabled="1" if labels else "0",
    )  # fmt: skip


def _filter(style: FeatureStyle, rule: StyleRule) -> str:
    """The expression of a rule; ELSE is for all features of no other rule."""
    attribute = f'"{style.attribute}"'
    if rule.value is not None:
        return f"{attribute} = '{rule.value}'"
    if rule.every is not None:
        share = f"{attribute} / {number(rule.every)}"
        return f"abs({share} - round({share})) < {number(MULTIPLE_TOLERANCE)}"
    parts = []
    for low, high in rule.ranges:
        ends = [f"{attribute} >= {number(low)}"] * (low != -float("inf"))
        ends += [f"{attribute} < {number(high)}"] * (high != float("inf"))
        parts.append(" AND ".join(ends))
    return " OR ".join(f"({part})" for part in parts) or "ELSE"


def _symbol(style: FeatureStyle, rule: StyleRule, name: str) -> Element:
    colour = _rgba(rule)
    if style.shape == "polygon":
        kind, layer = "fill", "SimpleFill"
        inside = ",".join(str(part) for part in (*rule.colour, round(255 * rule.opacity)))
        values = {
            "color": inside, "style": "solid" if rule.opacity else "no", "outline_color": colour,
            "outline_width": number(rule.size_mm), "outline_width_unit": "MM",
            "outline_style": "solid" if rule.size_mm else "no", "joinstyle": "round",
        }  # fmt: skip
    elif style.shape == "line":
        kind, layer = "line", "SimpleLine"
        values = {
            "line_color": colour, "line_width": number(rule.size_mm), "line_width_unit": "MM", "line_style": "solid",
            "capstyle": "round", "joinstyle": "round",
        }  # fmt: skip
    else:
        kind, layer = "marker", "SimpleMarker"
        values = {
            "name": "circle", "color": colour, "size": number(rule.size_mm), "size_unit": "MM",
            "outline_color": "40,40,40,255", "outline_width": number(OUTLINE_MM), "outline_style": "solid",
        }  # fmt: skip
    options = node("Option", *(node("Option", type="QString", name=k, value=v) for k, v in values.items()), type="Map")
    part = node("layer", options, class_=layer, enabled="1", locked="0", pass_="0")
    return node("symbol", part, type=kind, name=name, alpha="1", clip_to_extent="1", force_rhr="0")


def _labels(style: FeatureStyle, rule: StyleRule, number_of_rule: int) -> Element:
    """The labels of a rule of lines, along them, or of points, around them."""
    buffer = node(
        "text-buffer", bufferDraw="1", bufferSize=number(BUFFER_MM), bufferSizeUnits="MM",
        bufferColor="255,255,255,255", bufferOpacity="1", bufferJoinStyle="128",
    )  # fmt: skip
    text = f'"{style.text_attribute}"' if style.text_attribute else _rounded(style)
    text_style = node(
        "text-style", buffer, fieldName=text,
        isExpression="1", fontSize=str(LABEL_POINTS), fontSizeUnit="Point", fontWeight=NORMAL_WEIGHT,
        namedStyle="Regular", textColor=_rgba(rule), textOpacity="1",
    )  # fmt: skip
    curved = {"maxCurvedCharAngleIn": "25", "maxCurvedCharAngleOut": "-25", "repeatDistance": "60",
              "repeatDistanceUnits": "MM"}  # fmt: skip
    along_outline = {"placement": str(PLACED_ALONG_OUTLINE), "placementFlags": str(BELOW_LINE), **curved}
    placements = {
        "line": {"placement": str(PLACED_ALONG_LINE), "placementFlags": str(ON_LINE), **curved},
        # Outlines without an inside may lie above each other, and so may their middles.
        "polygon": {"placement": str(PLACED_INSIDE)} if rule.opacity else along_outline,
        "point": {"placement": "0", "dist": "1", "distUnits": "MM"},
    }
    placement = node("placement", **placements[style.shape])
    rendering = node("rendering", drawLabels="1", obstacle="1", upsidedownLabels="0", fontMaxPixelSize="10000")
    settings = node("settings", text_style, placement, rendering)
    return node("rule", settings, key=f"label{number_of_rule}", filter=_filter(style, rule))


def _rounded(style: FeatureStyle) -> str:
    return f'to_string(round("{style.attribute}", {style.decimals}))'


def _rgba(rule: StyleRule) -> str:
    return ",".join(str(part) for part in (*rule.colour, 255))
