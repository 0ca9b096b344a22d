"""Points as a reference: brought to the CRS and the vertical datum of the surface, some after others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.evaluation.height_file import HeightFile
from zlocus.evaluation.vertical import above, above_geoid, geoid_datum, stated_datum
from zlocus.io.crs import crs_label, is_on_earth
from zlocus.io.points.ground_points import Bounds, KnownPoints, PointFile, PointOptions
from zlocus.io.points.open_points import open_points
from zlocus.io.vertical import ELLIPSOID, ELLIPSOIDAL, VerticalDatum, named_vertical_datum
from zlocus.sensors.earth_frame import between

OUTSIDE = "outside of the surface"


@dataclass(frozen=True, eq=False)
class PointReference:
    """A file of points, as the reference of a surface.

    crs : of the points; None: coordinates are used as they are. datums : vertical datums of surface and points as
    their files state them, None where one does not. points_vertical_datum : what z of the points is above before it
    is converted; surface_vertical_datum : what is added to heights of the surface: one of both may be a geoid.
    assumed : what had to be assumed, as sentences.
    """

    height_file: HeightFile
    point_file: PointFile
    crs: CRS | None
    datums: tuple[str | None, str | None]
    points_vertical_datum: VerticalDatum = ELLIPSOIDAL
    surface_vertical_datum: VerticalDatum = ELLIPSOIDAL
    assumed: tuple[str, ...] = ()
    geoid_added_to: Path | None = None
    default_sigma_m: float = math.nan
    left_out: dict[str, int] = field(default_factory=dict)

    @classmethod
    def open(
        cls, height_file: HeightFile, paths: Sequence[Path], options: PointOptions, geoid: Path | None
    ) -> PointReference:
        """Open points as the reference of a surface. paths : of one file, or of several clouds.

        geoid : see `same_heights`.

        Raises
        ------
        InputError, ConfigError
            The file cannot be read; the CRS or vertical datums do not go together.
        """
        point_file, mine, path = open_points(paths, options), height_file.horizontal, paths[0]
        crs, assumed = point_file.crs, list[str]()
        if crs is None and mine is not None:
            assumed.append(
                f"{path} has no CRS: its coordinates are taken to be in that of the surface ({crs_label(mine)})"
            )
        if mine is None and crs is not None:
            if crs.is_geographic:
                raise InputError(
                    f"{path} has longitudes and latitudes, and {height_file.path} has no CRS. Assign it one (gdal_edit "
                    "-a_srs)."
                )
            assumed.append(f"{height_file.path} has no CRS: coordinates are compared as they are")
        for file_path, one in ((height_file.path, mine), (path, crs)):
            if mine is not None and crs is not None and one is not None and not is_on_earth(one):
                raise InputError(f"{file_path} has the CRS {one.name}, which cannot be converted to that of the other.")
        horizontal = crs.to_2d() if crs is not None else mine
        found = cls(height_file, point_file, None if mine is None else horizontal, (None, None))
        return found._with_datums(options, geoid, assumed)

    def _with_datums(self, options: PointOptions, geoid: Path | None, assumed: list[str]) -> PointReference:
        """The reference with its vertical datums."""
        height_file, path = self.height_file, self.point_file.path
        mine = stated_datum(height_file.spatial, height_file.path, height_file.description)
        theirs = None if self.point_file.crs is None else stated_datum(self.point_file.crs, path)
        points_vertical_datum = surface_vertical_datum = ELLIPSOIDAL
        if options.vertical is not None:
            points_vertical_datum, theirs = named_vertical_datum(options.vertical, "--points-vertical"), ELLIPSOID
            if points_vertical_datum.crs is not None and mine == points_vertical_datum.crs.name:
                points_vertical_datum, theirs = ELLIPSOIDAL, mine  # heights are of one kind already
        if points_vertical_datum.geoid is not None and mine is None:
            mine = ELLIPSOID
            assumed.append(f"{height_file.path} does not state its vertical datum: taken to be above the ellipsoid")
        converted = above_geoid((height_file.path, path), (mine, theirs), geoid)
        if geoid is not None and converted is not None:
            points_vertical_datum = geoid_datum(geoid) if converted == path else points_vertical_datum
            surface_vertical_datum = geoid_datum(geoid) if converted == height_file.path else surface_vertical_datum
        elif (mine is None) != (theirs is None):
            silent = path if theirs is None else height_file.path
            assumed.append(
                f"{silent} does not state its vertical datum: taken to be {above(mine or theirs)}, as of the other"
            )
        if (points_vertical_datum.geoid or surface_vertical_datum.geoid) and self.crs is None:
            raise InputError(f"{path} has no CRS, so no geoid can be added to its heights. Give it with --points-crs.")
        sigma_m = math.nan if options.sigma_m is None else options.sigma_m
        raised = converted or (path if points_vertical_datum.geoid is not None else None)
        return replace(
            self, datums=(mine, theirs), points_vertical_datum=points_vertical_datum,
            surface_vertical_datum=surface_vertical_datum,
            assumed=tuple(assumed), geoid_added_to=raised, default_sigma_m=sigma_m,
        )  # fmt: skip

    def chunks(self) -> Iterator[KnownPoints]:
        """The points inside of the raster, in the surface's CRS, with heights in its vertical datum.

        Raises
        ------
        InputError
            The file is damaged; no point lies in the surface; the geoid does not cover a point.
        """
        n, self_left_out, box = 0, self.left_out, np.array([[np.inf] * 2, [-np.inf] * 2])
        self_left_out.clear()
        for points in self.point_file.chunks(self._bounds()):
            xy = self.in_surface(points.xyz[:, :2])
            inside = self.height_file.inside(xy)
            known = xy[np.isfinite(xy).all(axis=1)]
            if len(known):
                box = np.array([np.minimum(box[0], known.min(axis=0)), np.maximum(box[1], known.max(axis=0))])
            self_left_out[OUTSIDE] = self_left_out.get(OUTSIDE, 0) + int(np.count_nonzero(~inside))
            if not inside.any():
                continue
            n += int(np.count_nonzero(inside))
            yield self._converted(points.where(inside), xy[inside])
        if not n:
            raise self._all_outside(box)

    def _bounds(self) -> Bounds | None:
        """Bounds of the surface in the CRS of the points; None where they cannot be said."""
        mine, bounds = self.height_file.horizontal, self.height_file.bounds
        if mine is None or self.crs is None or self.crs == mine:
            return bounds
        try:
            found = between(self.crs, mine).transform_bounds(*bounds, direction="INVERSE")
        except ProjError:
            return None
        # A CRS in degrees may have its seam in the surface.
        return found if np.isfinite(found).all() and found[0] <= found[2] else None

    def in_surface(self, xy: FloatArray) -> FloatArray:
        """Places (n, 2) of the points' CRS in that of the surface."""
        mine = self.height_file.horizontal
        if mine is None or self.crs is None or self.crs == mine:
            return xy
        transformer: Transformer = between(self.crs, mine)
        found = np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))
        return np.where(np.isfinite(found), found, np.nan)  # infinite where the CRS cannot express a place

    def _converted(self, points: KnownPoints, xy: FloatArray) -> KnownPoints:
        z = points.xyz[:, 2]
        if self.crs is not None:
            z = z + self.points_vertical_datum.undulation(points.xyz[:, :2], self.crs)
            z = z - self.surface_vertical_datum.undulation(points.xyz[:, :2], self.crs)
        measured = points.measured_xy
        if np.isfinite(measured).any():
            measured = self.in_surface(measured)
        sigma_m = np.where(np.isfinite(points.sigma_m), points.sigma_m, self.default_sigma_m)
        return replace(points, xyz=np.column_stack([xy, z]), sigma_m=sigma_m, measured_xy=measured)

    def _all_outside(self, box: FloatArray) -> InputError:
        xmin, ymin, xmax, ymax = self.height_file.bounds
        mine = self.height_file.horizontal
        where = (
            f"they lie between {box[0, 0]:.10g} and {box[1, 0]:.10g}, {box[0, 1]:.10g} and {box[1, 1]:.10g}"
            if np.isfinite(box).all()
            else "by their bounds, or because their places cannot be converted to its CRS"
        )
        of = "" if mine is None else f" ({crs_label(mine)})"
        return InputError(
            f"No point of {self.point_file.path} lies in {self.height_file.path}: {where}; the surface lies between "
            f"{xmin:.10g} and {xmax:.10g}, {ymin:.10g} and {ymax:.10g}{of}. Check the CRS of both (--points-crs)."
        )

    @property
    def dropped(self) -> dict[str, int]:
        """Numbers of points that were left out so far, by the reason."""
        counts = self.point_file.left_out | self.left_out
        return {reason: n for reason, n in counts.items() if n}
