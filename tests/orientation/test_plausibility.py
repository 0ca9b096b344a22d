"""Images that no tie supports, and cameras that are exchanged or far off, are named, corrected or left out."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
import rasterio

from rendered_scenes import HEIGHTS, RenderedImages, errors_of, rendered, run
from zlocus.core.errors import CoverageError
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest
from zlocus.io.scene_file import open_scene
from zlocus.orientation.orientation import orient
from zlocus.orientation.plausibility import (
    MAX_USUAL_RESIDUAL_PX,
    MAX_USUAL_SHIFT_PX,
    agreeing_shares,
    contradicting_views,
    doubts_about,
    exchanged_views,
    untied_images,
)
from zlocus.orientation.shift_adjustment import shifts_with_most_images_in_place
from zlocus.orientation.tie_points import first_ground_points
from zlocus.orientation.triangulate import Observations
from zlocus.pipeline.dsm import run_dsm

# A height that is off by more counts as a blunder; and the share of blunders that a good surface may have.
BLUNDER_M, FEW = 3.0, 0.002


def rewritten(path, to, pixels=None, rpc_of=None):
    """A copy of an image with other pixels, or with the camera of another image."""
    with rasterio.open(path) as source:
        found, rpc = source.read(1), source.rpcs
    if rpc_of is not None:
        with rasterio.open(rpc_of) as source:
            rpc = source.rpcs
    pixels = found if pixels is None else pixels
    profile = {"driver": "GTiff", "height": pixels.shape[0], "width": pixels.shape[1], "count": 1, "nodata": 0}
    with rasterio.open(to, "w", dtype=pixels.dtype, rpcs=rpc, **profile) as file:
        file.write(pixels, 1)
    return to


def noise_like(path, to):
    with rasterio.open(path) as source:
        shape = source.shape
    return rewritten(path, to, np.random.default_rng(1).integers(100, 3000, shape).astype(np.uint16))


def matched(paths, out, **asked):
    """Run on these images; what was said, and the error it ended with, if any."""
    said, failed = io.StringIO(), None
    request = DsmRequest(
        inputs=tuple(paths), out=out, crs="EPSG:32632", resolution=0.5, report=False, products=(), **asked
    )
    try:
        run_dsm(request, RunConfig(), progress_for(said))
    except CoverageError as error:
        failed = str(error)
    return said.getvalue(), failed


def blunders(out, kind="sine"):
    """Share of the heights that are off by more than BLUNDER_M, and share of the cells seen by all that have one."""
    error, seen = errors_of(out, kind)
    known = np.isfinite(error)
    return float((np.abs(error[known]) > BLUNDER_M).mean()), float(known[seen].mean())


def test_noise_beside_one_image_is_never_matched(images, tmp_path):
    scene = images("sine").paths
    said, failed = matched([scene["nadir"], noise_like(scene["fore"], tmp_path / "noise.tif")], tmp_path / "out",
                           heights=HEIGHTS)  # fmt: skip
    assert failed is not None
    assert "No two images are held together by tie points" in failed
    assert "noise takes no part" in said
    assert not (tmp_path / "out").exists()


def test_noise_beside_two_images_takes_no_part(images, tmp_path):
    scene = images("sine").paths
    noise = noise_like(scene["aft"], tmp_path / "noise.tif")
    said, failed = matched([scene["nadir"], scene["fore"], noise], tmp_path / "out", heights=HEIGHTS)
    assert failed is None
    assert "noise takes no part: no tie point" in said
    wrong, filled = blunders(tmp_path / "out")
    assert wrong < FEW
    assert filled > 0.95
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert list(record["orientation"]["excluded_images"]) == ["noise"]
    with rasterio.open(tmp_path / "out" / "views.tif") as file:
        assert file.read(1).max() == 2


def test_an_image_far_off_is_found_corrected_and_named(tmp_path):
    """Farther off than twice the error that is looked for, along and across its loci."""
    scene = rendered(tmp_path / "in", "sine", {"aft": (41.0, -63.0)})
    said, failed = matched(scene.inputs, tmp_path / "out")
    assert failed is None
    assert "aft: its camera pointed 75 px off and was corrected" in said
    record = json.loads((tmp_path / "out" / "run.json").read_text())["orientation"]["views"]
    np.testing.assert_allclose(record["aft"]["shift_px"], (-41.0, 63.0), atol=0.3)
    for name in ("nadir", "fore"):
        np.testing.assert_allclose(record[name]["shift_px"], (0.0, 0.0), atol=0.3)
    wrong, filled = blunders(tmp_path / "out")
    assert wrong < FEW
    assert filled > 0.95


def test_exchanged_cameras_of_three_images_end_with_a_sentence(images, tmp_path):
    scene = images("sine").paths
    one = rewritten(scene["nadir"], tmp_path / "one.tif", rpc_of=scene["fore"])
    other = rewritten(scene["fore"], tmp_path / "other.tif", rpc_of=scene["nadir"])
    said, failed = matched([one, other, scene["aft"]], tmp_path / "out", heights=HEIGHTS)
    assert failed is not None
    assert "The cameras of one and other seem to be exchanged" in failed
    assert "seem to be exchanged" in said
    assert (tmp_path / "out" / "dsm.tif").exists()
    doubts = json.loads((tmp_path / "out" / "run.json").read_text())["orientation"]["doubts"]
    assert any(doubt["is_grave"] for doubt in doubts)
    _, failed = matched([one, other, scene["aft"]], tmp_path / "out", heights=HEIGHTS, partial=True, overwrite=True)
    assert failed is None


def test_ties_far_from_the_dem_end_with_a_sentence(images, tmp_path):
    low = tmp_path / "dem.tif"
    profile = {"driver": "GTiff", "height": 90, "width": 90, "count": 1, "crs": "EPSG:32632"}
    transform = rasterio.transform.from_origin(462_000 - 135, 5_247_000 + 135, 3.0, 3.0)
    with rasterio.open(low, "w", dtype="float32", transform=transform, **profile) as file:
        file.write(np.full((90, 90), -60.0, np.float32), 1)
    said, failed = matched(images("sine").inputs, tmp_path / "out", dem=low, dem_vertical="ellipsoid", partial=True)
    assert "The tie points lie +1" in said
    assert "dem.tif" in said
    assert failed is None


def observations(counts):
    """Observations of views, so many each."""
    view = np.repeat(np.arange(len(counts)), counts)
    return Observations(view, np.arange(len(view)), np.zeros((len(view), 2)))


def test_views_with_few_ties_are_untied():
    np.testing.assert_array_equal(untied_images(observations([5, 3, 0, 4]), 4), [False, True, True, False])


def test_views_that_keep_few_of_their_ties_contradict():
    class Kept:
        observations = observations([90, 40, 0, 20])

    shares = agreeing_shares(observations([100, 100, 0, 100]), Kept, 4)
    np.testing.assert_allclose(shares, [0.9, 0.4, 1.0, 0.2])
    np.testing.assert_array_equal(contradicting_views(shares), [3, 1])


class Sensor:
    def height_bounds(self):
        return (0.0, 100.0)


class View:
    def __init__(self, name):
        self.name, self.sensor = name, Sensor()


@pytest.mark.parametrize(
    ("residual", "shift", "outside", "said"),
    [
        (MAX_USUAL_RESIDUAL_PX / 2, 3.0, 0, []),
        (2 * MAX_USUAL_RESIDUAL_PX, 3.0, 0, ["still lie 0.60 px off"]),
        (0.1, 2 * MAX_USUAL_SHIFT_PX, 0, ["pointed 120 px off"]),
        (0.1, 3.0, 5, ["5 of 205 tie points lie at heights of 50 to 130 m, outside the 0 to 100 m"]),
        (0.1, 3.0, 1, []),
    ],
)
def test_what_is_doubtful(residual, shift, outside, said):
    heights = np.concatenate([np.full(200, 50.0), np.full(outside, 130.0)])
    found = doubts_about([View("a"), View("b")], [0.1, residual], [(0.0, 0.0), (shift, 0.0)], heights)
    assert len(found) == len(said)
    for doubt, part in zip(found, said, strict=True):
        assert part in doubt.sentence
        assert doubt.is_grave == (outside > 0)


def test_cameras_that_nobody_corrected_are_not_said_to_be_off_after_a_correction():
    off = doubts_about([View("a")], [2.0], [(0.0, 0.0)], np.full(9, 50.0), is_corrected=False)
    (sentence,) = (doubt.sentence for doubt in off)
    assert sentence.startswith("a: its tie points lie 2.00 px off with the camera as delivered (median)")
    assert "after the correction" not in sentence


def test_one_image_far_off_does_not_move_the_others():
    """Four images that a translation of the ground moves in different directions; the third is off by 200 px."""
    rng = np.random.default_rng(2)
    basis, _ = np.linalg.qr(rng.normal(size=(8, 3)))
    true = np.zeros((4, 2))
    true[2] = (-150.0, 130.0)
    drawn = (true.ravel() - basis @ (basis.T @ true.ravel())).reshape(4, 2)
    assert np.hypot(*drawn.T)[[0, 1, 3]].max() > 10.0
    tied = np.ones(4, bool)
    np.testing.assert_allclose(shifts_with_most_images_in_place(drawn, basis, tied, 2), true, atol=0.1)


def test_cameras_of_their_own_are_not_called_exchanged(images):
    scene = open_scene(list(images("sine").inputs))
    found = orient(scene, OrientationOptions())
    xyz = first_ground_points(scene, found.refined_ties.ties)
    sensors = [view.sensor for view in scene.views]
    assert exchanged_views(sensors, found.refined_ties.observations, xyz, range(3), OrientationOptions()) is None
    wrong = [sensors[1], sensors[0], sensors[2]]
    assert exchanged_views(wrong, found.refined_ties.observations, xyz, range(3), OrientationOptions()) == (0, 1)


def test_good_images_raise_no_doubt(images, tmp_path):
    scene: RenderedImages = images("sine")
    out = run(scene, tmp_path / "out", report=False, products=()).out
    orientation = json.loads((out / "run.json").read_text())["orientation"]
    assert orientation["excluded_images"] == {}
    assert orientation["doubts"] == []
