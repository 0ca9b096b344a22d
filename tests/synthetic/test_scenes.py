"""Whole scenes: terrain, objects, and the files of a scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from zlocus.core.errors import ConfigError, OutputError, ZlocusError
from zlocus.io.cameras.rpc import read_rpc
from zlocus.sensors.rpc import RpcModel
from zlocus.synthetic import files
from zlocus.synthetic.__main__ import main
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.objects import BARE, PAINT, Objects
from zlocus.synthetic.raycast import WEEDS, top_albedo
from zlocus.synthetic.render import visible_ground_points
from zlocus.synthetic.scenes import (
    SceneSpec,
    ViewSpec,
    build_ground,
    city_spec,
    demo_spec,
    exposures_of,
    hills_spec,
    with_pointing_errors,
)
from zlocus.synthetic.terrain import BUILDING, PATTERN_ROWS, ROAD, TREE, SyntheticGround, analytic_height

RPC_PX = 1e-3
HEIGHT_M = 1e-3
SIZE, CELLS = 120, 240
STANDING = Objects(70.0, 16.0, 3.0, 40.0)
VIEWS = (ViewSpec("n", 1.0, -4.0), ViewSpec("f", 20.0, 9.0, 5.0, bias_row_px=2.25, bias_col_px=-1.5))


def small(**changes: object) -> SceneSpec:
    return city_spec(11, **{"size": SIZE, "relief_m": 5.0, "views": VIEWS, "objects": STANDING, **changes})


@pytest.fixture(scope="module")
def spec() -> SceneSpec:
    return small()


@pytest.fixture(scope="module")
def ground(spec: SceneSpec) -> SyntheticGround:
    return build_ground(spec, exposures_of(spec))


@pytest.fixture(scope="module")
def folder(spec: SceneSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_scene(spec, tmp_path_factory.mktemp("rendered") / "scene").folder


def read(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return np.asarray(file.read(1))


def test_truth_is_the_ground_that_was_rendered(folder: Path, spec: SceneSpec, ground: SyntheticGround) -> None:
    cells = ground.cells(spec.west_m, spec.north_m, (CELLS, CELLS))
    np.testing.assert_array_equal(read(folder / "truth_dsm.tif"), ground.heights[cells])
    np.testing.assert_array_equal(read(folder / "truth_class.tif"), ground.classes[cells])
    with rasterio.open(folder / "truth_dsm.tif") as file:
        assert file.crs.to_epsg() == 32632
        assert file.transform[:6] == (0.25, 0.0, spec.west_m, 0.0, -0.25, spec.north_m)


def test_pixels_see_the_truth(folder: Path, spec: SceneSpec, ground: SyntheticGround) -> None:
    """Tops that a pixel sees have the height of the truth's cell, to its slope; the rest are walls, lower than that.

    The cell is the one that the ray enters where it ends (a point of a wall is on the border of two).
    """
    truth = read(folder / "truth_dsm.tif")
    exposure = exposures_of(spec)[1]
    xy = np.random.default_rng(3).uniform(20, 90, (4000, 2))
    seen = visible_ground_points(ground, exposure.sensor, xy)
    within = exposure.sensor.ground_from_image(xy, seen[:, 2] - 0.001)
    row = np.floor((spec.north_m - within[:, 1]) / 0.25).astype(int)
    col = np.floor((within[:, 0] - spec.west_m) / 0.25).astype(int)
    inside = (row >= 0) & (row < CELLS) & (col >= 0) & (col < CELLS)
    below = truth[row[inside], col[inside]] - seen[inside, 2]
    assert (np.abs(below) < 0.2).mean() > 0.6
    assert (below > -0.2).all()
    assert (below > 5.0).any()


def test_pointing_errors_are_in_the_rpc_and_nowhere_else(folder: Path, spec: SceneSpec) -> None:
    """Row + 2.25, column - 1.5: what the file's RPC projects, against the exact camera."""
    corners = np.array([(spec.west_m + e, spec.north_m - n, z) for e in (0, 60) for n in (0, 60) for z in (430, 500)])
    for exposure in exposures_of(spec):
        model = RpcModel(read_rpc(folder / f"img_{exposure.view.name}.tif"), spec.crs)
        error = model.image_from_ground(corners.astype(float)) - exposure.sensor.image_from_ground(corners)
        expected = (exposure.view.bias_col_px, exposure.view.bias_row_px)
        np.testing.assert_allclose(error, np.broadcast_to(expected, error.shape), rtol=0, atol=RPC_PX)


def test_the_description_holds_the_specification(folder: Path, ground: SyntheticGround) -> None:
    text = json.loads((folder / "scene.json").read_text())
    assert text["views"]["f"]["bias_row_col"] == [2.25, -1.5]
    assert text["views"]["f"]["along"] == 20.0
    assert text["views"]["n"]["rpc_fit_max_px"] < RPC_PX
    assert (text["zmin"], text["zmax"]) == ground.height_range


def test_images_hold_all_terrain_of_the_area(folder: Path, spec: SceneSpec, ground: SyntheticGround) -> None:
    cells = ground.cells(spec.west_m, spec.north_m, (CELLS, CELLS))
    low_ground = ground.classes[cells] <= ROAD
    rows, cols = np.nonzero(low_ground)
    xyz = np.column_stack(
        [spec.west_m + (cols + 0.5) * 0.25, spec.north_m - (rows + 0.5) * 0.25, ground.heights[cells][low_ground]]
    )
    for exposure in exposures_of(spec):
        image = read(folder / f"img_{exposure.view.name}.tif")
        assert image.shape == exposure.shape
        assert (image > 0).all()
        xy = exposure.sensor.image_from_ground(xyz)
        assert xy.min() > 0.0
        assert (xy.max(axis=0) < np.array(exposure.shape[::-1]) - 1.0).all()


def test_the_same_seed_gives_the_same_bytes(folder: Path, spec: SceneSpec, tmp_path: Path) -> None:
    again = render_scene(spec, tmp_path / "again").folder
    other = render_scene(replace(spec, seed=12), tmp_path / "other").folder
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(path.name for path in again.iterdir())
    for name in names:
        assert (folder / name).read_bytes() == (again / name).read_bytes()
        assert (folder / name).read_bytes() != (other / name).read_bytes()


def test_a_folder_that_exists_is_left_alone(spec: SceneSpec, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="exists already"):
        render_scene(spec, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "raised"), [(OSError("disk full"), OutputError), (KeyboardInterrupt(), KeyboardInterrupt)]
)
def test_no_partial_folder_remains(
    error: BaseException, raised: type, spec: SceneSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(files, "write_image", fail)
    with pytest.raises(raised):
        render_scene(spec, tmp_path / "scene")
    assert not list(tmp_path.iterdir())


def test_objects_stand_on_the_ground(ground: SyntheticGround, spec: SceneSpec) -> None:
    assert set(np.unique(ground.classes)) == {0, ROAD, BUILDING, TREE}
    low, high = ground.height_range
    assert spec.height_range[0] <= low
    assert spec.terrain_range[0] + 25.0 < high <= spec.height_range[1]
    terrain = build_ground(replace(spec, objects=Objects(0.0, 0.0, 0.0, 0.0)), exposures_of(spec))
    rise = ground.heights - terrain.heights
    flat = ground.classes <= ROAD
    np.testing.assert_array_equal(rise[flat], 0.0)
    assert (rise[ground.classes == BUILDING] > 2.0).all()
    assert (rise[ground.classes == TREE] > 0.2).all()
    assert (ground.material == PAINT).any()
    assert terrain.heights.min() >= spec.base_m - 0.1
    assert terrain.heights.max() <= spec.terrain_range[1] + 0.1


def test_roofs_are_planes(ground: SyntheticGround) -> None:
    """Neighbouring cells of one material on a gabled roof lie in one plane, on either side of the ridge."""
    slope = np.abs(ground.slopes).sum(axis=2)
    roof = (ground.classes == BUILDING) & (slope > 0)
    same = roof[:, :-1] & roof[:, 1:] & (ground.material[:, :-1] == ground.material[:, 1:])
    same &= (ground.slopes[:, :-1] == ground.slopes[:, 1:]).all(axis=2)
    assert same.sum() > 500
    np.testing.assert_allclose(np.diff(ground.heights, axis=1)[same], ground.slopes[:, :-1, 0][same], atol=HEIGHT_M)


def test_crops_stand_on_bare_ground_and_move_nothing(ground: SyntheticGround, spec: SceneSpec) -> None:
    crops = replace(spec, objects=replace(STANDING, crop_side_m=20.0))
    planted = build_ground(crops, exposures_of(crops))
    np.testing.assert_array_equal(planted.planes, ground.planes)
    np.testing.assert_array_equal(planted.classes, ground.classes)
    in_rows = (planted.materials["pattern"] == PATTERN_ROWS)[planted.material]
    assert (ground.material[in_rows] == BARE).all()
    np.testing.assert_array_equal(planted.material[~in_rows], ground.material[~in_rows])
    assert 0.7 < in_rows.sum() / (ground.material == BARE).sum() < 0.9


def test_rows_repeat_across_and_run_straight_along(spec: SceneSpec) -> None:
    """Three tenths of a period further only the weeds differ from those a whole period away."""
    crops = replace(spec, objects=replace(STANDING, crop_side_m=20.0))
    ground = build_ground(crops, exposures_of(crops))
    crop = ground.materials[-1]
    x, y = np.random.default_rng(2).uniform(50.0, 150.0, (2, 300))

    def albedo(along: float, across: float) -> np.ndarray:
        at = x + along * crop["cos"] - across * crop["sin"], y + along * crop["sin"] + across * crop["cos"]
        return np.array([top_albedo(u, v, ground.texel_m, crop, ground.textures) for u, v in zip(*at, strict=True)])

    def differ(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.std(a - b) / (crop["albedo"] * crop["contrast"]))

    here = albedo(0.0, 0.0)
    assert differ(here, albedo(0.0, crop["period"])) < 2.0 * WEEDS
    assert differ(here, albedo(7.3, 0.0)) < 2.0 * WEEDS
    assert differ(here, albedo(0.0, 0.3 * crop["period"])) > 4.0 * WEEDS


def test_terrain_slopes_are_those_of_its_heights() -> None:
    hilly = hills_spec(5, size=64, relief_m=30.0, objects=Objects(0.0, 0.0, 0.0, 0.0), views=VIEWS[:1])
    ground = build_ground(hilly, exposures_of(hilly))
    middle = 0.5 * (ground.heights[:, 2:] - ground.heights[:, :-2])
    np.testing.assert_allclose(ground.slopes[:, 1:-1, 0], middle, atol=0.01)
    middle = 0.5 * (ground.heights[2:] - ground.heights[:-2])
    np.testing.assert_allclose(ground.slopes[1:-1, :, 1], middle, atol=0.01)
    assert np.abs(ground.slopes).max() > 0.1


def test_the_demo_is_the_block_of_the_paper() -> None:
    """Six level 1 images in two strips, 62.5 mm, 2000 m above ground, 0.21 m pixels, all seeing the middle."""
    spec = demo_spec()
    side = spec.size * spec.gsd_m
    middle = np.array([(spec.west_m + side / 2, spec.north_m - side / 2, sum(spec.terrain_range) / 2)])
    assert [view.name for view in spec.views] == ["n1", "f1", "b1", "n2", "f2", "b2"]
    for exposure in exposures_of(spec):
        assert exposure.taken.sensor.focal_m == 0.0625
        assert exposure.sensor.plane_from_image.determinant == pytest.approx(-(0.21**2))
        xy = exposure.sensor.image_from_ground(middle)
        np.testing.assert_allclose(xy[0], (exposure.shape[1] / 2, exposure.shape[0] / 2), atol=12.0)
        ground = exposure.sensor.ground_from_image(xy + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), middle[0, 2])
        assert np.linalg.norm(ground[1] - ground[0]) == pytest.approx(0.21, abs=1e-3)
        assert np.linalg.norm(ground[2] - ground[0]) == pytest.approx(0.21, abs=1e-3)
        high = exposure.sensor.ground_from_image(xy, middle[0, 2] + 100.0)[0] - ground[0]
        heading = np.deg2rad(exposure.view.heading_deg)
        forward, right = np.array([(np.sin(heading), np.cos(heading)), (np.cos(heading), -np.sin(heading))])
        ahead, aside = np.tan(np.deg2rad([exposure.view.along_deg, exposure.view.across_deg]))
        np.testing.assert_allclose(high[:2], -100.0 * (ahead * forward + aside * right), atol=0.5)


def test_pointing_errors_are_drawn_within_their_range() -> None:
    spec = with_pointing_errors(city_spec(3), 4.0)
    errors = np.array([(view.bias_row_px, view.bias_col_px) for view in spec.views])
    assert (np.abs(errors) <= 4.0).all()
    assert np.abs(errors).max() > 2.0
    assert spec == with_pointing_errors(city_spec(3), 4.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "sea"}, "kind = 'sea' is not one of"),
        ({"truth_step_m": 0.7}, "does not divide the side"),
        ({"views": ()}, "at least one"),
        ({"views": (VIEWS[0], VIEWS[0])}, "different names"),
    ],
)
def test_invalid_specifications_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        city_spec(1, **changes)


def test_there_is_no_other_analytic_ground() -> None:
    with pytest.raises(ZlocusError, match="plane, tilt, step, sphere, sine"):
        analytic_height("bowl", np.zeros(1), np.zeros(1))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scene"
    assert main(["--kind", "hills", "--size", "40", "--views", "2", "--pointing", "3", "-o", str(out)]) == 0
    assert sorted(path.name for path in out.glob("img_*")) == ["img_f1.tif", "img_n1.tif"]
    assert json.loads((out / "scene.json").read_text())["views"]["n1"]["bias_row_col"] != [0.0, 0.0]
    assert main(["-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err
