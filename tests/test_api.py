from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
import rasterio
import xarray
from pyproj import CRS
from scipy.ndimage import uniform_filter

import zlocus
import zlocus.api
from rendered_scenes import CENTRE, GSD_M, HEIGHTS, PART, SMALL_TILES, read, rendered_in_colours, run
from zlocus.core import errors
from zlocus.core.errors import ConfigError, InputError
from zlocus.core.options import SemiGlobalOptions
from zlocus.core.requests import DsmRequest
from zlocus.matching.quality import Quality
from zlocus.synthetic.terrain import analytic_height

ASKED = {"crs": "EPSG:32632", "resolution": GSD_M, "heights": HEIGHTS, "bounds": PART}
# A measure of one's own, without refinement, on noisy images: half a step, and how many may be beyond.
STEP_M, SHARE = 0.5, 0.97
# Correlation of two ortho-images, of which one was rounded.
SAME_ORTHO = 0.99
# Grey values, of tables over other heights.
SAME_GREY = 3.0


@pytest.fixture(scope="module")
def written(images, tmp_path_factory):
    """The part of the sine, through the command's own function."""
    return run(images("sine"), tmp_path_factory.mktemp("written") / "out", SMALL_TILES, bounds=PART).out


def test_a_surface_in_memory_is_what_the_command_writes(images, written):
    surface = zlocus.match(*map(str, images("sine").inputs), config=SMALL_TILES, **ASKED)
    for name, file in (("height", "dsm"), ("sigma", "sigma"), ("quality", "quality"), ("views", "views")):
        expected, source = read(written / f"{file}.tif")
        np.testing.assert_array_equal(surface[name].values, expected)
    assert CRS.from_user_input(surface.rio.crs.to_wkt()).to_2d().equals(CRS.from_epsg(32632))
    assert surface.rio.transform() == source.transform
    assert (float(surface.x[0]), float(surface.y[0])) == (source.bounds.left + 0.25, source.bounds.top - 0.25)
    assert surface.height.attrs["units"] == "m"
    seen = surface.where((surface.quality & int(Quality.JUMP)) == 0).height
    assert np.isfinite(seen.values).mean() > 0.9


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_surface_of_colour_images(tmp_path):
    images = rendered_in_colours(tmp_path, "uint8")
    surface = zlocus.match(*images, out=tmp_path / "out", config=SMALL_TILES, **ASKED)
    assert list(surface.ortho.band.values) == ["red", "green", "blue"]
    with rasterio.open(tmp_path / "out" / "ortho.tif") as file:
        np.testing.assert_array_equal(surface.ortho.values, file.read())
    assert surface.height.dims == ("y", "x")


def test_nothing_is_made_that_nobody_sees(images, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("zlocus.pipeline.dsm.run_dsm", lambda request, *_: asked.append(request))
    for more in ({}, {"products": ("hillshade", "dtm")}, {"out": tmp_path / "out", "products": "dtm, laz"}):
        with pytest.raises(InputError, match="There is no folder"):
            zlocus.match(*images("sine").inputs, **ASKED, **more)
    made = [(request.products, request.report) for request in asked]
    assert made == [((), False), ((), False), (("dtm", "laz"), True)]


def test_products_are_kept_where_they_are_asked_for(images, tmp_path):
    surface = zlocus.match(*images("sine").inputs, out=str(tmp_path / "kept"), config=SMALL_TILES, **ASKED)
    assert (tmp_path / "kept" / "run.json").is_file()
    np.testing.assert_array_equal(surface.height.values, read(tmp_path / "kept" / "dsm.tif")[0])


def test_what_is_wrong_is_said(images):
    with pytest.raises(TypeError, match="resolutoin"):
        zlocus.match(*images("sine").inputs, resolutoin=1.0)
    with pytest.raises(InputError, match="two images or more"):
        zlocus.open_scene(images("sine").inputs[0])
    with pytest.raises(ConfigError, match="EPSG:4326"):
        zlocus.open_scene(*images("sine").inputs, crs="EPSG:4326")
    scene = zlocus.open_scene(*images("sine").inputs)
    with pytest.raises(ConfigError, match="0 x 52 cells at 1 heights hold nothing"):
        zlocus.locus_stack(scene, (PART[0], PART[1], PART[2], PART[1]), GSD_M, [50.0])


def test_stages_one_by_one_find_the_true_heights(images):
    """Open, orient, resample along the loci, a measure of one's own, the semi-global constraint."""
    scene = zlocus.open_scene(*images("sine").inputs, crs="EPSG:32632")
    scene = zlocus.orient(scene, heights=HEIGHTS).apply(scene)
    heights = np.arange(40.0, 60.1, STEP_M)
    stack = zlocus.locus_stack(scene, PART, GSD_M, heights)
    assert stack.grey.shape == (3, len(heights), 38, 52)
    assert stack.names == tuple(view.name for view in scene.views)
    windows = [(v - uniform_filter(v, (1, 5, 5))) for v in stack.grey.astype(float)]
    units = [v / np.sqrt(uniform_filter(v * v, (1, 5, 5)) + 1e-6) for v in windows]
    ncc = np.mean([uniform_filter(units[a] * units[b], (1, 5, 5)) for a, b in ((0, 1), (0, 2), (1, 2))], axis=0)
    found = zlocus.semiglobal(np.moveaxis(1 - ncc, 0, -1), step_cells=STEP_M / GSD_M)
    z = heights[0] + STEP_M * found.vertex
    x, y = np.meshgrid(stack.x, stack.y)
    error = (z - analytic_height("sine", x - CENTRE[0], y - CENTRE[1]))[4:-4, 4:-4]
    assert (np.abs(error) < STEP_M).mean() > SHARE


def test_the_stack_shows_nothing_outside_an_image(images):
    scene = zlocus.open_scene(*images("sine").inputs, crs="EPSG:32632")
    far = (PART[0] - 500.0, PART[1], PART[0] - 490.0, PART[3])
    assert np.isnan(zlocus.locus_stack(scene, far, GSD_M, [50.0]).grey).all()
    wide = (PART[0] - 60, PART[1] - 60, PART[2] + 60, PART[3] + 60)
    edge = zlocus.locus_stack(scene, wide, GSD_M, [50.0])
    np.testing.assert_allclose(edge.x[[0, -1]], (wide[0] + GSD_M / 2, wide[2] - GSD_M / 2), rtol=0, atol=1e-6)
    np.testing.assert_allclose(edge.y[[0, -1]], (wide[3] - GSD_M / 2, wide[1] + GSD_M / 2), rtol=0, atol=1e-6)
    column, row = np.meshgrid(edge.x, edge.y)
    for view, grey in zip(scene.views, edge.grey[:, 0], strict=True):
        xy = view.sensor.image_from_ground(np.column_stack([column.ravel(), row.ravel(), np.full(row.size, 50.0)]))
        inside = ((xy >= 0) & (xy <= np.array(view.image.shape[::-1]) - 1)).all(axis=1).reshape(row.shape)
        np.testing.assert_array_equal(np.isfinite(grey), inside)
        assert 0.1 < inside.mean() < 0.9


@pytest.mark.parametrize("n_heights", [1, 2, 5, 16, 27])
@pytest.mark.parametrize("predecessors", [1, 2])
def test_semiglobal_of_any_number_of_heights(n_heights, predecessors):
    """A ramp from the first height to the last, with a hole in what is known and false minima of single cells."""
    rng, shape = np.random.default_rng(n_heights), (23, 31)
    truth = np.broadcast_to(np.linspace(0, n_heights - 1, shape[1]).round().astype(int), shape)
    cost = 1.0 - 0.9 * (np.arange(n_heights) == truth[..., None])
    false = rng.random(shape) < 0.05
    cost[false] = 1.0 - 0.9 * (np.arange(n_heights) == rng.integers(0, n_heights, shape)[..., None])[false]
    cost[10:12, 14:16] = np.nan
    found = zlocus.semiglobal(cost, options=SemiGlobalOptions(predecessors=predecessors))
    assert (np.abs(found.best - truth) <= 1).mean() > 0.98
    np.testing.assert_array_equal(np.asfortranarray(cost), cost)
    again = zlocus.semiglobal(np.asfortranarray(cost), options=SemiGlobalOptions(predecessors=predecessors))
    np.testing.assert_array_equal(again.best, found.best)


def test_semiglobal_jumps_at_edges_of_the_ortho_image():
    """Where nothing is known beside a jump, it is put where the grey value changes."""
    truth = np.where(np.arange(30) < 15, 2, 9) * np.ones((20, 1), int)
    cost = 1.0 - 0.9 * (np.arange(12) == truth[..., None])
    cost[:, 11:18] = np.nan
    rng = np.random.default_rng(0)
    ortho = (np.where(np.arange(30) < 13, 50, 200) + rng.normal(0, 2, (20, 30))).astype(np.float32)
    found = zlocus.semiglobal(cost, ortho=ortho)
    assert (found.best[:, :13] == 2).all()
    assert (found.best[:, 13:] == 9).all()


def test_arrays_that_do_not_fit():
    with pytest.raises(ConfigError, match=r"shape \(4, 5\)\. Give one of \(rows, columns, heights\)"):
        zlocus.semiglobal(np.zeros((4, 5)))
    with pytest.raises(ConfigError, match=r"\(5, 4\) cells, the cost \(4, 5\)"):
        zlocus.semiglobal(np.zeros((4, 5, 6)), ortho=np.zeros((5, 4), np.float32))


def test_the_package_is_imported_without_its_kernels():
    heavy = {"numba", "numpy", "rasterio", "xarray", "IPython"}
    code = f"import sys, zlocus; dir(zlocus); assert not {heavy} & set(sys.modules); zlocus.ZlocusError; zlocus.match"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'mtach'"):
        _ = zlocus.mtach


def test_every_name_can_be_had():
    listed = set(dir(zlocus))
    assert {*zlocus.__all__, "open", "__version__", "__path__"} <= listed
    assert not listed & {"import_module", "TYPE_CHECKING", "annotations"}
    assert all(getattr(zlocus, name) is not None for name in listed - {"__loader__", "__spec__"})
    mine = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert mine <= listed
    assert all(issubclass(getattr(zlocus, name), zlocus.ZlocusError) for name in mine - {"ZlocusNote", "ZlocusWarning"})
    # A star import leaves Python's own `open` alone.
    assert "open" not in zlocus.__all__
    assert zlocus.open is zlocus.open_surface


# What the Python interface takes in place of what a request holds.
TAKEN = {
    Path: zlocus.api.PathLikes, Path | None: zlocus.api.PathLikes | None, tuple[str, ...]: Sequence[str],
}  # fmt: skip
MORE = {
    "crs": str | CRS | None, "vertical": zlocus.api.PathLikes, "dem_vertical": zlocus.api.PathLikes | None,
    "out": zlocus.api.PathLikes | None,
}  # fmt: skip


def test_match_names_every_field_of_a_request():
    """With its default and its type; then what is no field."""
    hints = get_type_hints(zlocus.match, localns={"xr": xarray})
    parameters = inspect.signature(zlocus.match).parameters
    known = [field for field in fields(DsmRequest) if field.name != "inputs"]
    assert list(parameters) == ["inputs", *(field.name for field in known), "config", "progress"]
    of_request = get_type_hints(DsmRequest)
    for field in known:
        default = None if field.name == "out" else field.default
        assert parameters[field.name].default == default, field.name
        assert parameters[field.name].kind is inspect.Parameter.KEYWORD_ONLY
        expected = MORE.get(field.name, TAKEN.get(of_request[field.name], of_request[field.name]))
        assert hints[field.name] == expected, field.name


def test_every_argument_of_match_reaches_the_run(images, tmp_path, monkeypatch):
    (tmp_path / "geoid.tif").touch()
    asked, inputs = [], images("sine").inputs
    monkeypatch.setattr("zlocus.pipeline.dsm.run_dsm", lambda request, *_: asked.append(request))
    every = {
        "resolution": np.float32(0.5), "crs": CRS.from_epsg(32632), "bounds": np.array(PART), "area": "area.gpkg",
        "mask": tmp_path / "mask.gpkg", "dem": "dem.tif", "dem_vertical": tmp_path / "geoid.tif",
        "reference": "nadir", "views": "all", "method": "mvll", "selection": "default",
        "vertical": tmp_path / "geoid.tif", "fill": "dem", "water": "water.gpkg", "water_level": "level",
        "level_water": True, "partial": True, "workers": np.int64(2),
        "scheduler": "tcp://host:8786", "memory_gb": 3, "overwrite": True, "resume": False, "products": ["laz"],
        "report": False, "out": tmp_path / "out",
    }  # fmt: skip
    others = {"like": "like.tif", "heights": [20, 80]}
    for given in (every, others):
        with pytest.raises(InputError, match=r"There is no folder|holds no run"):
            zlocus.match(*inputs, **given)
    expected = every | {
        "crs": "EPSG:32632", "bounds": PART, "area": Path("area.gpkg"), "dem": Path("dem.tif"),
        "dem_vertical": str(tmp_path / "geoid.tif"), "vertical": str(tmp_path / "geoid.tif"), "products": ("laz",),
        "inputs": inputs, "like": None, "heights": None, "water": Path("water.gpkg"),
    }  # fmt: skip
    assert vars(asked[0]) == expected
    assert (asked[1].like, asked[1].heights) == (Path("like.tif"), (20.0, 80.0))
    assert {field.name for field in fields(DsmRequest)} == {*every, *others, "inputs"}


@pytest.mark.parametrize("function", [zlocus.match, zlocus.open_scene])
def test_inputs_that_are_no_paths_are_refused(function, monkeypatch):
    monkeypatch.setattr("zlocus.pipeline.dsm.run_dsm", None)
    paths = ["a.tif", "b.tif"]
    name = f"zlocus.{function.__name__}"
    for value in (paths, tuple(paths), set(paths), iter(paths), Path().glob("*")):
        with pytest.raises(InputError, match=rf"Input 1 of {name} is an? .*Give {name}\(\*paths\)\.$"):
            function(value)
    array = np.zeros((4, 5))
    for value in (array, xarray.DataArray(array), xarray.Dataset({"a": ("x", [1])}), 7, None, b"a.tif"):
        with pytest.raises(InputError, match=rf"Input 2 of {name} is .*Give the paths of two images"):
            function("a.tif", value)


def test_wrong_arguments_are_refused_before_any_work(images, monkeypatch):
    monkeypatch.setattr("zlocus.pipeline.dsm.run_dsm", None)
    inputs = images("sine").inputs
    wrong = {
        "out": 3, "bounds": "1 2 3 4", "heights": 50.0, "config": "options.toml", "progress": "yes",
        "resolution": "0.5", "workers": 1.5, "overwrite": "no", "crs": 32632, "like": np.zeros(3), "views": ["a"],
        "scheduler": object(), "products": 3, "report": None,
    }  # fmt: skip
    for name, value in wrong.items():
        with pytest.raises(ConfigError, match=rf"^{name} is .*\. Give .*\.$"):
            zlocus.match(*inputs, **{name: value})
    for name, value in (("bounds", (1, 2, 3)), ("heights", (1, 2, 3)), ("heights", ("low", 2))):
        with pytest.raises(ConfigError, match=rf"^{name} (has 3 values|holds a str).* Give \d numbers"):
            zlocus.match(*inputs, **{name: value})


def test_a_missing_library_is_said_before_any_work(images, monkeypatch):
    monkeypatch.setattr("zlocus.pipeline.dsm.run_dsm", None)
    monkeypatch.setitem(sys.modules, "rioxarray", None)
    with pytest.raises(InputError, match=r"^rioxarray is not installed\. .*pip install xarray rioxarray"):
        zlocus.match(*images("sine").inputs)


def test_scenes_and_options_of_another_kind_are_refused(images):
    scene = zlocus.open_scene(*images("sine").inputs)
    for function in (zlocus.orient, zlocus.find_ties):
        with pytest.raises(ConfigError, match=r"^scene is a list of 3, not a Scene\. Give zlocus\.open_scene"):
            function(list(images("sine").inputs))
        with pytest.raises(ConfigError, match=r"^options is a RunConfig, not an OrientationOptions"):
            function(scene, zlocus.RunConfig())
        with pytest.raises(ConfigError, match="empty range"):
            function(scene, heights=(80, 20))


def test_ties_alone_are_those_of_an_orientation(images):
    scene = zlocus.open_scene(*images("sine").inputs, crs="EPSG:32632")
    ties = zlocus.find_ties(scene, heights=HEIGHTS)
    xy, view, point = (getattr(ties.observations, name) for name in ("xy", "view", "point"))
    assert xy.shape == (len(view), 2)
    assert point.max() == len(ties.z) - 1
    orientation = zlocus.orient(scene, heights=HEIGHTS)
    assert orientation.n_refined <= len(ties.z)
    assert (np.bincount(point) >= 2).all()
    # Seen from the cameras, a tie lies where it was found, but for the height that it was given first.
    low, high = ties.z_range
    assert HEIGHTS[0] <= low <= ties.z.min() <= ties.z.max() <= high <= HEIGHTS[1]
    truth = analytic_height("sine", *(orientation.xyz[:, :2] - CENTRE).T)
    assert np.median(np.abs(orientation.xyz[:, 2] - truth)) < STEP_M


def test_options_are_read_from_a_file(tmp_path):
    (tmp_path / "options.toml").write_text("[checks]\nmax_sigma_m = 1.5\n")
    assert zlocus.read_config(tmp_path / "options.toml").checks == zlocus.CheckOptions(max_sigma_m=1.5)
    with pytest.raises(ConfigError, match=r"^file is a dict of 0"):
        zlocus.read_config({})


def test_progress_is_shown_where_it_is_asked_for(images, capsys):
    scene = zlocus.open_scene(*images("sine").inputs)
    zlocus.find_ties(scene, heights=HEIGHTS)
    assert capsys.readouterr().err == ""
    zlocus.find_ties(scene, heights=HEIGHTS, progress=True)
    assert "Tie points: done in" in capsys.readouterr().err


def test_a_cost_by_hand():
    """Three images of 3 x 3 cells, one window: NCC 1 with a brighter copy, -1 with a negative."""
    one = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 10]])
    grey = np.stack([one, 40 + 3 * one, 9 - one])[:, None]
    middle = (1, 1, 0)
    assert zlocus.ncc_cost(grey[:2], window=3)[middle] == pytest.approx(0.0, abs=1e-6)
    assert zlocus.ncc_cost(grey, window=3)[middle] == pytest.approx((0 + 2 + 2) / 3, abs=1e-6)
    assert zlocus.ncc_cost(grey, window=3, reference=0)[middle] == pytest.approx((0 + 2) / 2, abs=1e-6)
    assert zlocus.ncc_cost(grey, window=3, reference=2)[middle] == pytest.approx(2.0, abs=1e-6)
    rim = zlocus.ncc_cost(grey, window=3)[..., 0]
    assert np.isnan(rim).sum() == 8  # windows that are not whole
    grey[0, 0, 2, 2] = np.nan
    assert zlocus.ncc_cost(grey, window=3)[middle] == pytest.approx(2.0, abs=1e-6)
    assert np.isnan(zlocus.ncc_cost(grey[:2], window=3)[middle])


def test_a_cost_ignores_gain_and_offset_and_knows_no_texture():
    rng = np.random.default_rng(8)
    grey = rng.normal(3000.0, 500.0, (2, 3, 9, 8))
    cost = zlocus.ncc_cost(grey)
    moved = zlocus.ncc_cost(np.stack([grey[0], 5000.0 - 4000.0 + 0.5 * grey[1]]))
    np.testing.assert_allclose(cost, moved, atol=1e-5)
    assert cost.shape == (9, 8, 3)
    # As NumPy has it, in one window.
    parts = [grey[i, 1, 2:7, 3:8].ravel() for i in (0, 1)]
    assert cost[4, 5, 1] == pytest.approx(1 - np.corrcoef(*parts)[0, 1], abs=1e-5)
    grey[1] = 7.0
    flat = zlocus.ncc_cost(grey)
    np.testing.assert_array_equal(flat[np.isfinite(flat)], 1.0)


@pytest.mark.parametrize(
    ("shape", "asked"),
    [((1, 2, 9, 9), {}), ((2, 9, 9), {}), ((2, 2, 9, 9), {"window": 4}), ((2, 2, 9, 9), {"reference": 2})],
)
def test_costs_that_make_no_sense_are_refused(shape, asked):
    with pytest.raises(ConfigError, match="Give"):
        zlocus.ncc_cost(np.zeros(shape), **asked)


def test_loci_costs_and_heights_in_a_row(images):
    """Stage after stage on arrays: the sine is found."""
    inputs = images("sine").inputs
    scene = zlocus.open_scene(*inputs, crs="EPSG:32632")
    scene = zlocus.orient(scene, heights=HEIGHTS).apply(scene)
    heights = np.arange(35.0, 70.0, STEP_M)
    stack = zlocus.locus_stack(scene, PART, GSD_M, heights)
    found = zlocus.semiglobal(zlocus.ncc_cost(stack.grey), step_cells=STEP_M / GSD_M)
    height = heights[0] + STEP_M * found.vertex
    column, row = np.meshgrid(stack.x - CENTRE[0], stack.y - CENTRE[1])
    truth = analytic_height("sine", column, row)
    inner = np.s_[4:-4, 4:-4]  # the windows of the rim are not whole
    assert (np.abs(height - truth)[inner] < STEP_M).mean() > SHARE


def test_the_ortho_image_of_a_surface(images, written):
    """That of the true heights is that of the run, whose heights are near them, but for the noise of the pixels."""
    inputs = images("sine").inputs
    scene = zlocus.open_scene(*inputs, crs="EPSG:32632")
    scene = zlocus.orient(scene, heights=HEIGHTS).apply(scene)
    surface = zlocus.open_surface(written)
    height = surface.height.values.astype(float)
    height[10:14, 5:9] = np.nan
    ortho = zlocus.true_ortho(scene, height, surface.x.values, surface.y.values)
    known = np.isfinite(height)
    np.testing.assert_array_equal(np.isfinite(ortho) & ~known, False)
    assert np.isfinite(ortho[known]).mean() > SHARE
    both = np.isfinite(ortho) & known
    theirs = surface.ortho.values.astype(float)[both]
    assert np.corrcoef(ortho[both], theirs)[0, 1] > SAME_ORTHO
    # Another place of the images is another image.
    wrong = zlocus.true_ortho(scene, height + 15.0, surface.x.values, surface.y.values)
    both &= np.isfinite(wrong)
    assert np.corrcoef(wrong[both], ortho[both])[0, 1] < SAME_ORTHO - 0.1


def test_a_tower_hides_the_ground_behind_it_from_the_ortho_image(images):
    """Beside a wall that stands high above all else the views on the far side show the ground, or none does."""
    inputs = images("sine").inputs
    scene = zlocus.open_scene(*inputs, crs="EPSG:32632")
    x = CENTRE[0] + (np.arange(80) - 40) * GSD_M
    y = CENTRE[1] - (np.arange(80) - 40) * GSD_M
    ground = np.full((80, 80), 50.0)
    wall = ground.copy()
    wall[38:42] = 75.0
    open_, behind = (zlocus.true_ortho(scene, z, x, y) for z in (ground, wall))
    with np.errstate(invalid="ignore"):
        changed = (np.abs(open_ - behind) > SAME_GREY) | (np.isnan(open_) != np.isnan(behind))
    changed[38:42] = False
    rows = np.flatnonzero(changed.any(axis=1))
    assert len(rows)  # something else is shown beside the wall
    # As far as the flattest rays reach beside it: 25 m, 18 degrees from above.
    reach = 25.0 * np.tan(np.radians(18.0)) / GSD_M + 2
    assert rows.min() >= 38 - reach
    assert rows.max() <= 41 + reach


@pytest.mark.parametrize("height", [np.zeros((3, 3)), np.full((4, 5), np.nan)])
def test_ortho_images_of_nothing_are_refused(height, images):
    scene = zlocus.open_scene(*images("sine").inputs, crs="EPSG:32632")
    with pytest.raises(ConfigError, match="show nothing"):
        zlocus.true_ortho(scene, height, CENTRE[0] + np.arange(5.0), CENTRE[1] - np.arange(4.0))


def test_what_is_shown_at_a_prompt_is_a_line(images):
    scene = zlocus.open_scene(
        *images("sine").inputs,
        crs="EPSG:32632",
    )
    orientation = zlocus.orient(scene, heights=HEIGHTS)
    stack = zlocus.locus_stack(scene, PART, GSD_M, [40.0, 45.0])
    for shown in (scene, scene.views[0], orientation, stack):
        assert len(repr(shown)) < 200
        assert "\n" not in repr(shown)
    assert repr(scene) == "Scene(3 views: nadir, fore, aft; WGS 84 / UTM zone 32N)"
    assert f"shift, 3 views, {len(orientation.xyz)} ties" in repr(orientation)
    many = replace(scene, views=scene.views * 5, heights=(1.0, 2.0))
    assert repr(many).startswith("Scene(15 views: nadir, fore, aft, nadir, fore, aft, nadir, fore, ...; ")
    assert repr(many).endswith("heights (1.0, 2.0))")
