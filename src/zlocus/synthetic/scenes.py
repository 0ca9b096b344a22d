"""Specifications of rendered scenes (`SceneSpec`), their exact cameras and their ground."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from affine import Affine
from pyproj import CRS

from zlocus.core.errors import ConfigError
from zlocus.core.options.option_fields import Checked, option
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.synthetic.appearance import Changes
from zlocus.synthetic.cameras import LineScanner, RectifiedScanner, SatelliteCamera, Shake, axes_of_heading
from zlocus.synthetic.lakes import LAKES, with_lake
from zlocus.synthetic.objects import Objects, add_objects
from zlocus.synthetic.painting import TruthArea
from zlocus.synthetic.realistic_ground import Cover, realistic_ground
from zlocus.synthetic.render import Optics, Sun
from zlocus.synthetic.sensor_errors import SensorErrors, WavySatelliteCamera
from zlocus.synthetic.terrain import Relief, RoundHill, SyntheticGround, natural_ground
from zlocus.synthetic.troubles import TROUBLES, with_trouble
from zlocus.synthetic.weather import Weather

FLIGHT_HEIGHT_M = 2000.0
ADVANCE_M = 0.208
WOBBLE_M, WOBBLE_DEG = 0.5, 0.03
LEVEL_1_M = 0.21
BORDER_PX = 4
TALLEST_M = {"city": 66.0, "hills": 15.0, "real": 160.0}
LARGE_SIZE = 3000  # cells; in larger scenes heights and truth are as coarse as the images, to save memory

MORNING, AFTERNOON = Sun(152.0, 46.0), Sun(232.0, 33.0)
CLEAR = Optics()
# Seeds of the towns that troubles are painted into.
TROUBLE_SEEDS = (5, 6, 7)
# Angles along the flight in which they are seen: even steps, so that rows repeat at equal heights in all pairs.
TROUBLE_ALONG_DEG = (0.0, 20.0, -20.0)
NO_ERRORS, TWELVE_BITS = SensorErrors(), SensorErrors(saturation=4095)
# Moving cars on the places of a trouble (see `Changes.cars_per_km`): three of ten bays of the car park are taken.
CARS_PER_KM = {"cars": 150.0}
SOFTER = Optics(gain=1020.0, haze=145.0, blur_px=0.62)
OTHER_DATE = Optics(gain=760.0, haze=135.0, blur_px=0.7, noise=0.01, noise_floor=9.0)
HAZY = Optics(gain=900.0, haze=330.0, blur_px=1.3, noise=0.02, noise_floor=22.0, n_clouds=5)


@dataclass(frozen=True)
class ViewSpec:
    """One image to render.

    along_deg, across_deg : view angles from the nadir, positive forward and to the right in flight direction.
    heading_deg : of the flight, clockwise from north. bias_row_px, bias_col_px : pointing error of the RPC, by which
    every point is projected too far down and to the right. day : number of the day; images of one day see the same
    weather. errors : of the sensor. wave_px : largest displacement of lines by an attitude that RPCs do not describe.
    """

    name: str
    along_deg: float
    across_deg: float
    heading_deg: float = 0.0
    sun: Sun = MORNING
    optics: Optics = CLEAR
    bias_row_px: float = 0.0
    bias_col_px: float = 0.0
    day: int = 0
    errors: SensorErrors = NO_ERRORS
    wave_px: float = 0.0


SATELLITE_VIEWS = (
    ViewSpec("n1", 1.0, -4.0, 2.0),
    ViewSpec("f1", 20.0, -4.0, 2.0, optics=replace(CLEAR, gain=1050.0)),
    ViewSpec("b1", -20.0, -4.0, 2.0, optics=replace(CLEAR, gain=1150.0, haze=155.0)),
    ViewSpec("n2", 0.0, 12.0, -1.5, optics=SOFTER),
    ViewSpec("f2", 22.0, 13.0, -1.5, optics=replace(SOFTER, gain=1180.0, haze=160.0, noise_floor=6.0)),
    ViewSpec("b2", -22.0, 13.0, -1.5, optics=replace(SOFTER, gain=950.0, haze=150.0, noise_floor=6.5)),
    ViewSpec("d1", 8.0, -14.0, 4.0, AFTERNOON, OTHER_DATE),
    ViewSpec("d2", -10.0, 4.0, 0.0, Sun(165.0, 55.0), HAZY),
)
ADS40_VIEWS = (
    ViewSpec("n1", 2.0, -6.0, 1.0),
    ViewSpec("f1", 26.0, -6.0, 1.0),
    ViewSpec("b1", -14.0, -6.0, 1.0, optics=SOFTER),
    ViewSpec("n2", 2.0, 12.0, -1.0, optics=SOFTER),
    ViewSpec("f2", 26.0, 12.0, -1.0, optics=SOFTER),
    ViewSpec("b2", -14.0, 12.0, -1.0),
)


@dataclass(frozen=True)
class SceneSpec(Checked):
    """A scene to render. Equal specifications give equal bytes.

    objects : of a town or of hills; cover : of a realistic scene (kind "real"). changes : what differs between its
    images. weather : of each day, in order; later days are clear. is_dated, works_day : see `acquisitions`, `works`.
    """

    kind: str = option("city", "Kind of objects on the ground.", choices=("city", "hills", "real"))
    seed: int = option(1, "Seed of terrain, objects, texture and noise.", low=0)
    size: int = option(520, "Side of the area with truth, in cells of `gsd_m`.", low=32, high=20000)
    gsd_m: float = option(0.5, "Ground pixel.", low=0.05, high=5.0, unit="m")
    camera: str = option(
        "satellite", "A satellite at 600 km, or an airborne three-line scanner.", choices=("satellite", "ads40")
    )
    shaken: bool = option(False, "Airborne: an unsteady flight (`Shake`), different in each strip.")
    level: int = option(0, "Level of airborne images: raw, or resampled to a plane.", choices=(0, 1))
    truth_step_m: float | None = option(None, "Cell of heights and truth; unset: half of `gsd_m`.", low=0.02, unit="m")
    whole_truth: bool = option(False, "Truth covers all ground that two images show, not only the area.")
    margin_m: float = option(
        0.0, "Width of the ground around the area that all satellite images show too.", low=0.0, high=1000.0, unit="m"
    )
    samples: int = option(2, "Rays per pixel and axis.", low=1, high=8)
    base_m: float = option(430.0, "Lowest ellipsoidal height of the terrain.", low=-400.0, high=8000.0, unit="m")
    relief_m: float = option(
        38.0, "Difference from lowest to highest terrain, without the hill.", low=0.1, high=1000.0, unit="m"
    )
    longest_m: float = option(240.0, "Longest wavelength of the terrain.", low=10.0, high=20000.0, unit="m")
    hill_m: float = option(0.0, "Height of a round hill in the north-east of the area.", low=0.0, high=100.0, unit="m")
    objects: Objects = field(default=Objects(145.0, 1.15, 0.4, 10.5, rough_m=0.08))
    views: tuple[ViewSpec, ...] = SATELLITE_VIEWS
    cover: Cover = field(default=Cover())
    changes: Changes = field(default=Changes())
    trouble: str | None = option(
        None, "One trouble or lake painted into a town; unset: none.", choices=(*TROUBLES, *LAKES)
    )
    weather: tuple[Weather, ...] = ()
    is_dated: bool = option(False, "The tags of the images say when and how they were taken.")
    works_day: int | None = option(None, "Day from which on a pit and a heap are there; unset: never.", low=0)
    west_m: float = option(462000.0, "Western border of the area, easting.", unit="m")
    north_m: float = option(5247000.0, "Northern border of the area, northing.", unit="m")
    epsg: int = option(32632, "Projected CRS of the truth; heights are ellipsoidal.", low=1024, high=32767)

    def __post_init__(self) -> None:
        super().__post_init__()
        cells = self.size * self.gsd_m / self.step_m
        if abs(cells - round(cells)) > 1e-6:
            raise ConfigError(
                f"SceneSpec.truth_step_m = {self.step_m} m does not divide the side of {self.size * self.gsd_m} m: "
                "choose half or all of gsd_m."
            )
        names = [view.name for view in self.views]
        if not names or len(set(names)) < len(names):
            raise ConfigError(f"SceneSpec.views must have different names and be at least one, not {names}.")

    @property
    def step_m(self) -> float:
        """Cell of the height field and the truth, m."""
        return self.gsd_m / 2 if self.truth_step_m is None else self.truth_step_m

    @property
    def crs(self) -> CRS:
        """CRS of the ground."""
        return CRS.from_epsg(self.epsg)

    @property
    def terrain_range(self) -> tuple[float, float]:
        """Lower and upper bound of the heights of the terrain, m."""
        return self.base_m, self.base_m + self.relief_m + self.hill_m

    @property
    def height_range(self) -> tuple[float, float]:
        """Lower and upper bound of all heights, with objects, m."""
        low, high = self.terrain_range
        tallest_m = TALLEST_M["real"] if self.trouble == "towers" else TALLEST_M[self.kind]
        return low - 1.0, high + tallest_m


@dataclass(frozen=True)
class Exposure:
    """A view with its exact camera and the rows and columns of its image."""

    view: ViewSpec
    sensor: SensorModel
    shape: tuple[int, int]

    @property
    def taken(self) -> Exposure:
        """The raw exposure, before it was resampled to a plane; the exposure itself if it was not resampled."""
        if isinstance(self.sensor, RectifiedScanner):
            return replace(self, sensor=self.sensor.raw_camera, shape=self.sensor.raw_shape)
        return self


def city_spec(seed: int, **changes: object) -> SceneSpec:
    """A town with gentle relief, roads, houses, towers up to 34 m and trees; eight views.

    Its difficulty was tuned with other matching methods, see `benchmarks/baselines.py`.
    """
    return replace(SceneSpec(kind="city", seed=seed), **changes)  # type: ignore[arg-type]


def trouble_spec(trouble: str, seed: int = TROUBLE_SEEDS[0], **changes: object) -> SceneSpec:
    """A town with one painted trouble, seen by sensors of 12 bits in three views of one pass."""
    seen = zip(SATELLITE_VIEWS, TROUBLE_ALONG_DEG, strict=False)
    views = tuple(replace(view, along_deg=along_deg, errors=TWELVE_BITS) for view, along_deg in seen)
    spec = city_spec(seed, views=views, trouble=trouble, changes=Changes(cars_per_km=CARS_PER_KM.get(trouble, 0.0)))
    return replace(spec, **changes)  # type: ignore[arg-type]


def hills_spec(seed: int, **changes: object) -> SceneSpec:
    """Steep hills with trees and few roads; eight views."""
    hills = SceneSpec(
        kind="hills", seed=seed, base_m=350.0, relief_m=185.0, objects=Objects(300.0, 0.0, 0.0, 20.0, rough_m=0.08)
    )
    return replace(hills, **changes)  # type: ignore[arg-type]


def demo_spec(seed: int = 4) -> SceneSpec:
    """The demo: six ADS40 images in two unsteady strips, over 120 m x 120 m of towers, houses, trees and a hill.

    Level 1, 62.5 mm, 2000 m above ground, 0.21 m pixels: table 2 of Ji et al. (2014).
    """
    return SceneSpec(
        kind="city", seed=seed, size=600, gsd_m=0.2, camera="ads40", shaken=True, level=1, relief_m=6.0, hill_m=9.0,
        views=ADS40_VIEWS, whole_truth=True,
        objects=Objects(70.0, 3.6, 0.8, 14.0, plain_roofs=0.25, max_tree_m=12.0, tower_m=(25.0, 58.0)),
    )  # fmt: skip


def with_ads40(spec: SceneSpec) -> SceneSpec:
    """The scene with the six ADS40 images of the demo, at their ground pixel."""
    return replace(spec, camera="ads40", views=ADS40_VIEWS, gsd_m=0.2)


def steady(spec: SceneSpec) -> SceneSpec:
    """The scene with raw images of a steady flight."""
    return replace(spec, shaken=False, level=0)


def with_pointing_errors(spec: SceneSpec, max_px: float) -> SceneSpec:
    """The scene with a random pointing error for each view, uniform within `max_px` in row and column."""
    rng = np.random.default_rng([spec.seed, 77])
    errors = rng.uniform(-max_px, max_px, (len(spec.views), 2))
    views = (
        replace(view, bias_row_px=float(row), bias_col_px=float(col))
        for view, (row, col) in zip(spec.views, errors, strict=True)
    )
    return replace(spec, views=tuple(views))


def exposures_of(spec: SceneSpec) -> tuple[Exposure, ...]:
    """The exposures of all views, with exact cameras, whose images show all terrain of the area."""
    corners = area_corners(spec)
    easting, northing, height = map(float, (corners.min(axis=0) + corners.max(axis=0)) / 2)
    middle = easting, northing, height
    result = []
    for view in spec.views:
        camera = _camera(spec, view, middle)
        if isinstance(camera, LineScanner) and spec.level == 1:
            result.append(_level_1(view, camera, middle, corners))
            continue
        first, shape = first_pixel_and_shape(camera.image_from_ground(area_corners(spec, spec.margin_m)))
        result.append(Exposure(view, replace(camera, centre=(-first[0], -first[1])), shape))
    return tuple(result)


def area_corners(spec: SceneSpec, margin_m: float = 0.0) -> FloatArray:
    """Corners (8, 3) m of the area at its lowest and highest terrain, with a margin around it."""
    low, high = -margin_m, spec.size * spec.gsd_m + margin_m
    return np.array([
        (spec.west_m + e, spec.north_m - s, z) for e in (low, high) for s in (low, high) for z in spec.terrain_range
    ])  # fmt: skip


def first_pixel_and_shape(xy: FloatArray) -> tuple[tuple[float, float], tuple[int, int]]:
    """First pixel (column, row) and shape (rows, columns) of an image that holds positions (n, 2) px with a border."""
    first = np.floor(xy.min(axis=0)) - BORDER_PX
    cols, rows = np.ceil(xy.max(axis=0)) + BORDER_PX + 1 - first
    return (float(first[0]), float(first[1])), (int(rows), int(cols))


def _level_1(view: ViewSpec, camera: LineScanner, middle: tuple[float, float, float], corners: FloatArray) -> Exposure:
    """The exposure resampled to the plane at the height of `middle`, rows across the flight, showing `corners`."""
    forward, right = LEVEL_1_M * np.array(axes_of_heading(view.heading_deg))
    around_middle = Affine(right[0], -forward[0], middle[0], right[1], -forward[1], middle[1])
    rectified = RectifiedScanner(camera, (0, 0), middle[2], around_middle)
    first, shape = first_pixel_and_shape(rectified.image_from_ground(corners))
    rectified = replace(rectified, plane_from_image=around_middle * Affine.translation(*first))
    rows, cols = np.arange(shape[0]), np.arange(shape[1])
    outline = np.concatenate([
        *(np.column_stack([np.full(shape[0], col), rows]) for col in (0, shape[1] - 1)),
        *(np.column_stack([cols, np.full(shape[1], row)]) for row in (0, shape[0] - 1)),
    ])  # fmt: skip
    first, raw_shape = first_pixel_and_shape(rectified.raw_from_image(outline))
    raw = replace(camera, centre=(-first[0], -first[1]))
    return Exposure(view, replace(rectified, raw_camera=raw, raw_shape=raw_shape), shape)


def _camera(
    spec: SceneSpec, view: ViewSpec, middle: tuple[float, float, float]
) -> SatelliteCamera | LineScanner:  # fmt: skip
    """A camera that sees the middle of the area at the view's angles. The origin of its image is not set yet."""
    if spec.camera == "satellite":
        angles = view.along_deg, view.across_deg, view.heading_deg
        if not view.wave_px:
            return SatelliteCamera(middle, (0.0, 0.0), spec.gsd_m, *angles)
        wave_seed = (spec.seed, *view.name.encode())
        return WavySatelliteCamera(middle, (0.0, 0.0), spec.gsd_m, *angles, wave_px=view.wave_px, wave_seed=wave_seed)
    heading = np.deg2rad(view.heading_deg)
    aside = FLIGHT_HEIGHT_M * np.tan(np.deg2rad(view.across_deg))
    east, north = aside * float(np.cos(heading)), -aside * float(np.sin(heading))
    position = (middle[0] - east, middle[1] - north, middle[2] + FLIGHT_HEIGHT_M)
    strip = (round(1e3 * (view.heading_deg % 360.0)), round(1e3 * (view.across_deg + 90.0)))
    shake = Shake((spec.seed, *strip)) if spec.shaken else None
    return LineScanner(
        position, (0.0, 0.0), view.heading_deg, view.along_deg, ADVANCE_M, wobble_m=WOBBLE_M, wobble_deg=WOBBLE_DEG,
        shake=shake,
    )  # fmt: skip


def build_ground(spec: SceneSpec, exposures: tuple[Exposure, ...]) -> SyntheticGround:
    """The ground of a scene: the area, and as much around it as any of the images can show.

    The positions of objects depend on the extent of the ground. Scenes that are to have the same ground must therefore
    be built with the same images, those of a steady flight (`steady`); other images may then miss some pixels at the
    rim.
    """
    xyz = np.concatenate([_footprint(spec, exposure) for exposure in exposures])
    step = spec.step_m
    # Cells from the area's upper left corner to the west, north, east and south.
    margin = np.ceil(np.array([
        spec.west_m - xyz[:, 0].min(), xyz[:, 1].max() - spec.north_m,
        xyz[:, 0].max() - spec.west_m, spec.north_m - xyz[:, 1].min(),
    ]) / step).astype(int) + 4  # fmt: skip
    side = spec.size * spec.gsd_m
    origin = (spec.west_m - int(margin[0]) * step, spec.north_m + int(margin[1]) * step)
    bare = bare_terrain(spec, origin, (int(margin[1] + margin[3]), int(margin[0] + margin[2])))
    truth_area = TruthArea(int(margin[0]) * step, int(margin[1]) * step, side)
    if spec.kind == "real":
        return realistic_ground(bare, spec.cover, truth_area, spec.seed)
    built = add_objects(bare, spec.objects, spec.seed)
    if spec.trouble is None:
        return built
    paint = with_lake if spec.trouble in LAKES else with_trouble
    return paint(built, spec.trouble, truth_area, spec.seed)


def bare_terrain(spec: SceneSpec, origin: tuple[float, float], shape: tuple[int, int]) -> SyntheticGround:
    """The terrain of a scene without objects. origin : west and north of its first cell, m; shape : its cells."""
    side = spec.size * spec.gsd_m
    hill = RoundHill(spec.west_m + 0.7 * side, spec.north_m - 0.3 * side, side / 7, spec.hill_m)
    relief = Relief(spec.base_m, spec.relief_m, spec.longest_m, roughness=3.0, hill=hill if spec.hill_m else None)
    return natural_ground(spec.seed, origin, spec.step_m, shape, relief, spec.gsd_m / 2)


def _footprint(spec: SceneSpec, exposure: Exposure) -> FloatArray:
    """Ground points (n, 3) m that enclose all that an image can show, with a few pixels beyond its border."""
    rows, cols = exposure.shape
    along, across = np.linspace(-3.0, rows + 2.0, 9), np.linspace(-3.0, cols + 2.0, 9)
    xy = np.array([(c, r) for r in along for c in across])
    return np.concatenate([exposure.sensor.ground_from_image(xy, np.full(len(xy), z)) for z in spec.height_range])
