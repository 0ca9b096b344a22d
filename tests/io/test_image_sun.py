from __future__ import annotations

import numpy as np
import pytest
import rasterio

from rpc_fixtures import write_image
from zlocus.core.scene import SunDirection
from zlocus.io.image_sun import sun_direction_at_exposure
from zlocus.io.images import open_image

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
GREY = np.random.default_rng(5).integers(1, 4000, (20, 30)).astype(np.uint16)
OCTOBER = SunDirection(158.4, 51.2)
PLEIADES = "PHR1A_P_201304171036448_SEN_IPU_001-001_R1C1"
IMD = (
    'version = "R";\nBEGIN_GROUP = IMAGE_1\n\tsatId = "WV03";\n\tmeanSunAz = 158.4;\n\tmeanSunEl = 51.2;\n'
    "\tcloudCover = 0.01;\nEND_GROUP = IMAGE_1\nEND;\n"
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


def tagged(path, **tags):
    write_image(path, GREY)
    with rasterio.open(path, "r+") as file:
        file.update_tags(**tags)
    return path


def sun_of(path):
    with rasterio.open(path) as source:
        return sun_direction_at_exposure(source)


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
    assert open_image(tmp_path / image).sun_direction == OCTOBER


def test_the_header_of_a_nitf_file(tmp_path):
    assert sun_of(tagged(tmp_path / "a.tif", NITF_USE00A_SUN_AZ="158.4", NITF_USE00A_SUN_EL="51.2")) == OCTOBER


@pytest.mark.parametrize("altitude", ["", "low", "nan", "-3.0", "0.0", "91", "999.9"])
def test_what_cannot_be_a_direction_is_none(tmp_path, altitude):
    assert sun_of(tagged(tmp_path / "a.tif", NITF_USE00A_SUN_AZ="158.4", NITF_USE00A_SUN_EL=altitude)) is None


def test_a_file_that_does_not_say(tmp_path):
    assert sun_of(tagged(tmp_path / "a.tif", NITF_USE00A_SUN_AZ="158.4")) is None
