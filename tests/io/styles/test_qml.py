"""Styles of QGIS: what QGIS reads of them. `make test-qgis` loads and draws them."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import pytest

from zlocus.io.styles.layer_style import (
    ClassStyle,
    FeatureStyle,
    PointCloudStyle,
    RampStyle,
    StretchStyle,
    StyleRule,
    ValueColour,
    hexadecimal,
    number,
)
from zlocus.io.styles.qml import MULTIPLY, qml_of

RED, BLUE = (255, 0, 0), (0, 0, 16)
STOPS = (ValueColour(-1.5, BLUE, "-1.5 m"), ValueColour(100.25, RED, "100.25 <m> & more"))


def read(style):
    return ElementTree.fromstring(qml_of(style))


def test_numbers_have_no_exponent_and_no_needless_digit():
    assert [number(v) for v in (0.0, -3.0, 1e-6, 0.1 + 0.2, 1e15)] == ["0", "-3", "0.000001", "0.3", "1000000000000000"]
    assert hexadecimal(BLUE) == "#000010"


def test_a_ramp_has_its_stops():
    root = read(RampStyle(STOPS, "m", is_multiplied=True))
    renderer = root.find("pipe/rasterrenderer")
    assert (renderer.get("type"), renderer.get("classificationMin"), renderer.get("classificationMax")) == (
        "singlebandpseudocolor", "-1.5", "100.25",
    )  # fmt: skip
    shader = root.find(".//colorrampshader")
    assert shader.get("colorRampType") == "INTERPOLATED"
    assert [(item.get("value"), item.get("color"), item.get("label")) for item in shader.iter("item")] == [
        ("-1.5", "#000010", "-1.5 m"), ("100.25", "#ff0000", "100.25 <m> & more"),
    ]  # fmt: skip
    assert shader.find("rampLegendSettings").get("suffix") == " m"
    assert root.findtext("blendMode") == str(MULTIPLY)
    assert read(RampStyle(STOPS)).findtext("blendMode") == "0"


def test_classes_are_not_averaged():
    root = read(ClassStyle((ValueColour(3, RED, "three"),)))
    (entry,) = root.findall(".//paletteEntry")
    assert (entry.get("value"), entry.get("color"), entry.get("label")) == ("3", "#ff0000", "three")
    assert root.find("pipe/rasterresampler").get("zoomedOutResampler") == "nearest"


@pytest.mark.parametrize(
    ("bands", "kind", "shown"),
    [((1,), "singlebandgray", {"grayBand": "1"}),
     ((5, 3, 2), "multibandcolor", {"redBand": "5", "greenBand": "3", "blueBand": "2"})],
    ids=["grey", "colours"],
)  # fmt: skip
def test_an_image_has_its_bands_and_its_mask(bands, kind, shown):
    renderer = read(StretchStyle(((5.0, 80.5),) * len(bands), bands, 9)).find("pipe/rasterrenderer")
    assert (renderer.get("type"), renderer.get("alphaBand")) == (kind, "9")
    assert {name: renderer.get(name) for name in shown} == shown
    assert [found.text for found in renderer.iter("minValue")] == ["5"] * len(bands)
    assert [found.text for found in renderer.iter("maxValue")] == ["80.5"] * len(bands)
    assert read(StretchStyle(((5.0, 80.5),))).find("pipe/rasterrenderer").get("alphaBand") == "-1"


def test_rules_choose_features_and_labels():
    index = StyleRule("every 2.5 m", RED, 0.4, ((2.25, 2.75),), every=2.5, is_labelled=True)
    root = read(FeatureStyle("elevation_m", "line", (index, StyleRule("others", BLUE, 0.2)), decimals=1))
    rules = root.findall("renderer-v2/rules/rule")
    multiple = 'abs("elevation_m" / 2.5 - round("elevation_m" / 2.5)) < 0.000001'
    assert [(rule.get("label"), rule.get("filter"), rule.get("symbol")) for rule in rules] == [
        ("every 2.5 m", multiple, "0"), ("others", "ELSE", "1"),
    ]  # fmt: skip
    widths = [option.get("value") for option in root.iter("Option") if option.get("name") == "line_width"]
    assert widths == ["0.4", "0.2"]
    (label,) = root.findall("labeling/rules/rule")
    assert label.get("filter") == multiple
    assert label.find("settings/text-style").get("fieldName") == 'to_string(round("elevation_m", 1))'
    assert root.get("labelsEnabled") == "1"


def test_ranges_include_their_lower_end():
    low = StyleRule("low", RED, 1.0, ((-math.inf, 0.5), (7.0, 8.0)))
    root = read(FeatureStyle("residual_px", "point", (low, StyleRule("high", RED, 1.0, ((0.5, math.inf),)))))
    assert [rule.get("filter") for rule in root.findall("renderer-v2/rules/rule")] == [
        '("residual_px" < 0.5) OR ("residual_px" >= 7 AND "residual_px" < 8)', '("residual_px" >= 0.5)',
    ]  # fmt: skip
    assert root.find("labeling") is None
    assert {symbol.get("type") for symbol in root.iter("symbol")} == {"marker"}


def test_polygons_are_chosen_by_a_text_and_named_by_another():
    """Insides without an outline, and outlines without an inside, along which the name is written."""
    inside = StyleRule("overlap", BLUE, 0.0, value="overlap", opacity=0.2)
    outline = StyleRule("image", RED, 0.4, value="image", is_labelled=True)
    root = read(FeatureStyle("kind", "polygon", (inside, outline), text_attribute="name"))
    assert [rule.get("filter") for rule in root.findall("renderer-v2/rules/rule")] == [
        "\"kind\" = 'overlap'", "\"kind\" = 'image'",
    ]  # fmt: skip
    drawn = [{part.get("name"): part.get("value") for part in symbol.iter("Option")} for symbol in root.iter("symbol")]
    assert [(each["style"], each["outline_style"]) for each in drawn] == [("solid", "no"), ("no", "solid")]
    assert drawn[0]["color"] == "0,0,16,51"
    (label,) = root.findall("labeling/rules/rule")
    assert (label.get("filter"), label.find("settings/text-style").get("fieldName")) == ("\"kind\" = 'image'", '"name"')


def test_points_of_a_cloud_have_their_own_colours():
    renderer = read(PointCloudStyle()).find("renderer")
    assert [renderer.get(name) for name in ("type", "red", "green", "blue")] == ["rgb", "Red", "Green", "Blue"]
    assert [each.text for each in renderer.iter("maxValue")] == ["65535"] * 3
