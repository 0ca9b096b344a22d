"""A small valid file of every format that zlocus reads, its reader, and the values in it."""

from __future__ import annotations

import functools
import json
import math
import re
import struct
import tomllib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
import yaml
from odc.geo.geobox import GeoBox
from pydantic import BaseModel
from pyproj import CRS
from rasterio.transform import from_origin

import camera_files as files
from bundle_scenes import views_of
from csm_states import state
from flights import FOCAL_MM, INTERVAL_S
from geoids import write_geoid
from grid_input_files import write_polygons, write_raster
from location_grids import grid_of, written
from rpc_fixtures import dimap_dim, dimap_rpc, rpb, rpc_txt, satellite_rpc, write_image
from zlocus.core.options import RunConfig
from zlocus.core.requests import ImportRequest
from zlocus.evaluation.heights import read_heights
from zlocus.evaluation.truth import read_classes
from zlocus.io.cameras.csm import MODEL, read_csm
from zlocus.io.cameras.linescan_files import read_calibration, read_times, read_trajectory
from zlocus.io.cameras.location_grid import LocationGridCamera
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.config import config_as_dict, read_config, write_config
from zlocus.io.control_points import read_control
from zlocus.io.geoid import GeoidRaster
from zlocus.io.grid_inputs import read_dem, read_geobox, read_polygons
from zlocus.io.images import open_image
from zlocus.io.importers.scene import import_scene
from zlocus.io.run_record import read_record
from zlocus.io.scene_file import open_scene, read_scene_file
from zlocus.sensors.rpc import RpcModel

RPC = satellite_rpc()
PIXELS = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
GRID = GeoBox((20, 30), from_origin(700000, 4790400, 10.0, 10.0), "EPSG:32631")
DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
MAX_LEAVES = 10_000
Leaves = dict[tuple[Any, ...], Any]


def decimal(text: str) -> float | None:
    """As nearly all formats write a number."""
    return float(text) if DECIMAL.fullmatch(text) and np.isfinite(float(text)) else None


def toml_number(text: str) -> float | None:
    """TOML has numbers to other bases, and underscores in them."""
    try:
        found = tomllib.loads(f"x = {text}\n")["x"]
        return float(found) if type(found) in (int, float) and math.isfinite(found) else None
    except (tomllib.TOMLDecodeError, ValueError, OverflowError):
        return None


@dataclass(frozen=True)
class Case:
    """write : makes the file in a folder; read : what it says, as leaves by their place; text : whether it is text.

    exact : numbers of the file are handed over as they are, or moved by a constant. rows : a list that does not say how
    long it is, so that whole lines lost at its end leave a good file; defaults : what is lost with them has another
    value then. value : a number as the format writes it, None for what is none.
    """

    write: Callable[[Path], Path]
    read: Callable[[Path], Leaves]
    text: bool = True
    exact: bool = False
    rows: bool = False
    defaults: bool = False
    value: Callable[[str], float | None] = decimal


def leaves(value: Any, at: tuple[Any, ...] = ()) -> Leaves:
    """All numbers and words of a nested value by their place."""
    if isinstance(value, BaseModel):
        value = {key: getattr(value, key) for key in value.model_fields_set}
    elif is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in fields(value) if not f.name.startswith("_")}
    elif isinstance(value, np.ndarray):
        value = value.tolist() if value.size < MAX_LEAVES else value.tobytes()
    if isinstance(value, Mapping):
        return {k: v for key, each in value.items() for k, v in leaves(each, (*at, key)).items()}
    if isinstance(value, list | tuple):
        return {k: v for i, each in enumerate(value) for k, v in leaves(each, (*at, i)).items()}
    return {at: value}


def _rpc(name: str, text: Callable[..., str], **options: Any) -> Case:
    def write(folder: Path) -> Path:
        write_image(folder / "img.tif", PIXELS)
        (folder / name).write_text(text(RPC, **options))
        return folder / name

    return Case(write, lambda path: leaves(read_rpc(path.with_name("img.tif"))), exact=True)


def _write_dim(folder: Path) -> Path:
    write_image(folder / "IMG_X_R2C3.TIF", PIXELS)
    (folder / "RPC_X.XML").write_text(dimap_rpc(RPC))
    (folder / "DIM_X.XML").write_text(dimap_dim({"IMG_X_R1C1.TIF": (1, 1), "IMG_X_R2C3.TIF": (2, 3)}, (500, 400)))
    return folder / "DIM_X.XML"


def _read_dim(path: Path) -> Leaves:
    image = path.with_name("IMG_X_R2C3.TIF")
    named = leaves(read_rpc(image, path))
    assert named == leaves(read_rpc(image)), "found by itself, it says the same"
    return named


def _write_tag(folder: Path) -> Path:
    return write_image(folder / "tag.tif", PIXELS, RPC)


def _scene(frame: dict[str, Any], cameras: list[dict[str, Any]], **more: Any) -> Case:
    def write(folder: Path) -> Path:
        for i, name in enumerate("ab"):
            write_image(folder / f"{name}.tif", PIXELS, RPC.moved(column=-20000 - i, row=-20000))
        _write_scanner(folder)
        views = [{"name": f"v{i}", "image": f"{'ab'[i]}.tif", "camera": camera} for i, camera in enumerate(cameras)]
        document = {"schema": 1, "frame": frame, **more, "views": views}
        (folder / "scene.yaml").write_text("# a scene\n" + yaml.safe_dump(document, sort_keys=False))
        return folder / "scene.yaml"

    def read(path: Path) -> Leaves:
        scene = open_scene([path])
        for view in scene.views:
            seen = view.sensor.image_from_ground(np.array([[700000.0, 4790000.0, 100.0], [0.0, 1.0, 2.0]]))
            assert not np.isinf(seen).any()
        return leaves(read_scene_file(path))

    return Case(write, read, exact=True, rows=True)


FRAME = {
    "kind": "frame", "focal": [4200.5, 4201.5], "principal_point": [30.5, 22.25],
    "distortion": {"kind": "brown", "k1": -0.2125, "k2": 0.0925, "p1": 8.0e-4},
    "centre": [700120.5, 4790230.25, 1450.75], "angles": [0.25, -1.125, 92.5],
}  # fmt: skip
FISHEYE = {
    "kind": "frame", "focal": 70.5, "principal_point": [30.5, 22.25], "centre": [0.5, 1.5, 100.25],
    "distortion": {"kind": "fisheye", "k1": -0.0125}, "rotation": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
    "skew": 0.125,
}  # fmt: skip
SCANNER = {
    "kind": "linescan", "calibration": "plane.csv", "line": "nadir", "focal_mm": FOCAL_MM, "trajectory": "path.csv",
    "rays": "frame", "times": {"start": 0.0, "interval": INTERVAL_S}, "lever_arm": [0.125, 0.25, 0.5],
    "boresight": [0.125, 0.25, 0.5],
    "rectification": {"height": 450.5, "transform": [0.5, 0.0, 700000.5, 0.0, -0.5, 4790400.5], "rows": 48},
}  # fmt: skip


def _write_scanner(folder: Path) -> dict[str, Path]:
    lines = (("nadir", 2.25), ("aft", -9.5))
    columns = [f"{line},{i},{-20.5 + 0.0625 * i!r},{y!r}" for line, y in lines for i in range(64)]
    flight = np.array([-1.0, 700100.5, 4790300.5, 2450.25, 0.125, 0.25, 2.5])
    step = np.array([0.25, 40.0, 0.5, 0.125, 0.0, 0.015625, 0.0])
    path = [",".join(map(repr, (flight + i * step).tolist())) for i in range(14)]
    tables = {
        "plane.csv": ["line,column,x_mm,y_mm", *columns],
        "path.csv": ["# a flight", "time,x,y,z,omega,phi,kappa", *path],
        "times.csv": ["row;time", *(f"{i};{0.5 + 0.125 * i!r}" for i in range(-2, 50, 4))],
    }
    for name, lines in tables.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    return {name: folder / name for name in tables}


def _scanner(name: str, read: Callable[[Path], Any], exact: bool, rows: bool) -> Case:
    return Case(lambda folder: _write_scanner(folder)[name], lambda path: leaves(read(path)), exact=exact, rows=rows)


def _trajectory(path: Path) -> Any:
    found = read_trajectory(path, None, "frame", np.zeros(3), np.zeros(3))
    return [[t, *c, *r.ravel()] for t, c, r in zip(found.times, found.centres, found.rotations, strict=True)]


def _times(path: Path) -> Any:
    found = read_times(path, 40)
    return np.column_stack([found.rows, found.times])


def _write_csm(folder: Path) -> Path:
    (folder / "state.json").write_text(f"{MODEL}\n{json.dumps(state(pieces=True, distortion=(1e-4, 2e-5, -1e-6)))}")
    return folder / "state.json"


def _read_csm(path: Path) -> Leaves:
    found = read_csm(path)
    return leaves({"lines": found.lines, "line": found.line, "times": found.trajectory.times, "shape": found.shape,
                   "centres": found.trajectory.centres, "rotations": found.trajectory.rotations})  # fmt: skip


CONTROL = """# surveyed in June
name,x,y,z,sigma,sigma_z,role,image,column,row
gcp1,500000.25,5200000.5,431.125,0.02,0.04,control,view0,10.5,20.25
gcp1,500000.25,5200000.5,431.125,0.02,0.04,control,view1.tif,11.5,21.25
gcp2,500010.25,5200100.5,433.125,0.02,0.04,control,view0,40.5,21.75
chk7,500100.0,5200100.0,440.0,0.02,0.04,check,view0,50.125,60.5
chk7,500100.0,5200100.0,440.0,0.02,0.04,check,view1,51.125,61.25
"""


@functools.cache
def _views() -> Any:
    return views_of([None, None], (100, 80))


def _write_control(folder: Path) -> Path:
    (folder / "control.csv").write_text(CONTROL)
    return folder / "control.csv"


def _read_control(path: Path) -> Leaves:
    control = read_control(path, _views())
    points = {
        name: [control.xyz[i], np.nan_to_num(control.sigma_m[i], nan=-1.0), control.is_check[i]]
        for i, name in enumerate(control.names)
    }
    rows = control.observations
    positions = {
        (control.names[point], int(view)): xy for view, point, xy in zip(rows.view, rows.point, rows.xy, strict=True)
    }
    return leaves({"points": points, "seen": positions})


def _write_toml(folder: Path) -> Path:
    """A few options of every type, as a user would keep them."""
    lines = [line for line in write_config(RunConfig()).splitlines() if line and not line.startswith("#")]
    (folder / "config.toml").write_text("# options\n" + "\n".join(lines) + "\n")
    return folder / "config.toml"


def _write_config_yaml(folder: Path) -> Path:
    (folder / "config.yaml").write_text("# options\n" + yaml.safe_dump(config_as_dict(RunConfig()), sort_keys=False))
    return folder / "config.yaml"


def _read_config(path: Path) -> Leaves:
    return leaves(config_as_dict(read_config(path)))


def _import(kind: str, write: Callable[[Path], Any], name: str, rows: bool = False, defaults: bool = False) -> Case:
    def made(folder: Path) -> Path:
        return write(folder / "p").folder / name

    def read(path: Path) -> Leaves:
        folder = next(parent for parent in path.parents if parent.name == "p")
        options = {"camera": folder / "camera.yaml"} if kind == "eo" else {}
        request = ImportRequest(kind, folder, folder / "scene.yaml", overwrite=True, **options)
        found: Leaves = {}
        for view in import_scene(request).views:
            pose = {"centre": view.camera.centre, "rotation": view.camera.rotation}  # type: ignore[attr-defined]
            inner = view.camera.model_dump(exclude={"centre", "rotation"})
            found |= leaves({f"pose {view.image}": pose, "interior": {view.image: inner}})
        return found

    return Case(made, read, text="bin" not in name, rows=rows, defaults=defaults)


def _picture(suffix: str, **profile: Any) -> Case:
    def write(folder: Path) -> Path:
        rng = np.random.default_rng(1)
        pixels = rng.integers(0, 255, (96, 80)).astype(np.uint8)
        return write_image(folder / f"image{suffix}", pixels, **profile)

    return Case(write, _read_image, text=False)


def _read_image(path: Path) -> Leaves:
    image = open_image(path)
    rows, cols = (min(n, 200) for n in image.shape)
    window = image.read(0, 0, rows, cols)
    return {("shape",): image.shape, ("pixels",): window.pixels.tobytes(), ("valid",): window.valid.tobytes()}


def _write_dem(folder: Path) -> Path:
    rng = np.random.default_rng(2)
    heights = rng.normal(300.0, 20.0, (60, 70)).astype(np.float32)
    return write_raster(
        folder / "dem.tif", heights, from_origin(699900, 4790500, 10.0, 10.0), "EPSG:32631", compress="deflate"
    )


def _read_surface(path: Path) -> Leaves:
    found = read_heights(path)
    return {("z",): found.z.tobytes(), ("transform",): tuple(found.transform), ("crs",): str(found.crs)}


def _write_posts(folder: Path) -> Path:
    posts = np.linspace(40.0, 50.0, 13 * 9, dtype=np.float32).reshape(13, 9)
    return write_geoid(folder / "geoid.tif", posts, from_origin(4.5, 44.5, 0.25, 0.25), compress="deflate")


def _write_location_grid(folder: Path) -> Path:
    write_image(folder / "img.tif", PIXELS)
    utm = CRS.from_epsg(32631)
    location_grid = grid_of(RpcModel(RPC, utm), utm, (0.0, 400.0, 900.0), (-1.0, -1.0), (35.0, 13.0), (5, 3))
    return written(folder / "grid.tif", location_grid, "LG_", compress="deflate")


def _read_location_grid(path: Path) -> Leaves:
    camera = LocationGridCamera(file=path.name)
    sensor = camera.read(path.parent, path.with_name("img.tif")).sensor(CRS.from_epsg(32631))
    xy = np.array([[0.0, 0.0], [60.0, 40.0]])
    return leaves(sensor.ground_from_image(xy, np.array([100.0, 700.0])))


def _write_gtx(folder: Path) -> Path:
    """Posts of a GTX file, the first in the south-west. Source: NOAA, "VDatum GTX file format"."""
    posts = np.linspace(40.0, 50.0, 13 * 9, dtype=">f4").reshape(13, 9)
    path = folder / "geoid.gtx"
    path.write_bytes(struct.pack(">4d2i", 41.5, 4.5, 0.25, 0.25, *posts.shape) + posts.tobytes())
    return path


def _read_geoid(path: Path) -> Leaves:
    at = np.array([[5.0, 43.0], [5.3, 42.2], [6.1, 43.9]])
    return leaves(GeoidRaster.open(path).undulation(at, CRS.from_epsg(4326)))


def _write_classes(folder: Path) -> Path:
    _write_dem(folder)
    classes = np.random.default_rng(4).integers(0, 4, (60, 70)).astype(np.uint8)
    return write_raster(folder / "classes.tif", classes, from_origin(699900, 4790500, 10.0, 10.0), "EPSG:32631")


def _read_classes(path: Path) -> Leaves:
    return {("classes",): read_classes(path, read_heights(path.with_name("dem.tif"))).tobytes()}


def _write_colours(folder: Path) -> Path:
    pixels = np.random.default_rng(3).integers(0, 255, (3, 40, 50)).astype(np.uint8)
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        folder / "colours.tif", "w", driver="GTiff", height=40, width=50, count=3, dtype="uint8", photometric="RGB",
        compress="lzw",
    ) as file:  # fmt: skip
        file.write(pixels)
    return folder / "colours.tif"


def _read_colours(path: Path) -> Leaves:
    image = open_image(path)
    size = [min(n, 200) for n in image.shape]
    bands = image.colours(0, 0, *size).tobytes() if image.has_colours else b""
    return {("bands",): bands, **_read_image(path)}


RECORD = {"schema": 2, "grid": {"crs": "EPSG:32631", "shape": [12, 13]}, "stages": [{"name": "open", "wall_s": 0.25}]}


def _write_record(folder: Path) -> Path:
    (folder / "run.json").write_text(json.dumps(RECORD, indent=2) + "\n")
    return folder / "run.json"


def _vector(name: str, **options: Any) -> Case:
    def write(folder: Path) -> Path:
        rings = [shapely.box(700010, 4790210, 700110, 4790310), shapely.box(700150, 4790250, 700250, 4790390)]
        return write_polygons(folder / name, rings, **options)

    def read(path: Path) -> Leaves:
        found = read_polygons(path, GRID.crs.proj)
        return {(i,): shapely.to_wkt(polygon) for i, polygon in enumerate(found)}

    return Case(write, read, text=name.endswith("json"))


CASES: dict[str, Case] = {
    "rpc-txt": _rpc("img_RPC.TXT", rpc_txt),
    "rpb": _rpc("img.RPB", rpb),
    "dimap-2": _rpc("RPC_img.XML", dimap_rpc),
    "dimap-3": _rpc("RPC_img.XML", dimap_rpc, version=3, first_pixel=0.5),
    "dimap-dim": Case(_write_dim, _read_dim),
    "rpc-tag": Case(_write_tag, lambda path: leaves(read_rpc(path)), text=False),
    "scene-rpc": _scene(
        {"crs": "EPSG:32631"},
        [{"kind": "rpc", "shift": [0.5, -1.25]}, {"kind": "rpc", "file": "a.tif"}],
        area={"bounds": [700000.5, 4790000.5, 700500.25, 4790500.25]},
        heights=[0.5, 400.25],
    ),
    "scene-frame": _scene({"crs": "EPSG:32631"}, [FRAME, FRAME | {"earth": "curved", "crs": "EPSG:32631"}]),
    "scene-local": _scene({"local": True, "up": [0.0, 0.5, 1.0]}, [FISHEYE, FISHEYE]),
    "scene-linescan": _scene({"crs": "EPSG:32631"}, [SCANNER, SCANNER | {"line": "aft"}]),
    "calibration": _scanner("plane.csv", lambda path: read_calibration(path, "nadir", FOCAL_MM).xy_mm, True, True),
    "trajectory": _scanner("path.csv", _trajectory, False, True),
    "times": _scanner("times.csv", _times, False, True),
    "csm": Case(_write_csm, _read_csm),
    "control": Case(_write_control, _read_control, rows=True),
    "config-toml": Case(_write_toml, _read_config, exact=True, rows=True, value=toml_number),
    "config-yaml": Case(_write_config_yaml, _read_config, exact=True, rows=True),
    "colmap-text-cameras": _import("colmap", files.write_colmap, "sparse/0/cameras.txt"),
    "colmap-text-images": _import("colmap", files.write_colmap, "sparse/0/images.txt"),
    "colmap-binary-cameras": _import("colmap", lambda f: files.write_colmap(f, binary=True), "sparse/0/cameras.bin"),
    "colmap-binary-images": _import("colmap", lambda f: files.write_colmap(f, binary=True), "sparse/0/images.bin"),
    "opensfm": _import("opensfm", files.write_opensfm, "reconstruction.json"),
    "metashape": _import("metashape", files.write_metashape, "cameras.xml"),
    "bundler": _import("bundler", files.write_bundler, "bundle.out"),
    "bundler-list": _import("bundler", files.write_bundler, "list.txt"),
    "eo": _import("eo", files.write_eo, "eo.csv", rows=True),
    "eo-interior": _import("eo", files.write_eo, "camera.yaml", rows=True, defaults=True),
    "image-tiff": _picture(".tif", tiled=True, blockxsize=32, blockysize=32),
    "image-deflate": _picture(".tif", compress="deflate", blockysize=16),
    "image-envi": _picture(".img", driver="ENVI"),
    "image-png": _picture(".png", driver="PNG"),
    "image-jpeg": _picture(".jpg", driver="JPEG"),
    "dem": Case(_write_dem, lambda path: {("z",): read_dem(path, GRID).tobytes()}, text=False),
    "like": Case(_write_dem, lambda path: {("grid",): str(read_geobox(path))}, text=False),
    "geoid-tif": Case(_write_posts, _read_geoid, text=False),
    "location-grid": Case(_write_location_grid, _read_location_grid, text=False),
    "geoid-gtx": Case(_write_gtx, _read_geoid, text=False),
    "classes": Case(_write_classes, _read_classes, text=False),
    "image-colours": Case(_write_colours, _read_colours, text=False),
    "record": Case(_write_record, lambda path: leaves(read_record(path)), exact=True),
    "surface": Case(_write_dem, _read_surface, text=False),
    "area-geojson": _vector("area.geojson", driver="GeoJSON"),
    "area-gpkg": _vector("area.gpkg", driver="GPKG"),
}
