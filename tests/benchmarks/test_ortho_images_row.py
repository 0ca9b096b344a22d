"""The rows on ortho-images and on control from an ortho-photo: how they judge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine

from displaced_windows import displacements
from rows.ortho_images import PIXEL_M, controlled_spec, write_photo
from zlocus.synthetic.ortho_photo import FOUR_BANDS, OrthographicCamera, exposed_bands
from zlocus.synthetic.render import Sun
from zlocus.synthetic.scenes import build_ground, exposures_of

SIZE = 120
# What the peak of a correlation of 40 pixels tells, in single windows.
TOLD_PX = 0.1


def test_a_displaced_ortho_image_is_judged(tmp_path):
    spec = replace(controlled_spec(3), size=SIZE)
    ground = build_ground(spec, exposures_of(spec))
    camera = OrthographicCamera(spec.west_m, spec.north_m, PIXEL_M)
    assert camera.transform == Affine(PIXEL_M, 0.0, spec.west_m, 0.0, -PIXEL_M, spec.north_m)
    numbers = exposed_bands(ground, camera, (SIZE, SIZE), Sun(150.0, 50.0), FOUR_BANDS[:2], 1)
    write_photo(tmp_path / "truth.tif", numbers, camera, spec)
    write_photo(tmp_path / "moved.tif", np.roll(numbers, 2, axis=2), camera, spec)
    off = displacements(tmp_path / "moved.tif", tmp_path / "truth.tif")
    assert np.median(off, axis=0) == pytest.approx([2.0, 0.0], abs=TOLD_PX)
    assert np.abs(displacements(tmp_path / "truth.tif", tmp_path / "truth.tif")).max() < TOLD_PX
