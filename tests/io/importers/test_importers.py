"""Imported cameras project as the other programs do, in the pixel convention of zlocus."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from pyproj import CRS
from typer.testing import CliRunner

import camera_files as files
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, InputError, OutputError, ZlocusWarning
from zlocus.core.requests import ImportRequest
from zlocus.io.importers.registry import IMPORTERS
from zlocus.io.importers.scene import import_scene
from zlocus.io.scene_file import open_scene
from zlocus.sensors.earth_frame import FRAME_SPACE, EarthSpace

SAME_PX = 1e-6
# Of 70 px focal length at 100 m: a micrometre on the ground, which UTM's own figures do not hold to.
SAME_ON_A_MAP_PX = 1e-6


def imported(kind, written, **options):
    """The scene of a folder, opened from the file that was written."""
    out = written.folder / "scene.yaml"
    import_scene(ImportRequest(kind, written.folder, out, overwrite=True, **options))
    return open_scene([out])


LOCAL = {
    "colmap-text": ("colmap", files.write_colmap, {}),
    **{f"colmap-{m}": ("colmap", lambda f, m=m: files.write_colmap(f, m, binary=True), {}) for m in files.COLMAP},
    "bundler": ("bundler", files.write_bundler, {}),
    "eo": ("eo", files.write_eo, {"camera": True}),
    "eo-heading": ("eo", lambda f: files.write_eo(f, heading=True, delimiter=";"), {"camera": True}),
    **{f"opensfm-{p}": ("opensfm", lambda f, p=p: files.write_opensfm(f, p), {"local": True}) for p in files.OPENSFM},
    "metashape-local": ("metashape", lambda f: files.write_metashape(f, crs=""), {}),
    "metashape-fisheye": ("metashape", lambda f: files.write_metashape(f, "fisheye", crs=""), {}),
}
ON_EARTH = {
    "opensfm": ("opensfm", files.write_opensfm, {}),
    "metashape": ("metashape", files.write_metashape, {}),
    "opensfm-other-map": ("opensfm", files.write_opensfm, {"crs": "EPSG:32631"}),
    "metashape-of-a-map": (
        "metashape",
        lambda f: files.write_metashape(f, crs=CRS.from_user_input("EPSG:32632+5773").to_wkt("WKT1_GDAL")),
        {},
    ),
    "metashape-other-map": ("metashape", files.write_metashape, {"crs": "EPSG:32631"}),
}


def scene_of(case, folder):
    kind, write, options = case
    written = write(folder)
    given = {key: written.folder / "camera.yaml" if key == "camera" else value for key, value in options.items()}
    return written, imported(kind, written, **given)


def own_pixels(written, xy):
    """The program's pixels as zlocus counts them."""
    return (xy - np.array(written.first)) * [1.0, -1.0 if written.y_up else 1.0]


@pytest.mark.parametrize("case", LOCAL.values(), ids=LOCAL)
def test_projects_as_the_program_does(case, tmp_path):
    written, scene = scene_of(case, tmp_path / "p")
    assert len(scene.views) == 3
    assert scene.crs.is_engineering
    for i, view in enumerate(scene.views):
        here = view.sensor.image_from_ground(files.GROUND)
        there = own_pixels(written, written.project(i, files.GROUND))
        assert np.isfinite(here).all()
        np.testing.assert_allclose(here, there, rtol=0, atol=SAME_PX)


@pytest.mark.parametrize("case", ON_EARTH.values(), ids=ON_EARTH)
def test_projects_as_the_program_does_on_the_earth(case, tmp_path):
    written, scene = scene_of(case, tmp_path / "p")
    epsg = 32631 if case[2] else 32632
    assert scene.crs == CRS.from_epsg(epsg)
    ground = files.map_ground(files.GROUND, epsg)
    for i, view in enumerate(scene.views):
        there = own_pixels(written, written.project(i, files.GROUND))
        np.testing.assert_allclose(view.sensor.image_from_ground(ground), there, rtol=0, atol=SAME_ON_A_MAP_PX)


FIRST = {
    "colmap": (0.5, 0.5), "opensfm": (-31.5, -23.5), "metashape": (0.5, 0.5), "bundler": (-31.5, 23.5),
    "eo": (0.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("kind", IMPORTERS)
def test_pixel_origin(kind, tmp_path):
    """Where the program sees the centre of the first pixel of a 64 x 48 image, zlocus sees (0, 0)."""
    case = next(case for case in LOCAL.values() if case[0] == kind)
    written, scene = scene_of(case, tmp_path / "p")
    for i, view in enumerate(scene.views):
        ground = view.sensor.ground_from_image(np.zeros((1, 2)), np.zeros(1))
        np.testing.assert_allclose(written.project(i, ground), [FIRST[kind]], rtol=0, atol=SAME_PX)


def test_every_format_has_its_tests():
    assert {kind for kind, *_ in LOCAL.values()} == set(IMPORTERS)


@pytest.mark.parametrize("binary", [False, True])
def test_what_colmap_itself_writes(tmp_path, binary):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed: COLMAP's own files are not tried")
    written = files.write_colmap(tmp_path / "p", "OPENCV", binary=True)
    (tmp_path / "p/sparse/0/points3D.bin").write_bytes(bytes(8))
    model = pycolmap.Reconstruction(tmp_path / "p/sparse/0")
    out = tmp_path / "q/sparse/0"
    out.mkdir(parents=True)
    (model.write_binary if binary else model.write_text)(str(out))
    os.rename(tmp_path / "p/images", tmp_path / "q/images")
    import_scene(ImportRequest("colmap", tmp_path / "q", tmp_path / "q/scene.yaml"))
    scene = open_scene([tmp_path / "q/scene.yaml"])
    by_name = {image.name: image for image in model.images.values()}
    for i, view in enumerate(scene.views):
        image = by_name[files.NAMES[i]]
        theirs = np.array([image.project_point(point) for point in files.GROUND])
        here = view.sensor.image_from_ground(files.GROUND)
        np.testing.assert_allclose(here, theirs - 0.5, rtol=0, atol=SAME_PX)
        np.testing.assert_allclose(here, own_pixels(written, written.project(i, files.GROUND)), rtol=0, atol=SAME_PX)


def test_the_scene_file_is_relative_and_whole(tmp_path):
    written = files.write_colmap(tmp_path / "project")
    out = tmp_path / "scenes" / "mine.yaml"
    out.parent.mkdir()
    import_scene(ImportRequest("colmap", written.folder, out))
    document = yaml.safe_load(out.read_text())
    assert [view["name"] for view in document["views"]] == ["a", "b 2", "c"]
    assert document["views"][1]["image"] == "../project/images/b 2.tif"
    assert os.listdir(out.parent) == ["mine.yaml"]
    assert open_scene([out]).views[0].path.samefile(written.folder / "images/a.tif")


def test_a_folder_with_linked_images_can_be_moved(tmp_path):
    written = files.write_colmap(tmp_path / "project")
    disk = tmp_path / "disk"
    (written.folder / "images").rename(disk)
    (written.folder / "images").symlink_to(disk)
    import_scene(ImportRequest("colmap", written.folder, written.folder / "scene.yaml"))
    document = yaml.safe_load((written.folder / "scene.yaml").read_text())
    assert [view["image"] for view in document["views"]] == [f"images/{name}" for name in files.NAMES]
    moved = tmp_path / "deep" / "er" / "moved"
    moved.parent.mkdir(parents=True)
    written.folder.rename(moved)
    assert open_scene([moved / "scene.yaml"]).views[0].path.samefile(disk / "a.tif")


def test_a_scene_file_in_a_linked_folder_finds_its_images(tmp_path):
    """The steps up from a linked folder begin at the folder itself, not at the link."""
    written = files.write_colmap(tmp_path / "project")
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "scenes").symlink_to(tmp_path / "far" / "away")
    out = tmp_path / "scenes" / "mine.yaml"
    import_scene(ImportRequest("colmap", written.folder, out))
    assert open_scene([out]).views[0].path.samefile(written.folder / "images/a.tif")


def test_a_scene_file_is_replaced_only_with_overwrite(tmp_path):
    written = files.write_colmap(tmp_path / "p")
    out = tmp_path / "scene.yaml"
    out.write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        import_scene(ImportRequest("colmap", written.folder, out))
    assert out.read_text() == "mine"
    import_scene(ImportRequest("colmap", written.folder, out, overwrite=True))
    assert out.read_text() != "mine"


@pytest.mark.filterwarnings("ignore:The camera centres")
def test_coordinates_of_a_map_may_be_cartesian(tmp_path):
    """COLMAP's axes laid on a map, and a table of orientations that was adjusted on a flat map."""
    written = files.write_colmap(tmp_path / "p")
    scene = imported("colmap", written, crs="EPSG:32632")
    assert scene.crs == CRS.from_epsg(32632)
    here = scene.views[1].sensor.image_from_ground(files.GROUND)
    np.testing.assert_allclose(here, own_pixels(written, written.project(1, files.GROUND)), rtol=0, atol=SAME_PX)
    table = files.write_eo(tmp_path / "q")
    camera = table.folder / "camera.yaml"
    flat = imported("eo", table, crs="EPSG:32632", camera=camera, earth="flat")
    curved = imported("eo", table, crs="EPSG:32632", camera=camera)
    assert flat.views[0].sensor.space == FRAME_SPACE
    assert isinstance(curved.views[0].sensor.space, EarthSpace)


def test_a_focal_length_alone_has_the_centre_of_the_image(tmp_path):
    table = files.write_eo(tmp_path / "p")
    sensor = imported("eo", table, focal=70.0).views[0].sensor
    assert sensor.principal_point == (31.5, 23.5)
    assert (sensor.focal, sensor.aspect, sensor.distortion) == (70.0, 1.0, None)


def test_up_becomes_z(tmp_path):
    written = files.write_colmap(tmp_path / "p")
    plain, turned = (imported("colmap", written, **options) for options in ({}, {"up": (1.0, 2.0, -3.0)}))
    up = np.array([1.0, 2.0, -3.0]) / np.sqrt(14.0)
    for one, other in zip(plain.views, turned.views, strict=True):
        ground = one.sensor.ground_from_image(np.array([[10.0, 20.0], [50.0, 5.0]]), np.zeros(2))
        rotation = other.sensor.rotation.T @ one.sensor.rotation
        np.testing.assert_allclose(rotation @ up, [0.0, 0.0, 1.0], atol=1e-12)
        xy = other.sensor.image_from_ground(ground @ rotation.T)
        np.testing.assert_allclose(xy, [[10.0, 20.0], [50.0, 5.0]], atol=SAME_PX)


OFFSET = (462_000.0, 5_247_000.0, 400.0)
# Coordinates of a map in float64, projected with a focal length of 70 px at 100 m.
WITH_OFFSET_PX = 1e-5
LOCAL_ON_A_MAP = {"colmap": {}, "bundler": {}, "eo": {"focal": 70.0, "earth": "flat"}}


@pytest.mark.parametrize("kind", LOCAL_ON_A_MAP)
def test_an_offset_leads_from_the_model_to_the_map(kind, tmp_path):
    assert [name for name, importer in IMPORTERS.items() if "offset" in importer.options] == list(LOCAL_ON_A_MAP)
    written = getattr(files, f"write_{kind}")(tmp_path / "p")
    options = LOCAL_ON_A_MAP[kind] | {"crs": "EPSG:32632"}
    with pytest.warns(ZlocusWarning, match=r"Give what was subtracted from the coordinates of the map with --offset"):
        there = imported(kind, written, **options)
    here = imported(kind, written, offset=OFFSET, **options)
    for one, other in zip(there.views, here.views, strict=True):
        xy = other.sensor.image_from_ground(files.GROUND + OFFSET)
        np.testing.assert_allclose(xy, one.sensor.image_from_ground(files.GROUND), rtol=0, atol=WITH_OFFSET_PX)


def moved_model(folder, by):
    """A model of COLMAP whose coordinates lie elsewhere."""
    written = files.write_colmap(folder)
    path = folder / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines):
        fields = line.split()
        if line.endswith(".tif") and not line.startswith("#"):
            i = [name.split()[0] for name in files.NAMES].index(fields[9])
            translation = -files.rotation(i) @ (files.CENTRES[i] + by)
            lines[number] = " ".join([*fields[:5], *map(repr, map(float, translation)), *fields[8:]])
    path.write_text("\n".join(lines) + "\n")
    return written


@pytest.mark.parametrize(
    ("by", "options", "says"),
    [
        (OFFSET, {}, r"around X = 462010, Y = 5247000, Z = 500, as coordinates of a map do.*--crs EPSG:n"),
        ((4_300_000.0, 660_000.0, 4_650_000.0), {}, "as geocentric coordinates do.*enu"),
        (OFFSET, {"crs": "EPSG:32612"}, None),  # a zone elsewhere cannot be told from the right one
        ((2_600_000.0, 1_200_000.0, 400.0), {"crs": "EPSG:32632"}, "outside the area in which EPSG:32632 is used"),
        (OFFSET, {"crs": "EPSG:32632", "offset": OFFSET}, "Check --offset and --crs"),
        (OFFSET, {"crs": "EPSG:32632"}, None),
        (OFFSET, {"crs": "EPSG:3857"}, None),  # used in the whole world
        (OFFSET, {"up": (0.0, 0.0, 1.0)}, None),
        ((900.0, -400.0, 0.0), {}, None),
    ],
)  # fmt: skip
def test_places_that_cannot_be_meant_are_warned_of(by, options, says, tmp_path):
    written = moved_model(tmp_path / "p", np.array(by))
    request = ImportRequest("colmap", written.folder, tmp_path / "scene.yaml", **options)
    if says is None:
        import_scene(request)
        return
    with pytest.warns(ZlocusWarning, match=says) as caught:
        import_scene(request)
    assert len(caught) == 1


def remade(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def colmap_text(folder):
    return files.write_colmap(folder).folder / "sparse/0"


FAULTS = [
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", "OPENCV", "FOV", "model 'FOV', which is not read"),
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", " 64 ", " 6.5 ", "6.5 x 48 pixels"),
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", " 64 ", " 65 ", r"64 x 48 pixels.*65 x 48"),
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", "70.0", "nan", "'nan', not a finite number"),
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", "70.0", "-70.0", "focal"),
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", "70.0 ", "", "has 7 numbers, not 8"),
    ("colmap", files.write_colmap, "sparse/0/cameras.txt", "cameras: 1", "cameras: 2", "2 cameras, and it holds 1"),
    ("colmap", files.write_colmap, "sparse/0/images.txt", "images: 3", "images: 4", "holds 4 images, and it holds 3"),
    ("colmap", files.write_colmap, "sparse/0/images.txt", " 7 a.tif", " 8 a.tif", "camera 8, which is not in"),
    ("colmap", files.write_colmap, "sparse/0/images.txt", "a.tif", "z.tif", "Give the folder with --images"),
    ("colmap", files.write_colmap, "sparse/0/images.txt", "b 2.tif", "z.tif", "lacks 1 of 3 images"),
    ("colmap", files.write_colmap, "sparse/0/images.txt", "\n1 0.", "\n1 9.", "quaternion of length"),
    ("bundler", files.write_bundler, "bundle.out", "v0.3", "v9", "does not begin with"),
    ("bundler", files.write_bundler, "bundle.out", "4 1", "5 1", "5 cameras, and .* lists 4 images"),
    ("bundler", files.write_bundler, "bundle.out", "4 1", "4 99", "truncated: 99 points"),
    ("bundler", files.write_bundler, "list.txt", "lost.tif\n", "lost.tif", "stops within line 4"),
    ("bundler", files.write_bundler, "bundle.out", "70.0", "-70.0", "focal"),
    ("eo", files.write_eo, "eo.csv", "100.0", "inf", "z in line 2 is 'inf'"),
    ("eo", files.write_eo, "eo.csv", "b ", "a ", "'a' is there twice"),
    ("eo", files.write_eo, "camera.yaml", "focal", "fokal", "unknown key fokal"),
    ("opensfm", files.write_opensfm, "reconstruction.json", '"brown"', '"spherical"', "'spherical', which is not read"),
    ("opensfm", files.write_opensfm, "reconstruction.json", "47.3", "NaN", "NaN, which is no number"),
    ("opensfm", files.write_opensfm, "reconstruction.json", "47.3", "147.3", "no place on the Earth"),
    ("opensfm", files.write_opensfm, "reconstruction.json", "reference_lla", "lla", "Give --local"),
    ("opensfm", files.write_opensfm, "reconstruction.json", '"v2 x"\n', '"v3"\n', "camera 'v3', which the file"),
    ("metashape", files.write_metashape, "cameras.xml", "<f>70.0</f>", "", "no calibration with an f"),
    ("metashape", files.write_metashape, "cameras.xml", "<k1>", "<k4>0.1</k4><k1>", "has k4, which is not read"),
    ("metashape", files.write_metashape, "cameras.xml", 'sensor_id="0"', 'sensor_id="5"', "sensor that the file"),
    ("metashape", files.write_metashape, "cameras.xml", 'label="unknown"', 'master_id="1"', "a rig of several sensors"),
    ("metashape", files.write_metashape, "cameras.xml", "GEOGCS", "WOGCS", "which is no CRS"),
    ("metashape", files.write_metashape, "cameras.xml", f"{files.SCALE}", "-1", "scale of the chunk is -1"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "write", "name", "old", "new", "says"), FAULTS)
def test_a_fault_is_named(tmp_path, kind, write, name, old, new, says):
    folder = write(tmp_path / "p").folder
    remade(folder / name, old, new)
    options = {"camera": folder / "camera.yaml"} if kind == "eo" else {}
    with pytest.raises(InputError, match=says) as caught:
        import_scene(ImportRequest(kind, folder, folder / "scene.yaml", **options))
    assert "\n" not in str(caught.value)
    assert not (folder / "scene.yaml").exists()


def test_options_that_do_not_apply_are_refused(tmp_path):
    folder = files.write_colmap(tmp_path / "p").folder
    out = folder / "scene.yaml"
    for request, says in (
        (lambda: ImportRequest("kitti", folder, out), "Choose from colmap"),
        (lambda: ImportRequest("colmap", folder, out, focal=3.0), "--focal says nothing"),
        (lambda: ImportRequest("colmap", folder, out, local=True), "--local says nothing"),
        (lambda: ImportRequest("eo", folder, folder / "scene.json"), "no name of a scene file"),
        (lambda: ImportRequest("eo", folder, out, focal=0.0), "--focal 0"),
        (lambda: ImportRequest("eo", folder, out, earth="hollow"), "--earth hollow"),
        (lambda: ImportRequest("eo", folder, out, earth="flat"), "Give --crs"),
        (lambda: ImportRequest("eo", folder, out, up=(0.0, 0.0, 0.0)), "no direction"),
        (lambda: ImportRequest("opensfm", folder, out, crs="EPSG:32632", local=True), "exclude each other"),
        (lambda: ImportRequest("colmap", folder, out, offset=(1.0, 2.0, 3.0)), "Give --crs"),
        (lambda: ImportRequest("colmap", folder, out, crs="EPSG:32632", offset=(1.0, np.inf, 3.0)), "no place"),
        (lambda: ImportRequest("opensfm", folder, out, crs="EPSG:32632", offset=OFFSET), "--offset says nothing"),
    ):
        with pytest.raises(ConfigError, match=says):
            import_scene(request())
    table = files.write_eo(tmp_path / "q").folder
    with pytest.raises(ConfigError, match="Give --focal in pixels"):
        import_scene(ImportRequest("eo", table, table / "scene.yaml"))
    with pytest.raises(ConfigError, match="is no CRS"):
        import_scene(ImportRequest("eo", table, table / "scene.yaml", focal=70.0, crs="somewhere"))


def test_the_command(tmp_path, monkeypatch):
    files.write_colmap(tmp_path / "p")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["import", "colmap", "p"])
    assert done.exit_code == 0, done.output
    assert done.stdout == "scene.yaml: 3 views.\n"
    assert len(open_scene([Path("scene.yaml")]).views) == 3
    again = CliRunner().invoke(app, ["import", "colmap", "p"])
    assert again.exit_code == 2
    assert again.stderr.count("\n") == 1
    assert CliRunner().invoke(app, ["import", "colmap", "p", "--overwrite", "--up", "0", "1", "0"]).exit_code == 0
    assert CliRunner().invoke(app, ["import", "colmap", "nowhere", "--overwrite"]).exit_code == 2
