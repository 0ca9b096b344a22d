"""Damaged files through the real command line: exit status 2, one sentence, no trace, and nothing half written."""

from __future__ import annotations

import shutil

import pytest
from typer.testing import CliRunner

from damage_cases import CASES
from zlocus.cli.app import app

# What is done to a file: cut in the middle, in UTF-16, a number that is none, nothing left of it.
DAMAGES = {
    "cut": lambda content: content[: len(content) * 2 // 3],
    "utf-16": lambda content: content.decode("utf-8").encode("utf-16"),
    "nul": lambda content: b"\0" * len(content),
    "empty": lambda _: b"",
}
IMPORTED = {
    "colmap-text-cameras": "colmap", "colmap-text-images": "colmap", "opensfm": "opensfm", "metashape": "metashape",
    "bundler": "bundler", "bundler-list": "bundler", "eo": "eo",
    "colmap-binary-cameras": "colmap", "colmap-binary-images": "colmap",
}  # fmt: skip


def refused(folder, *arguments):
    """The sentence of a command that must refuse its input, and leave the folder as it is."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    result = CliRunner().invoke(app, [*map(str, arguments)])
    said = [line for line in result.stderr.splitlines() if line.startswith("zlocus: ")]
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert len(said) == 1
    assert result.stderr.rstrip().endswith(said[0])
    assert said[0][-1] in ".?"
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    return said[0]


def with_damages(names):
    """Each name with every damage that can be done to it: binary files have no encoding, and of a raster whose grid
    alone is read, which stands at its beginning, nothing is missed where it is cut."""
    return [
        (name, damage)
        for name in names
        for damage in DAMAGES
        if (CASES[name].text or damage != "utf-16") and (name, damage) != ("like", "cut")
    ]


@pytest.mark.parametrize(("name", "damage"), with_damages(IMPORTED))
def test_import(tmp_path, name, damage):
    path = CASES[name].write(tmp_path)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    options = ["--camera", tmp_path / "p" / "camera.yaml"] if name == "eo" else []
    sentence = refused(tmp_path, "import", IMPORTED[name], tmp_path / "p", "-o", tmp_path / "scene.yaml", *options)
    assert path.name in sentence or path.parent.name in sentence


@pytest.mark.parametrize("command", ["dsm", "cloud", "orient", "ties", "doctor"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_scene_file(tmp_path, command, damage):
    path = CASES["scene-frame"].write(tmp_path)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert "scene.yaml" in refused(tmp_path, command, path, "-o", tmp_path / "out")


@pytest.mark.parametrize("command", ["dsm", "cloud", "orient", "ties"])
@pytest.mark.parametrize(
    ("name", "damaged", "old", "new"),
    [
        ("scene-frame", "scene.yaml", b"1450.75", b"nan"),
        ("scene-frame", "scene.yaml", b"kind: brown", b"kind: browm"),
        ("scene-linescan", "path.csv", b"700100.5", b"inf"),
        ("scene-linescan", "plane.csv", b"-20.5", b"x"),
        ("scene-rpc", "a.tif", b"II*", b"II+"),
    ],
)
def test_a_file_of_a_scene(tmp_path, command, name, damaged, old, new):
    scene = CASES[name].write(tmp_path)
    content = (tmp_path / damaged).read_bytes()
    assert old in content
    (tmp_path / damaged).write_bytes(content.replace(old, new, 1))
    assert damaged in refused(tmp_path, command, scene, "-o", tmp_path / "out")


@pytest.mark.parametrize("name", ["rpc-txt", "rpb", "dimap-2"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_camera_beside_its_image(tmp_path, name, damage):
    path = CASES[name].write(tmp_path)
    shutil.copy(tmp_path / "img.tif", tmp_path / "other.tif")
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    arguments = (tmp_path / "img.tif", tmp_path / "other.tif", "-o", tmp_path / "out")
    # GDAL too looks at what lies beside an image, and then names the image.
    names = ("img.tif cannot be read", path.name)
    sentence = refused(tmp_path, "dsm", *arguments)
    assert any(name in sentence for name in names)
    result = CliRunner().invoke(app, ["doctor", *map(str, arguments[:2])])
    assert result.exit_code == 2
    assert any(name in result.stdout for name in names)
    assert "other.tif has no camera" in result.stdout


@pytest.mark.parametrize("damage", DAMAGES)
def test_control_points(tmp_path, good_pair, damage):
    path = CASES["control"].write(tmp_path)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert "control.csv" in refused(tmp_path, "orient", *good_pair, "--control", path, "-o", tmp_path / "out")


@pytest.mark.parametrize(("name", "damage"), with_damages(["dem", "like", "area-geojson", "area-gpkg"]))
def test_side_files(tmp_path, good_pair, name, damage):
    path = CASES[name].write(tmp_path)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    option = f"--{name.split('-')[0]}"
    heights = [] if name == "dem" else ["--heights", 20, 90]
    assert path.name in refused(tmp_path, "dsm", *good_pair, *heights, option, path, "-o", tmp_path / "out")


@pytest.mark.parametrize("damage", [name for name in DAMAGES if name != "empty"])
@pytest.mark.parametrize("command", ["dsm", "doctor"])
def test_options(tmp_path, good_pair, command, damage):
    path = CASES["config-toml"].write(tmp_path)
    content = DAMAGES[damage](path.read_bytes())
    # The first half of a number is one too, unlike a name without its value.
    path.write_bytes(content[: content.rindex(b"=")] if damage == "cut" else content)
    assert "config.toml" in refused(tmp_path, command, *good_pair, "--config", path, "-o", tmp_path / "out")


@pytest.mark.parametrize("damage", [name for name in DAMAGES if name != "utf-16"])
def test_surfaces_to_compare(tmp_path, damage):
    whole = CASES["surface"].write(tmp_path)
    path = tmp_path / "other.tif"
    path.write_bytes(DAMAGES[damage](whole.read_bytes()))
    assert "other.tif" in refused(tmp_path, "evaluate", path, whole)
    assert "other.tif" in refused(tmp_path, "evaluate", whole, path)
