"""Heights of images on a ground grid: drawing, agreement, reasons, and `zlocus dsm --method gc3-sgm`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from affine import Affine
from typer.testing import CliRunner

from reference.mesh import agreed_heights_reference
from rendered_scenes import HEIGHTS, PART, SMALL_TILES, camera, errors_of, read, run
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError
from zlocus.core.requests import DsmRequest
from zlocus.core.scene import View
from zlocus.matching.fusion import GridCells, PixelHeights, _pixels_of, agreed, gridded
from zlocus.matching.image_space import ImageSpace, MatchedImage
from zlocus.matching.kernels.rasterise import SurfaceLimits, agreed_heights, draw_image
from zlocus.matching.quality import Quality, is_empty
from zlocus.matching.surface import Surface
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.image_scenes import GroundArea
from zlocus.sensors.distortion import FisheyeDistortion
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.image_rays import HeightRays

LIMITS = SurfaceLimits(3.0, 1.0, 3.0)
WITHIN_M, MEDIAN_M, BIAS_M = 1.0, 0.1, 0.05
LEAST_WITHIN = {"plane": 0.995, "step": 0.97, "sine": 0.995}
LEAST_KEPT = {"plane": 0.98, "step": 0.93, "sine": 0.98}
NOTHING = np.float32(np.nan)


def drawn(ground: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    height, pixel = np.full(shape, NOTHING), np.full(shape, -1, np.int32)
    draw_image(ground, LIMITS, height, pixel)
    return height, pixel


def pixels(shape: tuple[int, int], spacing: float, z) -> np.ndarray:
    """Pixels `spacing` cells apart, at heights z(x, y)."""
    x, y = np.meshgrid(np.arange(shape[1]) * spacing + 0.2, np.arange(shape[0]) * spacing + 0.3)
    return np.stack([x, y, z(x, y)], axis=-1)


def test_a_plane_is_drawn_exactly_at_the_centres_of_cells():
    height, pixel = drawn(pixels((20, 24), 1.3, lambda x, y: 0.4 * x - 0.2 * y), (25, 30))
    row, col = np.mgrid[1:24, 1:29] + 0.5
    np.testing.assert_allclose(height[1:24, 1:29], 0.4 * col - 0.2 * row, atol=1e-5)
    assert (pixel[1:24, 1:29] >= 0).all()


def test_a_jump_is_not_bridged_and_the_roof_wins():
    def roof(x, y):
        return np.where((x > 8) & (x < 16), 10.0, 0.0)

    # The right half is seen again as ground that lies below the roof's right end: the roof stays.
    ground = pixels((20, 24), 1.0, roof)
    ground[:, 16:, 0] -= 3.0
    height, _ = drawn(ground, (20, 20))
    known = height[np.isfinite(height)]
    assert np.isin(np.round(known, 4), (0.0, 10.0)).all()
    assert (height[1:18, 9:15] == 10.0).all()


def test_a_lone_pixel_counts_for_the_cell_it_falls_into():
    ground = np.full((3, 3, 3), np.nan)
    ground[1, 1] = 4.9, 2.1, 7.0
    height, pixel = drawn(ground, (5, 6))
    assert height[2, 4] == 7.0
    assert pixel[2, 4] == 4
    assert np.isfinite(height).sum() == 1


def test_most_images_decide_and_the_higher_of_two_alike():
    rng = np.random.default_rng(3)
    heights = rng.choice([0.0, 0.4, 5.0, 5.3, 9.0, np.nan], (5, 12, 13)).astype(np.float32)
    height, agrees = np.empty((12, 13), np.float32), np.empty((5, 12, 13), bool)
    agreed_heights(heights, np.float32(0.5), height, agrees)
    expected, voters = agreed_heights_reference(heights, 0.5)
    np.testing.assert_array_equal(height, expected)
    np.testing.assert_array_equal(agrees, voters)
    two = np.array([[[1.0]], [[6.0]]], np.float32)
    agreed_heights(two, np.float32(0.5), height[:1, :1], agrees[:2, :1, :1])
    assert height[0, 0] == 6.0


def layer(height: float, sigma: float, quality: int = 0) -> Surface:
    one = np.ones((1, 1), np.float32)
    return Surface(one * height, one * sigma, np.full((1, 1), quality, np.uint16), np.full((1, 1), 2, np.uint8), one)


def test_warnings_are_those_of_all_images_and_sigma_holds_their_differences():
    both, jump = int(Quality.WEAK), int(Quality.WEAK | Quality.JUMP | Quality.AMBIGUOUS)
    found = agreed([layer(5.0, 0.3, both), layer(5.4, 0.3, jump), layer(9.0, 0.1)], 2, 0.5)
    assert found.height[0, 0] == pytest.approx(5.2)
    assert found.quality[0, 0] == Quality.WEAK | Quality.JUMP
    assert found.sigma[0, 0] == pytest.approx(np.hypot(0.3, 0.2))
    nothing = agreed([layer(5.0, 0.3), layer(9.0, 0.3)], 2, 0.5)
    assert np.isnan(nothing.height[0, 0])
    assert np.isnan(nothing.sigma[0, 0])
    assert nothing.views[0, 0] == 0
    assert nothing.quality[0, 0] == 0


def flat_image(height: np.ndarray, quality: np.ndarray) -> PixelHeights:
    """The nadir camera's pixels at 50 m and above; one hypothesis is a metre."""
    view = View("nadir", None, None, camera("nadir"))  # type: ignore[arg-type]
    space = ImageSpace(view, HeightRays(view.sensor, 50.0, 1.0), (view,))
    same = np.zeros_like(height)
    surface = Surface(height, same, quality, same.astype(np.uint8), same)
    return PixelHeights(MatchedImage(space, height, 0.0), surface, surface, 0.5, 0.5, 0.5)


def test_every_empty_cell_says_why():
    height, quality = np.zeros((150, 150), np.float32), np.zeros((150, 150), np.uint16)
    low = height.copy()
    low[60:70, 60:70], quality[60:70, 60:70] = np.nan, Quality.NO_MATCH
    west, north = camera("nadir").ground_from_image(np.zeros((1, 2)), np.array([50.0]))[0, :2]
    cells = GridCells((170, 150), Affine(0.5, 0, west, 0, -0.5, north), (40.0, 80.0))
    image = flat_image(low, quality)
    found = gridded([image] * 2, cells, [image] * 2)
    empty = np.isnan(found.height)
    np.testing.assert_array_equal(empty, is_empty(found.quality))
    hole = np.zeros_like(empty)
    hole[50:80, 50:80] = empty[50:80, 50:80]
    assert 64 <= hole.sum() <= 150
    assert (found.quality[hole] == Quality.NO_MATCH).all()
    assert (found.quality[160:] == Quality.UNSEEN).all()
    alone = gridded([image], cells, [image])
    assert (alone.quality[hole] == Quality.UNSEEN).all()


def test_an_excluded_image_is_marked_in_empty_cells_too():
    """IMAGE_EXCLUDED does not explain an empty cell: another flag stands beside it."""
    height, quality = np.zeros((150, 150), np.float32), np.zeros((150, 150), np.uint16)
    height[60:70, 60:70] = np.nan
    quality[60:66, 60:70], quality[66:70, 60:70] = Quality.NO_MATCH | Quality.IMAGE_EXCLUDED, Quality.IMAGE_EXCLUDED
    west, north = camera("nadir").ground_from_image(np.zeros((1, 2)), np.array([50.0]))[0, :2]
    image = flat_image(height, quality)
    found = gridded([image] * 2, GridCells((150, 150), Affine(0.5, 0, west, 0, -0.5, north), (40.0, 80.0)), [image] * 2)
    hole = found.quality[55:75, 55:75][np.isnan(found.height[55:75, 55:75])]
    excluded = Quality.IMAGE_EXCLUDED
    assert set(np.unique(hole)) == {Quality.NO_MATCH | excluded, Quality.OCCLUDED | excluded}
    np.testing.assert_array_equal(np.isnan(found.height), is_empty(found.quality))


FISHEYE = FrameModel((0.0, 0.0, 100.0), rotation_from_angles(0.0, 0.0, 0.0), 600.0, (500.0, 500.0), 1.0, 0.0,
                     FisheyeDistortion())  # fmt: skip


def fisheye_space() -> ImageSpace:
    view = View("fisheye", None, None, FISHEYE)  # type: ignore[arg-type]
    return ImageSpace(view, HeightRays(FISHEYE, 0.0, 1.0), (view,))


@pytest.mark.parametrize("row", np.linspace(20, 980, 13))
def test_a_lens_sees_the_area_beyond_the_corners_of_a_window(row):
    from zlocus.core.grid import CellWindow

    x, y, _ = FISHEYE.ground_from_image(np.array([[250.0, row]]), np.array([5.0]))[0]
    area = GroundArea((x - 1.0, y - 1.0, x + 1.0, y + 1.0), (0.0, 10.0))
    assert area.may_show(fisheye_space(), CellWindow(0, 0, 1000, 250))
    assert not area.may_show(fisheye_space(), CellWindow(0, 750, 1000, 250))


def test_a_lens_sees_cells_beyond_those_at_the_corners():
    cells = GridCells((160, 60), Affine(1.0, 0, 20.0, 0, -1.0, 80.0), (0.0, 10.0))
    image = MatchedImage(fisheye_space(), np.zeros((1000, 1000), np.float32), 0.0)
    rows, cols = _pixels_of(image, cells)
    for z in cells.z_range:
        col, minus_row, _ = (
            fisheye_space().frame_from_ground(cells.ground(np.ones(cells.shape, bool), np.full(9600, z))).T
        )
        assert (np.floor(col) >= cols.start).all()
        assert (np.ceil(col) < cols.stop).all()
        assert (np.floor(-minus_row) >= rows.start).all()
        assert (np.ceil(-minus_row) < rows.stop).all()
    assert cols.stop - cols.start < 400


def test_only_pixels_that_may_show_the_area_are_matched():
    from zlocus.core.grid import CellWindow

    space = flat_image(np.zeros((150, 150), np.float32), np.zeros((150, 150), np.uint16)).matched_image.image_space
    area = GroundArea(PART, (45.0, 55.0))
    assert area.may_show(space, CellWindow(60, 60, 30, 30))
    assert not area.may_show(space, CellWindow(0, 0, 20, 150))


@pytest.mark.parametrize("kind", list(LEAST_WITHIN))
def test_heights_are_true(images, tmp_path, kind):
    result = run(images(kind), tmp_path / "out", method="gc3-sgm")
    error, seen = errors_of(result.out, kind)
    found = np.isfinite(error) & seen
    assert found.sum() / seen.sum() > LEAST_KEPT[kind]
    assert (np.abs(error[found]) < WITHIN_M).mean() > LEAST_WITHIN[kind]
    assert np.median(np.abs(error[found])) < MEDIAN_M
    assert abs(np.median(error[found])) < BIAS_M
    height, quality, sigma, views, ortho = (
        read(result.out / f"{name}.tif")[0] for name in ("dsm", "quality", "sigma", "views", "ortho")
    )
    empty = np.isnan(height)
    np.testing.assert_array_equal(empty, is_empty(quality))
    np.testing.assert_array_equal(empty, np.isnan(sigma))
    np.testing.assert_array_equal(empty, views == 0)
    assert (ortho[~empty] > 0).all()
    record = json.loads((result.out / "run.json").read_text())
    assert record["config"]["request"]["method"] == "gc3-sgm"
    assert 0 < record["evaluations"]["done"] <= record["evaluations"]["all_images"]


def test_without_room_in_memory_the_bytes_are_the_same(images, tmp_path, monkeypatch):
    whole = run(images("step"), tmp_path / "whole", SMALL_TILES, method="gc3-sgm").out
    made = []

    def no_room(beside, room_bytes):
        made.append(SpillArrays(beside, 0.0))
        assert room_bytes > 0
        return made[0]

    monkeypatch.setattr("zlocus.pipeline.tile_makers.SpillArrays", no_room)
    out = run(images("step"), tmp_path / "out", SMALL_TILES, method="gc3-sgm", workers=2).out
    assert made[0].file_bytes > 0
    for name in ("dsm", "sigma", "quality", "views", "ortho"):
        assert (out / f"{name}.tif").read_bytes() == (whole / f"{name}.tif").read_bytes(), name


def test_area_and_workers_change_nothing(images, tmp_path):
    whole = run(images("sine"), tmp_path / "whole", SMALL_TILES, method="gc3-sgm")
    part = run(images("sine"), tmp_path / "part", SMALL_TILES, method="gc3-sgm", bounds=PART, workers=2)
    for name in ("dsm", "sigma", "quality", "views", "ortho"):
        (all_cells, large), (cells, small) = (read(r.out / f"{name}.tif") for r in (whole, part))
        col, row = ~large.transform * (small.transform.c, small.transform.f)
        rows, cols = cells.shape
        np.testing.assert_array_equal(all_cells[round(row) : round(row) + rows, round(col) : round(col) + cols], cells)


def test_one_reference_gives_heights_the_others_confirm(images, tmp_path):
    result = run(images("step"), tmp_path / "out", method="gc3-sgm", reference="nadir")
    quality, _ = read(result.out / "quality.tif")
    assert (quality & Quality.INCONSISTENT).any()
    error, seen = errors_of(result.out, "step")
    assert (np.abs(error[seen & np.isfinite(error)]) < WITHIN_M).mean() > LEAST_WITHIN["step"]


def test_gaps_are_filled_on_request(images, tmp_path):
    result = run(images("step"), tmp_path / "out", method="gc3-sgm", fill="interpolate")
    height, quality = (read(result.out / f"{name}.tif")[0] for name in ("dsm", "quality"))
    filled = (quality & Quality.FILLED) != 0
    assert filled.any()
    assert np.isfinite(height[filled]).all()


def test_what_it_cannot_do_is_refused(images, tmp_path):
    paths = images("plane").inputs
    with pytest.raises(ConfigError, match=r"gc3-sgm .* --dem .*dem\.tif.*mvll-sgm"):
        DsmRequest(inputs=paths, out=tmp_path, method="gc3-sgm", dem=tmp_path / "dem.tif")
    with pytest.raises(ConfigError, match="--reference nobody"):
        run(images("plane"), tmp_path / "out", method="gc3-sgm", reference="nobody")
    asked = ["dsm", *map(str, paths), "-o", str(tmp_path / "out"), "--heights", *map(str, HEIGHTS), "--method"]
    for method, said in (("gc3", "mvll-sgm or mvll or gc3-sgm"), ("sgm", "mvll-sgm, mvll, gc3-sgm")):
        result = CliRunner().invoke(app, [*asked, method])
        assert result.exit_code == 2
        assert said in result.stderr
