from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mask_files import box, gml, mask_of, whole, write_raster
from zlocus.core.errors import ConfigError
from zlocus.io.masks.vendor_masks import VENDOR_KINDS, vendor_kind, vendor_mask


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("CLD_PHR1A_P_201809021029220_SEN_1_MSK.GML", "cloud"),
        ("SNW_SPOT7_P_201710111019265_SEN_1_MSK.GML", "snow"),
        ("ROI_PNEO3_1_MSK.GML", "region"),
        ("QTE_PHR1A_1_MSK.GML", "quality"),
        ("DET_PHR1A_1_MSK.GML", "detector"),
        ("VIS_PHR1A_1_MSK.GML", "hidden"),
        ("20200102_1_3B_udm2.tif", "udm2"),
        ("20200102_1_3B_udm2_clip.tif", "udm2"),
        ("20200102_1_1B_Analytic_DN_udm.tif", "udm"),
        ("IMG_PHR1A_P_1_R1C1.TIF", None),
        ("DIM_PHR1A_1.XML", None),
        ("ABC_PHR1A_1_MSK.GML", None),
    ],
)
def test_kinds_by_the_names_of_files(name, kind):
    assert vendor_kind(Path("delivery") / name) == kind


def test_only_what_hides_the_ground_is_applied_unless_classes_are_named(tmp_path):
    applied = {kind for kind in VENDOR_KINDS if vendor_mask(tmp_path / "x", kind) is not None}
    assert applied == {"cloud", "detector", "hidden", "quality", "region", "classes", "udm", "udm2"}
    assert vendor_mask(tmp_path / "SNW_1_MSK.GML") is None
    assert vendor_mask(tmp_path / "SNW_1_MSK.GML", values=["SNOW"]) is not None
    with pytest.raises(ConfigError, match="is no mask of a kind that is known"):
        vendor_mask(tmp_path / "IMG.TIF")


def test_its_entries_are_those_of_a_view(tmp_path):
    shape = (30, 40)
    files = [
        gml(tmp_path / "CLD_1_MSK.GML", box(0.5, 0.5, 4.5, 4.5)),
        gml(tmp_path / "ROI_1_MSK.GML", box(0.5, 0.5, 30.5, 31)),
    ]
    udm2 = np.zeros((8, *shape), np.uint8)
    udm2[5, 20:, :3] = 1
    files.append(write_raster(tmp_path / "a_udm2.tif", udm2))
    entries = [vendor_mask(path) for path in files]
    mask = mask_of(shape, *entries)
    assert list(mask.files) == files
    expected = udm2[5] > 0
    expected[:4, :4] = expected[:, 30:] = True
    np.testing.assert_array_equal(whole(mask), expected)
