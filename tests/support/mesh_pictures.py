"""Pictures of a written mesh as a camera sees it, by plain steps."""

from __future__ import annotations

import cv2
import numpy as np

from glb_files import meshes

# Points along the sides of a triangle for each pixel that it is long.
POINTS_PER_PX = 3.0
# Points so much farther than the nearest one of their pixel belong to the same surface.
FRONT_M = 0.5


def picture(out, sensor, shape, nearness):
    """Grey values (r, c) of a mesh in a folder as a sensor sees it; NaN where it shows none of it.

    nearness : of ground points (n, 3), larger where nearer to the camera.
    """
    record, reads = meshes(out)
    places, nears, values = [], [], []
    for read in reads:
        ground = read.xyz.astype(float) + np.array(record["origin"])
        xy = sensor.image_from_ground(ground)
        sides = np.linalg.norm(xy[read.triangles] - np.roll(xy[read.triangles], 1, axis=1), axis=2).max(axis=1)
        n = int(np.ceil(POINTS_PER_PX * np.quantile(sides, 0.99))) + 1
        a, b = (v.ravel() for v in np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n))
        weights = np.stack([a, b, 1 - a - b])[:, a + b <= 1.0]
        uv = np.einsum("tkc,kw->twc", read.uv[read.triangles], weights).reshape(-1, 2)
        at = (uv * read.texture.shape[1::-1] - 0.5).astype(np.float32)
        grey = read.texture.mean(axis=2).astype(np.float32)
        rows = np.array_split(at, -(-len(at) // 30000))  # a picture may not be higher than this
        values += [
            cv2.remap(grey, *r.T[..., None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel() for r in rows
        ]
        places.append(np.einsum("tkc,kw->twc", xy[read.triangles], weights).reshape(-1, 2))
        nears.append(np.einsum("tk,kw->tw", nearness(ground)[read.triangles], weights).ravel())
    place, near, value = np.rint(np.concatenate(places)).astype(int), np.concatenate(nears), np.concatenate(values)
    inside = ((place >= 0) & (place < [shape[1], shape[0]])).all(axis=1)
    place, near, value = place[inside], near[inside], value[inside]
    pixel = place[:, 1] * shape[1] + place[:, 0]
    # Of all points in a pixel the mean of those near the nearest one counts.
    nearest = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(nearest, pixel, near)
    front = near >= nearest[pixel] - FRONT_M
    count = np.bincount(pixel[front], minlength=shape[0] * shape[1])
    total = np.bincount(pixel[front], value[front], shape[0] * shape[1])
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)
