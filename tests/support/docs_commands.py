"""Commands of the documents: where they stand, and the files that they name."""

from __future__ import annotations

import json
import re
import shutil
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
import typer.main
from pyogrio.raw import write as write_vector
from pyproj import Transformer
from rasterio.transform import from_origin
from scipy.spatial.transform import Rotation

import camera_files
import made_up_deliveries as deliveries
from facade_scene import axes_of_wall, photographed
from geoids import write_geoid, write_proj_grid
from grid_input_files import write_water
from overlapping_surfaces import CORNER, town, two_runs, write_raster, write_run
from places import ROOT
from point_files import cloud, csv
from rendered_scenes import CENTRE, GSD_M, QUIET, UTM, rendered
from zlocus.cli.app import app
from zlocus.io.open_raster import open_raster
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import KNOWN_GEOIDS
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.files import write_image
from zlocus.synthetic.render import Sun, expose, render
from zlocus.synthetic.terrain import analytic_ground, analytic_height

# Every page that a reader may be sent to, the notebooks aside.
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md"), ROOT / "benchmarks" / "README.md"])
# Those whose commands are run; the examples of the others have tests of their own.
PAGES_WITH_COMMANDS = [page for page in PAGES if page.name not in ("contributing.md", "paper_figures.md")]
PROGRAMS = ("zlocus", "python", "make", "printf")
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```|((?:^ {4}[^\n]*\n)+)", re.DOTALL | re.MULTILINE)
# Where a user's own grids of PROJ lie, below a page's folder.
PROJ_GRIDS = "proj"
INLINE = re.compile(r"`((?:zlocus|python -m zlocus\.synthetic|make) [^`]+)`")


@dataclass(frozen=True)
class Step:
    """One thing that a page tells the reader to do. is_python : a block of Python, else a line for the shell."""

    text: str
    is_python: bool = False


def name_of(page: Path) -> str:
    """The path of a page from the root of the repository; the name alone of a page that lies elsewhere."""
    return page.relative_to(ROOT).as_posix() if page.is_relative_to(ROOT) else page.name


def steps_of(page: Path) -> list[Step]:
    """Commands and Python of a page's blocks, in their order."""
    found = []
    for block in BLOCK.finditer(page.read_text(encoding="utf-8")):
        language, fenced, indented = block.groups()
        if language == "python":
            found.append(Step(fenced, is_python=True))
            continue
        lines = [line.partition("  #")[0].strip() for line in (indented if fenced is None else fenced).splitlines()]
        lines = [line for line in lines if line]
        if language in ("", None) and lines and lines[0].split()[0] in PROGRAMS:
            found += map(Step, lines)
    return found


def all_commands() -> dict[str, Any]:
    """The commands of the command line by their names; those of a group as `group command`, beside the group."""
    commands: dict[str, Any] = {}
    for name, command in vars(typer.main.get_command(app))["commands"].items():
        of_group = vars(command).get("commands", {})
        commands |= {name: command} | {f"{name} {each}": of_group[each] for each in of_group}
    return commands


def command_name(words: list[str]) -> str:
    """The name of the command in words that begin with `zlocus`."""
    pair = " ".join(words[1:3])
    return pair if pair in all_commands() else words[1]


def inline_commands(page: Path) -> list[str]:
    """Commands in the sentences and tables of a page."""
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    return [" ".join(each.split()) for each in INLINE.findall(text.replace("\\|", "|"))]


def lay_out_images(folder: Path) -> None:
    """Three images with RPC, and a reference: what README and others call theirs."""
    images = rendered(folder / "rendered", "sine")
    for number, path in enumerate(images.inputs, 1):
        path.rename(folder / f"img_{number}.tif")
    half = 40.0
    n = round(2 * half / GSD_M)
    along = (np.arange(n) + 0.5) * GSD_M - half
    heights = analytic_height("sine", *np.meshgrid(along, -along)).astype(np.float32)
    where = from_origin(CENTRE[0] - half, CENTRE[1] + half, GSD_M, GSD_M)
    with rasterio.open(
        folder / "reference.tif", "w", driver="GTiff", width=n, height=n, count=1, dtype="float32", crs="EPSG:32632",
        transform=where,
    ) as file:  # fmt: skip
        file.write(heights, 1)


def lay_out_images_and_bands(folder: Path) -> None:
    """The same, and an image of another sensor."""
    lay_out_images(folder)
    shutil.copy(folder / "img_3.tif", folder / "multispectral.tif")


def lay_out_images_and_area(folder: Path) -> None:
    """The same, and polygons of an area."""
    lay_out_images(folder)
    (x, y), side = CENTRE, 15.0
    ring = [[x, y], [x + side, y], [x + side, y + side], [x, y + side], [x, y]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    area = {"type": "FeatureCollection", "crs": crs, "features": [feature]}
    (folder / "town.geojson").write_text(json.dumps(area), encoding="utf-8")


def lay_out_strips(folder: Path) -> None:
    """Two runs that overlap, and heights of a raster."""
    runs = two_runs(folder, seed=1)
    for run, name in zip(runs.folders, ("north", "south"), strict=True):
        run.rename(folder / name)
    write_raster(folder / "reference.tif", runs.truth.astype(np.float32))


def lay_out_dates(folder: Path) -> None:
    """Runs of two dates, heights of a raster, and polygons."""
    lay_out_strips(folder)
    truth = town(180, 240)
    rng = np.random.default_rng(2)
    for name in ("spring", "autumn"):
        write_run(folder / name, truth + 0.1 * rng.normal(size=truth.shape), np.full(truth.shape, 0.1))
    (west, north), (east, south) = CORNER * (50, 50), CORNER * (90, 90)
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    area = {"type": "FeatureCollection", "crs": crs, "features": [feature]}
    (folder / "town.geojson").write_text(json.dumps(area), encoding="utf-8")


# A drone 60 m above its ground: pixels of 0.26 m.
DRONE_FOCAL_PX, DRONE_SHAPE, DRONE_HEIGHT_M, DRONE_TILT_DEG = 230.0, (180, 240), 110.0, 3.0
DRONE_STATIONS = ((-10.0, -6.0), (0.0, -6.0), (10.0, -6.0), (-10.0, 6.0), (0.0, 6.0), (10.0, 6.0))


def lay_out_drone(folder: Path) -> None:
    """Images of a drone in a project of OpenSfM."""
    ground = analytic_ground("sine", (0.0, 0.0), 0.15, (1000, 1000), seed=9)
    shots = {}
    for number, station in enumerate(DRONE_STATIONS):
        tilt = DRONE_TILT_DEG * (-1) ** number
        camera_from_ground = Rotation.from_euler("xy", [180.0 + tilt, tilt], degrees=True).as_matrix()
        centre = np.array([*station, DRONE_HEIGHT_M])
        middle = ((DRONE_SHAPE[1] - 1) / 2, (DRONE_SHAPE[0] - 1) / 2)
        model = FrameModel(tuple(centre), camera_from_ground, DRONE_FOCAL_PX, middle)
        grey = expose(render(ground, model, DRONE_SHAPE, Sun(150.0, 50.0)), QUIET, np.random.default_rng(number))
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_image(folder / "images" / f"{number}.tif", grey, None)
        shots[f"{number}.tif"] = {
            "camera": "drone",
            "rotation": Rotation.from_matrix(camera_from_ground).as_rotvec().tolist(),
            "translation": (-camera_from_ground @ centre).tolist(),
        }
    camera = {
        "projection_type": "perspective", "width": DRONE_SHAPE[1], "height": DRONE_SHAPE[0],
        "focal": DRONE_FOCAL_PX / max(DRONE_SHAPE), "k1": 0.0, "k2": 0.0,
    }  # fmt: skip
    place = {"latitude": 47.3, "longitude": 8.6, "altitude": 432.0}
    project = [{"cameras": {"drone": camera}, "shots": shots, "points": {}, "reference_lla": place}]
    (folder / "reconstruction.json").write_text(json.dumps(project), encoding="utf-8")


def lay_out_deliveries(folder: Path) -> None:
    """What four vendors might send of two images: an archive, a folder, another archive, and a catalogue."""
    images = rendered(folder / "rendered", "sine")
    taken = deliveries.shots({name: images.paths[name] for name in ("nadir", "fore")})
    deliveries.zipped(deliveries.dimap_delivery(folder / "delivery", taken), folder / "delivery.zip")
    deliveries.maxar_delivery(folder / "first_strip", taken[:1])
    with tarfile.open(folder / "second_strip.tar", "w") as archive:
        archive.add(deliveries.maxar_delivery(folder / "second_strip", taken[1:]), "second_strip")
    catalogue = deliveries.stac_delivery(folder / "catalogue", taken)
    for path in catalogue.parent.iterdir():
        path.rename(folder / path.name)


def lay_out_readme(folder: Path) -> None:
    """Three satellite images, a delivery, a reference, and the project of a drone."""
    lay_out_images(folder)
    images = rendered(folder / "rendered", "sine")
    taken = deliveries.shots({name: images.paths[name] for name in ("nadir", "fore")})
    deliveries.zipped(deliveries.dimap_delivery(folder / "delivery", taken), folder / "delivery.zip")
    lay_out_drone(folder / "PROJECT")


def lay_out_cameras(folder: Path) -> None:
    """Cameras of every program, by the names of the page on `zlocus import`; a photographed wall."""
    for write in (camera_files.write_colmap, camera_files.write_opensfm, camera_files.write_bundler):
        write(folder / "PROJECT")
    # One folder for three programs: the images of each of them where the others have theirs.
    for image in (folder / "PROJECT" / "images").glob("*.tif"):
        shutil.copy(image, folder / "PROJECT")
    metashape = camera_files.write_metashape(folder / "metashape").folder
    (metashape / "cameras.xml").rename(folder / "cameras.xml")
    shutil.move(metashape / "images" if (metashape / "images").is_dir() else metashape, folder / "photos")
    table = camera_files.write_eo(folder / "eo", at=(500_000.0, 4_650_000.0, 0.0)).folder
    (table / "eo.csv").rename(folder / "orientations.csv")
    for image in table.glob("*.tif"):
        image.rename(folder / image.name)
    photographed(folder / "WALL", "sine", axes_of_wall((-0.733, 0.68, 0.0), (0.0, 0.0, -1.0)))


def lay_out_products(folder: Path) -> None:
    """Three images, and a file of options."""
    lay_out_images(folder)
    (folder / "options.toml").write_text("[products]\n")


def lay_out_comparison(folder: Path) -> None:
    """Three images, a reference and its classes."""
    lay_out_images(folder)
    with rasterio.open(folder / "reference.tif") as reference:
        profile = reference.profile | {"dtype": "uint8"}
    with rasterio.open(folder / "classes.tif", "w", **profile) as file:
        file.write(np.zeros((profile["height"], profile["width"]), np.uint8), 1)


def lay_out_surfaces(folder: Path) -> None:
    """A reference with classes, surfaces that are right and that lie elsewhere, and a geoid under them."""
    side, shape = 0.5, (400, 400)
    row, col = np.indices(shape)
    z = (60 + 20 * np.sin(col / 37) * np.cos(row / 29)).astype(np.float32)
    surfaces = {"reference": (z, 0.0), "dsm": (z + 0.1, 0.0), "moved": (z, 1.0), "classes": (0 * z, 0.0)}
    for name, (values, east) in surfaces.items():
        dtype = "uint8" if name == "classes" else "float32"
        with rasterio.open(
            folder / f"{name}.tif", "w", driver="GTiff", width=shape[1], height=shape[0], count=1, dtype=dtype,
            crs="EPSG:32632", transform=from_origin(CENTRE[0] + east, CENTRE[1], side, side),
        ) as file:  # fmt: skip
            file.write(values.astype(dtype), 1)
    write_geoid(folder / "geoid.tif", np.full((8, 8), 48.0, np.float32), from_origin(7.5, 48.5, 0.25, 0.25))


def lay_out_points(folder: Path) -> None:
    """The same, and points of the ground: check points, laser points and heights of a satellite."""
    lay_out_surfaces(folder)
    with rasterio.open(folder / "reference.tif") as file:
        z, transform = file.read(1), file.transform
    row, col = np.random.default_rng(0).integers(4, 396, (2, 400))
    x, y = transform * (col + 0.5, row + 0.5)
    xyz = np.column_stack([x, y, z[row, col]])
    cloud(folder / "laser.laz", xyz, np.resize([2, 6], len(xyz)))
    csv(folder / "check_points.csv", {"x": x, "y": y, "z": xyz[:, 2], "sigma": [0.02] * len(x)})
    lon, lat = Transformer.from_crs("EPSG:32632", 4326, always_xy=True).transform(x, y)
    csv(folder / "atl08.csv", {"longitude": lon, "latitude": lat, "h_te_best_fit": xyz[:, 2], "time": 86400.0 * row})


def lay_out_datums(folder: Path) -> None:
    """Three images, a geoid as a file and as PROJ has two, a terrain model and control points above it."""
    lay_out_images(folder)
    undulation_m, grid_m, half = 48.0, 2.0, 200.0
    write_geoid(folder / "geoid.tif", np.full((8, 8), undulation_m, np.float32), from_origin(7.5, 48.5, 0.25, 0.25))
    (folder / PROJ_GRIDS).mkdir()
    for geoid in KNOWN_GEOIDS.values():
        write_proj_grid(folder / PROJ_GRIDS / geoid.grids[0], np.full((721, 1440), undulation_m, np.float32))
    n = round(2 * half / grid_m)
    along = (np.arange(n) + 0.5) * grid_m - half
    heights = analytic_height("sine", *np.meshgrid(along, -along)) - undulation_m
    with rasterio.open(
        folder / "srtm.tif", "w", driver="GTiff", width=n, height=n, count=1, dtype="float32", crs="EPSG:32632",
        transform=from_origin(CENTRE[0] - half, CENTRE[1] + half, grid_m, grid_m),
    ) as file:  # fmt: skip
        file.write(heights.astype(np.float32), 1)
    views = open_scene([folder / "img_1.tif", folder / "img_2.tif"], UTM).views
    rows = ["name,x,y,z,image,column,row"]
    for name, (east, north) in {"p": (-10.0, -8.0), "q": (12.0, 3.0), "r": (0.0, 15.0)}.items():
        x, y, z = CENTRE[0] + east, CENTRE[1] + north, float(analytic_height("sine", east, north))
        for view in views:
            column, row = view.sensor.image_from_ground(np.array([[x, y, z]]))[0]
            rows.append(f"{name},{x},{y},{z - undulation_m:.4f},{view.name},{column:.3f},{row:.3f}")
    (folder / "points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def lay_out_lakes(folder: Path) -> None:
    """Three images, a geoid, and two lakes, of which one has a level above it."""
    lay_out_images(folder)
    write_geoid(folder / "geoid.tif", np.full((8, 8), 48.0, np.float32), from_origin(7.5, 48.5, 0.25, 0.25))
    x, y = CENTRE
    lakes = [shapely.box(x - 10, y - 8, x - 2, y + 6), shapely.box(x + 2, y - 8, x + 9, y + 6)]
    write_water(folder / "lakes.gpkg", lakes, LEVEL=[1.75, None])


def lay_out_parts(folder: Path) -> None:
    """Three images, polygons of parts of their surface, and a break line."""
    lay_out_images(folder)
    x, y = CENTRE
    for name, west in (("roof", -10), ("quay", -3), ("basin", 3)):
        write_water(folder / f"{name}.gpkg", [shapely.box(x + west, y - 8, x + west + 6, y + 6)])
    edge = np.array([shapely.LineString([(x - 0.2, y - 9), (x, y + 9)])], object)
    write_vector(folder / "edges.gpkg", shapely.to_wkb(edge), [], [], geometry_type="LineString", crs="EPSG:32632")


def lay_out_masked(folder: Path) -> None:
    """A scene file of three images, one with a mask over its right half."""
    lay_out_images(folder)
    names = ("img_1", "img_2", "img_3")
    views = [{"name": name, "image": f"{name}.tif", "camera": {"kind": "rpc"}} for name in names]
    views[0]["mask"] = "clouds.tif"
    with open_raster(folder / "img_1.tif") as image:
        mask = np.zeros(image.shape, np.uint8)
    mask[:, mask.shape[1] // 2 :] = 1
    write_image(folder / "clouds.tif", mask, None)
    scene = {"schema": 1, "views": views}
    (folder / "scene.yaml").write_text(json.dumps(scene), encoding="utf-8")


def lay_out_surface(folder: Path) -> None:
    """A flags raster, for what reads one."""
    (folder / "surface").mkdir()
    with rasterio.open(
        folder / "surface" / "quality.tif", "w", driver="GTiff", width=2, height=1, count=1, dtype="uint16",
        crs="EPSG:32632", transform=from_origin(*CENTRE, 1.0, 1.0),
    ) as file:  # fmt: skip
        file.write(np.array([[[16, 256]]], np.uint16))


def lay_out_geoid(folder: Path) -> None:
    """A geoid as a file, in place of one that has to be fetched."""
    write_geoid(folder / "geoid.tif", np.full((8, 8), 48.0, np.float32), from_origin(7.5, 48.5, 0.25, 0.25))


# What the tests run in place of words of a page, so that scenes are smaller than those of a reader, and of the same
# structure. Tests see to it that the page has the words.
IN_SMALL = {
    "docs/tutorials/delivery_to_contours.md": {"--size 300": "--size 96", "egm2008 --": "geoid.tif --"},
    "docs/tutorials/many_dates.md": {"--size 240": "--size 120 --views 8", "img_20140[89]": "img_2014"},
    "docs/tutorials/drone_block.md": {
        "--resolution 0.4": "--resolution 1.2 --no-report",
        "--reference s1_2 --reference s2_2": "--reference s1_2 --bounds 462195 5247295 462205 5247305",
    },
}


def in_small(page: Path, step: Step) -> Step:
    """A step of a page as the tests run it, see `IN_SMALL`."""
    text = step.text
    for words, smaller in IN_SMALL.get(name_of(page), {}).items():
        text = text.replace(words, smaller)
    return Step(text, step.is_python)


# What a page's commands find in the folder in which they are run.
LAID_OUT = {
    "README.md": lay_out_readme,
    "docs/how-to/align.md": lay_out_points,
    "docs/how-to/array_jobs.md": lay_out_images,
    "docs/how-to/change.md": lay_out_dates,
    "docs/how-to/cloud.md": lay_out_images_and_area,
    "docs/how-to/compare.md": lay_out_images,
    "docs/how-to/curves.md": lay_out_images,
    "docs/how-to/deliveries.md": lay_out_deliveries,
    "docs/how-to/doctor.md": lay_out_images,
    "docs/how-to/evaluate.md": lay_out_points,
    "docs/how-to/export.md": lay_out_images,
    "docs/how-to/import.md": lay_out_cameras,
    "docs/how-to/inspect.md": lay_out_images,
    "docs/how-to/large.md": lay_out_images,
    "docs/how-to/masks.md": lay_out_masked,
    "docs/how-to/mosaic.md": lay_out_strips,
    "docs/how-to/orient.md": lay_out_images,
    "docs/how-to/redo.md": lay_out_parts,
    "docs/how-to/ortho.md": lay_out_images_and_bands,
    "docs/how-to/report.md": lay_out_comparison,
    "docs/how-to/vertical.md": lay_out_datums,
    "docs/how-to/water.md": lay_out_lakes,
    "docs/reference/api.md": lay_out_images,
    "docs/reference/products.md": lay_out_products,
    "docs/reference/quality.md": lay_out_surface,
    "docs/reference/rpc.md": lay_out_images,
    "docs/tutorials/delivery_to_contours.md": lay_out_geoid,
    "docs/tutorials/drone_block.md": lambda folder: None,
    "docs/tutorials/first_surface.md": lambda folder: None,
    "docs/tutorials/many_dates.md": lambda folder: None,
}
