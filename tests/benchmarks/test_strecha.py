"""Camera files of the benchmark of Strecha et al.: projected as the benchmark does, and damaged ones refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import camera_files as files
import strecha
from benchmark_scripts import run_script
from strecha import write_strecha_scene
from zlocus.core.errors import InputError
from zlocus.io.scene_file import open_scene

SAME_PX = 1e-6


def write_strecha(folder):
    files.images(folder / "images", ["a.tif", "b.tif", "c.tif"])
    for i, name in enumerate(("a.tif", "b.tif", "c.tif")):
        rows = [
            [70.0, 0.1, 31.0],
            [0.0, 71.0, 25.5],
            [0.0, 0.0, 1.0],
            [0.0] * 3,
            *files.rotation(i).T.tolist(),
            files.CENTRES[i],
        ]
        text = "\n".join(" ".join(map(repr, map(float, row))) for row in rows)
        (folder / f"{name}.camera").write_text(f"{text}\n{files.WIDE} {files.HIGH}\n")

    def project(i, xyz):
        x, y = files.seen(i, xyz)
        return np.column_stack([70.0 * x + 0.1 * y + 31.0, 71.0 * y + 25.5])

    return files.Written(folder, project, (0.0, 0.0))


def opened(folder, **options):
    write_strecha_scene(folder, folder / "scene.yaml", **options)
    return open_scene([folder / "scene.yaml"])


def test_projects_as_the_benchmark_does(tmp_path):
    written = write_strecha(tmp_path / "p")
    scene = opened(written.folder)
    assert len(scene.views) == 3
    assert scene.crs.is_engineering
    for i, view in enumerate(scene.views):
        expected = written.project(i, files.GROUND)
        np.testing.assert_allclose(view.sensor.image_from_ground(files.GROUND), expected, rtol=0, atol=SAME_PX)


def test_the_script_writes_the_scene_turned_to_its_up(tmp_path, monkeypatch):
    folder, out = write_strecha(tmp_path / "p").folder, tmp_path / "scene.yaml"
    run_script(monkeypatch, strecha, folder, "--up", 1, 2, -3, "-o", out)
    up = np.array([1.0, 2.0, -3.0]) / np.sqrt(14.0)
    for plain, turned in zip(opened(folder).views, open_scene([out]).views, strict=True):
        rotation = turned.sensor.rotation.T @ plain.sensor.rotation
        np.testing.assert_allclose(rotation @ up, [0.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("0.0 0.0 0.0", "0.1 0.0 0.0", "has a distortion"),
        ("0.0 0.0 1.0", "0.0 0.0 2.0", "no calibration matrix"),
        ("\n64 48", "", "has 8 lines, not 9"),
    ],
)
def test_a_damaged_camera_file_is_named(tmp_path, old, new, says):
    folder = write_strecha(tmp_path / "p").folder
    path = folder / "a.tif.camera"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=says):
        write_strecha_scene(folder, folder / "scene.yaml")
    assert not (folder / "scene.yaml").exists()


def test_a_folder_without_camera_files_is_refused(tmp_path):
    with pytest.raises(InputError, match="Give a folder"):
        write_strecha_scene(tmp_path, tmp_path / "scene.yaml")


def test_the_facade_stands_upright(shared_data, tmp_path):
    """Rays of shared points meet; what is `up` lies towards the cameras."""
    folder, out = shared_data / "herzjesu_p8", tmp_path / "scene.yaml"
    write_strecha_scene(folder, out, up=(-1.0, 0.0, 0.0))
    scene = open_scene([out])
    assert len(scene.views) == 8
    # All look down on the facade.
    assert all(view.sensor.rotation[2, 2] < -0.5 for view in scene.views)
    sift = cv2.SIFT_create(1500)
    found = {}
    for view in scene.views[3:5]:
        pixels = view.image.read(0, 0, *view.image.shape).pixels.astype(np.uint8)
        keys, found[view.name] = sift.detectAndCompute(cv2.resize(pixels, None, fx=0.5, fy=0.5), None)
        found[view.name] = (2.0 * np.array([key.pt for key in keys]) + 0.5, found[view.name])
    (here, one), (there, other) = found.values()
    pairs = [(m.queryIdx, m.trainIdx) for m, n in cv2.BFMatcher().knnMatch(one, other, k=2)
             if m.distance < 0.7 * n.distance]  # fmt: skip
    here, there = here[[i for i, _ in pairs]], there[[j for _, j in pairs]]
    first, second = (view.sensor for view in scene.views[3:5])
    rays = first.ray_from_image(here), second.ray_from_image(there)
    base = np.array(second.centre) - np.array(first.centre)
    normal = np.cross(rays[0], rays[1])
    # Distance of the rays in pixels of the depth at which they meet.
    gap = np.abs(normal @ base) / np.linalg.norm(normal, axis=1)
    depth = np.linalg.norm(np.cross(base, rays[1]), axis=1) / np.linalg.norm(normal, axis=1)
    assert len(pairs) > 100
    assert np.median(gap / depth * first.focal) < 1.0
