"""Projects of other programs beside a rendered drone block: their importers find the cameras of the block."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from zlocus.core.errors import ConfigError
from zlocus.core.requests import ImportRequest
from zlocus.io.importers.scene import import_scene
from zlocus.io.scene_file import open_scene
from zlocus.synthetic.drone_block import drone_block_files, drone_exposures, small_drone_block_spec
from zlocus.synthetic.drone_projects import offset_of, write_projects

SPEC = small_drone_block_spec(3, east_m=462200.75)
SAME_PX = 1e-6
# A map of UTM shortens distances here by less than 4e-4, and a frame shows ground up to 300 px from its middle.
ON_THE_EARTH_PX = 4e-4 * 350


def project_in(folder):
    """A project whose frames show noise."""
    block = drone_block_files(SPEC, folder)
    folder.mkdir()
    for path in block.images.values():
        Image.effect_noise((SPEC.columns, SPEC.rows), 40.0).save(path)
    block.scene.write_text("")
    return block


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    block = project_in(tmp_path_factory.mktemp("drone") / "project")
    write_projects(SPEC, block)
    return block.folder


def largest_offset_px(scene):
    """Largest distance between positions in the frames of a scene and in those of the block, px."""
    worst = 0.0
    for view, exposure in zip(scene.views, drone_exposures(SPEC), strict=True):
        assert view.name == exposure.view.name
        xy = np.random.default_rng(0).uniform(0, [SPEC.columns, SPEC.rows], (50, 2))
        ground = exposure.sensor.ground_from_image(xy, np.full(len(xy), SPEC.middle_m))
        worst = max(worst, float(np.abs(view.sensor.image_from_ground(ground) - xy).max()))
    return worst


def test_colmap_and_an_offset_give_the_cameras_of_the_block(project):
    zone, numbers = (project / "odm_georeferencing" / "coords.txt").read_text().splitlines()
    assert zone == "WGS84 UTM 32N"
    offset = (*map(float, numbers.split()), 0.0)
    assert offset[:2] == offset_of(SPEC) == (462200.0, 5247300.0)
    request = ImportRequest("colmap", project, project / "colmap.yaml", crs="EPSG:32632", offset=offset)
    import_scene(request)
    assert largest_offset_px(open_scene([request.out])) < SAME_PX


def test_opensfm_has_their_place_on_the_earth(project):
    request = ImportRequest("opensfm", project, project / "odm.yaml")
    import_scene(request)
    scene = open_scene([request.out])
    assert scene.crs.to_epsg() == SPEC.epsg
    assert largest_offset_px(scene) < ON_THE_EARTH_PX


def test_the_images_lie_where_the_programs_have_them(project):
    assert not (project / "scene.yaml").exists()
    assert len(list((project / "images").glob("*.jpg"))) == SPEC.strips * SPEC.frames_per_strip


def test_a_rolling_shutter_is_refused(tmp_path):
    block = project_in(tmp_path / "project")
    with pytest.raises(ConfigError, match="no rolling shutter"):
        write_projects(small_drone_block_spec(3, readout_s=0.02), block)
    assert block.scene.exists()
