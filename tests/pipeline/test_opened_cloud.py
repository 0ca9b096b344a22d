"""The folder of a cloud is opened with the cameras of its run, and refused where its images have changed."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from rendered_scenes import HEIGHTS, rendered
from zlocus.core.errors import InputError
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import CloudRequest
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.opened_cloud import is_cloud, open_cloud

# Heights of the rendered ground lie within its range by so much.
NEAR_M = 1.0


@pytest.fixture
def made(tmp_path):
    """A cloud of three rendered images beside it, and the images."""
    images = list(rendered(tmp_path / "images", "sine").inputs)
    out = tmp_path / "cloud"
    run_cloud(CloudRequest(images, out, crs="EPSG:32632", heights=HEIGHTS), RunConfig(), SilentProgress())
    return out, images


def test_maps_of_a_cloud_are_read_and_changed_images_refused(made):
    out, images = made
    assert is_cloud(out)
    opened = open_cloud(out, SilentProgress())
    assert [each.view.name for each in opened.image_maps]
    for image_map in opened.image_maps:
        rows, cols = image_map.shape
        z = image_map.read(CellWindow(0, 0, rows, cols), 4).points[..., 2]
        assert np.isfinite(z).mean() > 0.3
        assert HEIGHTS[0] - NEAR_M < np.nanmin(z) < np.nanmax(z) < HEIGHTS[1] + NEAR_M
    shutil.copy(images[1], images[0])
    with pytest.raises(InputError, match=r"cannot be restored \(.* has changed since the cloud was made\)"):
        open_cloud(out, SilentProgress())
