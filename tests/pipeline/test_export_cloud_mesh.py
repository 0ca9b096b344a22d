"""`zlocus export mesh` of a cloud: walls look as they do within two pixels, tiles fit, memory is that of a tile."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio

from glb_files import check_valid, meshes
from mesh_pictures import picture
from rendered_scenes import CENTRE, UTM
from wall_scene import ACROSS_DEG, HEIGHT_M, IMAGE, camera, displacements, rendered, true_heights, write_scene
from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.export_request import ExportRequest
from zlocus.core.progress import SilentProgress
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import ELLIPSOIDAL
from zlocus.pipeline import export_cloud_mesh
from zlocus.pipeline.export_cloud_mesh import export_cloud_mesh as export
from zlocus.pipeline.opened_cloud import OpenedCloud
from zlocus.products.cloud_maps import ImageMap

# East of the middle; the wall stands at no node of the lattice.
WALL_M = 0.2
# Noise of the heights of the maps, and share of the wall's pixels that have none, in blocks.
NOISE_M, LOST = 0.15, 0.5
MOST_PX = 2.0
# Values of the picture less the truth: interpolation, JPEG, pixels' area, and edges.
MOST_RMS = 14.0
SAME_M = 1e-3
AROUND_WALL = (CENTRE[0] - 5.0, CENTRE[1] - 13.5, CENTRE[0] + 5.0, CENTRE[1] + 13.5)
PART = (CENTRE[0] - 8.0, CENTRE[1] - 7.0, CENTRE[0] + 8.0, CENTRE[1] + 7.0)


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A cloud of the wall scene whose maps are the truth with noise and gaps."""
    folder, rng = tmp_path_factory.mktemp("cloud"), np.random.default_rng(5)
    textures = write_scene(folder / "scene", WALL_M)
    views = open_scene([folder / "scene" / f"{name}.tif" for name in ACROSS_DEG], UTM).views
    image_maps = []
    for view in views:
        z = true_heights(view.name, WALL_M)
        lost = (z > 0) & (z < HEIGHT_M) & (rng.random((IMAGE[0] // 4, IMAGE[1])).repeat(4, axis=0) < LOST)
        z = np.where(lost, np.nan, z + NOISE_M * rng.standard_normal(IMAGE)).astype(np.float32)
        paths = [folder / f"{view.name}_{of}.tif" for of in ("height", "quality")]
        for path, band in zip(paths, (z, np.zeros(IMAGE, np.uint16)), strict=True):
            profile = {"driver": "GTiff", "dtype": band.dtype, "count": 1, "height": IMAGE[0], "width": IMAGE[1]}
            with rasterio.open(path, "w", **profile, transform=rasterio.Affine.scale(2.0)) as file:
                file.write(band, 1)
        image_maps.append(ImageMap(view, *paths, False, ELLIPSOIDAL, UTM))
    with pytest.MonkeyPatch.context() as patch:
        cloud = OpenedCloud(folder, UTM, image_maps, [0.1] * len(image_maps))
        patch.setattr(export_cloud_mesh, "open_cloud", lambda folder, progress: cloud)
        yield folder, textures


def exported(opened, out, **asked):
    return export(ExportRequest("mesh", (opened[0],), out, **asked), SilentProgress())


@pytest.fixture(scope="module")
def mesh(opened, tmp_path_factory):
    out = tmp_path_factory.mktemp("mesh") / "out"
    return out, *exported(opened, out, bounds=AROUND_WALL)


def test_a_new_image_shows_the_wall_where_it_is(opened, mesh):
    found = picture(mesh[0], camera("between"), IMAGE, lambda ground: ground[:, 2])
    truth = rendered("between", WALL_M, opened[1]).astype(float)
    z = true_heights("between", WALL_M)
    cols = np.nonzero((z > 0) & (z < HEIGHT_M))[1]
    part = slice(8, -8), slice(cols.min(), cols.max() + 1)
    assert np.isfinite(found[part]).mean() > 0.99
    wall = np.where(np.isfinite(found), found, 128.0)[part]
    away = displacements(wall, truth[part])
    error = np.nan_to_num(found - truth)[8:-8]
    print(f"largest displacement of a wall: {away.max():.3f} px, RMS of values {np.sqrt((error**2).mean()):.2f}")
    assert len(away) > 4
    assert away.max() < MOST_PX
    assert np.sqrt((error**2).mean()) < MOST_RMS


def test_the_wall_is_geometry(mesh):
    record, reads = meshes(mesh[0])
    cell_m = record["cell_m"]
    points = np.concatenate([read.xyz for read in reads]) + np.array(record["origin"])
    inner = np.abs(points[:, 1] - CENTRE[1]) < 6.0
    on_wall = inner & (points[:, 2] > 3 * cell_m) & (points[:, 2] < HEIGHT_M - 3 * cell_m)
    x = points[on_wall, 0] - CENTRE[0] - WALL_M
    x = x[np.abs(x) < 4 * cell_m]  # dust apart
    assert len(x) > 0.9 * (HEIGHT_M / cell_m - 6) * (12.0 / cell_m)
    assert np.abs(np.median(x)) < 0.5 * cell_m
    assert np.sqrt((x**2).mean()) < cell_m
    assert sum(tile["walls"] for tile in record["tiles"]) > 1000
    assert record["tiles"][0]["file"] == "tile_0_0.glb"
    assert mesh[1].startswith(str(mesh[0] / "tileset.json"))
    unseen = sum(tile["faces_not_seen"] for tile in record["tiles"])
    assert unseen < 0.05 * sum(tile["triangles"] for tile in record["tiles"])  # beyond the borders of images


def test_the_files_are_valid(mesh):
    check_valid(sorted(mesh[0].glob("*.glb")))


def triangles(out):
    """Corners (n, 9) m of all triangles of a mesh, sorted."""
    record, reads = meshes(out)
    corners = [(read.xyz[read.triangles] + np.array(record["origin"])).reshape(-1, 9) for read in reads]
    found = np.concatenate(corners)
    return found[np.lexsort(np.rint(found.T / (10 * SAME_M)))]


def test_tiles_fit_and_need_the_memory_of_one(opened, tmp_path, monkeypatch):
    asked = {"bounds": PART, "resolution": 0.6}
    shapes, areas, read, fused = [], [], ImageMap.read, export_cloud_mesh.fused

    def counted_read(self, window, stride=1):
        areas.append(window.rows * window.cols)
        return read(self, window, stride)

    def counted_fused(range_maps, cube, band_m):
        shapes.append(cube.shape)
        return fused(range_maps, cube, band_m)

    monkeypatch.setattr(ImageMap, "read", counted_read)
    monkeypatch.setattr(export_cloud_mesh, "fused", counted_fused)
    exported(opened, tmp_path / "whole", **asked)
    assert len(shapes) == 1
    of_whole = np.mean(areas[-len(ACROSS_DEG) :])
    shapes.clear()
    monkeypatch.setattr(export_cloud_mesh, "MIN_TILE_NODES", 16)
    monkeypatch.setattr(export_cloud_mesh, "MAX_NODES", 32 * 32 * 64)
    exported(opened, tmp_path / "tiles", **asked)
    assert len(shapes) >= 4
    assert max(np.prod(shape) for shape in shapes) <= 32 * 32 * 64
    assert np.mean(areas[-len(shapes) * len(ACROSS_DEG) :]) < 0.75 * of_whole
    one, other = (triangles(tmp_path / name) for name in ("whole", "tiles"))
    low, high = (end(one.reshape(-1, 3), axis=0) for end in (np.min, np.max))
    assert (low[:2] > np.array(PART[:2]) - 1.0).all()
    assert (high[:2] < np.array(PART[2:]) + 1.0).all()
    assert len(one) == len(other)
    middles = [np.sort(each.reshape(-1, 3, 3).mean(axis=1), axis=0) for each in (one, other)]
    np.testing.assert_allclose(*middles, atol=SAME_M)


def test_bad_input_is_refused(opened, tmp_path):
    folder, out = opened[0], tmp_path / "out"
    for asked, error, said in (
        ({"inputs": (folder, folder / "scene" / "east.tif")}, InputError, "is a cloud, which tells its images"),
        ({"jump": 1.0}, ConfigError, "--jump says nothing"),
        ({"bounds": (0.0, 0.0, 10.0, 10.0)}, GeometryError, "no height inside --bounds"),
    ):
        with pytest.raises(error, match=said):
            export(ExportRequest(**{"kind": "mesh", "inputs": (folder,), "out": out} | asked), SilentProgress())
        assert not out.exists()
