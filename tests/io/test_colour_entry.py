from __future__ import annotations

import numpy as np
import pytest
import yaml

from made_up_deliveries import shots
from rpc_fixtures import rpc_txt, write_image
from zlocus.core.errors import InputError
from zlocus.io.scene_file import open_scene

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def folder(images, tmp_path_factory):
    """Panchromatic and multispectral images of two passes, each with its RPC beside it."""
    folder = tmp_path_factory.mktemp("images")
    for shot in shots({name: images("sine").paths[name] for name in ("nadir", "fore")}):
        for kind, pixels, rpc in (("pan", shot.grey, shot.rpc), ("ms", shot.bands("BGRN"), shot.colour_rpc)):
            write_image(folder / f"{shot.name}_{kind}.tif", pixels)
            (folder / f"{shot.name}_{kind}_RPC.TXT").write_text(rpc_txt(rpc))
    return folder


def scene_of(folder, colours):
    """The scene of both views, of which the first has an entry `colours`."""
    views = [{"name": name, "image": f"{name}_pan.tif", "camera": {"kind": "rpc"}} for name in ("nadir", "fore")]
    views[0]["colours"] = colours
    (folder / "scene.yaml").write_text(yaml.safe_dump({"schema": 1, "views": views}))
    return open_scene([folder / "scene.yaml"])


def test_another_image_gives_the_colours_of_a_view(folder):
    nadir, fore = scene_of(folder, {"image": "nadir_ms.tif", "bands": [3, 2, 1]}).views
    red, green, blue = nadir.image.colours(0, 0, *nadir.image.shape)
    assert np.median(green / red) == pytest.approx(0.75, abs=0.01)
    assert np.median(blue / red) == pytest.approx(0.5, abs=0.01)
    assert not fore.image.has_colours
    assert {"nadir_ms.tif"} < {path.name for path in nadir.files}


@pytest.mark.parametrize(
    ("colours", "says"),
    [
        ({"image": "fore_ms.tif", "bands": [3, 2, 1]}, "as in images of different passes. Leave `colours` out"),
        ({"image": "none.tif", "bands": [3, 2, 1]}, "There is no image"),
        ({"image": "nadir_ms.tif", "bands": [3, 3, 1]}, "three different numbers, from 1"),
        ({"image": "nadir_ms.tif", "bands": [0, 2, 1]}, "three different numbers, from 1"),
        ({"image": "nadir_ms.tif", "bands": [7, 2, 1]}, "has 4 bands, and no band 7"),
        ({"image": "nadir_ms.tif"}, "bands"),
    ],
)
def test_colours_that_cannot_be_given(folder, colours, says):
    with pytest.raises(InputError, match=says):
        scene_of(folder, colours)
