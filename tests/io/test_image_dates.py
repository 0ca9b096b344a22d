from __future__ import annotations

import datetime

import numpy as np
import pytest
import rasterio

from rpc_fixtures import write_image
from zlocus.io.image_dates import date_of_exposure
from zlocus.io.images import open_image

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
GREY = np.random.default_rng(5).integers(1, 4000, (20, 30)).astype(np.uint16)
OCTOBER = datetime.date(2014, 10, 5)


def date_of(path):
    with rasterio.open(path) as source:
        return date_of_exposure(source)


def tagged(path, domain=None, **tags):
    write_image(path, GREY)
    with rasterio.open(path, "r+") as file:
        file.update_tags(ns=domain, **tags)
    return path


@pytest.mark.parametrize(
    ("domain", "tags"),
    [
        ("IMAGERY", {"ACQUISITIONDATETIME": "2014-10-05 16:01:38"}),
        (None, {"NITF_IDATIM": "20141005160138"}),
        (None, {"NITF_IDATIM": "20141005------"}),
        (None, {"EXIF_DateTimeOriginal": "2014:10:05 16:01:38"}),
    ],
)
def test_dates_of_vendors_of_nitf_and_of_photographs(tmp_path, domain, tags):
    assert date_of(tagged(tmp_path / "a.tif", domain, **tags)) == OCTOBER
    assert open_image(tmp_path / "a.tif").date == OCTOBER


@pytest.mark.parametrize("text", ["", "unknown", "00000000000000", "20141305120000", "18540101120000", "99991231"])
def test_what_cannot_be_a_date_is_none(tmp_path, text):
    assert date_of(tagged(tmp_path / "a.tif", NITF_IDATIM=text)) is None


def test_a_wrong_first_entry_does_not_hide_a_right_second_one(tmp_path):
    tagged(tmp_path / "a.tif", NITF_IDATIM="--------------", EXIF_DateTimeOriginal="2014:10:05 16:01:38")
    assert date_of(tmp_path / "a.tif") == OCTOBER


def test_the_time_at_which_a_file_was_written_is_not_that_of_the_exposure(tmp_path):
    assert date_of(tagged(tmp_path / "a.tif", TIFFTAG_DATETIME="2020:01:01 00:00:00")) is None


def test_metadata_of_the_vendor_beside_the_image(tmp_path):
    write_image(tmp_path / "a.tif", GREY)
    (tmp_path / "a.IMD").write_text(
        'version = "R";\nBEGIN_GROUP = IMAGE_1\n\tsatId = "WV03";\n\tfirstLineTime = 2014-10-05T16:01:38.123456Z;\n'
        "\tcloudCover = 0.01;\nEND_GROUP = IMAGE_1\nEND;\n",
        encoding="ascii",
    )
    assert open_image(tmp_path / "a.tif").date == OCTOBER
