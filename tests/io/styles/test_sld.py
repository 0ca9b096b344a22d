"""Styles of map servers: what they say, and that their elements stand in the order of SLD 1.0.0."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import pytest

from zlocus.io.styles.layer_style import ClassStyle, FeatureStyle, RampStyle, StretchStyle, StyleRule, ValueColour
from zlocus.io.styles.sld import NAMESPACES, sld_of

SLD, OGC = (f"{{{address}}}" for address in NAMESPACES.values())
RED = (255, 0, 0)
# Elements of each element, in the order that the schema of OGC 02-070 asks for. VendorOption is GeoServer's.
ORDER = {
    "StyledLayerDescriptor": ["NamedLayer"], "NamedLayer": ["Name", "UserStyle"],
    "UserStyle": ["Name", "Title", "FeatureTypeStyle"], "FeatureTypeStyle": ["Rule", "VendorOption"],
    "Rule": ["Name", "Title", "Filter", "ElseFilter", "LineSymbolizer", "PointSymbolizer",
             "PolygonSymbolizer", "TextSymbolizer", "RasterSymbolizer"],
    "PolygonSymbolizer": ["Fill", "Stroke"], "PropertyIsEqualTo": ["PropertyName", "Literal"],
    "RasterSymbolizer": ["Opacity", "ChannelSelection", "ColorMap"], "ColorMap": ["ColorMapEntry"],
    "ChannelSelection": ["RedChannel", "GreenChannel", "BlueChannel"],
    "RedChannel": ["SourceChannelName", "ContrastEnhancement"], "ContrastEnhancement": ["Normalize"],
    "Graphic": ["Mark", "Size"], "Mark": ["WellKnownName", "Fill"], "Stroke": ["CssParameter"],
    "TextSymbolizer": ["Label", "Font", "LabelPlacement", "Halo", "Fill", "VendorOption"],
    "Halo": ["Radius", "Fill"], "And": ["PropertyIsGreaterThanOrEqualTo", "PropertyIsLessThan"],
}  # fmt: skip


def read(style):
    root = ElementTree.fromstring(sld_of(style, "layer"))
    for element in root.iter():
        order = ORDER.get(local(element))
        if order is not None:
            places = [order.index(local(part)) for part in element]
            assert places == sorted(places), local(element)
    return root


def local(element):
    return element.tag.partition("}")[2]


def texts(root, name):
    return [element.text for element in root.iter(name)]


@pytest.mark.parametrize("style", [RampStyle, ClassStyle])
def test_values_have_colours_and_names(style):
    root = read(style((ValueColour(2, RED, "two"), ValueColour(10.5, (0, 0, 0), ""))))
    (colours,) = root.iter(f"{SLD}ColorMap")
    assert colours.get("type") == {RampStyle: "ramp", ClassStyle: "values"}[style]
    assert [dict(entry.attrib) for entry in colours] == [
        {"color": "#ff0000", "quantity": "2", "opacity": "1", "label": "two"},
        {"color": "#000000", "quantity": "10.5", "opacity": "1"},
    ]
    assert texts(root, f"{SLD}Name") == ["layer", "layer"]


def test_classes_are_in_the_order_of_their_values():
    """As MapServer needs them, which draws intervals."""
    root = read(ClassStyle(tuple(ValueColour(value, RED, "") for value in (2050, 2, 16))))
    assert [entry.get("quantity") for entry in root.iter(f"{SLD}ColorMapEntry")] == ["2", "16", "2050"]


def test_a_layer_that_is_multiplied_says_so():
    style = RampStyle((ValueColour(0, RED, ""), ValueColour(1, RED, "")), is_multiplied=True)
    (option,) = read(style).iter(f"{SLD}VendorOption")
    assert (option.get("name"), option.text) == ("composite", "multiply")


def test_images_are_stretched():
    (colours,) = read(StretchStyle(((0.0, 510.0),))).iter(f"{SLD}ColorMap")
    greys = [(entry.get("color"), entry.get("quantity")) for entry in colours]
    assert (greys[0], greys[1], greys[-1]) == (("#000000", "0"), ("#050505", "10"), ("#ffffff", "510"))
    root = read(StretchStyle(((1.0, 2.0), (3.0, 4.0), (5.0, 6.0)), (5, 3, 2)))
    assert texts(root, f"{SLD}SourceChannelName") == ["5", "3", "2"]
    limits = [option.text for option in root.iter(f"{SLD}VendorOption") if option.get("name") != "algorithm"]
    assert limits == ["1", "2", "3", "4", "5", "6"]


def test_rules_say_the_ranges_that_expressions_compute():
    index = StyleRule("every 5 m", RED, 0.28, ((4.5, 5.5), (9.5, 10.5)), every=5.0, is_labelled=True)
    root = read(FeatureStyle("elevation_m", "line", (index, StyleRule("every 1 m", RED, 0.14))))
    second, first = root.iter(f"{SLD}Rule")  # QGIS needs the rule for all others below
    assert texts(first, f"{OGC}Literal") == ["4.5", "5.5", "9.5", "10.5"]
    assert len(list(first.iter(f"{OGC}And"))) == 2
    assert second.find(f"{SLD}ElseFilter") is not None
    width = [each.text for each in first.find(f"{SLD}LineSymbolizer").iter(f"{SLD}CssParameter")]
    assert width == ["#ff0000", "1"]
    assert first.find(f"{SLD}TextSymbolizer/{SLD}Label/{OGC}PropertyName").text == "elevation_m"


def test_a_rule_that_needs_an_expression_is_left_out():
    rules = (StyleRule("every 5 m", RED, 0.4, every=5.0), StyleRule("every 1 m", RED, 0.2))
    assert texts(read(FeatureStyle("elevation_m", "line", rules)), f"{SLD}Title")[1:] == ["every 1 m"]


def test_points_have_a_size():
    rules = (StyleRule("low", RED, 1.4, ((-math.inf, 0.5),)), StyleRule("high", RED, 1.4, ((0.5, math.inf),)))
    root = read(FeatureStyle("residual_px", "point", rules))
    assert texts(root, f"{SLD}Size") == ["5", "5"]
    assert texts(root, f"{OGC}Literal") == ["0.5", "0.5"]


def test_polygons_have_an_inside_an_outline_and_a_name():
    rules = (StyleRule("overlap", RED, 0.0, value="overlap", opacity=0.25),
             StyleRule("image", RED, 0.28, value="image", is_labelled=True))  # fmt: skip
    overlap, image = read(FeatureStyle("kind", "polygon", rules, text_attribute="name")).iter(f"{SLD}Rule")
    assert texts(overlap, f"{OGC}Literal") == ["overlap"]
    assert [local(part) for part in overlap.find(f"{SLD}PolygonSymbolizer")] == ["Fill"]
    assert texts(overlap, f"{SLD}CssParameter") == ["#ff0000", "0.25"]
    assert [local(part) for part in image.find(f"{SLD}PolygonSymbolizer")] == ["Stroke"]
    assert image.find(f"{SLD}TextSymbolizer/{SLD}Label/{OGC}PropertyName").text == "name"
