"""Images of different ground pixels: the finest is reduced to the others, and finer cells are refused."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st
from rasterio.rpc import RPC

from rendered_scenes import CENTRE, UTM
from zlocus.core.errors import ConfigError
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.core.scene import ImageWindow, Scene, View, has_mask
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.matching.ground_pixels import (
    ReducedImage,
    check_cells_in_overlap,
    check_resolution,
    common_pixel,
    default_cell,
    rounded_up,
    with_common_pixel,
)
from zlocus.pipeline.dsm import run_dsm
from zlocus.sensors.correction import ReducedModel
from zlocus.synthetic.cameras import SatelliteCamera

POSITION_PX = 1e-6
# Of the rendered town, with one image at a third of the other's resolution. Completeness and the share off by more than
# 10 m were .97 and .024 in cells of the median ground pixel, and .62 and .16 in those of the finer image.
LEAST_COMPLETE, MOST_FAR_OFF = 0.99, 0.02


@dataclass
class ArrayImage:
    pixels: np.ndarray
    valid: np.ndarray
    dtype: str = "uint16"

    @property
    def shape(self):
        return self.pixels.shape

    def read(self, row, col, rows, cols):
        part = np.s_[row : row + rows, col : col + cols]
        return ImageWindow(self.pixels[part].astype(np.float32), self.valid[part])


def scene(*gsd_m):
    views = []
    for number, gsd in enumerate(gsd_m):
        sensor = SatelliteCamera((*CENTRE, 50.0), (50.0, 50.0), gsd, 10.0 * number, 0.0)
        image = ArrayImage(np.zeros((101, 101), np.uint16), np.ones((101, 101), bool))
        views.append(View(f"v{number}", Path(f"v{number}.tif"), image, sensor))
    return Scene(tuple(views), UTM)


def test_a_reduced_image_holds_means_of_valid_pixels():
    rng = np.random.default_rng(3)
    pixels, valid = rng.integers(1, 999, (32, 41)).astype(np.uint16), rng.random((32, 41)) < 0.8
    image = ReducedImage(ArrayImage(pixels, valid), 3)
    assert image.shape == (10, 13)
    window = image.read(2, 4, 5, 6)
    for r, c in np.ndindex(5, 6):
        part = np.s_[3 * (2 + r) : 3 * (2 + r) + 3, 3 * (4 + c) : 3 * (4 + c) + 3]
        assert window.valid[r, c] == (valid[part].sum() > 4.5)
        if window.valid[r, c]:
            assert window.pixels[r, c] == pytest.approx(pixels[part][valid[part]].mean(), rel=1e-5)
        else:
            assert window.pixels[r, c] == 0


def test_a_reduced_image_is_masked_where_most_of_its_pixels_are():
    mask = np.random.default_rng(3).random((32, 41)) < 0.5
    full = ArrayImage(np.ones(mask.shape, np.uint16), ~mask)
    assert not has_mask(ReducedImage(full, 3))
    full.masked = lambda row, col, rows, cols: mask[row : row + rows, col : col + cols]
    reduced = ReducedImage(full, 3)
    np.testing.assert_array_equal(reduced.masked(2, 4, 5, 6), ~reduced.read(2, 4, 5, 6).valid)


@given(st.integers(2, 6), st.floats(-20, 20), st.floats(-20, 20), st.floats(20, 80))
def test_a_pixel_of_a_reduced_image_lies_in_the_middle_of_those_it_is_made_of(factor, east, north, z):
    base = SatelliteCamera((*CENTRE, 50.0), (50.0, 50.0), 0.5, 12.0, 5.0)
    model = ReducedModel(base, factor)
    xyz = np.array([[CENTRE[0] + east, CENTRE[1] + north, z]])
    found = model.image_from_ground(xyz)
    np.testing.assert_allclose(found * factor + (factor - 1) / 2, base.image_from_ground(xyz), atol=POSITION_PX)
    back = model.ground_from_image(found, np.array([z]))
    np.testing.assert_allclose(model.image_from_ground(back), found, atol=POSITION_PX)


@pytest.mark.parametrize(
    ("gsd_m", "cell_m", "reduced"),
    [
        ((0.5, 0.5), 0.5, ()),
        ((0.5, 1.0), 0.76, ()),
        ((0.5, 1.5), 1.5, ("v0",)),
        ((0.5, 1.5, 1.5), 1.5, ("v0",)),
        ((0.5, 0.5, 2.0), 0.51, ()),
    ],
)
def test_the_cell_of_a_scene_and_what_is_reduced(gsd_m, cell_m, reduced):
    found = scene(*gsd_m)
    assert default_cell(found, 50.0) == pytest.approx(cell_m, rel=0.04)
    views = with_common_pixel(found.views, 50.0)
    assert tuple(view.name for view in views if isinstance(view.image, ReducedImage)) == reduced
    assert all(
        view.sensor is old.sensor for view, old in zip(views, found.views, strict=True) if view.name not in reduced
    )


def test_cells_that_one_image_alone_supports_are_refused():
    found = scene(0.5, 2.0)
    with pytest.raises(ConfigError, match=r"only v0 has pixels of 0\.5 m on the ground, the next has 2 m\. Ask for 1"):
        check_resolution(0.5, found, 50.0, "--resolution")
    check_resolution(rounded_up(common_pixel([0.5, 2.1]) / 2), found, 50.0, "--resolution")
    check_resolution(0.5, scene(0.5, 0.5, 2.0), 50.0, "--resolution")


@given(st.floats(1e-3, 1e3))
def test_a_size_that_is_asked_for_is_never_below_what_is_needed(size):
    assert size * (1 - 1e-6) <= rounded_up(size) <= 1.11 * size


def at_a_third(path, to):
    """An image with a third of the resolution, and its RPC."""
    with rasterio.open(path) as source:
        pixels, rpc = source.read(1), source.rpcs
    rows, cols = (size // 3 * 3 for size in pixels.shape)
    means = pixels[:rows, :cols].reshape(rows // 3, 3, cols // 3, 3).mean(axis=(1, 3)).astype(pixels.dtype)
    numbers = rpc.to_dict() | {
        "line_off": (rpc.line_off + 0.5) / 3 - 0.5, "samp_off": (rpc.samp_off + 0.5) / 3 - 0.5,
        "line_scale": rpc.line_scale / 3, "samp_scale": rpc.samp_scale / 3,
    }  # fmt: skip
    profile = {"driver": "GTiff", "height": means.shape[0], "width": means.shape[1], "count": 1, "nodata": 0}
    with rasterio.open(to, "w", dtype=means.dtype, rpcs=RPC(**numbers), **profile) as file:
        file.write(means, 1)
    return to


def test_an_image_at_a_third_of_the_others_resolution(shared_data, tmp_path):
    city = shared_data / "rendered-city"
    inputs = (city / "img_n1.tif", at_a_third(city / "img_f1.tif", tmp_path / "f.tif"))
    request = DsmRequest(inputs=inputs, out=tmp_path / "out", report=False, products=())
    run_dsm(request, RunConfig(), SilentProgress())
    comparison = Comparison(city / "truth_dsm.tif", more_thresholds_m=(10.0,))
    found = evaluate(tmp_path / "out" / "dsm.tif", comparison).statistics.as_dict()
    assert found["completeness"] > LEAST_COMPLETE
    assert found["completeness"] - found["within_m"]["10"] < MOST_FAR_OFF


def test_cells_must_leave_room_for_a_window_in_the_overlap():
    shared = (0.0, 0.0, 200.0, 90.0)
    check_cells_in_overlap(30.0, 3, shared, 0.5, "--resolution")
    says = r"--resolution 31 m .* 3 x 3 cells, which are 93 m wide, .* 200 x 90 m of ground\. Ask for less than 30 m"
    with pytest.raises(ConfigError, match=says):
        check_cells_in_overlap(31.0, 3, shared, 0.5, "--resolution")
