from __future__ import annotations

import numpy as np
import pytest

from mask_files import mask_of, whole, write_raster
from zlocus.core.errors import InputError
from zlocus.io.masks.planet_masks import UDM2_BANDS

SHAPE = (8, 40)
# Columns 0-4 are snow, 5-9 shadow, and so on; the last five have no class and are blackfill in udm1.
CLASS = np.repeat(np.arange(8), 5)[None].repeat(8, axis=0)
UDM1 = np.select([CLASS == 4, CLASS == 5, CLASS == 7], [2, 4, 1], 0).astype(np.uint8)
NAMED = {"snow": 0, "shadow": 1, "light_haze": 2, "heavy_haze": 3, "cloud": 4}


def udm2(path, descriptions=UDM2_BANDS):
    bands = np.zeros((8, *SHAPE), np.uint8)
    for name, number in NAMED.items():
        bands[UDM2_BANDS.index(name)] = number == CLASS
    bands[0], bands[6], bands[7] = CLASS >= 5, 90, UDM1
    return str(write_raster(path, bands, descriptions))


def test_clouds_heavy_haze_and_unusable_pixels_of_a_udm2(tmp_path):
    """Not the clouds of the older mask in its last band, and not the confidence."""
    found = whole(mask_of(SHAPE, {"file": udm2(tmp_path / "a.tif")}))
    np.testing.assert_array_equal(found, np.isin(CLASS, (3, 4, 5, 7)))


@pytest.mark.parametrize("descriptions", [UDM2_BANDS, ()])
@pytest.mark.parametrize(("values", "classes"), [(["snow"], (0,)), (["haze light", "unusable"], (2, 5, 7))])
def test_classes_of_a_udm2_by_name(tmp_path, descriptions, values, classes):
    """Bands in the order of the vendor where they have no names."""
    entry = {"file": udm2(tmp_path / "a.tif", descriptions), "kind": "udm2", "values": values}
    np.testing.assert_array_equal(whole(mask_of(SHAPE, entry)), np.isin(CLASS, classes))


def test_the_spelling_of_the_vendors_pages(tmp_path):
    names = ("clear", "snow", "shadow", "haze_light", "haze_heavy", "cloud", "confidence", "udm1")
    found = whole(mask_of(SHAPE, {"file": udm2(tmp_path / "a.tif", names)}))
    np.testing.assert_array_equal(found, np.isin(CLASS, (3, 4, 5, 7)))


def test_a_band_of_a_udm2_as_a_plain_raster(tmp_path):
    entry = {"file": udm2(tmp_path / "a.tif"), "band": "clear", "outside": True}
    np.testing.assert_array_equal(whole(mask_of(SHAPE, entry)), CLASS < 5)


@pytest.mark.parametrize(
    ("values", "expected"), [(None, UDM1 > 0), (["blackfill"], UDM1 == 1), (["missing", "cloud"], UDM1 >= 2)]
)
def test_bits_of_a_udm(tmp_path, values, expected):
    path = write_raster(tmp_path / "x_1B_Analytic_DN_udm.tif", UDM1)
    entry = {"file": str(path)} | ({} if values is None else {"values": values})
    np.testing.assert_array_equal(whole(mask_of(SHAPE, entry)), expected)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"values": ["fog"]}, "has no class called 'fog'. It has clear, snow"),
        ({"values": ["confidence"]}, "has no class called 'confidence'"),
        ({"kind": "udm2", "band": 2}, "whose classes have names"),
        ({"kind": "udm", "values": [3]}, "has no class called '3'. It has blackfill, cloud, missing"),
    ],
)
def test_what_a_udm_has_not_is_refused(tmp_path, entry, message):
    with pytest.raises(InputError, match=message):
        mask_of(SHAPE, {"file": udm2(tmp_path / "a.tif")} | entry)


def test_another_raster_is_no_udm2(tmp_path):
    path = write_raster(tmp_path / "a.tif", np.zeros((3, *SHAPE), np.uint8))
    with pytest.raises(InputError, match="is no UDM2: it has 3 bands without names"):
        mask_of(SHAPE, {"file": str(path), "kind": "udm2"})
    named = write_raster(tmp_path / "b.tif", np.zeros((2, *SHAPE), np.uint8), ("clear", "snow"))
    with pytest.raises(InputError, match="it has no band for 'cloud', but clear, snow"):
        mask_of(SHAPE, {"file": str(named), "kind": "udm2"})
