"""What changes between the images of a scene: brightness by direction of view and day, waves on water, cars that move.

The height field of the truth holds none of it: cars are painted onto a copy of the ground for each image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from zlocus.core.options.option_fields import Checked, option
from zlocus.synthetic.objects import Footprint
from zlocus.synthetic.terrain import (
    MATERIAL,
    MOVING_PATTERNS,
    PATTERN_GRAIN,
    ROAD,
    SyntheticGround,
    plain_material,
)

BRIGHTNESS_STREAM, VIEW_STREAM = 61, 67
# Directions of view differ by about this tangent between images of one pass.
USUAL_TANGENT = 0.3
CAR_M, CAR_HEIGHT_M = (4.3, 1.8), 1.5
CAR_ALBEDOS = (0.04, 0.08, 0.2, 0.5, 0.9)
WAVE_PERIOD_TEXELS = 1024.0


@dataclass(frozen=True)
class Changes(Checked):
    """How much a scene changes from image to image; nothing by default."""

    directional: float = option(
        0.0, "Standard deviation of the relative change of a surface's brightness between the views of a pass.",
        low=0.0, high=0.5,
    )  # fmt: skip
    daily: float = option(
        0.0, "Standard deviation of the relative change of a surface's brightness between days.", low=0.0, high=0.5
    )
    cars_per_km: float = option(0.0, "Moving cars per kilometre of lane and image.", low=0.0, high=500.0)


@dataclass(frozen=True)
class Moment:
    """When and from where an image is taken. along_deg, across_deg : view angles; day, index : of the image."""

    along_deg: float
    across_deg: float
    day: int
    index: int


def ground_in_view(ground: SyntheticGround, changes: Changes, moment: Moment, seed: int) -> SyntheticGround:
    """The ground as it looks and stands at the moment of one image."""
    materials = ground.materials.copy()
    materials["albedo"] *= brightness(len(materials), changes, moment, seed)
    rng = np.random.default_rng([seed, VIEW_STREAM, moment.index])
    moving = np.isin(materials["pattern"], MOVING_PATTERNS)
    for axis in ("x", "y"):
        materials[axis][moving] = rng.uniform(0.0, WAVE_PERIOD_TEXELS, int(moving.sum()))
    seen = replace(ground, materials=materials)
    n_cars = rng.poisson(changes.cars_per_km * len(ground.lanes) * 0.002) if len(ground.lanes) else 0
    return with_cars(seen, ground.lanes[rng.integers(len(ground.lanes), size=n_cars)], rng) if n_cars else seen


def brightness(n_materials: int, changes: Changes, moment: Moment, seed: int) -> np.ndarray:
    """Factors (m,) on the albedo of materials: other ones for every surface, direction of view and day."""
    rng = np.random.default_rng([seed, BRIGHTNESS_STREAM])
    slope = changes.directional * rng.standard_normal((n_materials, 2))
    tangents = np.tan(np.deg2rad([moment.along_deg, moment.across_deg])) / USUAL_TANGENT
    of_day = np.random.default_rng([seed, BRIGHTNESS_STREAM, 1 + moment.day]).standard_normal(n_materials)
    return np.asarray(np.exp(slope @ tangents + changes.daily * of_day))


def with_cars(ground: SyntheticGround, places: np.ndarray, rng: np.random.Generator) -> SyntheticGround:
    """The ground with cars. places : (n, 4) m, of their middles and directions, as `SyntheticGround.lanes`."""
    paints = [plain_material(ROAD, PATTERN_GRAIN, albedo, 0.01) for albedo in CAR_ALBEDOS]
    first = len(ground.materials)
    parked = replace(
        ground, planes=ground.planes.copy(), material=ground.material.copy(),
        materials=np.array([*ground.materials, *paints], MATERIAL),
    )  # fmt: skip
    for x, y, east, south in places:
        car = Footprint(float(x), float(y), float(np.arctan2(south, east)), *CAR_M)
        paint = first + int(rng.integers(len(paints)))
        window = car.window(parked, 0.0)
        if window is None:
            continue
        p, q = car.axes(parked, window)
        body = (np.abs(p) < car.length / 2) & (np.abs(q) < car.width / 2)
        # Crowns that hang over a road hide the cars below them.
        body &= parked.classes[window] == ROAD
        parked.heights[window][body] += np.float32(CAR_HEIGHT_M)
        parked.material[window][body] = paint
    # Bounds of blocks and classes are computed from the planes when they are first asked for.
    return replace(parked)
