from __future__ import annotations

import datetime

import numpy as np
import pytest
import rasterio

from rpc_fixtures import write_image
from zlocus.core.scene import Acquisition, SunDirection
from zlocus.io.image_acquisition import acquisition_from, acquisition_of, sun_altitude_deg
from zlocus.io.images import open_image

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
GREY = np.random.default_rng(5).integers(1, 4000, (20, 30)).astype(np.uint16)
OCTOBER = datetime.date(2014, 10, 5)
EXPOSURE = datetime.datetime(2014, 10, 5, 16, 1, 38, tzinfo=datetime.UTC)
SUN = SunDirection(158.4, 51.2)
PLEIADES = "PHR1A_P_201304171036448_SEN_IPU_001-001_R1C1"
IMD = (
    'version = "R";\nBEGIN_GROUP = IMAGE_1\n\tsatId = "WV03";\n\tfirstLineTime = 2014-10-05T16:01:38.123456Z;\n'
    "\tmeanSunAz = 158.4;\n\tmeanSunEl = 51.2;\n\tmeanSatAz = 212.0;\n\tmeanSatEl = 70.5;\n"
    "\tmeanOffNadirViewAngle = 17.5;\n\tcloudCover = 0.25;\nEND_GROUP = IMAGE_1\nEND;\n"
)
DIMAP = """<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.0">DIMAP</METADATA_FORMAT>
</Metadata_Identification><Geometric_Data><Use_Area>
<Located_Geometric_Values><LOCATION_TYPE>Top Center</LOCATION_TYPE>
<Solar_Incidences><SUN_AZIMUTH unit="deg">158.4</SUN_AZIMUTH><SUN_ELEVATION unit="deg">51.2</SUN_ELEVATION>
</Solar_Incidences></Located_Geometric_Values>
<Located_Geometric_Values><LOCATION_TYPE>Center</LOCATION_TYPE>
<Solar_Incidences><SUN_AZIMUTH unit="deg">158.5</SUN_AZIMUTH><SUN_ELEVATION unit="deg">51.3</SUN_ELEVATION>
</Solar_Incidences></Located_Geometric_Values></Use_Area></Geometric_Data></Dimap_Document>
"""


def acquired(path):
    with rasterio.open(path) as source:
        return acquisition_of(source)


def tagged(path, domain=None, **tags):
    write_image(path, GREY)
    with rasterio.open(path, "r+") as file:
        file.update_tags(ns=domain, **tags)
    return path


@pytest.mark.parametrize(
    ("domain", "tags", "time"),
    [
        ("IMAGERY", {"ACQUISITIONDATETIME": "2014-10-05 16:01:38"}, EXPOSURE),
        (None, {"NITF_IDATIM": "20141005160138"}, EXPOSURE),
        (None, {"NITF_IDATIM": "20141005------"}, None),
        # The clock of a camera is set to the time of its place.
        (None, {"EXIF_DateTimeOriginal": "2014:10:05 16:01:38"}, None),
    ],
)
def test_times_of_vendors_of_nitf_and_of_photographs(tmp_path, domain, tags, time):
    found = acquired(tagged(tmp_path / "a.tif", domain, **tags))
    assert (found.date, found.time) == (OCTOBER, time)
    assert open_image(tmp_path / "a.tif").acquisition.date == OCTOBER


@pytest.mark.parametrize("text", ["", "unknown", "00000000000000", "20141305120000", "18540101120000", "99991231"])
def test_what_cannot_be_a_date_is_none(tmp_path, text):
    assert acquired(tagged(tmp_path / "a.tif", NITF_IDATIM=text)) == Acquisition()


def test_a_wrong_first_entry_does_not_hide_a_right_second_one(tmp_path):
    tagged(tmp_path / "a.tif", NITF_IDATIM="--------------", EXIF_DateTimeOriginal="2014:10:05 16:01:38")
    assert acquired(tmp_path / "a.tif").date == OCTOBER


def test_the_time_at_which_a_file_was_written_is_not_that_of_the_exposure(tmp_path):
    assert acquired(tagged(tmp_path / "a.tif", TIFFTAG_DATETIME="2020:01:01 00:00:00")).date is None


@pytest.mark.parametrize(
    ("image", "beside"),
    [
        ("a.tif", {"a.IMD": IMD}),
        # GDAL reads the one only beside the other.
        (f"IMG_{PLEIADES}.TIF", {f"DIM_{PLEIADES}.XML": DIMAP, f"RPC_{PLEIADES}.XML": "<Dimap_Document/>"}),
    ],
)
def test_metadata_of_the_vendor_beside_the_image(tmp_path, image, beside):
    write_image(tmp_path / image, GREY)
    for name, text in beside.items():
        (tmp_path / name).write_text(text, encoding="ascii")
    found = open_image(tmp_path / image).acquisition
    assert found.sun_direction == SUN
    if image == "a.tif":
        assert found == Acquisition(OCTOBER, EXPOSURE, "WV03", SUN, 212.0, 19.5, 17.5, 0.25)


def test_the_header_of_a_nitf_file(tmp_path):
    tagged(tmp_path / "a.tif", NITF_USE00A_SUN_AZ="158.4", NITF_USE00A_SUN_EL="51.2")
    assert acquired(tmp_path / "a.tif").sun_direction == SUN


@pytest.mark.parametrize("altitude", ["", "low", "nan", "-3.0", "0.0", "91", "999.9"])
def test_what_cannot_be_a_direction_is_none(tmp_path, altitude):
    tagged(tmp_path / "a.tif", NITF_USE00A_SUN_AZ="158.4", NITF_USE00A_SUN_EL=altitude)
    assert acquired(tmp_path / "a.tif").sun_direction is None


def test_a_file_that_does_not_say(tmp_path):
    assert acquired(tagged(tmp_path / "a.tif", NITF_USE00A_SUN_AZ="158.4")).sun_direction is None


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"cloudcover": "-999"}, Acquisition()),
        ({"acquired": "2014-10-05 16:01 GMT"}, Acquisition(
            OCTOBER, datetime.datetime(2014, 10, 5, 16, 1, tzinfo=datetime.UTC))),
        ({"cloud_percent": "30"}, Acquisition(cloud_cover=0.3)),
        ({"view_angle": "-4.5", "satellite_azimuth": "-90"}, Acquisition(off_nadir_deg=4.5, view_azimuth_deg=270.0)),
        ({"meansatel": "0", "satellite_azimuth": "720"}, Acquisition()),
        ({"acquired": "2014-10-05T23:59:59.75Z"}, Acquisition(
            OCTOBER, datetime.datetime(2014, 10, 5, 23, 59, 59, 750_000, datetime.UTC))),
    ],
)  # fmt: skip
def test_fields_of_vendors(fields, expected):
    assert acquisition_from(fields) == expected


def test_two_sources_complete_each_other():
    day = Acquisition(date=OCTOBER, cloud_cover=0.1)
    other = Acquisition(OCTOBER, EXPOSURE, "WV03", cloud_cover=0.5)
    assert day.completed_by(other) == Acquisition(OCTOBER, EXPOSURE, "WV03", cloud_cover=0.1)
    # The time of another day does not go with the day.
    assert Acquisition(date=datetime.date(2016, 1, 1)).completed_by(other).time is None


@pytest.mark.parametrize(
    ("time", "lon", "lat", "altitude"),
    [
        # Equinox and solstices at noon, over the equator, a tropic and a polar circle.
        (datetime.datetime(2024, 3, 20, 12, 7, tzinfo=datetime.UTC), 0.0, 0.0, 90.0),
        (datetime.datetime(2024, 6, 20, 12, 2, tzinfo=datetime.UTC), 0.0, 23.44, 90.0),
        (datetime.datetime(2024, 12, 21, 11, 58, tzinfo=datetime.UTC), 0.0, 66.56, 0.0),
        # Jacksonville, as the vendor says it.
        (EXPOSURE, -81.66, 30.35, 51.2),
    ],
)
def test_where_the_sun_stood(time, lon, lat, altitude):
    assert sun_altitude_deg(time, lon, lat) == pytest.approx(altitude, abs=0.6)
