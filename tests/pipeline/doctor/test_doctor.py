"""`zlocus doctor` through the real command line: good inputs, and each fault that it has to tell."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from scipy.ndimage import gaussian_filter
from shapely.geometry import Point, shape
from typer.testing import CliRunner

from orientation_scenes import image_of
from rendered_scenes import CENTRE, GSD_M, QUIET, UTM, camera, read, rendered, run
from zlocus.cli.app import app
from zlocus.core.errors import InputError
from zlocus.core.footprints import view_geometry
from zlocus.core.options import OrientationOptions
from zlocus.core.scene import View
from zlocus.io.scene_file import open_scene, open_usable_views
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.plausibility import Doubt, ExcludedImage
from zlocus.orientation.tie_residuals import Residuals, ViewOrientation
from zlocus.orientation.triangulate import Observations
from zlocus.pipeline.doctor.geometry import geometry_findings
from zlocus.pipeline.doctor.plan import RunPlan, plan_findings
from zlocus.pipeline.doctor.quality import MOST_WINDOWS, SIDE_PX, image_quality, sample_windows
from zlocus.pipeline.doctor.ties import tie_findings
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.files import write_image
from zlocus.synthetic.mixed import render_mixed_scene
from zlocus.synthetic.render import Sun, expose, render
from zlocus.synthetic.scenes import demo_spec
from zlocus.synthetic.terrain import analytic_ground

KIND = "sine"
BASE_SHARE = 0.02  # base-to-height is that of the RPC, in the middle of the overlap
BLUR_SHARE = 0.1
NARROW_DEG = (0.0, 1.5)


@pytest.fixture(scope="module")
def good(images):
    return images(KIND).paths


def doctor(out, *arguments):
    """Exit status, printed report and doctor.json."""
    result = CliRunner().invoke(app, ["doctor", *map(str, arguments), "-o", str(out)])
    assert "Traceback" not in result.output
    return result.exit_code, result.stdout, json.loads((out / "doctor.json").read_text())


def sentences(report, level):
    return [each["sentence"] for each in report["findings"] if each["level"] == level]


def changed(path, folder, change):
    """A copy of an image with other pixels and the same camera; the name says nothing of the change."""
    with rasterio.open(path) as source:
        pixels, rpc = source.read(1), source.rpcs
    profile = {"driver": "GTiff", "height": pixels.shape[0], "width": pixels.shape[1], "count": 1}
    with rasterio.open(folder / path.name, "w", dtype=pixels.dtype, rpcs=rpc, **profile) as file:
        file.write(change(pixels).astype(pixels.dtype), 1)
    return folder / path.name


@pytest.fixture(scope="module")
def healthy(good, tmp_path_factory):
    out = tmp_path_factory.mktemp("healthy") / "out"
    return doctor(out, *good.values()), out


def test_nothing_is_wrong_with_good_images(healthy):
    (status, text, report), _ = healthy
    assert status == 0
    assert report["findings"] == []
    assert report["verdict"] == "good"
    assert text.rstrip().endswith("Nothing speaks against a run.")
    for name, view in report["views"].items():
        assert name in text
        assert view["n_ties"] > 100
        assert view["residual_after_px"]["median"] < 0.1
        assert view["ground_px_m"] == pytest.approx(GSD_M, rel=0.1)
        assert view["closing_px"] < 1e-3
    keep, buy = report["advice"]
    assert keep == "Keep aft, fore, nadir."
    assert buy.startswith("No direction is missing: the rays of 3 images differ by up to 3")
    assert f"- {keep}\n- {buy}\n" in text


def test_base_to_height_is_that_of_the_cameras(healthy):
    (_, _, report), _ = healthy
    at = np.array([[*CENTRE, 50.0]] * 2)

    def lean(name):
        low, high = camera(name).ground_from_image(camera(name).image_from_ground(at), np.array([49.0, 51.0]))
        return (high - low)[:2] / 2

    assert len(report["pairs"]) == 3
    for pair in report["pairs"]:
        a, b = map(lean, pair["views"])
        assert pair["base_to_height"] == pytest.approx(np.hypot(*(a - b)), rel=BASE_SHARE)
        assert 0.9 < pair["overlap"] <= 1.0
        assert pair["n_ties"] > 100


def test_footprints_lie_where_the_images_do(healthy):
    (_, _, report), out = healthy
    features = json.loads((out / "footprints.geojson").read_text())["features"]
    kinds = [feature["properties"]["kind"] for feature in features]
    assert kinds == ["image"] * 3 + ["overlap"] * 3
    centre = Point(Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform(*CENTRE))
    to_utm = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
    for feature in features:
        polygon = shape(feature["geometry"])
        assert polygon.contains(centre)
        assert polygon.exterior.is_ccw
        ring = np.column_stack(to_utm.transform(*np.array(polygon.exterior.coords).T))
        assert np.ptp(ring, axis=0) == pytest.approx([150 * GSD_M] * 2, rel=0.15)
    assert features[0]["properties"]["edge_px"] == report["views"]["aft"]["edge_px"]


def test_the_picture_shows_the_overlap(healthy):
    _, out = healthy
    picture = cv2.imread(str(out / "footprints.png"))
    colour, count = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    # Ground of all three images is the largest part, in the scale's brightest colour.
    brightest = cv2.applyColorMap(np.array([[255]], np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0]
    assert (colour[count.argmax()] == brightest).all()
    assert (picture == 255).all(axis=2).any()


def test_the_plan_is_what_a_run_does(good, tmp_path):
    heights = (25.0, 80.0)
    status, text, report = doctor(
        tmp_path / "doctor", *good.values(), "--resolution", GSD_M, "--heights", *heights, "--crs", "EPSG:32632",
    )  # fmt: skip
    out = run(tuple(good.values()), tmp_path / "dsm", heights=heights).out
    done = json.loads((out / "run.json").read_text())
    began = json.loads((out / "events.jsonl").read_text().splitlines()[0])
    plan = report["plan"]
    assert status == 0
    assert plan["shape"] == done["grid"]["shape"]
    assert plan["heights"] == list(heights)
    assert plan["step_m"] == pytest.approx(done["heights"]["step_m"], abs=1e-3)
    # Three images of about 150 x 147 pixels of 0.5 m.
    assert plan["view_cells"] == pytest.approx(3 * 150 * 147, rel=0.05)
    assert began["event"] == "began"
    assert plan["seconds"] == pytest.approx(began["seconds"], rel=1e-3)
    assert plan["n_tiles"] == began["n_tiles"]
    assert f"{plan['shape'][0]} rows x {plan['shape'][1]} columns" in text
    assert "rough estimate" in text


def test_nothing_is_written_without_a_folder(good, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["doctor", *map(str, good.values())])
    assert result.exit_code == 0
    assert list(tmp_path.iterdir()) == []


def test_pointing_errors_are_seen_and_corrected(tmp_path):
    flawed = rendered(tmp_path / "flawed", KIND, {"nadir": (1.5, -2.0), "fore": (-3.0, 1.0)})
    status, _, report = doctor(tmp_path / "out", *flawed.inputs)
    assert status == 0
    before, after = (
        [v[f"residual_{when}_px"]["median"] for v in report["views"].values()] for when in ("before", "after")
    )
    assert max(before) > 0.5
    assert max(after) < 0.1
    assert max(abs(s) for v in report["views"].values() for s in v["shift_px"]) > 1.0


def test_a_saturated_image(good, tmp_path):
    bright = changed(good["aft"], tmp_path, lambda p: np.minimum(p, np.percentile(p, 70)))
    status, text, report = doctor(tmp_path / "out", good["nadir"], good["fore"], bright)
    (sentence,) = sentences(report, "poor")
    assert status == 0
    assert sentence.startswith("aft: 30 % of its pixels have the image's greatest value")
    assert sentence in text
    assert report["verdict"] == "doubtful"


def test_a_blurred_image(good, tmp_path):
    soft = changed(good["aft"], tmp_path, lambda p: gaussian_filter(p.astype(float), 3.0))
    status, _, report = doctor(tmp_path / "out", good["nadir"], good["fore"], soft)
    assert status == 0
    assert report["views"]["aft"]["edge_px"] == pytest.approx(math.hypot(3.0, 1.0), rel=BLUR_SHARE)
    told = sentences(report, "poor")
    assert any("aft: it is blurred" in sentence and "3." in sentence for sentence in told)
    assert not any(sentence.startswith(("nadir", "fore")) for sentence in told)


@pytest.mark.parametrize("axis", [0, 1, None])
@pytest.mark.parametrize("sigma", [1.5, 2.5, 4.0])
def test_edge_width_is_the_blur_of_edges(axis, sigma):
    rng = np.random.default_rng(4)
    blocks = np.kron(rng.uniform(200, 2000, (20, 20)), np.ones((25, 25)))
    along = (sigma if axis in (0, None) else 0.6, sigma if axis in (1, None) else 0.6)
    quality = image_quality(quiet(gaussian_filter(blocks, along) + rng.normal(0.0, 3.0, blocks.shape)))
    assert quality.edge_px == pytest.approx(sigma, rel=BLUR_SHARE)


def quiet(pixels, valid=None):
    """An image of floats."""
    image = image_of(pixels, valid)
    object.__setattr__(image, "dtype", "float32")
    return image


def test_nodata_is_no_grey_value():
    rng = np.random.default_rng(4)
    pixels, valid = rng.uniform(1, 9, (300, 200)), np.ones((300, 200), bool)
    valid[:90] = False
    quality = image_quality(quiet(pixels, valid))
    assert quality.nodata == pytest.approx(0.3)
    assert quality.black == 0.0
    assert quality.saturated == pytest.approx(1 / (210 * 200))


def test_windows_lie_inside_and_cover_small_images():
    for rows, cols in ((150, 147), (600, 5), (1300, 40_000)):
        windows = list(sample_windows((rows, cols)))
        assert len(windows) <= MOST_WINDOWS**2
        assert all(0 <= r <= r + h <= rows and 0 <= c <= c + w <= cols for r, c, h, w in windows)
        covered = np.zeros((rows, cols), bool)
        for r, c, h, w in windows:
            covered[r : r + h, c : c + w] = True
        if max(rows, cols) <= SIDE_PX * MOST_WINDOWS:
            assert covered.all()


def test_a_black_border_that_is_not_declared(good, tmp_path):
    def border(pixels):
        pixels[:, :20] = 0
        return pixels

    _, _, report = doctor(tmp_path / "out", good["nadir"], good["fore"], changed(good["aft"], tmp_path, border))
    expected = "aft.tif: 13.3 % of its pixels are a border of the constant value 0 that no tag declares"
    assert any(expected in s for s in sentences(report, "poor"))
    assert report["views"]["aft"]["nodata"] == pytest.approx(0.133, abs=0.01)


def elsewhere(path, folder):
    """A copy of an image whose camera looks 11 km further north."""
    with rasterio.open(path) as source:
        pixels, rpc = source.read(1), source.rpcs
    rpc.lat_off += 0.1
    profile = {"driver": "GTiff", "height": pixels.shape[0], "width": pixels.shape[1], "count": 1}
    with rasterio.open(folder / "far.tif", "w", dtype=pixels.dtype, rpcs=rpc, **profile) as file:
        file.write(pixels, 1)
    return folder / "far.tif"


def test_no_overlap(good, tmp_path):
    status, text, report = doctor(tmp_path / "out", good["nadir"], elsewhere(good["fore"], tmp_path))
    (sentence,) = sentences(report, "stops")
    assert status == 2
    assert sentence.startswith("No two images see the same ground")
    assert text.rstrip().endswith("A run will fail. What stops it stands above.")
    assert report["pairs"] == []
    assert report["plan"] is None
    assert drawn(tmp_path / "out") == ["far", "nadir"]


def drawn(out):
    """Names of the images that have a footprint."""
    features = json.loads((out / "footprints.geojson").read_text())["features"]
    return [f["properties"]["name"] for f in features if f["properties"]["kind"] == "image" and f["geometry"]]


def test_one_of_three_images_lies_elsewhere(good, tmp_path):
    far = elsewhere(good["aft"], tmp_path)
    status, _, report = doctor(tmp_path / "out", good["nadir"], good["fore"], far)
    assert status == 0
    told = sentences(report, "poor")
    assert any("far" in s and "overlaps no other image" in s for s in told)
    assert any(s.startswith("far: it takes no part: no tie point") for s in told)


def looking(folder, name, along_deg, seed=5):
    """An image of the scene at a view angle. seed : of the texture."""
    sensor, size = SatelliteCamera((*CENTRE, 50.0), (74.5, 74.5), GSD_M, along_deg, -3.0, 3.0), (150, 150)
    ground = analytic_ground(KIND, CENTRE, GSD_M / 2, (640, 640), seed=seed)
    numbers = expose(render(ground, sensor, size, Sun(150.0, 50.0)), QUIET, np.random.default_rng(7))
    write_image(folder / name, numbers, fit_rpc(sensor, size, UTM, (0.0, 120.0)).rpc)
    return folder / name


def test_a_narrow_base(tmp_path):
    paths = [looking(tmp_path, f"{i}.tif", angle) for i, angle in enumerate(NARROW_DEG)]
    status, _, report = doctor(tmp_path / "out", *paths)
    base = math.tan(math.radians(NARROW_DEG[1])) - math.tan(math.radians(NARROW_DEG[0]))
    assert status == 0
    (pair,) = report["pairs"]
    assert pair["base_to_height"] == pytest.approx(base, rel=0.15)  # the Earth is round below a satellite
    assert report["advice"][1].startswith("Buy an image that looks from about 20 degrees away")
    assert any("nearly the same line" in s and "0.2 px makes a height off by" in s for s in sentences(report, "poor"))


def test_images_along_one_line_stop_a_run(good, tmp_path):
    part = changed(good["nadir"], tmp_path, lambda p: p[1:])
    twin = part.rename(tmp_path / "twin.tif")
    with rasterio.open(twin, "r+") as file:
        rpc = file.rpcs
        rpc.line_off -= 1
        file.rpcs = rpc
    status, _, report = doctor(tmp_path / "out", good["nadir"], twin, "--heights", 25, 80)
    assert status == 2
    assert any("same line" in s and "show no heights" in s for s in sentences(report, "stops"))


def test_an_image_of_another_ground_has_no_ties(good, tmp_path):
    other = looking(tmp_path, "other.tif", 10.0, seed=77)
    _, _, report = doctor(tmp_path / "out", good["nadir"], good["fore"], other)
    assert report["views"]["other"]["n_ties"] == 0
    assert any(s.startswith("other: it takes no part: no tie point") for s in sentences(report, "poor"))
    keep, drop, buy = report["advice"]
    assert keep == "Keep fore, nadir."
    assert drop.startswith("Drop other: ")
    assert buy.startswith("Buy a third image")


def bare(path, folder):
    """An image without a camera."""
    pixels, _ = read(path)
    profile = {"driver": "GTiff", "height": pixels.shape[0], "width": pixels.shape[1], "count": 1}
    with rasterio.open(folder / "bare.tif", "w", dtype=pixels.dtype, **profile) as file:
        file.write(pixels, 1)
    return folder / "bare.tif"


def short(path, folder):
    """An image that ends too early."""
    content = path.read_bytes()
    (folder / "short.tif").write_bytes(content[: int(0.7 * len(content))])
    return folder / "short.tif"


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize(("fault", "word"), [(bare, "has no camera"), (short, "is truncated")])
def test_an_image_that_cannot_be_used_does_not_hide_the_others(good, tmp_path, fault, word):
    faulty = fault(good["aft"], tmp_path)
    status, text, report = doctor(tmp_path / "out", faulty, good["nadir"], tmp_path / "missing.tif", good["fore"])
    assert status == 2
    told = sentences(report, "stops")
    assert len(told) == 2
    assert str(faulty) in told[0]
    assert word in told[0]
    assert "missing.tif" in told[1]
    assert all(f"- {sentence}" in text.splitlines() for sentence in told)
    assert list(report["refused"]) == [faulty.stem, "missing"]
    mend = f"Mend {faulty.stem}, missing before you look for other images: see above what is wrong."
    assert report["advice"] == ["Keep fore, nadir.", mend]
    assert [view["n_ties"] > 100 for view in report["views"].values()] == [True, True]
    assert drawn(tmp_path / "out") == ["fore", "nadir"]


def test_an_image_damaged_inside(good, tmp_path):
    with rasterio.open(good["aft"]) as source:
        pixels, rpc = source.read(1), source.rpcs
    profile = {"driver": "GTiff", "height": 144, "width": 150, "count": 1, "compress": "deflate", "tiled": True}
    path = tmp_path / "hurt.tif"
    with rasterio.open(path, "w", dtype=pixels.dtype, blockxsize=64, blockysize=64, rpcs=rpc, **profile) as file:
        file.write(pixels, 1)
    with rasterio.open(path) as source:
        offset = int(source.get_tag_item("BLOCK_OFFSET_1_1", "TIFF", bidx=1))
    content = bytearray(path.read_bytes())
    content[offset : offset + 400] = bytes(400)
    path.write_bytes(content)
    status, _, report = doctor(tmp_path / "out", good["nadir"], path)
    assert status == 2
    assert any("hurt.tif cannot be read" in sentence for sentence in sentences(report, "stops"))


def test_only_one_image_is_left(good, tmp_path):
    status, _, report = doctor(tmp_path / "out", good["nadir"], tmp_path / "missing.tif")
    assert status == 2
    assert any("two images or more" in sentence for sentence in sentences(report, "stops"))
    assert report["views"]["nadir"]["edge_px"] > 0


def test_no_image_is_left(tmp_path):
    status, text, report = doctor(tmp_path / "out", tmp_path / "a.tif", tmp_path / "b.tif")
    assert status == 2
    assert len(sentences(report, "stops")) == 2
    assert "A run will fail" in text
    assert not (tmp_path / "out" / "footprints.png").exists()


def test_a_scene_file_with_a_missing_view(good, tmp_path):
    views = [*good.values(), Path("gone.tif")]
    lines = [f"  - {{name: {p.stem}, image: '{p}', camera: {{kind: rpc}}}}" for p in views]
    scene = tmp_path / "scene.yaml"
    scene.write_text("\n".join(["schema: 1", "heights: [25, 80]", "views:", *lines]))
    status, _, report = doctor(tmp_path / "out", scene)
    assert status == 2
    assert list(report["refused"]) == ["gone"]
    assert report["plan"]["heights"] == [25.0, 80.0]
    usable = open_usable_views([scene])
    assert [view.name for view in usable.scene.views] == list(good)


BAD_ENTRIES = {
    "kind": ("name: bad, image: bad.tif, camera: {kind: rcp}", "bad", r"views[1].camera.kind is 'rcp'"),
    "key": ("name: bad, image: bad.tif, camera: {kind: frame, focal: 70.0}", "bad", "views[1].camera.principal_point"),
    "number": ("name: bad, image: bad.tif, camera: {kind: rpc, shift: [yes, 0]}", "bad", "views[1].camera.shift[0]"),
    "image": ("name: bad, camera: {kind: rpc}", "bad", "the key views[1].image is missing"),
    "name": ("image: bad.tif, camera: {kind: rpc}", "views[1]", "the key views[1].name is missing"),
    "no camera": ("name: bad, image: bad.tif", "bad", "the key views[1].camera is missing"),
    "same name": ("name: nadir, camera: {kind: rpc}", "views[1]", "the key views[1].image is missing"),
}


def scene_of(folder, good, bad):
    """A scene file of good images, with another entry in the second place."""
    entries = [f"name: {p.stem}, image: '{p}', camera: {{kind: rpc}}" for p in good.values()]
    lines = [f"  - {{{entry}}}" for entry in (entries[0], *bad, *entries[1:])]
    scene = folder / "scene.yaml"
    scene.write_text("\n".join(["schema: 1", "heights: [25, 80]", "views:", *lines]) + "\n")
    return scene


@pytest.mark.parametrize("bad", BAD_ENTRIES)
def test_a_scene_file_with_a_bad_entry(good, tmp_path, bad):
    """The others are opened all the same; the entry is named as a run names it."""
    entry, name, says = BAD_ENTRIES[bad]
    scene = scene_of(tmp_path, good, [entry])
    usable = open_usable_views([scene])
    assert [view.name for view in usable.scene.views] == list(good)
    (refused,) = usable.refused
    assert refused.name == name
    assert says in refused.reason
    assert "scene.yaml" in refused.reason
    with pytest.raises(InputError) as caught:
        open_scene([scene])
    assert str(caught.value) == refused.reason


def test_the_doctor_goes_on_after_bad_entries(good, tmp_path):
    scene = scene_of(tmp_path, good, [BAD_ENTRIES["key"][0], "what: 6"])
    status, text, report = doctor(tmp_path / "out", scene)
    assert status == 2
    assert list(report["refused"]) == ["bad", "views[2]"]
    assert report["refused"]["bad"]["path"] == str(tmp_path / "bad.tif")
    assert len(sentences(report, "stops")) == 2
    assert set(report["views"]) == set(good)
    assert all(view["n_ties"] > 30 for view in report["views"].values())
    assert "cannot be used" in text


def test_a_scene_file_of_bad_entries_only(tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(f"schema: 1\nviews:\n  - {{{BAD_ENTRIES['kind'][0]}}}\n  - 7\n")
    status, _, report = doctor(tmp_path / "out", scene)
    assert status == 2
    assert list(report["refused"]) == ["bad", "views[1]"]


def test_every_kind_of_sensor(tmp_path):
    whole = demo_spec()
    spec = replace(whole, size=150, hill_m=0.0, objects=replace(whole.objects, towers_per_ha=0.0))
    scenes = render_mixed_scene(spec, tmp_path / "scene")
    status, text, report = doctor(tmp_path / "out", scenes["mixed"])
    assert status == 0, text
    assert len(report["views"]) == 9
    assert {view["sensor"] for view in report["views"].values()} == {"frame", "linescan", "rpc"}
    assert all(view["n_ties"] > 30 and view["closing_px"] < 0.01 for view in report["views"].values())
    assert sentences(report, "stops") == []


def test_a_local_frame(tmp_path):
    ground = analytic_ground(KIND, CENTRE, GSD_M / 2, (640, 640), seed=5)
    views = []
    for index, x in enumerate((-20.0, 20.0)):
        model = FrameModel((CENTRE[0] + x, CENTRE[1], 170.0), rotation_from_angles(1.0, 0.0, 0.0), 240.0, (74.5, 69.5))
        numbers = expose(render(ground, model, (140, 150), Sun(150.0, 50.0)), QUIET, np.random.default_rng(index))
        write_image(tmp_path / f"{index}.tif", numbers, None)
        camera_entry = {
            "kind": "frame", "focal": 240.0, "principal_point": [74.5, 69.5], "centre": list(model.centre),
            "rotation": [list(map(float, row)) for row in model.camera_from_ground],
        }  # fmt: skip
        views.append({"name": str(index), "image": f"{index}.tif", "camera": camera_entry})
    scene = tmp_path / "scene.yaml"
    scene.write_text(json.dumps({"schema": 1, "frame": {"local": True}, "views": views}))
    status, _, report = doctor(tmp_path / "out", scene)
    assert status == 0
    assert report["plan"]["n_tiles"] == 1
    assert report["pairs"][0]["base_to_height"] == pytest.approx(40.0 / 120.0, rel=0.1)
    footprints = json.loads((tmp_path / "out" / "footprints.geojson").read_text())
    assert footprints["frame"] == "local, m"
    assert shape(footprints["features"][0]["geometry"]).contains(Point(CENTRE))


def test_too_little_memory(good, tmp_path):
    status, _, report = doctor(tmp_path / "out", *good.values(), "--memory", 0.001)
    assert status == 2
    assert any("--memory 0.001 GB is too little" in sentence for sentence in sentences(report, "stops"))


def test_an_earlier_look_leaves_no_footprints(healthy, good, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for ending in ("png", "qml", "sld"):
        (out / f"footprints.{ending}").write_bytes(b"of another look")
    (out / "dsm.tif").write_bytes(b"of a run")
    doctor(out, tmp_path / "a.tif", tmp_path / "b.tif")
    assert sorted(path.name for path in out.iterdir()) == ["doctor.json", "dsm.tif"]


def test_too_few_quick_features_give_way_to_all(good, tmp_path, monkeypatch):
    _, text, report = doctor(tmp_path / "quick", *good.values(), "--config", more_features(tmp_path))
    assert report["quick_ties"] is True
    assert "Ties are of a quick pass" in text
    monkeypatch.setattr(
        "zlocus.pipeline.doctor.ties.quick_options", lambda options, scene: replace(options, min_ties=10000)
    )
    status, _, report = doctor(tmp_path / "all", *good.values())
    assert (status, report["quick_ties"]) == (0, False)


def more_features(folder):
    (folder / "options.toml").write_text("[orientation]\nfeatures_per_image = 30000\n")
    return folder / "options.toml"


@dataclass(frozen=True)
class Twisted:
    """A camera whose two directions disagree by 0.3 px and that has no ground left of a column."""

    base: SatelliteCamera
    first_column: float = -1.0

    def image_from_ground(self, xyz):
        return self.base.image_from_ground(xyz) + np.array([0.3, 0.0])

    def ground_from_image(self, xy, z):
        xyz = self.base.ground_from_image(xy, z)
        xyz[xy[:, 0] < self.first_column] = np.nan
        return xyz


@pytest.mark.parametrize(("first_column", "share"), [(-1.0, 0.0), (50.0, 0.4)])
def test_a_camera_that_does_not_agree_with_itself(first_column, share):
    view = View("odd", Path("odd.tif"), image_of(np.zeros((150, 150))), Twisted(camera("nadir"), first_column))
    found = view_geometry(view, 50.0)
    assert found.closing_px == pytest.approx(0.3, abs=1e-6)
    assert found.lost == pytest.approx(share)
    told = [finding.sentence for finding in geometry_findings(["odd"], [found], [])]
    assert any("miss themselves by up to 0.30 px" in sentence for sentence in told)
    assert any("cannot map 40 %" in sentence for sentence in told) == (share > 0)


def oriented_as(views, excluded=(), doubts=()):
    """An orientation without tie points that says this of its views."""
    nothing = np.empty(0)
    seen = Observations(nothing.astype(int), nothing.astype(int), np.empty((0, 2)))
    return Orientation(
        views, (), np.empty((0, 3)), nothing, seen, "shift", 0, (0.0, 1.0), 0, excluded_images=excluded, doubts=doubts
    )


@pytest.mark.parametrize(
    ("n_ties", "shift_px", "said"),
    [
        (500, 2.0, None),
        (20, 2.0, "only 20 tie points"),
        (500, 25.0, "off by 25 px, close to the 30 px"),
        (500, 200.0, None),  # its doubt says more
    ],
)
def test_what_ties_say_of_a_view(n_ties, shift_px, said):
    left = Residuals(0.1, 0.1, 0.1)
    views = tuple(ViewOrientation(name, (shift_px, -1.0), n_ties, left, left) for name in ("odd", "even"))
    told = [f.sentence for f in tie_findings(["odd", "even"], oriented_as(views), [], OrientationOptions())]
    assert [said in sentence for sentence in told] == ([] if said is None else [True, True])


def test_what_takes_no_part_and_what_is_doubtful_is_told():
    left = Residuals(0.1, 0.1, 0.1)
    views = tuple(ViewOrientation(name, (0.0, 0.0), 500, left, left) for name in "abc")
    doubts = (Doubt("b: its camera is odd."), Doubt("The cameras of b and c are exchanged.", is_grave=True))
    found = oriented_as(views, (ExcludedImage("a", "nothing supports it."),), doubts)
    told = tie_findings(["a", "b", "c"], found, [], OrientationOptions())
    assert [(f.level, f.sentence) for f in told] == [
        ("poor", "a: it takes no part: nothing supports it."),
        ("poor", doubts[0].sentence),
        ("stops", doubts[1].sentence),
    ]
    found = oriented_as(views[:2], (ExcludedImage("a", "nothing supports it."),))
    told = tie_findings(["a", "b"], found, [], OrientationOptions())
    assert any(f.level == "stops" and "No two images are held together" in f.sentence for f in told)


@pytest.mark.parametrize(("machine", "level"), [(None, []), (9 * 10**9, []), (7 * 10**9, ["poor"])])
def test_more_memory_than_the_machine_has(machine, level):
    plan = RunPlan(0.5, (9, 9), (0.0, 1.0), 0.1, 10, 8, 2 * 10**9, 4, machine, 1.0, 1.0, None)
    assert [finding.level for finding in plan_findings(plan, None)] == level


def test_suns_that_are_far_apart_are_told(good, tmp_path):
    """The farthest two of the images whose sun is known; without one nothing is told."""
    suns = {"nadir": (150.0, 50.0), "fore": (152.0, 51.0), "aft": (230.0, 30.0)}
    paths = {name: Path(shutil.copy(path, tmp_path)) for name, path in good.items()}
    for name, (azimuth, altitude) in suns.items():
        with rasterio.open(paths[name], "r+") as file:
            file.update_tags(NITF_USE00A_SUN_AZ=str(azimuth), NITF_USE00A_SUN_EL=str(altitude))
    _, _, report = doctor(tmp_path / "out", *paths.values())
    (told,) = sentences(report, "note")
    assert re.match(r"The sun stood up to 61 degrees apart \(aft and nadir\): shadows", told)
    assert report["verdict"] == "good"
    aft = report["views"]["aft"]
    assert (aft["sun_azimuth_deg"], aft["sun_altitude_deg"]) == (230.0, 30.0)
    _, _, report = doctor(tmp_path / "out", paths["nadir"], paths["fore"])
    assert not sentences(report, "note")


def test_the_plan_names_where_the_surface_lies_and_follows_the_bounds(good, healthy, tmp_path):
    (_, told, report), _ = healthy
    plan = report["plan"]
    xmin, ymin, xmax, ymax = plan["extent"]["bounds"]
    assert "- covers, in EPSG:" in told
    assert "m above the ellipsoid, " in told
    half = (xmin, ymin, (xmin + xmax) / 2, ymax)
    status, text, report = doctor(tmp_path / "out", *good.values(), "--bounds", *half)
    assert status == 0, text
    assert report["plan"]["shape"][1] == pytest.approx(plan["shape"][1] / 2, abs=2)
    beyond = (xmin - 3 * (xmax - xmin), ymin, xmax, ymax)
    told = sentences(doctor(tmp_path / "beyond", *good.values(), "--bounds", *beyond)[2], "poor")
    assert any("of the area asked for" in each for each in told)
    far = doctor(tmp_path / "far", *good.values(), "--bounds", xmin - 9000, ymin, xmax - 9000, ymax)
    assert far[0] == 2
    assert any("lies outside the ground that two images see" in each for each in sentences(far[2], "stops"))
