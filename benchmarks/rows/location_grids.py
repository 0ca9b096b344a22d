"""Row of the acceptance table on the physical model of a line scanner, given as location grids, beside its RPC."""

from __future__ import annotations

import numpy as np
import yaml

from workplace import COVERAGE_SHORT, ZLOCUS, Figure, Workplace, run
from zlocus.evaluation.heights import read_heights
from zlocus.io.scene_file import open_scene

# The file of each image's grid, and the column and row of the full image at which the image was cut out.
GRIDS = {
    "img_01": ("GRID_PHR1B_P_201308051042194_SEN_690908101-001.tif", [5000, 5000]),
    "img_02": ("GRID_PHR1B_P_201308051042523_SEN_690908101-002.tif", [4915, 5162]),
}
# Of the ground, m, with room for all relief around it.
HEIGHTS_M = (0.0, 2000.0)
N_POINTS = 20_000
CLOSE_M = 0.1


def ventoux_grid(workplace: Workplace) -> list[Figure]:
    """The Pleiades pair with the location grids of its physical model, against the same pair with its RPC."""
    folder = workplace.scene("pleiades_pair_ventoux")
    workplace.out.mkdir(parents=True, exist_ok=True)
    scene_file = workplace.out / "location_grids.yaml"
    views = []
    for name, (file, first_pixel) in GRIDS.items():
        grid = str(folder / "physical_model_grids" / file)
        camera = {"kind": "location_grid", "file": grid, "first_pixel": first_pixel}
        views.append({"name": name, "image": str(folder / f"{name}.tif"), "camera": camera})
    scene_file.write_text(yaml.safe_dump({"schema": 1, "views": views}))
    images = [folder / f"{name}.tif" for name in GRIDS]
    surfaces = []
    for camera_name, inputs in (("rpc", images), ("grid", [scene_file])):
        out = workplace.out / camera_name
        run([ZLOCUS, "dsm", *inputs, "-o", out, "--overwrite"], accept=(0, COVERAGE_SHORT))
        surfaces.append(read_heights(out / "dsm.tif"))
    rpc, grid_surface = surfaces
    row, col = np.nonzero(np.isfinite(rpc.z))
    difference = grid_surface.nearest(np.column_stack(rpc.transform * (col + 0.5, row + 0.5))) - rpc.z[row, col]
    both = difference[np.isfinite(difference)]
    distance = distances_px(open_scene([scene_file]), open_scene(images))
    return [
        Figure(
            "image positions, grid less RPC, largest", float(distance.max()), "px", at_most=0.01,
            fails_when="nodes are taken for other pixels, or interpolated wrongly",
        ),
        Figure("image positions, grid less RPC, RMS", float(np.sqrt(np.mean(distance**2))), "px"),
        Figure(
            "cells of the RPC filled with grids", float(np.isfinite(difference).mean()), at_least=0.99,
            fails_when="images with a location grid are tied or matched in another way",
        ),
        Figure("height with grids less with RPC, median", float(np.median(both)), "m"),
        Figure("height with grids less with RPC, NMAD", 1.4826 * float(np.median(np.abs(both - np.median(both)))), "m"),
        Figure(
            "heights with both within 0.1 m", float((np.abs(both) <= CLOSE_M).mean()), at_least=0.95,
            fails_when="the location grid is not the camera of which the RPC was made",
        ),
    ]  # fmt: skip


def distances_px(scene, other_scene) -> np.ndarray:
    """Distances (n,) px of the image positions of both cameras of each image, of ground all over the image."""
    rng, found = np.random.default_rng(1), []
    for view, other_view in zip(scene.views, other_scene.views, strict=True):
        xy = rng.uniform(-0.5, np.array(view.image.shape[::-1]) - 0.5, (N_POINTS, 2))
        xyz = view.sensor.ground_from_image(xy, rng.uniform(*HEIGHTS_M, N_POINTS))
        found.append(np.hypot(*(other_view.sensor.image_from_ground(xyz) - xy).T))
    return np.concatenate(found)
