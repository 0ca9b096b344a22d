"""Styles for map servers (SLD 1.0), with the extensions of GeoServer that QGIS and MapServer read too."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from zlocus.io.styles.layer_style import (
    ClassStyle,
    FeatureStyle,
    LayerStyle,
    RampStyle,
    StretchStyle,
    StyleRule,
    ValueColour,
    hexadecimal,
    number,
)
from zlocus.io.styles.xml_nodes import document, node

NAMESPACES = {"xmlns": "http://www.opengis.net/sld", "xmlns:ogc": "http://www.opengis.net/ogc"}
COLOUR_CHANNELS = ("RedChannel", "GreenChannel", "BlueChannel")
# A pixel of SLD is 0.28 mm wide.
PX_PER_MM = 1.0 / 0.28
LABEL_PX, HALO_PX, REPEAT_PX = 10, 2, 300
WHITE = (255, 255, 255)
N_GREYS = 52


def sld_of(style: LayerStyle, name: str) -> str:
    """The text of a style file. name : of the layer and of the style."""
    if isinstance(style, FeatureStyle):
        rules = [_feature_rule(style, rule) for rule in style.rules if rule.every is None or rule.ranges]
        options = []
    else:
        rules = [node("Rule", _symbolizer(style))]
        is_multiplied = isinstance(style, RampStyle) and style.is_multiplied
        options = [node("VendorOption", text="multiply", name="composite")] if is_multiplied else []
    features = node("FeatureTypeStyle", *rules, *options)
    user_style = node("UserStyle", node("Name", text=name), node("Title", text=name), features)
    layer = node("NamedLayer", node("Name", text=name), user_style)
    root = node("StyledLayerDescriptor", layer, version="1.0.0")
    root.attrib.update(NAMESPACES)
    return document(root)


def _symbolizer(style: RampStyle | ClassStyle | StretchStyle) -> Element:
    opacity = node("Opacity", text="1.0")
    if isinstance(style, StretchStyle) and len(style.ranges) > 1:
        return node("RasterSymbolizer", opacity, _channels(style))
    if isinstance(style, ClassStyle):
        # MapServer takes each value as the lower end of an interval.
        kind, entries = "values", tuple(sorted(style.classes, key=lambda colour: colour.value))
    elif isinstance(style, RampStyle):
        kind, entries = "ramp", style.stops
    else:
        kind, entries = "ramp", _greys(*style.ranges[0])
    return node("RasterSymbolizer", opacity, node("ColorMap", *map(_entry, entries), type=kind))


def _greys(low: float, high: float) -> tuple[ValueColour, ...]:
    """Stops from black to white, many, because MapServer draws steps and no ramp."""
    shares = [k / (N_GREYS - 1) for k in range(N_GREYS)]
    return tuple(ValueColour(round(low + share * (high - low), 6), (round(share * 255),) * 3, "") for share in shares)


def _entry(colour: ValueColour) -> Element:
    label = {"label": colour.label} if colour.label else {}
    return node("ColorMapEntry", color=hexadecimal(colour.colour), quantity=number(colour.value), opacity="1", **label)


def _channels(style: StretchStyle) -> Element:
    channels = []
    for k, (channel, (low, high)) in enumerate(zip(COLOUR_CHANNELS, style.ranges, strict=True), 1):
        limits = {"algorithm": "StretchToMinimumMaximum", "minValue": number(low), "maxValue": number(high)}
        options = (node("VendorOption", text=value, name=key) for key, value in limits.items())
        stretched = node("ContrastEnhancement", node("Normalize", *options))
        channels.append(node(channel, node("SourceChannelName", text=str(k)), stretched))
    return node("ChannelSelection", *channels)


def _feature_rule(style: FeatureStyle, rule: StyleRule) -> Element:
    size_px = number(round(rule.size_mm * PX_PER_MM, 2))
    colour = hexadecimal(rule.colour)
    if style.is_line:
        drawn = node("LineSymbolizer", node("Stroke", _css("stroke", colour), _css("stroke-width", size_px)))
    else:
        mark = node("Mark", node("WellKnownName", text="circle"), node("Fill", _css("fill", colour)))
        drawn = node("PointSymbolizer", node("Graphic", mark, node("Size", text=size_px)))
    chosen = _filter(style, rule)
    label = _label(style, rule) if rule.is_labelled else None
    return node("Rule", node("Name", text=rule.label), node("Title", text=rule.label), chosen, drawn, label)


def _filter(style: FeatureStyle, rule: StyleRule) -> Element:
    ranges = [_range(style.attribute, low, high) for low, high in rule.ranges]
    if not ranges:
        return node("ElseFilter")
    return node("ogc:Filter", ranges[0] if len(ranges) == 1 else node("ogc:Or", *ranges))


def _range(attribute: str, low: float, high: float) -> Element:
    ends = []
    for kind, end in (("ogc:PropertyIsGreaterThanOrEqualTo", low), ("ogc:PropertyIsLessThan", high)):
        if abs(end) != float("inf"):
            ends.append(node(kind, node("ogc:PropertyName", text=attribute), node("ogc:Literal", text=number(end))))
    return ends[0] if len(ends) == 1 else node("ogc:And", *ends)


def _label(style: FeatureStyle, rule: StyleRule) -> Element:
    font = node("Font", _css("font-family", "sans-serif"), _css("font-size", str(LABEL_PX)))
    halo = node("Halo", node("Radius", text=str(HALO_PX)), node("Fill", _css("fill", hexadecimal(WHITE))))
    placement = node("LabelPlacement", node("LinePlacement")) if style.is_line else None
    options = {"followLine": "true", "repeat": str(REPEAT_PX)} if style.is_line else {}
    return node(
        "TextSymbolizer", node("Label", node("ogc:PropertyName", text=style.attribute)), font, placement, halo,
        node("Fill", _css("fill", hexadecimal(rule.colour))),
        *(node("VendorOption", text=value, name=key) for key, value in options.items()),
    )  # fmt: skip


def _css(name: str, value: str) -> Element:
    return node("CssParameter", text=value, name=name)
