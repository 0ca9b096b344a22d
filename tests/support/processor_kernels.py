"""Digest of what a few kernels compute, printed by `python processor_kernels.py`: two processors should print the same.

They are those that the positions in the images and the grey values there come from, in single and double precision:
whatever rounds otherwise on another processor shows in them. Each compiles in a second or two.
"""

from __future__ import annotations

import hashlib

import numpy as np

from kernel_scene import kernel_scene
from rendered_scenes import CENTRE, UTM, camera
from zlocus.matching.kernels.resample import (
    block_grid,
    block_velocity,
    flat_cells,
    image_of,
    resample_plane,
    resample_scratch,
)
from zlocus.matching.kernels.spline import spline_coefficients
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.rpc import RpcModel
from zlocus.sensors.rpc_fit import fit_rpc


def digest() -> str:
    """SHA-256 of the results."""
    found, rng = hashlib.sha256(), np.random.default_rng(3)
    scene = kernel_scene(is_bent=True)
    for view in range(scene.n_views):
        found.update(spline_coefficients(scene.images[view]).tobytes())
        for b, d, rows, cols in scene.blocks():
            relief = rng.uniform(-1, 1, (rows.stop - rows.start, cols.stop - cols.start)).astype(np.float32)
            views, cells = scene.of_block(b, d), flat_cells(*relief.shape)
            grid, velocity = block_grid(views, view, 0.37, 0), block_velocity(views, view, 0.37)
            out, scratch = np.empty(relief.size, np.float32), resample_scratch(100)
            resample_plane(image_of(scene.arrays, view), grid, velocity, cells, relief.ravel(), scratch, out)
            found.update(out.tobytes())
    xyz = np.array([*CENTRE, 50.0]) + rng.uniform(-30, 30, (500, 3))
    axes = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
    lens = BrownDistortion(k1=-0.05, p1=0.001)
    frame = FrameModel((*CENTRE, 500.0), axes, 900.0, (500.0, 400.0), distortion=lens)
    for sensor in (frame, RpcModel(fit_rpc(camera("fore"), (150, 150), UTM, (0.0, 120.0)).rpc, UTM)):
        found.update(sensor.image_from_ground(xyz).tobytes())
    return found.hexdigest()


if __name__ == "__main__":
    print(digest())
