"""Files of other programs for three cameras, and how each program projects: plain formulas of its own documents.

Every `write_*` makes a folder, complete with images, and returns how that program projects, in its own pixels.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass

import numpy as np
from pyproj import Transformer

from rpc_fixtures import write_image

WIDE, HIGH = 64, 48
NAMES = ("a.tif", "b 2.tif", "c.tif")
CENTRES = np.array([[0.0, 0.0, 100.0], [30.0, 5.0, 104.0], [10.0, -25.0, 97.0]])
ANGLES = ((1.0, -2.0, 5.0), (-3.0, 8.0, 170.0), (12.0, 1.0, -80.0))
GROUND = np.random.default_rng(0).uniform([-20, -20, -3], [30, 20, 3], (40, 3))
LLA = {"latitude": 47.3, "longitude": 8.6, "altitude": 432.0}
TANGENT = f"+proj=topocentric +ellps=WGS84 +lon_0={LLA['longitude']} +lat_0={LLA['latitude']} +h_0={LLA['altitude']}"
K1, K2, K3, K4, P1, P2 = -0.12, 0.04, -0.01, 0.002, 1e-3, -7e-4


@dataclass(frozen=True)
class Written:
    """A folder of a program. project : (camera, xyz (n, 3)) -> (n, 2) px of the program; first : its first pixel's
    centre; y_up : whether its y grows upwards."""

    folder: object
    project: object
    first: tuple[float, float]
    y_up: bool = False


def rotation(i):
    """Camera (right, down, forwards) from world, from the angles about x, y, z of an image with y up."""
    o, p, k = np.deg2rad(ANGLES[i])
    x = np.array([[1, 0, 0], [0, np.cos(o), -np.sin(o)], [0, np.sin(o), np.cos(o)]])
    y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    z = np.array([[np.cos(k), -np.sin(k), 0], [np.sin(k), np.cos(k), 0], [0, 0, 1]])
    return np.diag([1.0, -1.0, -1.0]) @ (x @ y @ z).T


def images(folder, names=NAMES):
    folder.mkdir(parents=True, exist_ok=True)
    pixels = np.arange(WIDE * HIGH, dtype=np.uint16).reshape(HIGH, WIDE)
    for name in names:
        write_image(folder / name, pixels)


def seen(i, xyz):
    """Positions at depth 1 in the camera, (n,) each."""
    x, y, z = camera_xyz(i, xyz)
    return x / z, y / z


def camera_xyz(i, xyz):
    return rotation(i) @ (np.asarray(xyz) - CENTRES[i]).T


def brown(x, y, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0):
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def equidistant(x, y, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    r = np.hypot(x, y)
    t = np.arctan(r)
    scale = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r
    return x * scale, y * scale


def quaternion(matrix):
    """w, x, y, z of a rotation matrix: the eigenvector of Bar-Itzhack's symmetric matrix."""
    m = matrix
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
        [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], np.trace(m)],
    ]) / 3.0  # fmt: skip
    _, vectors = np.linalg.eigh(k)
    x, y, z, w = vectors[:, -1]
    return np.array([w, x, y, z]) * np.copysign(1.0, w)


COLMAP = {
    "OPENCV": (4, [70.0, 71.0, 31.0, 25.5, K1, K2, P1, P2], lambda x, y: brown(x, y, K1, K2, P1, P2)),
    "SIMPLE_RADIAL": (2, [70.0, 31.0, 25.5, K1], lambda x, y: brown(x, y, K1)),
    "OPENCV_FISHEYE": (5, [70.0, 71.0, 31.0, 25.5, K1, K2, K3, K4], lambda x, y: equidistant(x, y, K1, K2, K3, K4)),
    "SIMPLE_PINHOLE": (0, [70.0, 31.0, 25.5], lambda x, y: (x, y)),
}


def write_colmap(folder, model="OPENCV", binary=False):
    number, values, lens = COLMAP[model]
    images(folder / "images")
    at = folder / "sparse" / "0"
    at.mkdir(parents=True)
    poses = [(quaternion(rotation(i)), -rotation(i) @ CENTRES[i]) for i in range(3)]
    if binary:
        cameras = struct.pack("<Q", 1) + struct.pack("<IiQQ", 7, number, WIDE, HIGH)
        (at / "cameras.bin").write_bytes(cameras + struct.pack(f"<{len(values)}d", *values))
        content = struct.pack("<Q", 3)
        for i, (q, t) in enumerate(poses):
            content += struct.pack("<I7dI", i + 1, *q, *t, 7) + NAMES[i].encode() + b"\0"
            content += struct.pack("<Q", i) + i * struct.pack("<ddQ", 1.0, 2.0, 2**64 - 1)
        (at / "images.bin").write_bytes(content)
    else:
        numbers = " ".join(map(repr, values))
        (at / "cameras.txt").write_text(f"# Number of cameras: 1\n7 {model} {WIDE} {HIGH} {numbers}\n")
        lines = ["# Image list", "# Number of images: 3, mean observations per image: 1"]
        for i, (q, t) in enumerate(poses):
            lines += [" ".join([str(i + 1), *map(repr, map(float, [*q, *t])), "7", NAMES[i]]), i * "1.0 2.0 -1 "]
        (at / "images.txt").write_text("\n".join(lines) + "\n")

    def project(i, xyz):
        x, y = lens(*seen(i, xyz))
        fx, fy, cx, cy = values[:4] if len(COLMAP[model][1]) > 4 else (values[0], *values[:3])
        return np.column_stack([fx * x + cx, fy * y + cy])

    return Written(folder, project, (0.5, 0.5))


def write_bundler(folder):
    images(folder, ["a.tif", "b.tif", "c.tif", "lost.tif"])
    focal = 70.0
    lines = ["# Bundle file v0.3", "4 1"]
    for i in range(3):
        up_backwards = np.diag([1.0, -1.0, -1.0]) @ rotation(i)
        rows = [[focal, K1, K2], *up_backwards.tolist(), (-up_backwards @ CENTRES[i]).tolist()]
        lines += [" ".join(map(repr, map(float, row))) for row in rows]
    lines += ["0 0 0"] * 5 + ["0 0 0", "255 255 255", "1 0 0 1.0 2.0"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("a.tif 0 69.0\nb.tif\nc.tif 0 69\nlost.tif\n")

    def project(i, xyz):
        p = np.diag([1.0, -1.0, -1.0]) @ camera_xyz(i, xyz)
        x, y = -p[0] / p[2], -p[1] / p[2]
        r2 = x * x + y * y
        return (focal * (1 + K1 * r2 + K2 * r2**2) * np.stack([x, y])).T

    return Written(folder, project, ((1 - WIDE) / 2, (HIGH - 1) / 2), y_up=True)


def write_eo(folder, heading=False, delimiter=" ", at=(0.0, 0.0, 0.0)):
    images(folder, ["a.tif", "b.tif", "c.tif"])
    lines = ["# an orientation"]
    if heading:
        lines.append(delimiter.join(["Omega", "Phi", "Kappa", "Label", "X", "Y", "Z"]))
    for i, name in enumerate("abc"):
        pose, angles = [repr(float(v)) for v in CENTRES[i] + at], [repr(v) for v in ANGLES[i]]
        lines.append(delimiter.join([*angles, name, *pose] if heading else [name, *pose, *angles]))
    (folder / "eo.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera.yaml").write_text(
        f"focal: [70.0, 71.0]\nprincipal_point: [30.5, 25.0]\ndistortion: {{kind: brown, k1: {K1}, p1: {P1}}}\n"
    )

    def project(i, xyz):
        x, y = brown(*seen(i, xyz), k1=K1, p1=P1)
        return np.column_stack([70.0 * x + 30.5, 71.0 * y + 25.0])

    return Written(folder, project, (0.0, 0.0))


OPENSFM = {
    "brown": ({"focal_x": 1.1, "focal_y": 1.12, "c_x": 0.01, "c_y": -0.02, "k1": K1, "k2": K2, "k3": K3, "p1": P1,
               "p2": P2}, lambda x, y: brown(x, y, K1, K2, P1, P2, K3)),
    "perspective": ({"focal": 1.1, "k1": K1, "k2": K2}, lambda x, y: brown(x, y, K1, K2)),
    "fisheye": ({"focal": 1.1, "k1": K1, "k2": K2}, lambda x, y: equidistant(x, y, K1, K2)),
    "fisheye_opencv": ({"focal_x": 1.1, "focal_y": 1.12, "c_x": 0.01, "c_y": -0.02, "k1": K1, "k2": K2, "k3": K3,
                        "k4": K4}, lambda x, y: equidistant(x, y, K1, K2, K3, K4)),
}  # fmt: skip


def write_opensfm(folder, projection="brown"):
    images(folder / "images")
    numbers, lens = OPENSFM[projection]
    camera = {"projection_type": projection, "width": WIDE, "height": HIGH, **numbers}
    shots = {}
    for i, name in enumerate(NAMES):
        q = quaternion(rotation(i))
        q = q if q[0] >= 0 else -q
        axis = 2 * np.arctan2(np.linalg.norm(q[1:]), q[0]) * q[1:] / np.linalg.norm(q[1:])
        shots[name] = {"rotation": axis.tolist(), "translation": (-rotation(i) @ CENTRES[i]).tolist(), "camera": "v2 x"}
    document = [{"cameras": {"v2 x": camera}, "shots": shots, "points": {}, "reference_lla": LLA}]
    (folder / "reconstruction.json").write_text(json.dumps(document, indent=1))

    def project(i, xyz):
        """Normalised: the centre of the image is 0, its larger side 1."""
        x, y = lens(*seen(i, xyz))
        fx = numbers.get("focal_x", numbers.get("focal"))
        fy = numbers.get("focal_y", numbers.get("focal"))
        return np.column_stack([fx * x + numbers.get("c_x", 0.0), fy * y + numbers.get("c_y", 0.0)]) * WIDE

    return Written(folder, project, ((1 - WIDE) / 2, (1 - HIGH) / 2))


METASHAPE = {
    "frame": "<k1>{K1}</k1><k2>{K2}</k2><k3>{K3}</k3><p1>{P1}</p1><p2>{P2}</p2>",
    "fisheye": "<k1>{K1}</k1><k2>{K2}</k2><k3>{K3}</k3><k4>{K4}</k4>",
}
SCALE = 2.5
TURN = rotation(1)


def write_metashape(folder, kind="frame", crs='GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",'
                    '6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'):  # fmt: skip
    """Chunk coordinates are those of GROUND, turned and shrunk; the world is geocentric, or GROUND without a CRS."""
    images(folder / "images")
    origin, axes = geocentric_origin() if crs else (np.zeros(3), np.eye(3))
    # world = origin + ground @ axes, and chunk = TURN @ ground / SCALE.
    world_from_chunk = axes.T @ TURN.T
    lens = METASHAPE[kind].format(**globals())
    cameras = ""
    for i, name in enumerate(NAMES):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = TURN @ rotation(i).T, TURN @ CENTRES[i] / SCALE
        cameras += (
            f'<camera id="{i}" sensor_id="0" component_id="0" label="{name.removesuffix(".tif")}">'
            f"<transform>{words(pose)}</transform><orientation>1</orientation></camera>"
        )
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="0" label="unknown" type="{kind}"><resolution width="{WIDE}" height="{HIGH}"/>
<calibration type="{kind}" class="initial"><resolution width="{WIDE}" height="{HIGH}"/><f>1.0</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="{WIDE}" height="{HIGH}"/><f>70.0</f><cx>-1.0</cx>
<cy>1.5</cy><b1>0.5</b1><b2>-0.25</b2>{lens}</calibration></sensor></sensors>
<components next_id="1"><component id="0" label="C"><transform><rotation locked="0">{words(world_from_chunk)}</rotation>
<translation locked="0">{words(origin)}</translation><scale locked="0">{SCALE}</scale></transform></component>
</components>
<cameras next_id="4">{cameras}<camera id="9" sensor_id="0" label="never aligned"/></cameras>
<reference>{crs}</reference></chunk></document>
"""
    (folder / "cameras.xml").write_text(text)

    def project(i, xyz):
        x, y = seen(i, xyz)
        if kind == "frame":
            r2 = x * x + y * y
            radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
            x, y = (
                x * radial + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y,
                y * radial + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y,
            )
        else:
            x, y = equidistant(x, y, K1, K2, K3, K4)
        return np.column_stack([WIDE * 0.5 - 1.0 + x * 70.0 + x * 0.5 + y * -0.25, HIGH * 0.5 + 1.5 + y * 70.0])

    return Written(folder, project, (0.5, 0.5))


def words(array):
    return " ".join(map(repr, map(float, np.ravel(array))))


def geocentric_origin():
    """Of the tangent frame at LLA: its origin (3,) and axes, rows, by PROJ."""
    to_world = Transformer.from_pipeline(f"+proj=pipeline +step +inv {TANGENT}")
    points = np.column_stack(to_world.transform(*np.vstack([np.zeros(3), 1e3 * np.eye(3)]).T))
    return points[0], (points[1:] - points[0]) / 1e3


def map_ground(xyz, epsg=32632):
    """Points of the tangent frame at LLA in the UTM zone, by PROJ's own chain."""
    utm = f"+proj=utm +zone={epsg % 100} +ellps=WGS84"
    chain = f"+proj=pipeline +step +inv {TANGENT} +step +inv +proj=cart +ellps=WGS84 +step {utm}"
    return np.column_stack(Transformer.from_pipeline(chain).transform(*np.asarray(xyz).T))
