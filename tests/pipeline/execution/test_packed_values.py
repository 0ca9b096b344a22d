"""Values as bytes: every camera comes back as it was, and no other class is read."""

from __future__ import annotations

import os
import pickle
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from rasterio.transform import from_origin
from shapely.geometry import box

from flights import CENTRE, GROUND_M, scanner
from geoids import write_geoid
from zlocus.core.grid import CellWindow
from zlocus.io.vertical import named_vertical_datum
from zlocus.matching.quality import Quality
from zlocus.pipeline.execution.packed_values import UnknownClassError, packed, unpacked
from zlocus.pipeline.tile_run import Polygons
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.distortion import BrownDistortion, FisheyeDistortion
from zlocus.sensors.earth_frame import EarthSpace
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.rolling_shutter import RollingShutter


def test_values_come_back():
    values = {
        "window": CellWindow(1, 2, 3, 4), "path": Path("a/b.tif"), "time": datetime(2026, 1, 2, tzinfo=UTC),
        "flag": Quality.FAILED, "number": np.float32(2.5),
    }  # fmt: skip
    assert unpacked(packed(values)) == values
    arrays = np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6, dtype=np.uint8).reshape(3, 2))
    for before, after in zip(arrays, unpacked(packed(arrays)), strict=True):
        np.testing.assert_array_equal(before, after)
        assert (before.dtype, before.flags.f_contiguous) == (after.dtype, after.flags.f_contiguous)
    for code in (32632, 5773, 9518):
        assert unpacked(packed(CRS.from_epsg(code))) == CRS.from_epsg(code)
    polygons = Polygons(np.array([box(0, 0, 1, 2)], object))
    assert unpacked(packed(polygons)).inside[0].equals(polygons.inside[0])


def frame(**more):
    centre, axes = (*CENTRE, GROUND_M + 100.0), ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    return FrameModel(centre, axes, 900.0, (500.0, 400.0), **more)


SENSORS = {
    "line scanner": scanner(),
    "Brown": frame(distortion=BrownDistortion(k1=-0.05, p1=0.001)),
    "fisheye": frame(distortion=FisheyeDistortion(k1=0.02)),
    "rolling shutter": frame(rolling_shutter=RollingShutter(0.02, (3.0, 1.0, 0.0), 800)),
    "shifted": ShiftedModel(frame(), 1.5, -0.5),
}


@pytest.mark.parametrize("name", SENSORS)
def test_a_camera_comes_back_bit_by_bit(name):
    """Also once it has computed what it keeps for later calls."""
    sensor = SENSORS[name]
    xyz = np.array([[*CENTRE, GROUND_M]]) + np.random.default_rng(5).uniform(-8.0, 8.0, (50, 3))
    before = sensor.image_from_ground(xyz)
    assert np.isfinite(before).all()
    np.testing.assert_array_equal(unpacked(packed(sensor)).image_from_ground(xyz), before)


def test_spaces_and_datums_come_back(tmp_path):
    space = EarthSpace(CRS.from_epsg(32632))
    xyz = np.array([[*CENTRE, GROUND_M]])
    np.testing.assert_array_equal(
        unpacked(packed(space)).cartesian_from_ground(xyz), space.cartesian_from_ground(xyz)
    )  # fmt: skip
    posts = np.full((8, 8), 48.0, np.float32)
    path = write_geoid(tmp_path / "geoid.tif", posts, from_origin(7.5, 48.5, 0.25, 0.25))
    datum = unpacked(packed(named_vertical_datum(str(path))))
    np.testing.assert_allclose(datum.undulation(xyz[:, :2], CRS.from_epsg(32632)), 48.0)


class Removal:
    """Something that runs a command when it is read."""

    def __reduce__(self):
        return os.system, ("touch planted",)


@dataclass
class Elsewhere:
    """A dataclass that is none of the package."""

    number: int = 0


def naming(module, name):
    """Bytes that name something and do nothing else."""
    words = [b"\x8c" + bytes([len(word)]) + word.encode() for word in (module, name)]
    return b"\x80\x04" + b"".join(words) + b"\x93."


@pytest.mark.parametrize(
    "content",
    [
        pickle.dumps(Removal()),
        pickle.dumps(Elsewhere()),
        pickle.dumps(np.memmap),
        naming("builtins", "eval"),
        # A name with a dot would lead from a module to what it imports.
        naming("zlocus.pipeline.array_plan", "hashlib.os.system"),
        naming("zlocus.pipeline.array_plan", "stored_plan"),
        naming("zlocus.pipeline.array_plan", "Path"),
    ],
)
def test_other_classes_are_not_read(content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UnknownClassError, match="is no class whose values are kept"):
        unpacked(content)
    assert not list(tmp_path.iterdir())


def test_a_value_that_would_not_be_read_is_not_packed():
    with pytest.raises(UnknownClassError, match="Elsewhere"):
        packed(Elsewhere())
