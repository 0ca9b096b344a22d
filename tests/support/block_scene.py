"""A surface of a block beside level ground, of which one image looks over the block and another one is falsified."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio

import rendered_scenes
from rendered_scenes import CENTRE, GSD_M, SIZE_PX, SMALL_TILES, SatelliteCamera, camera, rendered, run
from zlocus.inspector.folder import SurfaceFolder, surface_folder
from zlocus.inspector.restored_run import Restored, restored

GROUND_M, BLOCK_M = 50.0, 65.0
# The image that looks over the block, and the one whose pixels are moved around a place of the ground.
OVER, FALSIFIED = "aft", "fore"
FALSE_AT, FALSE_PX, MOVED_PX = (CENTRE[0] - 18.0, CENTRE[1] + 6.0), 16, 7
ALONG_DEG, ACROSS_DEG = -10.0, 22.0


def block_surface(tmp_path_factory) -> tuple[SurfaceFolder, Restored]:
    """The folder and the scene of the run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rendered_scenes.LOOKS, OVER, (ALONG_DEG, over_deg()))
        images = rendered(tmp_path_factory.mktemp("block"), "step")
    col, row = camera(FALSIFIED).image_from_ground(np.array([[*FALSE_AT, GROUND_M]]))[0].round().astype(int)
    with rasterio.open(images.paths[FALSIFIED], "r+") as file:
        pixels = file.read(1)
        part = np.s_[row - FALSE_PX : row + FALSE_PX, col - FALSE_PX : col + FALSE_PX]
        pixels[part] = np.roll(pixels, MOVED_PX, axis=0)[part]
        file.write(pixels, 1)
    folder = surface_folder(run(images, tmp_path_factory.mktemp("block") / "out", SMALL_TILES).out)
    return folder, restored(folder.out, folder.run)


def over_deg() -> float:
    """The angle across the flight from which rays rise over the block, which lies in the east."""
    here = np.array([[*CENTRE, GROUND_M]])
    for across in (ACROSS_DEG, -ACROSS_DEG):
        sensor = SatelliteCamera((*CENTRE, 50.0), (SIZE_PX / 2, SIZE_PX / 2), GSD_M, ALONG_DEG, across, 3.0)
        above = sensor.ground_from_image(sensor.image_from_ground(here), np.array([BLOCK_M]))
        if above[0, 0] > here[0, 0]:
            return across
    raise AssertionError("one of them looks over the block")
