from __future__ import annotations

import re

import numpy as np
import pytest

from mask_files import IMAGE_CRS, box, geojson, gml, mask_of, whole
from rpc_fixtures import satellite_rpc
from zlocus.core.errors import InputError

SHAPE = (60, 90)
RPC = satellite_rpc().moved(column=-20000, row=-20000)
EXPECTED = np.zeros(SHAPE, bool)
EXPECTED[5:25, 10:20] = True
# Columns 10 to 19 and rows 5 to 24 from the outer corner of the first pixel, which is (0.5, 0.5).
RING = box(10.5, 5.5, 20.5, 25.5)


@pytest.mark.parametrize("srs", [IMAGE_CRS, None])
def test_pixels_of_primary_products_count_from_1(tmp_path, srs):
    path = gml(tmp_path / "CLD_PHR1A_P_MSK.GML", RING, srs=srs)
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path)})), EXPECTED)


def test_an_envelope_names_the_system_of_polygons_that_do_not(tmp_path):
    path = gml(tmp_path / "CLD_A_MSK.GML", RING, srs=None)
    text = path.read_text().replace(
        "<hma:maskMembers>",
        f'<gml:boundedBy><gml:Envelope srsName="{IMAGE_CRS}"><gml:lowerCorner>1 1</gml:lowerCorner></gml:Envelope>'
        "</gml:boundedBy><hma:maskMembers>",
    )
    path.write_text(text)
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path)})), EXPECTED)


@pytest.mark.parametrize("name", ["ROI_PHR1A_P_MSK.GML", "CLD_x_MSK.GML"])
def test_outside_of_a_region_of_interest_is_masked(tmp_path, name):
    """By the letters of the file, or by its title."""
    title = "RegionOfInterest mask from data-strip X" if name.startswith("CLD") else "mask"
    path = gml(tmp_path / name, RING, title=title)
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path)})), ~EXPECTED)
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path), "outside": True})), EXPECTED)


def test_a_mask_without_features_masks_nothing(tmp_path):
    assert not whole(mask_of(SHAPE, {"file": str(gml(tmp_path / "CLD_A_MSK.GML"))})).any()


def test_holes_lists_of_positions_and_the_older_form_of_coordinates(tmp_path):
    path = gml(tmp_path / "CLD_A_MSK.GML", RING)
    positions = "".join(f"<gml:pos>{x} {y}</gml:pos>" for x, y in box(12.5, 10.5, 15.5, 12.5))
    hole = f"<gml:interior><gml:LinearRing>{positions}</gml:LinearRing></gml:interior></gml:Polygon>"
    path.write_text(path.read_text().replace("</gml:Polygon>", hole))
    expected = EXPECTED.copy()
    expected[10:12, 12:15] = False
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path)})), expected)
    old = gml(tmp_path / "CLD_B_MSK.GML", RING).read_text().replace("exterior", "outerBoundaryIs")
    pairs = " ".join(f"{x},{y}" for x, y in RING)
    old = re.sub("<gml:posList>.*?</gml:posList>", f"<gml:coordinates>{pairs}</gml:coordinates>", old)
    (tmp_path / "CLD_B_MSK.GML").write_text(old)
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(tmp_path / "CLD_B_MSK.GML")})), EXPECTED)


def test_features_are_chosen_by_their_type(tmp_path):
    path = gml(tmp_path / "CLD_A_MSK.GML", RING, box(40.5, 40.5, 50.5, 50.5))
    path.write_text(path.read_text().replace(">CLOUD<", ">SNOW<", 1))
    found = whole(mask_of(SHAPE, {"file": str(path), "values": ["cloud"]}))
    assert found.sum() == 100
    with pytest.raises(InputError, match=r"has no class called 'haze'\. It has SNOW, CLOUD"):
        mask_of(SHAPE, {"file": str(path), "values": ["haze"]})


@pytest.mark.parametrize(
    ("srs", "swapped"),
    [
        ("EPSG:4326", False),
        ("urn:ogc:def:crs:EPSG::4326", True),
        ("urn:ogc:def:crs:EPSG:6.3:4326", True),
        ("http://www.opengis.net/def/crs/EPSG/0/4326", True),
        ("http://www.opengis.net/gml/srs/epsg.xml#4326", False),
        ("urn:ogc:def:crs:EPSG:8.7:32631", False),
        ("urn:cnes:gdlib:projectionType:32631", False),
    ],
)
def test_polygons_on_the_ground_are_seen_as_those_of_other_vector_files(tmp_path, srs, swapped):
    """Whatever the order of the axes: the same ground as GeoJSON gives the same mask."""
    from pyproj import CRS, Transformer

    from mask_files import UTM
    from zlocus.sensors.rpc import RpcModel

    xy = np.array(box(10.2, 5.3, 70.4, 40.6))
    ground = RpcModel(RPC, UTM).ground_from_image(xy, np.full(len(xy), RPC.height_off))[:, :2]
    lon_lat = np.column_stack(Transformer.from_crs(UTM, CRS.from_epsg(4326), always_xy=True).transform(*ground.T))
    expected = whole(
        mask_of(
            SHAPE, {"file": str(geojson(tmp_path / "m.geojson", [lon_lat.tolist()]))}, rpc=RPC,
            mean_height=RPC.height_off,
        )
    )  # fmt: skip
    assert expected[6:41, 11:71].all()
    assert expected.sum() == 35 * 60
    points = ground if "32631" in srs else lon_lat[:, ::-1] if swapped else lon_lat
    path = gml(tmp_path / "CLD_A_MSK.GML", [(f"{x:.12f}", f"{y:.12f}") for x, y in points], srs=srs)
    found = whole(mask_of(SHAPE, {"file": str(path)}, rpc=RPC, mean_height=RPC.height_off))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<hma:Mask gml", "<!DOCTYPE x><hma:Mask gml", "declares a document type"),
        ("10.5 5.5", "nan 5.5", "a coordinate that is not finite"),
        ("10.5 5.5", "1e999 5.5", "a coordinate that is not finite"),
        ("10.5 5.5", "ten 5.5", "a ring that is no list of points"),
        ("10.5 5.5", "10.5", "a ring that is no list of points"),
        ("10.5 5.5 20.5 5.5 20.5 25.5 10.5 25.5 10.5 5.5", "1 1 2 2", "a ring of 3 points, which is no outline"),
        ("exterior>", "interior>", "a polygon with 0 outlines, not one|mismatched tag"),
        (IMAGE_CRS, "EPSG:999999", "999999"),
        ("hma:Mask ", "hma:Maskes ", "no element found|mismatched tag"),
    ],
)
def test_damaged_files_are_refused_in_a_sentence(tmp_path, old, new, message):
    path = gml(tmp_path / "CLD_A_MSK.GML", RING)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=f"The mask of the view a: .*({message})"):
        mask_of(SHAPE, {"file": str(path)}, rpc=RPC, mean_height=0.0)


def test_other_documents_and_options_that_do_not_fit(tmp_path):
    path = gml(tmp_path / "CLD_A_MSK.GML", RING)
    with pytest.raises(InputError, match="says itself what its coordinates are"):
        mask_of(SHAPE, {"file": str(path), "coordinates": "pixels"})
    (tmp_path / "x.xml").write_text("<Other/>")
    with pytest.raises(InputError, match="its root is 'Other', not Mask"):
        mask_of(SHAPE, {"file": str(tmp_path / "x.xml"), "kind": "gml"})
    two = gml(tmp_path / "CLD_B_MSK.GML", RING, RING)
    two.write_text(two.read_text().replace(IMAGE_CRS, "EPSG:4326", 1))
    with pytest.raises(InputError, match="several coordinate systems"):
        mask_of(SHAPE, {"file": str(two)})
