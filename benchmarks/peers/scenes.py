"""Scenes of the comparison: rendered ones with exact truth, and satellite images if there are any."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.enums import Resampling
from rasterio.transform import from_origin
from rasterio.warp import calculate_default_transform, reproject
from scipy.ndimage import distance_transform_edt
from shapely import Polygon, unary_union

from rectifying import STEP_M
from zlocus.io.scene_file import open_scene

VIEWS = ("n1", "f1", "b1", "n2", "f2", "b2")
RESOLUTION_M = STEP_M
# A coarse terrain model, as users of satellite programs have one before matching; it extends beyond the area.
TERRAIN_M, TERRAIN_PERCENTILE, TERRAIN_BORDER = 30.0, 20.0, 30
# Largest angle between the rays of a pair. With the pair of 40 degrees (fore and aft view of the shared town) beside
# the two pairs of 20 degrees, CARS loses a tenth of its roofs and gains 0.01 m of NMAD.
MAX_PAIR_ANGLE_DEG = 30.0
# The height range that programs search exceeds the true heights by this much on both sides.
RANGE_MARGIN_M = 3.0


@dataclass(frozen=True)
class Scene:
    """Images with RPC or of frame cameras, the area of the surface, and truth or reference data.

    images : paths by view, the first one nearest to the nadir; kind : city or hills; bounds : west, south, east, north
    of the area, m; heights : lowest and highest height of the search, m above the ellipsoid; terrain : a coarse terrain
    model (EPSG:4326, above the ellipsoid); truth, classes : exact rasters, None if there are none; reference : surface
    of another program; shifts : pointing corrections (column, row) px by view, for matchers that cannot find them;
    cameras : scene file of the images if their cameras are frame cameras, None if the images have RPC.
    """

    name: str
    kind: str
    images: dict[str, Path]
    crs: str
    bounds: tuple[float, float, float, float]
    heights: tuple[float, float]
    terrain: Path
    truth: Path | None = None
    classes: Path | None = None
    reference: Path | None = None
    shifts: dict[str, tuple[float, float]] = field(default_factory=dict)
    cameras: Path | None = None

    def shift(self, view: str) -> tuple[float, float]:
        """Pointing correction (column, row) px of a view; zero where none is known."""
        return self.shifts.get(view, (0.0, 0.0))

    @property
    def inputs(self) -> list[Path]:
        """What a program that reads scene files is given: that file, or the images with their RPC."""
        return list(self.images.values()) if self.cameras is None else [self.cameras]

    @property
    def slug(self) -> str:
        """Name of the scene's folder."""
        return "-".join(self.name.replace(",", "").lower().split())

    @property
    def million_cells(self) -> float:
        """Cells of the area, in millions."""
        west, south, east, north = self.bounds
        return (east - west) * (north - south) / RESOLUTION_M**2 / 1e6

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Pairs of views whose rays meet at no more than MAX_PAIR_ANGLE_DEG; the first view is nearer to the nadir."""
        views = list(self.images)
        rays = dict(zip(views, self.rays(), strict=True))
        steepness = {view: float(rays[view] @ (0.0, 0.0, 1.0)) for view in views}
        found = []
        for pair in itertools.combinations(views, 2):
            angle = np.degrees(np.arccos(np.clip(rays[pair[0]] @ rays[pair[1]], -1.0, 1.0)))
            if angle <= MAX_PAIR_ANGLE_DEG or len(views) == 2:
                steeper, other = sorted(pair, key=steepness.__getitem__, reverse=True)
                found.append((steeper, other))
        return found

    def rays(self) -> np.ndarray:
        """(n, 3) unit vectors from the middle of the area towards each view."""
        west, south, east, north = self.bounds
        low, high = self.heights
        middle = np.array([[(west + east) / 2, (south + north) / 2, low]])
        found = []
        for view in open_scene(self.inputs).views:
            seen = view.sensor.image_from_ground(middle)
            above = view.sensor.ground_from_image(seen, np.array([high]))[0]
            ray = above - middle[0]
            found.append(ray / np.linalg.norm(ray))
        return np.array(found)


@dataclass(frozen=True)
class Rendered:
    """A scene that `zlocus.synthetic` renders. side : in cells of RESOLUTION_M; views : numbers of views to match."""

    kind: str
    seed: int
    side: int
    views: tuple[int, ...] = (2, 3, 6)
    options: tuple[str, ...] = field(default=())

    def scenes(self, name: str, folder: Path) -> list[Scene]:
        """Render into a folder, if that is not done yet; one scene for each number of views."""
        where = folder / f"{self.kind}-{self.seed}-{self.side}"
        if not (where / "scene.json").exists():
            command = [sys.executable, "-m", "zlocus.synthetic", "-o", where, "--kind", self.kind, *self.options]
            command += ["--seed", self.seed, "--size", self.side, "--views", max(self.views)]
            done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{where} could not be rendered: {done.stderr.strip().splitlines()[-1]}")
        truth = where / "truth_dsm.tif"
        with rasterio.open(truth) as file:
            heights, crs, bounds = file.read(1), file.crs.to_string(), tuple(file.bounds)
            terrain = write_terrain(heights, file.transform, crs, where / "terrain.tif")
        reach = float(heights.min()) - RANGE_MARGIN_M, float(heights.max()) + RANGE_MARGIN_M
        classes = where / "truth_class.tif"
        return [
            Scene(f"{name}, {number} views", self.kind, {view: where / f"img_{view}.tif" for view in VIEWS[:number]},
                  crs, bounds, reach, terrain, truth, classes)
            for number in self.views
        ]  # fmt: skip


# The options of zlocus were chosen without these seeds. The large town has more than 4 million cells.
RENDERED = {
    "town": Rendered("city", 211, 1024),
    "hills": Rendered("hills", 211, 1024),
    "large town": Rendered("city", 212, 2048, views=(3,)),
}
WARM_UP = Rendered("city", 100, 640, views=(2,))


def write_terrain(heights: np.ndarray, transform: rasterio.Affine, crs: str, path: Path) -> Path:
    """Write a coarse terrain model: a low percentile of each cell, extended beyond the area, in degrees."""
    k = round(TERRAIN_M / transform.a)
    rows, cols = (-(-n // k) for n in heights.shape)
    padded = np.pad(heights, [(0, rows * k - heights.shape[0]), (0, cols * k - heights.shape[1])], mode="edge")
    blocks = padded.reshape(rows, k, cols, k).swapaxes(1, 2).reshape(rows, cols, -1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # cells without any height
        coarse = np.nanpercentile(blocks, TERRAIN_PERCENTILE, axis=-1)
    coarse = coarse[tuple(distance_transform_edt(np.isnan(coarse), return_distances=False, return_indices=True))]
    coarse = np.pad(coarse, TERRAIN_BORDER, mode="edge").astype(np.float32)
    border = TERRAIN_BORDER * TERRAIN_M
    where = from_origin(transform.c - border, transform.f + border, TERRAIN_M, TERRAIN_M)
    west, north = where.c, where.f
    east, south = west + coarse.shape[1] * TERRAIN_M, north - coarse.shape[0] * TERRAIN_M
    to, width, height = calculate_default_transform(
        crs, "EPSG:4326", coarse.shape[1], coarse.shape[0], west, south, east, north
    )
    found = np.full((height, width), np.nan, np.float32)
    reproject(
        coarse, found, src_transform=where, src_crs=crs, dst_transform=to, dst_crs="EPSG:4326",
        resampling=Resampling.bilinear, dst_nodata=np.nan,
    )  # fmt: skip
    found = found[tuple(distance_transform_edt(np.isnan(found), return_distances=False, return_indices=True))]
    with rasterio.open(
        path, "w", driver="GTiff", height=height, width=width, count=1, dtype="float32", crs="EPSG:4326", transform=to,
    ) as file:  # fmt: skip
        file.write(found, 1)
    return path


def shared(folder: Path) -> list[Scene]:
    """The Pleiades sets of `ZLOCUS_TEST_DATA`; empty if it is not set. folder : for their coarse terrain models."""
    data = os.environ.get("ZLOCUS_TEST_DATA")
    if not data:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    found = (make(Path(data), folder) for make in (calanques, ventoux))
    return [scene for scene in found if scene is not None]


def calanques(data: Path, folder: Path) -> Scene | None:
    """The Pleiades triplet; the surface of s2p gives the height range and the coarse terrain model."""
    where = data / "pleiades_triplet_calanques"
    reference = where / "reference" / "s2p_dsm_0.5m_utm31n.tif"
    if not reference.exists():
        return None
    with rasterio.open(reference) as file:
        heights, crs = file.read(1), file.crs.to_string()
        terrain = write_terrain(heights, file.transform, crs, folder / "calanques_terrain.tif")
    reach = float(np.nanmin(heights)) - RANGE_MARGIN_M, float(np.nanmax(heights)) + RANGE_MARGIN_M
    images = {f"img_0{k}": where / f"img_0{k}.tif" for k in (2, 1, 3)}
    bounds = overlap(images, crs, float(np.nanmedian(heights)))
    return Scene("Pleiades triplet", "hills", images, crs, bounds, reach, terrain, reference=reference)


def ventoux(data: Path, folder: Path) -> Scene | None:
    """The Pleiades pair, which overlaps in a strip; the terrain model is SRTM, converted to ellipsoidal heights."""
    where = data / "pleiades_pair_ventoux"
    srtm, geoid = (where / "reference" / name for name in ("srtm3_v2_egm96_heights.tif", "geoid_egm96_15min.tif"))
    if not srtm.exists():
        return None
    terrain, crs = folder / "ventoux_terrain.tif", "EPSG:32631"
    with rasterio.open(srtm) as file, rasterio.open(geoid) as undulation:
        heights = file.read(1).astype(np.float32)
        heights[heights == file.nodata] = np.nan
        above = np.zeros_like(heights)
        reproject(
            rasterio.band(undulation, 1), above, dst_transform=file.transform, dst_crs=file.crs,
            resampling=Resampling.bilinear,
        )  # fmt: skip
        heights += above
        heights = heights[tuple(distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True))]
        with rasterio.open(terrain, "w", driver="GTiff", **grid_of(file)) as written:
            written.write(heights, 1)
    images = {f"img_0{k}": where / f"img_0{k}.tif" for k in (1, 2)}
    bounds = overlap(images, crs, VENTOUX_M[0])
    return Scene("Pleiades pair", "hills", images, crs, bounds, VENTOUX_M[1:], terrain)


# Height of the ground in the middle of the pair, and height range around it: that of SRTM and some metres more.
VENTOUX_M = (500.0, 440.0, 600.0)


def grid_of(file: rasterio.DatasetReader) -> dict[str, object]:
    """Profile of a raster of heights on the grid of another one."""
    return {
        "height": file.height, "width": file.width, "count": 1, "dtype": "float32", "crs": file.crs,
        "transform": file.transform,
    }  # fmt: skip


def overlap(images: dict[str, Path], crs: str, z: float) -> tuple[float, float, float, float]:
    """West, south, east, north, m, of the ground inside at least two images at a height, in whole cells."""
    footprints = []
    opened = open_scene(list(images.values()))
    for view in opened.views:
        rows, cols = view.image.shape
        corners = np.array([(0, 0), (cols - 1, 0), (cols - 1, rows - 1), (0, rows - 1)], float)
        xyz = view.sensor.ground_from_image(corners, np.full(4, z))
        to = Transformer.from_crs(opened.crs, crs, always_xy=True)
        footprints.append(Polygon(np.column_stack(to.transform(xyz[:, 0], xyz[:, 1]))))
    seen = unary_union([a & b for a, b in itertools.combinations(footprints, 2)])
    west, south, east, north = (float(RESOLUTION_M * round(value / RESOLUTION_M)) for value in seen.bounds)
    return west, south, east, north
