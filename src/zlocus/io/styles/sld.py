"""Styles for map servers (SLD 1.0), with the extensions of GeoServer that QGIS and MapServer read too."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from zlocus.io.styles.layer_style import (
    ClassStyle,
    FeatureStyle,
    RampStyle,
    RasterStyle,
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


def sld_of(style: RasterStyle | FeatureStyle, name: str) -> str:
    """The text of a style file. name : of the layer and of the style."""
    if isinstance(style, FeatureStyle):
        # QGIS draws the rule for all other features for all of them, so it lies below the others.
        ordered = sorted(style.rules, key=lambda rule: rule.value is not None or bool(rule.ranges))
        rules = [_feature_rule(style, rule) for rule in ordered if rule.every is None or rule.ranges]
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


def _symbolizer(style: RasterStyle) -> Element:
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
    for channel, band, (low, high) in zip(COLOUR_CHANNELS, style.bands, style.ranges, strict=True):
        limits = {"algorithm": "StretchToMinimumMaximum", "minValue": number(low), "maxValue": number(high)}
        options = (node("VendorOption", text=value, name=key) for key, value in limits.items())
        stretched = node("ContrastEnhancement", node("Normalize", *options))
        channels.append(node(channel, node("SourceChannelName", text=str(band)), stretched))
    return node("ChannelSelection", *channels)


def _feature_rule(style: FeatureStyle, rule: StyleRule) -> Element:
    size_px = number(round(rule.size_mm * PX_PER_MM, 2))
    colour = hexadecimal(rule.colour)
    stroke = node("Stroke", _css("stroke", colour), _css("stroke-width", size_px))
    if style.shape == "polygon":
        inside = node("Fill", _css("fill", colour), _css("fill-opacity", number(rule.opacity)))
        drawn = node(
            "PolygonSymbolizer", inside if rule.opacity else None, stroke if rule.size_mm else None
        )  # fmt: skip
    elif style.shape == "line":
        drawn = node("LineSymbolizer", stroke)
    else:
        mark = node("Mark", node("WellKnownName", text="circle"), node("Fill", _css("fill", colour)))
        drawn = node("PointSymbolizer", node("Graphic", mark, node("Size", text=size_px)))
    chosen = _filter(style, rule)
    label = _label(style, rule) if rule.is_labelled else None
    return node("Rule", node("Name", text=rule.label), node("Title", text=rule.label), chosen, drawn, label)


def _filter(style: FeatureStyle, rule: StyleRule) -> Element:
    if rule.value is not None:
        return node("ogc:Filter", node("ogc:PropertyIsEqualTo", *_operands(style.attribute, rule.value)))
    ranges = [_range(style.attribute, low, high) for low, high in rule.ranges]
    if not ranges:
        return node("ElseFilter")
    return node("ogc:Filter", ranges[0] if len(ranges) == 1 else node("ogc:Or", *ranges))


def _range(attribute: str, low: float, high: float) -> Element:
    ends = []
    for kind, end in (("ogc:PropertyIsGreaterThanOrEqualTo", low), ("ogc:PropertyIsLessThan", high)):
        if abs(end) != float("inf"):
            ends.append(node(kind, *_operands(attribute, number(end))))
    return ends[0] if len(ends) == 1 else node("ogc:And", *ends)


def _operands(attribute: str, value: str) -> tuple[Element, Element]:
    return node("ogc:PropertyName", text=attribute), node("ogc:Literal", text=value)


def _label(style: FeatureStyle, rule: StyleRule) -> Element:
    font = node("Font", _css("font-family", "sans-serif"), _css("font-size", str(LABEL_PX)))
    halo = node("Halo", node("Radius", text=str(HALO_PX)), node("Fill", _css("fill", hexadecimal(WHITE))))
    is_line, attribute = style.shape == "line", style.text_attribute or style.attribute
    placement = node("LabelPlacement", node("LinePlacement")) if is_line else None
    options = {"followLine": "true", "repeat": str(REPEAT_PX)} if is_line else {}
    return node(
        "TextSymbolizer", node("Label", node("ogc:PropertyName", text=attribute)), font, placement, halo,
        node("Fill", _css("fill", hexadecimal(rule.colour))),
        *(node("VendorOption", text=value, name=key) for key, value in options.items()),
    )  # fmt: skip


def _css(name: str, value: str) -> Element:
    return node("CssParameter", text=value, name=name)
