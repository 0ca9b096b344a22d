"""`zlocus export mesh`: walls look as they do, within two pixels, and files are valid."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio
import yaml
from pyproj import Transformer

from glb_files import check_valid, meshes
from rendered_scenes import CENTRE, UTM
from wall_scene import ACROSS_DEG, CELL_M, CELLS, GSD_M, HEIGHT_M, IMAGE, camera, displacements, write_scene
from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.export_request import ExportRequest
from zlocus.core.options import RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.io.crs import local_frame
from zlocus.pipeline import export_mesh
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.export import run_export
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.files import write_image

# Displacement of a wall's texture from its truth, in pixels of the images.
MOST_PX = 2.0
MOST_ON_LINE_PX = 0.5
# Values of the texture of what an image shows straight on, less the truth: interpolation, JPEG, and pixels' area.
TOP_RMS = 12.0
SAME_M = 1e-3


def exported(folder, out, **asked):
    images = tuple(folder / f"{name}.tif" for name in ACROSS_DEG)
    request = ExportRequest("mesh", (folder / "dsm.tif", *images), out, **asked)
    return run_export(request, SilentProgress())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wall")
    return folder, write_scene(folder / "scene")


@pytest.fixture(scope="module")
def mesh(scene):
    folder, _ = scene
    result = exported(folder / "scene", folder / "mesh")
    return folder / "mesh", result


def seen_at(read, points):
    """Texture values (n,) at points of a mesh, barycentric in the triangle that each lies in; NaN outside."""
    values = np.full(len(points), np.nan)
    grey = read.texture.mean(axis=2).astype(np.float32)
    for a, b, c in read.triangles:
        corners = read.xyz[[a, b, c]]
        near = np.flatnonzero(
            ((points >= corners.min(axis=0) - 1e-3) & (points <= corners.max(axis=0) + 1e-3)).all(axis=1)
        )
        if not len(near):
            continue
        design, wanted = np.vstack([corners.T, np.ones(3)]), np.vstack([points[near].T, np.ones(len(near))])
        weights, *_ = np.linalg.lstsq(design, wanted, rcond=None)
        inside = (weights >= -1e-6).all(axis=0)
        if not inside.any():
            continue
        at = ((weights[:, inside].T @ read.uv[[a, b, c]]) * grey.shape[::-1] - 0.5).astype(np.float32)
        looked_up = cv2.remap(grey, at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values[near[inside]] = looked_up.ravel()
    return values


def facade(out, textures):
    """The wall's texture in the mesh and its truth, (r, c) each, a value per pixel of the images, lowest row first.

    In each row of the surface the wall stands east of the last cell that is higher than half of it.
    """
    y, z = np.meshgrid(np.arange(-5.5, 5.5, GSD_M), np.arange(0.5, HEIGHT_M - 0.5, GSD_M))
    record, reads = meshes(out)
    with rasterio.open(record["surface"]) as file:
        is_high, transform = np.nan_to_num(file.read(1)) > HEIGHT_M / 2, file.transform
    row = np.floor((CENTRE[1] + y.ravel() - transform.f) / transform.e).astype(int)
    last = is_high.shape[1] - np.argmax(is_high[:, ::-1], axis=1)
    x = transform.c + last[row] * transform.a
    points = np.column_stack([x, CENTRE[1] + y.ravel(), z.ravel()]) - np.array(record["origin"])
    found = np.stack([seen_at(read, points) for read in reads])
    return np.nanmax(found, axis=0).reshape(y.shape), textures.wall(y, z)


def test_a_wall_looks_as_it_does(scene, mesh):
    found, truth = facade(mesh[0], scene[1])
    assert np.isfinite(found).all()
    away = displacements(found, truth)
    print(f"largest displacement of a wall on its line: {away.max():.3f} px")
    assert len(away) > 4
    assert away.max() < MOST_ON_LINE_PX
    assert np.corrcoef(found.ravel(), truth.ravel())[0, 1] > 0.9


def test_a_wall_beside_its_line_is_within_two_pixels(tmp_path):
    """A surface places a wall on the line between its cells, up to half a cell from where it stands."""
    textures = write_scene(tmp_path / "scene", 0.2)
    exported(tmp_path / "scene", tmp_path / "mesh")
    away = displacements(*facade(tmp_path / "mesh", textures))
    print(f"largest displacement of a wall beside its line: {away.max():.3f} px")
    assert away.max() < MOST_PX


def test_a_wall_of_a_matched_surface_is_within_two_pixels(tmp_path):
    """From the images alone: the surface is matched, and places the wall too."""
    textures = write_scene(tmp_path / "scene", 0.2)
    (tmp_path / "scene" / "dsm.tif").unlink()
    asked = {"crs": "EPSG:32632", "resolution": CELL_M, "heights": (-10.0, 35.0), "report": False, "products": ()}
    inputs = tuple(sorted((tmp_path / "scene").glob("*.tif")))
    run_dsm(DsmRequest(inputs, tmp_path / "surface", **asked), RunConfig(), SilentProgress())
    run_export(ExportRequest("mesh", (tmp_path / "surface",), tmp_path / "mesh"), SilentProgress())
    found, truth = facade(tmp_path / "mesh", textures)
    assert np.isfinite(found).all()
    away = displacements(found, truth)
    print(f"largest displacement of a wall of a matched surface: {away.max():.3f} px")
    assert away.max() < MOST_PX


def test_roof_and_ground_look_as_they_do(scene, mesh):
    record, (read,) = meshes(mesh[0])
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-12.0, 12.0, 0.5), np.arange(-6.0, 6.0, 0.5)))
    x += 0.26
    for is_roof in (True, False):
        mine = (x < -0.5) if is_roof else (x > 0.5)
        z = np.full(mine.sum(), HEIGHT_M if is_roof else 0.0)
        points = np.column_stack([CENTRE[0] + x[mine], CENTRE[1] + y[mine], z]) - np.array(record["origin"])
        look = scene[1].roof if is_roof else scene[1].ground
        error = seen_at(read, points) - look(x[mine], y[mine])
        assert np.sqrt((error**2).mean()) < TOP_RMS


def test_what_is_written(mesh):
    out, result = mesh
    record, (read,) = meshes(out)
    assert "1 tiles" in result.text
    assert record["files"] == ["tile_0_0.glb", "tileset.json"]
    assert record["cell_m"] == CELL_M
    assert record["texel_m"] == GSD_M
    assert record["tiles"][0]["walls"] == CELLS[0]
    assert record["tiles"][0]["faces_not_seen"] == 0
    extras = read.document["asset"]["extras"]
    assert extras["crs"] == "EPSG:32632"
    assert extras["origin"] == record["origin"]
    low, high = (end(read.xyz, axis=0) + np.array(record["origin"]) for end in (np.min, np.max))
    half = np.array([CELLS[1], CELLS[0]]) / 2 * CELL_M
    np.testing.assert_allclose(low, [*(np.array(CENTRE) - half), 0.0], atol=SAME_M)
    np.testing.assert_allclose(high, [*(np.array(CENTRE) + half), HEIGHT_M], atol=SAME_M)


def check_tileset(out):
    """Tiles lie on the Earth where the map has them, and inside the boxes of the tileset."""
    record, reads = meshes(out)
    tileset = json.loads((out / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    to_geographic = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    to_geocentric = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    for tile, child, read in zip(record["tiles"], tileset["root"]["children"], reads, strict=True):
        assert child["content"]["uri"] == tile["file"]
        matrix = np.array(child["transform"]).reshape(4, 4).T
        placed = (np.column_stack([read.xyz, np.ones(len(read.xyz))]) @ matrix.T)[:, :3]
        on_map = read.xyz + np.array(record["origin"])
        truth = np.column_stack(to_geocentric.transform(*to_geographic.transform(*on_map[:, :2].T), on_map[:, 2]))
        np.testing.assert_allclose(placed, truth, atol=SAME_M)
        for volume, points in ((tileset["root"], truth), (child, read.xyz)):
            box = volume["boundingVolume"]["box"]
            middle, axes = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
            assert (np.abs((points - middle) @ axes.T) / (axes**2).sum(axis=1)).max() < 1.0 + 1e-3


def test_the_files_are_valid(mesh):
    check_valid(sorted(mesh[0].glob("*.glb")))


def test_tiles_join_without_gaps(scene, mesh, tmp_path, monkeypatch):
    monkeypatch.setattr(export_mesh, "MIN_TILE_CELLS", 16)
    monkeypatch.setattr(export_mesh, "MAX_TILE_CELLS", 16)
    exported(scene[0] / "scene", tmp_path / "tiles")
    check_tileset(tmp_path / "tiles")
    record, several = meshes(tmp_path / "tiles")
    assert len(several) == 8
    _, (whole,) = meshes(mesh[0])

    def triangles(each):
        corners = np.round(each.xyz[each.triangles], 3) + 0.0
        return {tuple(sorted(map(tuple, corner))) for corner in corners.tolist()}

    assert set().union(*map(triangles, several)) == triangles(whole)
    assert sum(tile["walls"] for tile in record["tiles"]) == CELLS[0]


def test_a_part_with_larger_cells(scene, tmp_path):
    bounds = (CENTRE[0] - 6.0, CENTRE[1] - 4.0, CENTRE[0] + 6.0, CENTRE[1] + 4.0)
    exported(scene[0] / "scene", tmp_path / "part", bounds=bounds, resolution=1.0)
    record, (read,) = meshes(tmp_path / "part")
    size = np.ptp(read.xyz, axis=0)
    np.testing.assert_allclose(size, [12.0, 8.0, HEIGHT_M], atol=SAME_M)
    assert record["tiles"][0]["walls"] == 8


def test_a_mesh_in_a_local_frame(tmp_path):
    """It lies nowhere on the Earth, and has no transform to it."""
    z = np.zeros((20, 30), np.float32)
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "height": 20, "width": 30}
    transform = rasterio.Affine(0.5, 0.0, -7.5, 0.0, -0.5, 5.0)
    with rasterio.open(tmp_path / "dsm.tif", "w", **profile, crs=local_frame().to_wkt(), transform=transform) as file:
        file.write(z, 1)
    views = []
    for k, name in enumerate("ab"):
        pixels = np.random.default_rng(k).integers(80, 120, (150, 200)).astype(np.uint8)
        write_image(tmp_path / f"{name}.tif", pixels, None)
        frame_camera = {"kind": "frame", "focal": 200.0, "principal_point": [99.5, 74.5], "centre": [k, 0.0, 20.0]}
        views.append({"name": name, "image": f"{name}.tif", "camera": frame_camera | {"angles": [0.0, 0.0, 0.0]}})
    scene = {"schema": 1, "frame": {"local": True}, "views": views}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene))
    request = ExportRequest("mesh", (tmp_path / "dsm.tif", tmp_path / "scene.yaml"), tmp_path / "out")
    run_export(request, SilentProgress())
    record, (read,) = meshes(tmp_path / "out")
    assert record["crs"] is None
    assert record["tiles"][0]["faces_not_seen"] == 0
    assert read.texture.mean() == pytest.approx(100.0, abs=2.0)
    tileset = json.loads((tmp_path / "out" / "tileset.json").read_text())
    assert "transform" not in tileset["root"]["children"][0]


def test_a_tile_that_no_image_shows_is_grey(scene, tmp_path, monkeypatch):
    """And images that do not show a tile are not looked at."""
    monkeypatch.setattr(export_mesh, "MIN_TILE_CELLS", 16)
    monkeypatch.setattr(export_mesh, "MAX_TILE_CELLS", 16)
    sensor = replace(camera("above"), target=(CENTRE[0] - 40.0, CENTRE[1], 5.0))  # its image ends before the wall
    pixels = np.random.default_rng(3).integers(190, 211, IMAGE).astype(np.uint8)
    write_image(tmp_path / "beside.tif", pixels, fit_rpc(sensor, IMAGE, UTM, (-20.0, 60.0)).rpc)
    request = ExportRequest("mesh", (scene[0] / "scene" / "dsm.tif", tmp_path / "beside.tif"), tmp_path / "out")
    run_export(request, SilentProgress())
    record, reads = meshes(tmp_path / "out")
    shown = [read.texture[: read.texture.shape[0] // 2].mean() > 150 for read in reads]
    assert any(shown)
    assert not all(shown)
    for tile, read, is_shown in zip(record["tiles"], reads, shown, strict=True):
        if not is_shown:
            assert tile["faces_not_seen"] >= len(read.triangles) // 2
            assert read.texture.mean() == pytest.approx(128.0, abs=1.0)


def test_bad_input_is_refused(scene, tmp_path):
    folder, out = scene[0] / "scene", tmp_path / "out"
    request = ExportRequest("mesh", (folder / "dsm.tif", folder / "east.tif"), out)
    for wrong, error, said in (
        (replace(request, inputs=(folder / "dsm.tif",)), InputError, "raster without images"),
        (replace(request, inputs=(folder,)), InputError, "no run.json that tells its images"),
        (replace(request, inputs=(tmp_path,)), InputError, "neither a surface"),
        (replace(request, resolution=0.1), ConfigError, "finer than the surface"),
        (replace(request, bounds=(0.0, 0.0, 10.0, 10.0)), GeometryError, "no height inside --bounds"),
    ):
        with pytest.raises(error, match=said):
            run_export(wrong, SilentProgress())
        assert not out.exists()
