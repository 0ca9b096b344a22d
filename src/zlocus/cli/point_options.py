"""Options that say how a file of points is to be understood, shared by the commands that take one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from zlocus.core.errors import ConfigError

if TYPE_CHECKING:
    from zlocus.io.points.ground_points import PointOptions

POINTS = "Points"
# Endings of the names of files of points, as `zlocus.io.points.open_points` has them.
POINT_FILES = "CSV, GeoPackage, GeoJSON, Parquet, LAS, LAZ or COPC"


@dataclass(frozen=True, kw_only=True)
class PointFileOptions:
    """How a file of points is understood: CRS, heights, columns, and which laser points are used."""

    points_crs: Annotated[
        str | None,
        typer.Option(
            help="CRS of points. Default: that of the file, WGS 84 for columns of longitude and latitude, or that of "
            "the surface.",
            metavar="EPSG:N", rich_help_panel=POINTS,
        ),
    ] = None  # fmt: skip
    points_vertical: Annotated[
        str | None,
        typer.Option(
            help="Vertical datum of the heights of points. Default: that of their CRS, or that of the surface.",
            metavar="ellipsoid|egm96|egm2008|FILE", rich_help_panel=POINTS,
        ),
    ] = None  # fmt: skip
    points_sigma: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of heights of points that have none in a column, m.", metavar="M",
            rich_help_panel=POINTS,
        ),
    ] = None  # fmt: skip
    columns: Annotated[
        str | None,
        typer.Option(
            help="Columns of a table by what they hold: x=EAST,y=NORTH,z=H; also sigma, sigma_xy, cover, time, "
            "measured_x, measured_y. Default: by their usual names.",
            metavar="NAME=COLUMN,...", rich_help_panel=POINTS,
        ),
    ] = None  # fmt: skip
    laser_classes: Annotated[
        str | None,
        typer.Option(
            help="Classes of laser points that are used. Default: all but noise.", metavar="N,N...",
            rich_help_panel=POINTS,
        ),
    ] = None  # fmt: skip
    returns: Annotated[
        str,
        typer.Option(help="Returns of a laser pulse that are used.", metavar="all|last|first", rich_help_panel=POINTS),
    ] = "all"

    def given(self) -> list[str]:
        """Names of the options about points that are given."""
        values = {
            "--points-crs": self.points_crs, "--points-vertical": self.points_vertical, "--columns": self.columns,
            "--points-sigma": self.points_sigma, "--laser-classes": self.laser_classes,
        }  # fmt: skip
        return [name for name, value in values.items() if value is not None] + ["--returns"] * (self.returns != "all")

    def point_options(self, vegetated: str | None = None) -> PointOptions:
        """The options as `zlocus.io.points` takes them. vegetated : of --vegetated.

        Raises
        ------
        ConfigError
            A value out of range.
        """
        from zlocus.io.points.columns import columns_from_text
        from zlocus.io.points.ground_points import PointOptions

        return PointOptions(
            crs=self.points_crs, vertical=self.points_vertical, sigma_m=self.points_sigma, returns=self.returns,
            columns={} if self.columns is None else columns_from_text(self.columns),
            vegetated=() if vegetated is None else tuple(vegetated.split(",")),
            laser_classes=_codes(self.laser_classes),
        )  # fmt: skip


def _codes(text: str | None) -> tuple[int, ...]:
    if text is None:
        return ()
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"--laser-classes {text} is no list of numbers. Give some like 2,8.") from error


def check_for_points(given: list[str], reference: str) -> None:
    """Refuse options about points where the reference is a raster.

    Raises
    ------
    ConfigError
        Such an option is given.
    """
    if given:
        raise ConfigError(
            f"{given[0]} is about points, and {reference} is a raster. Leave it out, or give points ({POINT_FILES})."
        )
