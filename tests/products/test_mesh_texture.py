"""Textures of meshes: where faces lie in them, and which image each part of a wall is taken from."""

from __future__ import annotations

import numpy as np
from affine import Affine

from rendered_scenes import CENTRE
from rpc_fixtures import write_image
from wall_scene import CELL_M, IMAGE, camera
from zlocus.io.images import open_image
from zlocus.products import mesh_texture
from zlocus.products.exported_images import shown_bands
from zlocus.products.mesh_geometry import surface_mesh
from zlocus.products.mesh_sight import SurfaceWindow
from zlocus.products.mesh_texture import TextureImage, TextureLayout

SHAPE, MARGIN = (12, 40), 20
TOWER_M, BLOCK_M = 20.0, 10.0


def surface(with_block):
    """A tower in the west, in the middle of which its wall stands, and perhaps a block two metres before it."""
    z = np.zeros((SHAPE[0] + 2 * MARGIN, SHAPE[1] + 2 * MARGIN))
    z[:, : MARGIN + 20] = TOWER_M
    if with_block:
        z[:, MARGIN + 24 : MARGIN + 30] = BLOCK_M
    transform = Affine(CELL_M, 0.0, CENTRE[0] - 20 * CELL_M, 0.0, -CELL_M, CENTRE[1] + SHAPE[0] / 2 * CELL_M)
    inner = z[MARGIN - 1 : MARGIN + SHAPE[0] + 1, MARGIN - 1 : MARGIN + SHAPE[1] + 1]
    return surface_mesh(inner, 1.0), SurfaceWindow(z, MARGIN, MARGIN, transform)


def images_of(folder, *names):
    pixels = np.random.default_rng(0).integers(10, 200, IMAGE).astype(np.uint8)
    write_image(folder / "a.tif", pixels)
    bands = shown_bands(open_image(folder / "a.tif"))
    return [TextureImage(camera(name), bands, (0.0, 255.0)) for name in names]


def test_the_part_of_a_wall_that_is_hidden_is_not_textured(tmp_path):
    images = images_of(tmp_path, "east", "above", "west")
    for with_block in (False, True):
        (_, walls), window = surface(with_block)
        is_tower = (walls.outlines[:, :, 0] == 20.0).all(axis=1)
        n = mesh_texture.WALL_PARTS
        outlines, outwards = (np.repeat(each, n, axis=0) for each in (walls.outlines, walls.outwards))
        samples = mesh_texture._wall_samples(walls)
        best = mesh_texture.best_image(images, outlines, samples, outwards, window).reshape(-1, n)[is_tower]
        assert len(best) == SHAPE[0]
        # At 32 degrees the block hides the wall up to 6.8 m.
        np.testing.assert_array_equal(best, np.broadcast_to([-1 if with_block else 0, 0, 0, 0], best.shape))


def test_faces_do_not_overlap_in_the_texture(monkeypatch):
    (patches, walls), _ = surface(True)
    for most_rows in (10_000, 100):
        monkeypatch.setattr(mesh_texture, "MAX_TEXTURE_ROWS", most_rows)
        layout = TextureLayout.of(SHAPE, walls, 3, CELL_M)
        assert layout.shape[0] <= most_rows
        used = np.zeros(layout.shape, int)
        used[: SHAPE[0] * 3, : SHAPE[1] * 3] += 1
        for (left, top), rows in zip(layout.first, layout.wall_rows, strict=True):
            used[top - 1 : top + rows + 1, left - 1 : left + 4] += 1
        assert used.max() == 1
        assert used.sum() == SHAPE[0] * SHAPE[1] * 9 + ((layout.wall_rows + 2) * 5).sum()
        uv = layout.wall_corners()
        assert (uv > 0.0).all()
        assert (uv < 1.0).all()
        assert layout.patch_corners(patches).min() == 0.0
