"""Options of the maps that are made of a surface."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class ProductOptions(Checked):
    """Maps made of a surface: hillshade, contours, terrain."""

    ortho_levels: str = option(
        "common", "Ortho-image: grey values and colours levelled to those of the leading image, without the fall-off "
        "of lenses, or as each image has them.", choices=("common", "own"),
    )  # fmt: skip
    sun_azimuth_deg: float = option(
        315.0, "Hillshade: direction of the sun, from north over east.", low=0.0, high=360.0, unit="degrees"
    )
    sun_altitude_deg: float = option(
        45.0, "Hillshade: height of the sun above the horizon.", low=0.0, high=90.0, unit="degrees"
    )
    contour_interval_m: float | None = option(
        None, "Height between contours; unset: 1, 2 or 5 times a power of ten that gives 10 to 25 of them within two "
        "standard deviations of the mean height, but at least 0.1.", low=1e-3, high=1e4, unit="m",
    )  # fmt: skip
    contours_of: str = option(
        "dsm", "What contours are drawn of: the surface, or the terrain, which then must be among the products.",
        choices=("dsm", "dtm"),
    )  # fmt: skip
    contour_least_cells: float = option(
        12.0, "Closed contours whose line is shorter than so many cells are left out; 0 keeps all.",
        low=0.0, high=1e6, unit="cells",
    )  # fmt: skip
    ground_cell_m: float = option(
        1.0, "Terrain: side of the cells in which ground is looked for, about.", low=0.01, high=1e3, unit="m"
    )
    ground_window_m: float = option(
        40.0, "Terrain: half the width of the largest building or wood that is removed.", low=0.1, high=1e4, unit="m"
    )
    ground_slope: float = option(
        0.15, "Terrain: steepest slope of the ground, as a ratio: what rises more above its surroundings is none.",
        low=0.0, high=10.0,
    )  # fmt: skip
    ground_tolerance_m: float = option(
        0.5, "Terrain: a cell is ground where its height is this close to the terrain found first.",
        low=0.0, high=100.0, unit="m",
    )  # fmt: skip
    ground_scaling: float = option(
        1.25, "Terrain: added to the tolerance, times the slope there.", low=0.0, high=100.0, unit="m"
    )
