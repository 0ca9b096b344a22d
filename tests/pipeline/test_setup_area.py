"""Which images of a block are read where only a part of it is asked for."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
import yaml
from rasterio.enums import ColorInterp

from zlocus.core.errors import GeometryError, InputError
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import SetupRequest
from zlocus.io.images import RasterImage
from zlocus.pipeline.setup import open_inputs

EAST, NORTH = 500_000.0, 5_300_000.0
SIDE_PX, STEP_M, FLYING_M, FOCAL_PX = 64, 40.0, 100.0, 64.0
N_FRAMES = 6
# Frames 0 and 1 lie over it, and frame 2 reaches it; frame 3 begins 20 m farther on.
AREA = (EAST - 10.0, NORTH - 10.0, EAST + 45.0, NORTH + 10.0)


class Notes(SilentProgress):
    """Keeps what is said."""

    def __init__(self):
        self.said = []

    def note(self, sentence):
        self.said.append(sentence)


pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def write_frame(path, pixels):
    with rasterio.open(path, "w", driver="GTiff", height=SIDE_PX, width=SIDE_PX, count=1, dtype="uint8") as file:
        file.write(pixels, 1)
        file.colorinterp = [ColorInterp.gray]


@pytest.fixture
def block(tmp_path):
    """A strip of frames that look straight down, 40 m apart and 100 m wide on the ground; the last one is black."""
    rng, views = np.random.default_rng(0), []
    for k in range(N_FRAMES):
        black = k == N_FRAMES - 1
        pixels = np.zeros((SIDE_PX, SIDE_PX)) if black else rng.integers(1, 255, (SIDE_PX, SIDE_PX))
        write_frame(tmp_path / f"f{k}.tif", pixels.astype(np.uint8))
        middle = (SIDE_PX - 1) / 2
        camera = {"kind": "frame", "focal": FOCAL_PX, "principal_point": [middle, middle], "earth": "flat",
                  "centre": [EAST + k * STEP_M, NORTH, FLYING_M], "angles": [0.0, 0.0, 0.0]}  # fmt: skip
        views.append({"name": f"f{k}", "image": f"f{k}.tif", "camera": camera})
    document = {"schema": 1, "frame": {"crs": "EPSG:32632"}, "heights": [-5.0, 5.0], "views": views}
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    return path


@pytest.fixture
def read_files(monkeypatch):
    """Names of the images of which pixels are read."""
    plain, names = RasterImage._read, set()

    def watched(self, source, window):
        names.add(self.path.name)
        return plain(self, source, window)

    monkeypatch.setattr(RasterImage, "_read", watched)
    return names


def test_images_that_show_nothing_of_the_area_are_not_read(block, read_files):
    """The black one is not even refused; no file of theirs is an input of the result."""
    notes = Notes()
    opened = open_inputs(SetupRequest((block,), bounds=AREA), notes)
    assert [view.name for view in opened.scene.views] == ["f0", "f1", "f2"]
    assert read_files == {"f0.tif", "f1.tif", "f2.tif"}
    assert [path.name for path in opened.files] == ["scene.yaml", "f0.tif", "f1.tif", "f2.tif"]
    assert notes.said == ["3 of 6 images may show the area asked for. The pixels of the others are not read."]


def test_all_images_are_read_where_no_area_is_asked_for(block, read_files):
    with pytest.raises(InputError, match=r"f5\.tif has the value 0 everywhere"):
        open_inputs(SetupRequest((block,)), SilentProgress())
    assert read_files == {f"f{k}.tif" for k in range(N_FRAMES)}


def test_the_area_of_the_scene_file_counts_too(block, read_files):
    document = yaml.safe_load(block.read_text()) | {"area": {"bounds": list(AREA)}}
    block.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert len(open_inputs(SetupRequest((block,)), SilentProgress()).scene.views) == 3
    assert "f3.tif" not in read_files


@pytest.mark.parametrize("names", [{"reference": "f4"}, {"references": ("f4",)}])
def test_a_named_reference_image_stays(block, names):
    opened = open_inputs(SetupRequest((block,), bounds=AREA, **names), SilentProgress(), "later")
    assert [view.name for view in opened.scene.views] == ["f0", "f1", "f2", "f4"]


def test_an_area_that_fewer_than_two_images_show_is_refused_before_pixels_are_read(block, read_files):
    far = (EAST + 5000.0, NORTH, EAST + 5010.0, NORTH + 10.0)
    with pytest.raises(GeometryError, match="lies outside the ground that two images see"):
        open_inputs(SetupRequest((block,), bounds=far), SilentProgress())
    assert not read_files
