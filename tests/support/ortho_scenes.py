"""A small rendered town with its true heights as a surface, and what images and ortho-photos of it have to show."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from zlocus.synthetic.files import fit_exposure, write_image
from zlocus.synthetic.ortho_photo import (
    FOUR_BANDS,
    Band,
    OrthographicCamera,
    bare_ground,
    exposed_bands,
    partly_rebuilt,
)
from zlocus.synthetic.render import Optics, Sun
from zlocus.synthetic.scenes import SATELLITE_VIEWS, SceneSpec, build_ground, city_spec, exposures_of
from zlocus.synthetic.terrain import SyntheticGround

SIZE = 220
PIXEL_M = 0.5
NAMES = ("n1", "f1", "b1")
# Pointing errors (row, column) of the images, px.
POINTING = {"n1": (6.0, -8.0), "f1": (-9.8, 2.0), "b1": (7.0, 7.1), "d1": (-6.3, 4.7)}
PHOTO_SUN = Sun(205.0, 58.0)
PAN = (Band(Optics()),)


@dataclass(frozen=True)
class Town:
    spec: SceneSpec
    ground: SyntheticGround
    folder: Path

    @property
    def camera(self) -> OrthographicCamera:
        return OrthographicCamera(self.spec.west_m, self.spec.north_m, PIXEL_M)

    def exposure(self, name):
        return next(each for each in exposures_of(self.spec) if each.view.name == name)


def town(folder: Path, seed: int = 5) -> Town:
    """The town, and its true heights (surface.tif)."""
    views = tuple(
        replace(view, bias_row_px=POINTING[view.name][0], bias_col_px=POINTING[view.name][1])
        for view in SATELLITE_VIEWS
        if view.name in POINTING
    )
    spec = replace(city_spec(seed), size=SIZE, views=views)
    made = Town(spec, build_ground(spec, exposures_of(spec)), folder)
    folder.mkdir(parents=True, exist_ok=True)
    row, col = (np.indices((SIZE, SIZE)) + 0.5) * PIXEL_M
    of_row = ((made.ground.y0 - spec.north_m + row) / made.ground.step).astype(int)
    of_col = ((spec.west_m - made.ground.x0 + col) / made.ground.step).astype(int)
    write_raster(folder / "surface.tif", made.ground.heights[of_row, of_col][None], made.camera, spec)
    return made


def write_view(made: Town, name: str, bands=PAN, gain: float = 1.0) -> Path:
    """An image of the town with a pointing error. gain : that its numbers are multiplied by."""
    exposure, path = made.exposure(name), made.folder / f"{name}.tif"
    numbers = exposed_bands(made.ground, exposure.taken.sensor, exposure.taken.shape, exposure.view.sun, bands, 3)
    numbers = np.rint(numbers * gain).astype(np.uint16)
    write_image(path, numbers[0], fit_exposure(made.spec, exposure).rpc)
    if len(numbers) > 1:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as file:
                profile, rpcs = file.profile, file.rpcs
            with rasterio.open(path, "w", **profile | {"count": len(numbers)}, rpcs=rpcs) as file:
                file.write(numbers)
                file.descriptions = ("blue", "green", "red", "nir")
    return path


def write_raster(path: Path, numbers, camera: OrthographicCamera, spec: SceneSpec, epsg: int | None = None) -> Path:
    _, rows, cols = numbers.shape
    with rasterio.open(
        path, "w", driver="GTiff", height=rows, width=cols, count=len(numbers), dtype=numbers.dtype,
        crs=f"EPSG:{epsg or spec.epsg}", transform=camera.transform,
    ) as file:  # fmt: skip
        file.write(numbers)
    return path


def write_photo(made: Town, path: Path, sun: Sun = PHOTO_SUN, bands=PAN, pixel_m: float = PIXEL_M, rebuilt: float = 0):
    """The town straight from above. rebuilt : share of it where other houses and trees stand."""
    ground = partly_rebuilt(made.spec, made.ground, rebuilt, 99) if rebuilt else made.ground
    n = round(SIZE * PIXEL_M / pixel_m)
    camera = OrthographicCamera(made.spec.west_m, made.spec.north_m, pixel_m)
    return write_raster(path, exposed_bands(ground, camera, (n, n), sun, bands, 8), camera, made.spec)


def write_terrain(made: Town, path: Path) -> Path:
    """The terrain of the town without its objects, in cells of 2 m."""
    bare = bare_ground(made.spec, made.ground)
    n = round(2.0 / bare.step)
    rows, cols = (each // n * n for each in bare.heights.shape)
    heights = bare.heights[:rows, :cols].reshape(rows // n, n, cols // n, n).mean(axis=(1, 3), dtype=np.float64)
    camera = OrthographicCamera(bare.x0, bare.y0, 2.0)
    return write_raster(path, heights.astype(np.float32)[None], camera, made.spec)


def truth_of(made: Town, name: str, bands=FOUR_BANDS) -> Path:
    """What the ortho-image of an image has to show, without noise."""
    quiet = [replace(band, optics=replace(band.optics, noise=0.0, noise_floor=0.0)) for band in bands]
    sun = made.exposure(name).view.sun
    return write_photo(made, made.folder / f"truth_{name}.tif", sun, quiet)
