"""Blocks of drone images: cameras, overlaps, pixels and truth agree, and a surface can be made of them."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from zlocus.core.errors import ConfigError, OutputError
from zlocus.core.options import PyramidOptions, RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest
from zlocus.io.open_raster import open_raster
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.dsm import run_dsm
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.drone_block import (
    DroneBlockSpec,
    RenderedDroneBlock,
    build_drone_ground,
    drone_exposures,
    render_drone_block,
    small_drone_block_spec,
    written_cameras,
)
from zlocus.synthetic.drone_ground import (
    CAR,
    PAVEMENT,
    PLOT_M,
    TARGET_BLACK_PX,
    TARGET_WHITE_PX,
    ColouredGround,
    n_plots,
)
from zlocus.synthetic.drone_photo import DronePhoto, SplinedRays, seen_colours
from zlocus.synthetic.drone_truth import n_frames_showing
from zlocus.synthetic.render import Sun, render, sunlit, visible_ground_points
from zlocus.synthetic.scenes import Exposure
from zlocus.synthetic.terrain import BUILDING, ROAD, TREE, SyntheticGround

# The scene file holds all digits of a camera.
READ_PX = 1e-6
# Centroids of targets of 8 px in images with noise and compression; and half of the window that holds a target.
TARGET_PX, REACH_PX = 0.1, 10
# Of a hundred targets, whose errors have a standard deviation of 0.03 px.
MEAN_OF_TARGETS_PX = 0.02
# Points around a target that the frame has to show, and how far the ground there may lie above or below the middle.
ANGLES, FLAT_M = np.arange(8) * np.pi / 4, 0.3
# Overlaps are exact for the same principal point; that of the next strip is turned by 180 degrees.
OVERLAP = 0.012
HEIGHT_M = 1e-4
# Two ground pixels, and the share of the cells that have to be as near to the truth; cells with an edge are left out.
NEAR_M, SHARE_NEAR = 0.4, 0.85


# Radiance and factors of colours of equal rays, and the share of the pixels of a row that have to be equal.
SAME_LIGHT, SHARE_SAME = 2e-3, 0.97


def tiny(seed: int = 3, **changes: object) -> DroneBlockSpec:
    """Two frames of 160 x 120 px, the inner part of those of the small block."""
    inner = {"columns": 160, "rows": 120, "strips": 1, "frames_per_strip": 2, "n_targets": 1, "samples": 1}
    return small_drone_block_spec(seed, **(inner | changes))


@pytest.fixture(scope="module")
def spec() -> DroneBlockSpec:
    return small_drone_block_spec()


@pytest.fixture(scope="module")
def block(spec: DroneBlockSpec, tmp_path_factory: pytest.TempPathFactory) -> RenderedDroneBlock:
    return render_drone_block(spec, tmp_path_factory.mktemp("drone") / "block")


@pytest.fixture(scope="module")
def coloured(spec: DroneBlockSpec) -> ColouredGround:
    return build_drone_ground(spec, drone_exposures(spec))


def grey(path: Path) -> np.ndarray:
    with open_raster(path) as file:
        return np.tensordot((0.299, 0.587, 0.114), file.read().astype(float), axes=1)


def test_the_files_hold_the_cameras_that_rendered_the_frames(block: RenderedDroneBlock, spec: DroneBlockSpec) -> None:
    scene = open_scene([block.scene])
    exposures = drone_exposures(spec)
    assert [view.name for view in scene.views] == [exposure.view.name for exposure in exposures]
    assert len(scene.views) == 6
    for view, exposure in zip(scene.views, exposures, strict=True):
        assert view.image.shape == exposure.shape == (420, 560)
        xy = np.random.default_rng(1).uniform((0, 0), (559, 419), (500, 2))
        xyz = exposure.sensor.ground_from_image(xy, np.full(500, spec.base_m))
        np.testing.assert_allclose(view.sensor.image_from_ground(xyz), xy, rtol=0, atol=READ_PX)
    with open_raster(block.images["s1_1"]) as file:
        assert (file.count, file.dtypes[0], file.driver) == (3, "uint8", "JPEG")


def test_targets_are_where_the_cameras_see_them(
    block: RenderedDroneBlock, spec: DroneBlockSpec, coloured: ColouredGround
) -> None:
    """The white disc of each target that is not occluded, through the distortion of the lens."""
    targets = np.array(json.loads((block.folder / "scene.json").read_text())["targets"])
    np.testing.assert_array_equal(targets, coloured.targets)
    last, errors, moved = np.array([559, 419]), [], []
    reach_m = (TARGET_WHITE_PX + TARGET_BLACK_PX) / 2 * spec.ground_pixel_m
    evenly_lit = is_evenly_lit(coloured.ground, spec.sun, targets)
    around = np.array([(0, 0), *(6.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]))])
    for exposure in drone_exposures(spec):
        image = grey(block.images[exposure.view.name])
        ideal = replace(exposure.sensor, distortion=None).image_from_ground(targets)
        for number, at in enumerate(exposure.sensor.image_from_ground(targets)):
            if not (evenly_lit[number] and ((at > 12) & (at < last - 12)).all()):
                continue
            seen = visible_ground_points(coloured.ground, exposure.sensor, at + around)
            if np.abs(seen[:, 2] - targets[number, 2]).max() < FLAT_M:
                errors.append(centroid(image, exposure, targets[number], reach_m) - at)
                moved.append(np.linalg.norm(ideal[number] - at))
    assert len(errors) >= 20
    assert np.abs(errors).max() < TARGET_PX
    # The lens moves some of them by many pixels, so a rendering without it would be seen here.
    assert max(moved) > 10.0


def is_evenly_lit(ground: SyntheticGround, sun: Sun, targets: np.ndarray) -> np.ndarray:
    """Whether a target lies in light or in shadow as a whole, (n,)."""
    lit, reach = sunlit(ground, sun), round(2.0 / ground.step)
    cells = [(int((ground.y0 - y) / ground.step), int((x - ground.x0) / ground.step)) for x, y, _ in targets]
    parts = [lit[i - reach : i + reach + 1, j - reach : j + reach + 1] for i, j in cells]
    return np.array([part.all() or not part.any() for part in parts])


@pytest.fixture(scope="module")
def moving() -> DroneBlockSpec:
    """Strips and crossing strips of a drone that flies 8 px in a read-out, with a camera stated wrongly."""
    return small_drone_block_spec(
        4, frames_per_strip=1, crossing_strips=2, crossing_tilt_deg=15.0, readout_s=0.15, speed_m_s=10.0,
        n_targets=40, trees_per_ha=5.0, stated_distortion=BrownDistortion(k1=-0.2), stated_readout_s=0.02,
        stated_focal_px=424.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def moving_block(moving: DroneBlockSpec, tmp_path_factory: pytest.TempPathFactory) -> RenderedDroneBlock:
    return render_drone_block(moving, tmp_path_factory.mktemp("moving") / "block")


def velocities_of(spec: DroneBlockSpec) -> dict[str, np.ndarray]:
    """Velocities (3,) m/s by frame, written out from the headings of the strips."""
    of_strip = {"s1": 20.0, "s2": 200.0, "c1": 110.0, "c2": 290.0}
    return {
        f"{strip}_{number}": spec.speed_m_s * np.array([np.sin(np.deg2rad(h)), np.cos(np.deg2rad(h)), 0.0])
        for strip, h in of_strip.items()
        for number in (1, 2, 3)
    }


def slowly_projected(exposure: Exposure, spec: DroneBlockSpec, velocity: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Column and row at which a frame shows a point (3,): of a camera at rest for the time of every row, the one that
    sees the point in that row, between two rows in proportion. A camera that has moved sees the point as one that has
    not would see it moved backwards."""
    at_rest, rows = replace(exposure.sensor, rolling_shutter=None), np.arange(-50, spec.rows + 50)
    seconds = spec.readout_s * (rows - (spec.rows - 1) / 2) / spec.rows
    seen = at_rest.image_from_ground(point - seconds[:, None] * velocity)
    ahead = seen[:, 1] - rows
    (first,) = np.flatnonzero((ahead[:-1] >= 0) & (ahead[1:] < 0))
    share = ahead[first] / (ahead[first] - ahead[first + 1])
    return seen[first] + share * (seen[first + 1] - seen[first])


def test_targets_are_where_a_rolling_shutter_sees_them(
    moving_block: RenderedDroneBlock, moving: DroneBlockSpec
) -> None:
    """In the JPEGs, against a camera at rest for the time of every row."""
    exposures = drone_exposures(moving)
    ground = build_drone_ground(moving, exposures).ground
    targets = np.array(json.loads((moving_block.folder / "scene.json").read_text())["targets"])
    velocities, last = velocities_of(moving), np.array([559, 419])
    reach_m = (TARGET_WHITE_PX + TARGET_BLACK_PX) / 2 * moving.ground_pixel_m
    evenly_lit = is_evenly_lit(ground, moving.sun, targets)
    around = np.array([(0, 0), *(6.0 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]))])
    errors, moved = [], []
    for exposure in exposures:
        image, still = grey(moving_block.images[exposure.view.name]), replace(exposure.sensor, rolling_shutter=None)
        for number, target in enumerate(targets):
            ((column, row),) = still.image_from_ground(target[None])
            if not (evenly_lit[number] and 20 < column < last[0] - 20 and 20 < row < last[1] - 20):
                continue
            at = slowly_projected(exposure, moving, velocities[exposure.view.name], target)
            seen = visible_ground_points(ground, exposure.sensor, at + around)
            if np.abs(seen[:, 2] - target[2]).max() < FLAT_M:
                errors.append(centroid(image, exposure, target, reach_m) - at)
                moved.append(np.hypot(*(at - (column, row))))
    assert len(errors) >= 40
    # Some targets of many lie beside something that is as bright.
    assert (np.abs(errors).max(axis=1) < TARGET_PX).mean() > 0.95
    assert np.abs(np.mean(errors, axis=0)).max() < MEAN_OF_TARGETS_PX
    assert max(moved) > 3.0


def test_each_row_is_rendered_from_where_the_camera_is_then(moving: DroneBlockSpec) -> None:
    """Light and colours of a row are those of a camera that stands still at the time of that row."""
    exposure = drone_exposures(moving)[1]
    velocity, shape = velocities_of(moving)["s2_1"], exposure.shape
    coloured = build_drone_ground(moving, (exposure,))
    lit, still = sunlit(coloured.ground, moving.sun), replace(exposure.sensor, rolling_shutter=None)

    def light_of(camera: FrameModel) -> np.ndarray:
        return render(coloured.ground, SplinedRays(camera, shape), shape, moving.sun, 1, lit)

    def at_the_time_of(row: float) -> FrameModel:
        seconds = moving.readout_s * (row - 209.5) / 420
        return replace(still, centre=tuple(np.array(still.centre) + seconds * velocity))

    light, colours = light_of(exposure.sensor), seen_colours(coloured, exposure.sensor, shape)
    for row in (0, 105, 210, 314, 419):
        assert share_equal(light[row], light_of(at_the_time_of(row))[row]) > SHARE_SAME
        of_colours = row // 2
        then = seen_colours(coloured, at_the_time_of(2 * of_colours + 0.5), shape)
        assert share_equal(colours[:, of_colours], then[:, of_colours]) > SHARE_SAME
    unmoved = light_of(still)
    assert max(share_equal(light[row], unmoved[row]) for row in (0, 419)) < 0.5


def share_equal(values: np.ndarray, others: np.ndarray) -> float:
    """Share of the values that are equal. Rays along the border of two cells may meet either."""
    return float(np.isclose(values, others, rtol=0, atol=SAME_LIGHT).mean())


def test_the_scene_file_states_the_camera_that_was_asked_for(
    moving_block: RenderedDroneBlock, moving: DroneBlockSpec
) -> None:
    """And `scene.json` the poses and the whole specification, the true camera included."""
    velocities = velocities_of(moving)
    for view, exposure in zip(open_scene([moving_block.scene]).views, drone_exposures(moving), strict=True):
        assert (view.sensor.focal, exposure.sensor.focal) == (424.0, 420.0)
        assert (view.sensor.distortion, exposure.sensor.distortion) == (BrownDistortion(k1=-0.2), moving.distortion)
        stated, true = view.sensor.rolling_shutter, exposure.sensor.rolling_shutter
        assert (stated.readout_s, true.readout_s) == (0.02, 0.15)
        for each in (stated, true):
            np.testing.assert_allclose(each.velocity, velocities[view.name], rtol=0, atol=1e-9)
            assert each.rows == 420
        assert view.sensor.centre == exposure.sensor.centre
    assert json.loads((moving_block.folder / "scene.json").read_text())["spec"]["readout_s"] == 0.15


def test_crossing_strips_look_forwards_at_the_same_ground() -> None:
    steady = {"least_tilt_deg": 0.0, "largest_tilt_deg": 0.0, "heading_noise_deg": 0.0, "flight_noise_m": 0.0}
    spec = small_drone_block_spec(crossing_strips=2, crossing_tilt_deg=15.0, frames_per_strip=3, **steady)
    exposures = {exposure.view.name: exposure.sensor for exposure in drone_exposures(spec)}
    assert len(exposures) == 12
    velocities = velocities_of(replace(spec, speed_m_s=1.0))
    middle = np.array([spec.east_m, spec.north_m])
    for strip in ("s", "c"):
        axes = []
        for name in (f"{strip}{k}_{number}" for k in (1, 2) for number in (1, 2, 3)):
            sensor = exposures[name]
            tilt_deg = np.rad2deg(np.arccos(-sensor.rotation[2, 2]))
            assert tilt_deg == pytest.approx(15.0 if strip == "c" else 0.0, abs=1e-4)
            forward = velocities[name]
            assert (sensor.rotation[2] @ forward > 0.2) == (strip == "c")
            # The top of the image points forwards.
            assert -sensor.rotation[1] @ forward > 0.9
            axes.append(sensor.ground_from_image(np.array([sensor.principal_point]), np.array([spec.middle_m]))[0, :2])
        np.testing.assert_allclose(np.mean(axes, axis=0), middle, rtol=0, atol=1e-3)


def centroid(image: np.ndarray, exposure: Exposure, target: np.ndarray, reach_m: float) -> np.ndarray:
    """Column and row of the middle of what is bright within `reach_m` of a target, by a third of its contrast."""
    first = np.rint(exposure.sensor.image_from_ground(target[None])[0]).astype(int) - REACH_PX
    col, row = np.meshgrid(first[0] + np.arange(2 * REACH_PX + 1), first[1] + np.arange(2 * REACH_PX + 1))
    xy = np.column_stack([col.ravel(), row.ravel()])
    on_ground = exposure.sensor.ground_from_image(xy.astype(float), np.full(len(xy), target[2]))
    xy = xy[np.hypot(*(on_ground - target)[:, :2].T) < reach_m]
    values = image[xy[:, 1], xy[:, 0]]
    weight = np.clip(values - values.min() - np.ptp(values) / 3, 0.0, None)
    return weight @ xy / weight.sum()


@pytest.mark.parametrize(("forward", "side"), [(0.6, 0.6), (0.8, 0.4)])
def test_frames_overlap_as_the_specification_says(forward: float, side: float) -> None:
    """Share of a frame's middle column that the next frame shows on level ground, and of its middle row the strip."""
    steady = {"least_tilt_deg": 0.0, "largest_tilt_deg": 0.0, "heading_noise_deg": 0.0, "flight_noise_m": 0.0}
    spec = replace(DroneBlockSpec(), forward_overlap=forward, side_overlap=side, **steady)
    exposures = {exposure.view.name: exposure for exposure in drone_exposures(spec)}
    assert len(exposures) == 20
    assert exposures["s1_1"].shape == (3000, 4000)
    column = np.array([(1999.5, -0.5), (1999.5, 2999.5)])
    row = np.array([(-0.5, 1499.5), (3999.5, 1499.5)])
    # The second strip is flown backwards, so its last frame lies beside the first of the first strip.
    for line, other, expected in ((column, "s1_2", forward), (row, "s2_1", side)):
        neighbour = "s2_1" if other == "s2_1" else other
        first = "s1_5" if other == "s2_1" else "s1_1"
        ends = exposures[first].sensor.ground_from_image(line, np.full(2, spec.middle_m))
        xyz = ends[0] + np.linspace(0.0, 1.0, 3001)[:, None] * (ends[1] - ends[0])
        xy = exposures[neighbour].sensor.image_from_ground(xyz)
        shown = ((xy >= -0.5) & (xy <= (3999.5, 2999.5))).all(axis=1).mean()
        assert shown == pytest.approx(expected, abs=OVERLAP)
    assert spec.ground_pixel_m == pytest.approx(0.0267, abs=1e-4)


def test_tilts_are_within_their_range(spec: DroneBlockSpec) -> None:
    down = np.array([exposure.sensor.rotation[2] for exposure in drone_exposures(spec)])
    tilts = np.rad2deg(np.arccos(-down[:, 2]))
    assert (tilts >= 1.0).all()
    assert (tilts <= 3.0).all()
    assert np.ptp(tilts) > 0.3


def test_truth_is_the_ground_that_two_frames_show(tmp_path: Path) -> None:
    """Counted cell by cell with the exact cameras."""
    spec = tiny()
    exposures = drone_exposures(spec)
    ground = build_drone_ground(spec, exposures).ground
    row, col = np.mgrid[: ground.heights.shape[0], : ground.heights.shape[1]]
    x, y = ground.x0 + (col + 0.5) * spec.step_m, ground.y0 - (row + 0.5) * spec.step_m
    xyz = np.column_stack([x.ravel(), y.ravel(), ground.heights.ravel()])
    count = np.zeros(ground.heights.shape, int)
    for exposure in exposures:
        xy = exposure.sensor.image_from_ground(xyz)
        count += ((xy >= 0) & (xy <= (159, 119))).all(axis=1).reshape(count.shape)
    assert {0, 1, 2} == set(np.unique(count))
    np.testing.assert_array_equal(n_frames_showing(ground, exposures), count)
    block = render_drone_block(spec, tmp_path / "block")
    with rasterio.open(block.truth_dsm) as file:
        truth, transform, crs = file.read(1), file.transform, file.crs
    cells = ground.cells(transform.c, transform.f, truth.shape)
    np.testing.assert_array_equal(truth, np.where(count >= 2, ground.heights, np.nan)[cells].astype(np.float32))
    assert np.isfinite(truth).sum() == (count >= 2).sum()
    assert crs.to_epsg() == spec.epsg
    with rasterio.open(block.truth_class) as file:
        np.testing.assert_array_equal(file.read(1), ground.classes[cells])


def test_the_ground_has_houses_trees_cars_and_roads(block: RenderedDroneBlock, coloured: ColouredGround) -> None:
    with rasterio.open(block.truth_class) as file:
        classes = file.read(1)
    shares = {kind: (classes == kind).mean() for kind in (ROAD, BUILDING, TREE, CAR)}
    assert shares[BUILDING] > 0.05
    assert shares[TREE] > 0.02
    assert shares[ROAD] > 0.05
    assert 0.001 < shares[CAR] < 0.02
    ground = coloured.ground
    # Pitched and flat roofs, planes between the centres of their cells.
    slope = np.abs(ground.slopes).sum(axis=2)
    roof = ground.classes == BUILDING
    assert (roof & (slope > 0.05)).sum() > 1000
    assert (roof & (slope == 0)).sum() > 1000
    same = roof[:, :-1] & roof[:, 1:] & (ground.material[:, :-1] == ground.material[:, 1:])
    same &= (ground.slopes[:, :-1] == ground.slopes[:, 1:]).all(axis=2)
    rise = np.diff(ground.heights, axis=1)
    is_plane = np.abs(rise - ground.slopes[:, :-1, 0])[same] < HEIGHT_M
    # Roof windows stand a few centimetres above the roof.
    assert is_plane.mean() > 0.98
    assert (ground.material == PAVEMENT).any()
    luminance = np.tensordot(coloured.top_colours, (0.299, 0.587, 0.114), axes=1)
    np.testing.assert_allclose(luminance, 1.0, rtol=0, atol=1e-6)
    assert len(coloured.top_colours) == len(ground.materials)


def test_equal_specifications_give_equal_bytes(tmp_path: Path) -> None:
    first, again, other = (
        render_drone_block(tiny(seed), tmp_path / name) for name, seed in (("a", 3), ("b", 3), ("c", 4))
    )
    names = sorted(path.name for path in first.folder.iterdir())
    assert names == ["s1_1.jpg", "s1_2.jpg", "scene.json", "scene.yaml", "truth_class.tif", "truth_dsm.tif"]
    for name in names:
        assert (first.folder / name).read_bytes() == (again.folder / name).read_bytes(), name
        assert (first.folder / name).read_bytes() != (other.folder / name).read_bytes(), name


def test_an_interrupted_rendering_leaves_nothing(tmp_path: Path) -> None:
    def interrupt(step: str) -> None:
        if step == "s1_2":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_drone_block(tiny(), tmp_path / "block", interrupt)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "block").mkdir()
    with pytest.raises(OutputError, match="exists already"):
        render_drone_block(tiny(), tmp_path / "block")


def test_written_cameras_have_the_errors_that_were_asked_for(tmp_path: Path) -> None:
    """The frames are rendered with the exact cameras, which `scene.json` keeps."""
    wrong = {"position_error_m": 0.5, "angle_error_deg": 0.2}
    spec = small_drone_block_spec(strips=10, frames_per_strip=20, **wrong)
    exposures = drone_exposures(spec)
    offsets, turns = [], []
    for camera, exposure in zip(written_cameras(spec, exposures), exposures, strict=True):
        offsets.append(np.subtract(camera.centre, exposure.sensor.centre))
        turn = camera.rotation @ exposure.sensor.rotation.T
        turns.append((turn[1, 2], turn[2, 0], turn[0, 1]))
    assert np.std(offsets) == pytest.approx(0.5, rel=0.1)
    assert np.rad2deg(np.std(turns)) == pytest.approx(0.2, rel=0.1)
    exact, moved = (render_drone_block(tiny(**more), tmp_path / str(len(more))) for more in ({}, wrong))
    assert exact.images["s1_1"].read_bytes() == moved.images["s1_1"].read_bytes()
    described = json.loads((moved.folder / "scene.json").read_text())
    assert described["position_error_m"] == 0.5
    for is_exact, view, exposure in (
        (block is exact, view, exposure)
        for block in (exact, moved)
        for view, exposure in zip(open_scene([block.scene]).views, drone_exposures(tiny()), strict=True)
    ):
        assert described["frames"][view.name]["centre"] == list(exposure.sensor.centre)
        assert (view.sensor.centre == exposure.sensor.centre) == is_exact


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"forward_overlap": 1.2}, r"forward_overlap = 1\.2 is outside its range 0\.0 to 0\.95"),
        ({"least_tilt_deg": 4.0}, "largest_tilt_deg = 3.0 is less than least_tilt_deg = 4.0"),
        ({"flying_height_m": 40.0, "relief_m": 60.0}, "flying_height_m = 40.0 m is not above trees"),
        ({"distortion": BrownDistortion(k1=-1.0)}, "does not map all of the frame"),
        ({"stated_distortion": BrownDistortion(k1=-1.0)}, r"stated_distortion does not map all of the frame"),
        ({"crossing_tilt_deg": 60.0}, r"crossing_tilt_deg = 60\.0 is outside its range 0\.0 to 30\.0"),
        ({"photo": DronePhoto(quality=0)}, "photo.quality = 0 is outside its range 1 to 100"),
        ({"seed": -1}, "seed = -1 is outside its range"),
    ],
)
def test_invalid_specifications_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        small_drone_block_spec(**changes)


def test_a_block_without_overlap_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No ground is shown by two frames"):
        render_drone_block(tiny(frames_per_strip=1), tmp_path / "block")
    assert list(tmp_path.iterdir()) == []


def test_a_surface_of_the_small_block(block: RenderedDroneBlock, spec: DroneBlockSpec, tmp_path: Path) -> None:
    """The whole way from JPEGs with distortion to heights, over the middle of the block, against the truth."""
    half = 12.0
    bounds = (spec.east_m - half, spec.north_m - half, spec.east_m + half, spec.north_m + half)
    request = DsmRequest(inputs=(block.scene,), out=tmp_path / "out", resolution=0.4, bounds=bounds, report=False)
    run_dsm(request, RunConfig(pyramid=PyramidOptions(tile=64)), progress_for(io.StringIO()))
    with rasterio.open(tmp_path / "out" / "dsm.tif") as dsm, rasterio.open(block.truth_dsm) as file:
        found = dsm.read(1)
        left, top = ~file.transform * (dsm.bounds.left, dsm.bounds.top)
        truth = file.read(1)[round(top) :, round(left) :][: 2 * found.shape[0], : 2 * found.shape[1]]
    assert np.allclose((left, top), np.rint((left, top)), rtol=0, atol=1e-3)
    parts = np.stack([truth[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    is_smooth = np.ptp(parts, axis=0) < NEAR_M
    error = (found - parts.mean(axis=0))[is_smooth]
    assert is_smooth.mean() > 0.7
    assert (np.abs(error) < NEAR_M).mean() > SHARE_NEAR


def test_the_command_renders_a_small_block(tmp_path: Path) -> None:
    """`--kind small-drone` writes the block of its seed."""
    from zlocus.synthetic.__main__ import main

    assert main(["--kind", "small-drone", "--seed", "3", "-o", str(tmp_path / "block")]) == 0
    assert len(open_scene([tmp_path / "block" / "scene.yaml"]).views) == 6


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--kind", "small-drone", "--delivery"], "--delivery writes satellite images"),
        (["--kind", "mixed", "--delivery"], "--delivery writes satellite images"),
        (["--cameras", "linescan", "--delivery"], "--delivery writes satellite images"),
        (["--kind", "city", "--projects"], "--projects writes the cameras of a drone block"),
    ],
)
def test_options_without_effect_are_refused(tmp_path, capsys, arguments, says):
    from zlocus.synthetic.__main__ import main

    assert main([*arguments, "-o", str(tmp_path / "block")]) != 0
    assert says in capsys.readouterr().err
    assert not (tmp_path / "block").exists()


@pytest.mark.parametrize("angle", [-0.12, -0.03, 0.0, 0.12])
@pytest.mark.parametrize("side_m", [60.0, 700.0, 3000.0])
def test_plots_cover_the_corners_of_the_ground(side_m, angle):
    n = n_plots(side_m, side_m, angle)
    for x, y in ((0.0, 0.0), (side_m, 0.0), (0.0, side_m), (side_m, side_m)):
        across = (np.cos(angle) * x + np.sin(angle) * y) / PLOT_M[0] + n / 2
        along = (np.cos(angle) * y - np.sin(angle) * x) / PLOT_M[1] + n / 2
        assert 0 <= across <= n
        assert 0 <= along <= n
