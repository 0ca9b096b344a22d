"""A building with a textured wall, seen by exact satellites: images and surface, and the true look of the wall."""

from __future__ import annotations

import cv2
import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter, map_coordinates

from rendered_scenes import CENTRE, UTM
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.files import write_image

HEIGHT_M, GSD_M, CELL_M = 20.0, 0.25, 0.5
# Cells of the surface; the wall stands in their middle, and its outer side looks to the east.
CELLS = (28, 56)
IMAGE = (120, 260)
# Angles to the side from which the satellites look: two from the east, one from the west, one from above.
ACROSS_DEG = {"east": -32.0, "far_east": -45.0, "above": -2.0, "west": 25.0}
# Of an image "between" them, which is not written.
BETWEEN_DEG = -38.0
# Texels of the textures, m.
TEXEL_M = 0.2
# Side of the windows in which two pictures are compared, px.
WINDOW_TEXELS = 32


class Textures:
    """Grey values of ground, roof and wall by two coordinates in m."""

    def __init__(self):
        rng = np.random.default_rng(11)
        fields = [gaussian_filter(rng.normal(size=(600, 600)), 2.2) for _ in range(3)]
        self.fields = [110.0 + 45.0 * field / field.std() for field in fields]

    def value(self, which, along, up):
        at = np.stack([300.0 + np.asarray(up) / TEXEL_M, 300.0 + np.asarray(along) / TEXEL_M])
        return map_coordinates(self.fields[which], at, order=3, mode="mirror")

    def ground(self, x, y):
        return self.value(0, x, y)

    def roof(self, x, y):
        return self.value(1, x, y)

    def wall(self, along, up):
        return self.value(2, along, up)


def displacements(found, truth):
    """Displacements of windows of one picture against another, px."""
    size, shifts = WINDOW_TEXELS, []
    window = cv2.createHanningWindow((size, size), cv2.CV_32F)
    for row in range(0, found.shape[0] - size + 1, size // 4):
        for col in range(0, found.shape[1] - size + 1, size // 4):
            parts = [np.asarray(each[row : row + size, col : col + size], np.float32) for each in (found, truth)]
            parts = [part - part.mean() for part in parts]
            shifts.append(cv2.phaseCorrelate(*parts, window)[0])
    return np.hypot(*np.array(shifts).T)


def camera(name):
    return SatelliteCamera((*CENTRE, 5.0), (129.5, 59.5), GSD_M, 3.0, ACROSS_DEG.get(name, BETWEEN_DEG))


def rendered(name, wall_x, textures, samples=2):
    """What a satellite sees, (r, c) uint8: the mean of rays through each pixel. wall_x : m east of the middle."""
    sensor, total = camera(name), np.zeros(IMAGE)
    row, col = np.indices(IMAGE).astype(float)
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    for down in steps:
        for right in steps:
            xy = np.column_stack([(col + right).ravel(), (row + down).ravel()])
            low, high = (
                sensor.ground_from_image(xy, np.full(len(xy), z))[:, :2] - CENTRE for z in (0.0, HEIGHT_M)
            )  # fmt: skip
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (wall_x - low[:, 0]) / (high[:, 0] - low[:, 0])
            along = low[:, 1] + share * (high[:, 1] - low[:, 1])
            on_roof = high[:, 0] < wall_x
            on_wall = ~on_roof & (low[:, 0] < wall_x)
            values = textures.ground(*low.T)
            values[on_roof] = textures.roof(*high[on_roof].T)
            values[on_wall] = textures.wall(along[on_wall], share[on_wall] * HEIGHT_M)
            total += values.reshape(IMAGE)
    return np.clip(np.rint(total / samples**2), 1, 255).astype(np.uint8)  # 0 is no value


def true_heights(name, wall_x):
    """Height (r, c) m of what each pixel of an image shows."""
    row, col = np.indices(IMAGE).astype(float)
    xy = np.column_stack([col.ravel(), row.ravel()])
    low, high = (camera(name).ground_from_image(xy, np.full(len(xy), z))[:, 0] - CENTRE[0] for z in (0.0, HEIGHT_M))
    with np.errstate(divide="ignore", invalid="ignore"):
        on_wall = (wall_x - low) / (high - low) * HEIGHT_M
    return np.where(high < wall_x, HEIGHT_M, np.where(low < wall_x, on_wall, 0.0)).reshape(IMAGE)


def write_scene(folder, wall_x=0.0):
    """Write the images and the surface dsm.tif into a folder, and return the textures. wall_x : m east of the line
    between two cells; cells have the height at their middle."""
    folder.mkdir(parents=True, exist_ok=True)
    textures = Textures()
    for name in ACROSS_DEG:
        pixels = rendered(name, wall_x, textures)
        write_image(folder / f"{name}.tif", pixels, fit_rpc(camera(name), IMAGE, UTM, (-20.0, 60.0)).rpc)
    rows, cols = CELLS
    west, north = CENTRE[0] - cols / 2 * CELL_M, CENTRE[1] + rows / 2 * CELL_M
    x = west - CENTRE[0] + (np.arange(cols) + 0.5) * CELL_M
    z = np.broadcast_to(np.where(x < wall_x, HEIGHT_M, 0.0), CELLS).astype(np.float32)
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "height": rows, "width": cols, "crs": "EPSG:32632"}
    transform = rasterio.Affine(CELL_M, 0.0, west, 0.0, -CELL_M, north)
    with rasterio.open(folder / "dsm.tif", "w", **profile, transform=transform, nodata=np.nan) as file:
        file.write(z, 1)
    return textures
