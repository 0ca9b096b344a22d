"""Options of the products derived from a surface."""

from __future__ import annotations

from dataclasses import dataclass

from zlocus.core.options.option_fields import Checked, option


@dataclass(frozen=True)
class ProductOptions(Checked):
    """Products derived from a surface: ortho-image, hillshade, contours, terrain."""

    ortho_levels: str = option(
        "common", "Ortho-image: 'common' balances grey values and colours to those of the reference image and removes "
        "the fall-off of lenses; 'own' keeps the values of each image.", choices=("common", "own"),
    )  # fmt: skip
    sun_azimuth_deg: float = option(
        315.0, "Hillshade: azimuth of the sun, clockwise from north.", low=0.0, high=360.0, unit="degrees"
    )
    sun_altitude_deg: float = option(
        45.0, "Hillshade: altitude of the sun above the horizon.", low=0.0, high=90.0, unit="degrees"
    )
    contour_interval_m: float | None = option(
        None, "Contours: difference in height between two contours. Unset: 1, 2 or 5 times a power of ten, so that 10 "
        "to 25 contours lie within two standard deviations of the mean height, but at least 0.1.",
        low=1e-3, high=1e4, unit="m",
    )  # fmt: skip
    contours_of: str = option(
        "dsm", "Contours: drawn from the surface (dsm) or the terrain (dtm), which must then be among the products.",
        choices=("dsm", "dtm"),
    )  # fmt: skip
    min_contour_cells: float = option(
        12.0, "Contours: closed lines shorter than this are left out; 0 keeps all.",
        low=0.0, high=1e6, unit="cells",
    )  # fmt: skip
    ground_window_m: float = option(
        40.0, "Terrain: half the width of the largest building or wood that is removed.", low=0.1, high=1e4, unit="m"
    )
    ground_slope: float = option(
        0.15, "Terrain: steepest slope of the ground, as a ratio; cells that rise more steeply are not ground.",
        low=0.0, high=10.0,
    )  # fmt: skip
    ground_tolerance_m: float = option(
        0.5, "Terrain: a cell is ground where its height is this close to the provisional terrain.",
        low=0.0, high=100.0, unit="m",
    )  # fmt: skip
    styles: bool = option(
        True, "Styles: for QGIS (.qml) and for map servers (.sld) beside each product, and an attribute table of "
        "quality.tif.",
    )  # fmt: skip
