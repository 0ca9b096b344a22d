"""What a folder holds, where a surface is asked for."""

from __future__ import annotations

import warnings

import pytest

from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.core.requests import RUN_FILES
from zlocus.io.run_folder import OTHER_RESULTS, SURFACE_RASTERS, check_surface


def made(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


COMPLETE = (*SURFACE_RASTERS, "run.json")


def test_a_finished_surface_is_accepted(tmp_path):
    for names in (COMPLETE, (*COMPLETE, "finished.json"), (*COMPLETE, "finished.json", "tiles/manifest.json")):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_surface(made(tmp_path, *names))


def test_a_surface_whose_run_did_not_end_is_doubted(tmp_path):
    with pytest.warns(ZlocusWarning, match="did not come to its end: tiles failed"):
        check_surface(made(tmp_path, *COMPLETE, "tiles/manifest.json"))


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ((), r"holds no run: there is no dsm\.tif in it\. Give the folder that a finished"),
        (("tiles/manifest.json",), r"holds a run that has not finished; .* Give the same command again"),
        (("dsm.tif", "run.json", "tiles/manifest.json"), "holds a run that has not finished"),
        (("cloud.laz", "run.json"), r"holds a point cloud \(cloud\.laz, of `zlocus cloud`\) and no surface\. Give"),
        (("orientation.json", "run.json", "scene.yaml"), "holds tie points and corrected cameras"),
        (("demo.json",), "holds a demo, whose surface has not been finished"),
        (("dsm.tif", "run.json"), r"lacks sigma\.tif, quality\.tif, views\.tif, ortho\.tif, water\.tif of the surface"),
        (SURFACE_RASTERS, r"lacks run\.json"),
        (("inner/dsm.tif",), r"holds no surface, but .*inner may\. Give that folder"),
    ],
)
def test_what_a_folder_holds_instead_is_said(tmp_path, names, said):
    with pytest.raises(InputError, match=said):
        check_surface(made(tmp_path, *names))


def test_what_is_no_folder_is_said(tmp_path):
    with pytest.raises(InputError, match=r"There is no folder .*nowhere"):
        check_surface(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"dsm\.tif is a file\. Give the folder"):
        check_surface(made(tmp_path, "dsm.tif") / "dsm.tif")


def test_every_kind_of_result_is_known():
    """By the files with which a command recognises the result of another."""
    assert set(RUN_FILES) - {"run.json", "dsm.tif"} <= set(OTHER_RESULTS)
