"""Rows of the acceptance table on ortho-images of a finished surface, and on control from an ortho-photo.

Towns are rendered with their cameras, and the ground straight from above: what an ortho-image has to be.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning

from displaced_windows import displacements
from seeds import fresh_seeds, over_seeds
from workplace import ZLOCUS, Figure, Workplace, run
from zlocus.io.scene_file import open_scene
from zlocus.orientation.triangulate import Observations, triangulate
from zlocus.synthetic.appearance import Changes, Moment, ground_in_view
from zlocus.synthetic.files import fit_exposure, render_scene, write_image
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

TOWN_CELLS, PIXEL_M = 360, 0.5
N_SEEDS = 3
NO_NOISE = {"noise": 0.0, "noise_floor": 0.0}
MAX_OFF_PX = 0.3
# Control: pointing errors of this size, each in another direction; the ortho-photo has other pixels, light and houses.
POINTING_PX, PHOTO_M, TERRAIN_M, REBUILT_SHARE, DAILY = 10.0, 0.3, 2.0, 0.25, 0.3
PHOTO = Band(Optics(gain=900.0, haze=100.0, blur_px=0.7), 1.3)
PHOTO_SUN = Sun(205.0, 58.0)
MAX_PLAN_PX = 0.5


def ortho_images(workplace: Workplace) -> list[Figure]:
    """An image that took no part in the surface, of another date and with four bands, against the rendered truth."""
    seeds = fresh_seeds(N_SEEDS)
    workplace.inputs["seeds"] = seeds
    return over_seeds(seeds, lambda seed: _left_out(workplace.out / f"town{seed}", seed))


def _left_out(scene: Path, seed: int) -> list[Figure]:
    spec = replace(city_spec(seed), size=TOWN_CELLS, views=SATELLITE_VIEWS[:3])
    if not scene.exists():
        render_scene(spec, scene)
    write_multispectral(scene, spec, seed)
    images = sorted(scene.glob("img_*.tif"))
    surface, out = scene / "surface", scene / "ortho"
    crs = f"EPSG:{spec.epsg}"
    run([ZLOCUS, "dsm", *images, "-o", surface, "--crs", crs, "--resolution", PIXEL_M, "--no-report", "--overwrite"])
    run([ZLOCUS, "ortho", surface, scene / "multispectral.tif", "-o", out, "--resolution", PIXEL_M, "--overwrite"])
    off = displacements(out / "multispectral_ortho.tif", scene / "truth_multispectral.tif")
    length = np.hypot(*off.T)
    return [
        Figure("displacement from the truth, RMS of all bands", float(np.sqrt((length**2).mean())), "px",
               at_most=MAX_OFF_PX, fails_when="the pointing of the image is not corrected"),
        Figure("mean displacement", float(np.hypot(*off.mean(axis=0))), "px", at_most=MAX_OFF_PX,
               fails_when="the pointing of the image is not corrected"),
    ]  # fmt: skip


def write_multispectral(folder: Path, spec: SceneSpec, seed: int, pointing: tuple[float, float] = (-6.3, 4.7)) -> None:
    """Write an image of four bands of another date (multispectral.tif) with a pointing error (row, column, px), and its
    truth straight from above (truth_multispectral.tif)."""
    left_out = replace(SATELLITE_VIEWS[6], bias_row_px=pointing[0], bias_col_px=pointing[1])
    with_it = replace(spec, views=(*spec.views, left_out))
    ground, exposure = build_ground(spec, exposures_of(spec)), exposures_of(with_it)[-1]
    sun = exposure.view.sun
    numbers = exposed_bands(ground, exposure.taken.sensor, exposure.taken.shape, sun, FOUR_BANDS, seed)
    path = folder / "multispectral.tif"
    write_image(path, numbers[0], fit_exposure(with_it, exposure).rpc)
    meanings = (ColorInterp.blue, ColorInterp.green, ColorInterp.red, ColorInterp.undefined)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            profile, rpcs = file.profile, file.rpcs
        with rasterio.open(path, "w", **profile | {"count": len(numbers)}, rpcs=rpcs) as file:
            file.write(numbers)
            file.descriptions, file.colorinterp = ("blue", "green", "red", "nir"), meanings
    camera = OrthographicCamera(spec.west_m, spec.north_m, PIXEL_M)
    noiseless = [replace(band, optics=replace(band.optics, **NO_NOISE)) for band in FOUR_BANDS]
    truth = exposed_bands(ground, camera, (spec.size, spec.size), sun, noiseless, seed)
    write_photo(folder / "truth_multispectral.tif", truth, camera, spec)


def write_photo(path: Path, numbers: NDArray[np.generic], camera: OrthographicCamera, spec: SceneSpec) -> None:
    """Write bands (b, r, c) on the grid of a camera that looks straight down."""
    _, rows, cols = numbers.shape
    with rasterio.open(
        path, "w", driver="GTiff", height=rows, width=cols, count=len(numbers), dtype=numbers.dtype, tiled=True,
        blockxsize=256, blockysize=256, crs=f"EPSG:{spec.epsg}", transform=camera.transform,
    ) as file:  # fmt: skip
        file.write(numbers)


def ortho_control(workplace: Workplace) -> list[Figure]:
    """Cameras that point 10 px past an ortho-photo of another date, corrected against it and a terrain model."""
    seeds = fresh_seeds(N_SEEDS)
    workplace.inputs["seeds"] = seeds
    return over_seeds(seeds, lambda seed: _controlled(workplace.out / f"town{seed}", seed))


def controlled_spec(seed: int) -> SceneSpec:
    """Three images with pointing errors of `POINTING_PX` in different directions."""
    angles = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, 3)
    views = [
        replace(view, bias_row_px=POINTING_PX * float(np.sin(angle)), bias_col_px=POINTING_PX * float(np.cos(angle)))
        for view, angle in zip(SATELLITE_VIEWS, angles, strict=False)
    ]
    return replace(city_spec(seed), size=TOWN_CELLS, views=tuple(views))


def write_control(folder: Path, spec: SceneSpec, seed: int) -> SyntheticGround:
    """Write an ortho-photo of another date (photo.tif) and a terrain model without objects (terrain.tif)."""
    ground = build_ground(spec, exposures_of(spec))
    later = partly_rebuilt(spec, ground, REBUILT_SHARE, seed + 1)
    later = ground_in_view(later, Changes(daily=DAILY, cars_per_km=50.0), Moment(0.0, 0.0, 1, 1), seed)
    side = spec.size * spec.gsd_m
    camera = OrthographicCamera(spec.west_m, spec.north_m, PHOTO_M)
    n = round(side / PHOTO_M)
    write_photo(folder / "photo.tif", exposed_bands(later, camera, (n, n), PHOTO_SUN, [PHOTO], seed), camera, spec)
    bare = bare_ground(spec, ground)
    cells = round(TERRAIN_M / bare.step)
    rows, cols = (n // cells * cells for n in bare.heights.shape)
    heights = bare.heights[:rows, :cols].reshape(rows // cells, cells, cols // cells, cells).mean(axis=(1, 3))
    grid = OrthographicCamera(bare.x0, bare.y0, TERRAIN_M)
    write_photo(folder / "terrain.tif", heights[None].astype(np.float32), grid, spec)
    return ground


def _controlled(scene: Path, seed: int) -> list[Figure]:
    spec, out = controlled_spec(seed), scene / "oriented"
    if not scene.exists():
        render_scene(spec, scene)
    ground = write_control(scene, spec, seed)
    images, control = sorted(scene.glob("img_*.tif")), ("--control-ortho", scene / "photo.tif")
    crs, terrain = ("--crs", f"EPSG:{spec.epsg}"), ("--control-dem", scene / "terrain.tif")
    run([ZLOCUS, "orient", *images, "-o", out, *crs, *control, *terrain, "--overwrite"])
    worst, together = plan_errors(out / "scene.yaml", spec, ground)
    other = scene / "elsewhere"
    other.mkdir(exist_ok=True)
    write_control(other, replace(spec, seed=seed + 1), seed + 1)
    wrong = ("--control-ortho", other / "photo.tif")
    refused = run([ZLOCUS, "orient", *images, "-o", scene / "no", *crs, *wrong, *terrain, "--json"], accept=(0, 2))
    is_refused = refused.status == 2 and "another place" in json.dumps(refused.said)
    fails_when = "the images are not matched with the ortho-photo, or its changes are taken for the ground"
    return [
        Figure("plan error of the worst image", worst, "px", at_most=MAX_PLAN_PX, fails_when=fails_when),
        Figure("plan error of points from all images, RMS", together, "px", at_most=MAX_PLAN_PX, fails_when=fails_when),
        Figure("ortho-photo of another place refused within", float(is_refused), at_least=1.0,
               fails_when="chance agreement counts as a match"),
    ]  # fmt: skip


def plan_errors(scene_file: Path, spec: SceneSpec, ground: SyntheticGround) -> tuple[float, float]:
    """Plan errors (px) of corrected cameras: mean of the worst image where the height is known, and RMS of points that
    are seen by all images."""
    rng, side = np.random.default_rng(spec.seed), spec.size * spec.gsd_m
    xy = np.array([spec.west_m, spec.north_m - side]) + rng.uniform(0.05 * side, 0.95 * side, (400, 2))
    row, col = ((ground.y0 - xy[:, 1]) / ground.step).astype(int), ((xy[:, 0] - ground.x0) / ground.step).astype(int)
    xyz = np.column_stack([xy, ground.heights[row, col]])
    views = {view.path.stem.removeprefix("img_"): view for view in open_scene([scene_file], spec.crs).views}
    sensors, places, off = [], [], []
    for exposure in exposures_of(spec):
        sensor, at = views[exposure.view.name].sensor, exposure.sensor.image_from_ground(xyz)
        off.append((sensor.ground_from_image(at, xyz[:, 2]) - xyz)[:, :2].mean(axis=0))
        sensors.append(sensor)
        places.append(at)
    point = np.tile(np.arange(len(xyz)), len(sensors)).astype(np.int64)
    view = np.repeat(np.arange(len(sensors)), len(xyz)).astype(np.int64)
    found = triangulate(sensors, Observations(view, point, np.concatenate(places)), xyz).xyz
    error = (found - xyz)[:, :2] / PIXEL_M
    return float(np.hypot(*np.array(off).T).max()) / PIXEL_M, float(np.sqrt((error**2).sum(axis=1).mean()))
