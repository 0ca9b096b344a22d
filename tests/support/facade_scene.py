"""A wall photographed from the side: rendered images, and their cameras as a text model of COLMAP."""

from __future__ import annotations

import numpy as np

from camera_files import quaternion
from rendered_scenes import QUIET
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.files import write_image
from zlocus.synthetic.render import Sun, expose, render
from zlocus.synthetic.terrain import analytic_ground

# The wall stands at z = 50 with waves of 3, x along it and y up it; cameras stand 25 to 34 before it, to one side of
# what they look at.
KIND, CELL_M, MIDDLE = "sine", 0.08, (0.0, 0.0)
SHAPE, FOCAL = (180, 240), 230.0
STATIONS = ((-16.0, -3.0, 75.0), (-11.5, -2.5, 78.0), (-7.0, -3.2, 81.0), (-2.5, -2.8, 84.0))
AIMS = ((-5.0, 0.5), (-3.0, 0.2), (-1.0, 0.4), (1.0, 0.0))
# Out of the wall and up it, in the axes of the camera files, whose y is down as in images.
OUT, ALONG = np.array([0.6, 0.0, -0.8]), np.array([0.0, -1.0, 0.0])


def axes_of_wall(out, along):
    """The wall's axes as columns (3, 3), from its directions outwards and upwards in the axes of the camera files."""
    out, along = (np.asarray(each, float) / np.linalg.norm(each) for each in (out, along))
    return np.column_stack([np.cross(along, out), along, out])


FILE_FROM_WALL = axes_of_wall(OUT, ALONG)


def facing(station, aim):
    """A camera that stands upright and looks at a point of the wall."""
    forwards = np.array([*aim, 50.0]) - station
    forwards /= np.linalg.norm(forwards)
    right = np.cross(forwards, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    principal_point = ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    return FrameModel(tuple(station), np.stack([right, np.cross(forwards, right), forwards]), FOCAL, principal_point)


def photographed(folder, kind, file_from_wall=FILE_FROM_WALL):
    """Render the wall into a folder of images with a COLMAP model, and return the folder.

    file_from_wall : (3, 3), columns are the wall's axes (along it, up it, out of it) in those of the camera files.
    """
    ground = analytic_ground(kind, MIDDLE, CELL_M, (1400, 1400), seed=8)
    (folder / "images").mkdir(parents=True)
    u, v = ((n - 1) / 2 + 0.5 for n in SHAPE[::-1])  # COLMAP's (0.5, 0.5) is the centre of the first pixel
    (folder / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE {SHAPE[1]} {SHAPE[0]} {FOCAL} {u} {v}\n")
    lines = []
    for number, (station, aim) in enumerate(zip(STATIONS, AIMS, strict=True)):
        model = facing(np.array(station), aim)
        grey = expose(render(ground, model, SHAPE, Sun(150.0, 50.0)), QUIET, np.random.default_rng([8, number]))
        write_image(folder / "images" / f"{number}.tif", grey, None)
        rotation = model.camera_from_ground @ file_from_wall.T
        pose = [*quaternion(rotation), *(-rotation @ (file_from_wall @ np.array(station)))]
        lines += [" ".join([str(number + 1), *(repr(float(value)) for value in pose), "1", f"{number}.tif"]), ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder
