"""`zlocus ortho` through the command line, on a rendered town whose surface is the truth."""

from __future__ import annotations

import json

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from displaced_windows import displacements
from ortho_scenes import FOUR_BANDS, PIXEL_M, town, truth_of, write_photo, write_view
from rendered_scenes import PART, rendered, run
from zlocus.cli.app import app
from zlocus.core.ortho_request import MOSAIC, MOSAIC_IMAGES, ORTHO_RECORD
from zlocus.pipeline.ortho import complete_or_removed
from zlocus.synthetic.render import visible_ground_points

OFF_PX = 0.3
# What the surface may wrongly show of hidden ground, at its cells.
DOUBLE_SHARE = 0.01
GAIN = 1.4


def ortho(*arguments):
    return CliRunner().invoke(app, ["ortho", *(str(argument) for argument in arguments)])


def record_in(folder):
    return json.loads((folder / ORTHO_RECORD).read_text())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    scene = town(tmp_path_factory.mktemp("town"))
    write_view(scene, "d1", FOUR_BANDS)
    write_photo(scene, scene.folder / "photo.tif")
    return scene


@pytest.fixture(scope="module")
def of_four_bands(made):
    out, folder = made.folder / "four", made.folder
    reference = ("--reference", folder / "photo.tif")
    result = ortho(folder / "surface.tif", folder / "d1.tif", *reference, "-o", out, "--resolution", PIXEL_M)
    assert result.exit_code == 0, result.output
    assert "d1 took no part in the surface" in result.stderr
    assert "4 bands of uint16, pixels of 0.5 m" in result.stdout
    return out


def test_an_image_of_another_date_lies_where_the_truth_is(made, of_four_bands):
    off = displacements(of_four_bands / "d1_ortho.tif", truth_of(made, "d1"))
    assert len(off) > 40
    assert np.sqrt((off**2).sum(axis=1).mean()) < OFF_PX
    assert np.hypot(*off.mean(axis=0)) < OFF_PX / 2
    facts = record_in(of_four_bands)["images"]["d1"]
    assert facts["pointing"] == "matched"
    assert facts["offset_px"] == pytest.approx([4.7, -6.3], abs=1.0) or facts["offset_px"] == pytest.approx(
        [-4.7, 6.3], abs=1.0
    )


def test_all_bands_keep_type_and_names(of_four_bands):
    with rasterio.open(of_four_bands / "d1_ortho.tif") as file:
        assert file.dtypes == ("uint16",) * 4
        assert file.descriptions == ("blue", "green", "red", "nir")
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert not (file.read_masks(1) > 0).all()


def test_hidden_ground_is_masked(made, of_four_bands):
    exposure = made.exposure("d1")
    with rasterio.open(of_four_bands / "d1_ortho.tif") as file, rasterio.open(made.folder / "surface.tif") as heights:
        valid, t = file.read_masks(1) > 0, file.transform
        row, col = np.nonzero(np.ones(valid.shape, bool))
        x, y = t.c + (col + 0.5) * PIXEL_M, t.f - (row + 0.5) * PIXEL_M
        z = np.array([value[0] for value in heights.sample(zip(x, y, strict=True))])
    inside = z > 0
    xyz = np.column_stack([x, y, z])[inside]
    seen = visible_ground_points(made.ground, exposure.sensor, exposure.sensor.image_from_ground(xyz))
    apart = np.hypot(*(seen - xyz)[:, :2].T)
    is_hidden, is_shown = apart > 4 * PIXEL_M, valid.ravel()[inside]
    assert is_hidden.mean() > DOUBLE_SHARE  # there is something to hide
    assert (is_hidden & is_shown).mean() < DOUBLE_SHARE
    assert is_shown[apart < PIXEL_M].mean() > 0.9


def test_without_a_reference_the_camera_is_used_as_delivered(made, tmp_path):
    result = ortho(made.folder / "surface.tif", made.folder / "d1.tif", "-o", tmp_path / "out")
    assert result.exit_code == 0
    assert "laid on the surface as the cameras were delivered" in result.stderr
    assert record_in(tmp_path / "out")["images"]["d1"]["pointing"] == "delivered"


def test_an_image_that_does_not_look_like_the_reference_is_used_as_delivered(made, tmp_path):
    other = town(tmp_path / "other", 6)
    photo = write_photo(other, tmp_path / "photo.tif")
    result = ortho(made.folder / "surface.tif", made.folder / "d1.tif", "--reference", photo, "-o", tmp_path / "out")
    assert result.exit_code == 0
    assert "may be off by its pointing error" in result.stderr


def test_a_mosaic_is_levelled(made, tmp_path):
    images = [write_view(made, "n1"), write_view(made, "f1", gain=GAIN)]
    reference = ("--reference", made.folder / "photo.tif")
    result = ortho(made.folder / "surface.tif", *images, *reference, "-o", tmp_path / "out", "--resolution", PIXEL_M)
    assert result.exit_code == 0, result.output
    of_images = record_in(tmp_path / "out")["mosaic"]["images"]
    assert of_images["n1"]["gain"][0] / of_images["f1"]["gain"][0] == pytest.approx(GAIN, rel=0.05)
    with rasterio.open(tmp_path / "out" / MOSAIC) as file, rasterio.open(tmp_path / "out" / MOSAIC_IMAGES) as numbers:
        assert file.dtypes == ("uint16",)
        valid, number = file.read_masks(1) > 0, numbers.read(1)
    assert set(np.unique(number)) == {0, 1, 2}
    assert ((number > 0) == valid).all()
    for name in ("n1", "f1"):
        with rasterio.open(tmp_path / "out" / f"{name}_ortho.tif") as file:
            assert valid.sum() > (file.read_masks(1) > 0).sum()  # each shows what the other hides
    made_of = [path.stem for path in (tmp_path / "out").glob("*.tif")]
    assert {path.stem for path in (tmp_path / "out").glob("*.qml")} == set(made_of)
    assert 'label="2 ' not in (tmp_path / "out" / "mosaic_images.qml").read_text()
    assert 'label="f1"' in (tmp_path / "out" / "mosaic_images.qml").read_text()


def test_images_of_different_bands_make_no_mosaic(made, tmp_path):
    inputs = (made.folder / "surface.tif", made.folder / "d1.tif", write_view(made, "n1"))
    asked = ortho(*inputs, "-o", tmp_path / "asked", "--mosaic", "--pointing", "delivered")
    assert asked.exit_code == 2
    assert "d1 has 4 bands of uint16 and n1 1 of uint16" in asked.stderr
    assert not (tmp_path / "asked").exists()


def test_images_of_the_run_have_the_cameras_of_the_run(tmp_path):
    flawed = rendered(tmp_path / "images", "sine", {"fore": (-3.0, 1.0), "nadir": (1.5, -2.0)})
    made_run = run(flawed, tmp_path / "surface", bounds=PART, products=())
    result = ortho(made_run.out, *flawed.inputs, "-o", tmp_path / "out", "--no-mosaic")
    assert result.exit_code == 0, result.output
    facts = record_in(tmp_path / "out")["images"]
    assert {each["pointing"] for each in facts.values()} == {"run"}
    with (
        rasterio.open(tmp_path / "out" / "fore_ortho.tif") as fore,
        rasterio.open(made_run.out / "ortho.tif") as of_run,
    ):
        found = displacements_of(fore, of_run)
    assert np.abs(found).max() < OFF_PX


def displacements_of(file, other):
    """Displacement (column, row) px of one whole ortho-image from another on a grid of the same cells."""
    from zlocus.orientation.edge_correlation import correlation, peak_of

    bounds = [f(a, b) for f, a, b in zip((max, max, min, min), file.bounds, other.bounds, strict=True)]
    pixels = []
    for each in (file, other):
        window = each.window(*bounds).round_offsets().round_lengths()
        grey = each.read(1, window=window).astype(np.float32)
        grey[each.read_masks(1, window=window) == 0] = np.nan
        pixels.append(grey)
    rows, cols = (min(each.shape[k] for each in pixels) for k in (0, 1))
    side = min(rows, cols)
    first, second = (each[:side, :side] for each in pixels)
    peak = peak_of(correlation(first, second, 6))
    return np.array([peak.col, peak.row])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("nothing.tif", "d1.tif"), "There is no surface nothing.tif"),
        ((".", "d1.tif"), "holds no dsm.tif"),
        (("surface.tif", "none.tif"), "no file"),
        (("surface.tif", "d1.tif", "--bounds", 1, 1, 2, 2), "None of the images (d1) shows the surface"),
        (("surface.tif", "d1.tif", "--pointing", "guessed"), "corrected, delivered"),
        (("surface.tif", "d1.tif", "--pointing", "delivered", "--reference", "photo.tif"), "Leave one out"),
        (("surface.tif", "d1.tif", "--resolution", -1), "--resolution"),
    ],
)
def test_refusals(made, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(made.folder)
    result = ortho(*arguments, "-o", tmp_path / "out")
    assert result.exit_code == 2, result.output
    assert says.lower() in " ".join(result.stderr.lower().split())
    assert not (tmp_path / "out").exists()


def test_another_result_is_kept(made, of_four_bands):
    again = ortho(made.folder / "surface.tif", made.folder / "d1.tif", "-o", of_four_bands)
    assert again.exit_code == 2
    assert "holds another set of ortho-images" in again.stderr


def test_the_styles_of_a_surface_in_the_same_folder_stay(tmp_path):
    for name in ("ortho.tif", "ortho.qml", "ortho.sld"):
        (tmp_path / name).write_text("of the surface")
    with complete_or_removed(tmp_path, []):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ortho.qml", "ortho.sld", "ortho.tif"]
