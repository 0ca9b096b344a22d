"""The `linescan` camera of a `scene.yaml`: focal plane, trajectory and line times (see docs/reference/linescan.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from affine import Affine
from pydantic import AfterValidator, Field, model_validator
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import InputError
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import SensorModel
from zlocus.io.cameras.camera_entry import CameraEntry, Vector
from zlocus.io.cameras.linescan_files import Rays, read_calibration, read_times, read_trajectory
from zlocus.io.crs import is_on_earth
from zlocus.io.open_raster import open_raster
from zlocus.io.schema import FiniteNumber, StrictModel, WholeNumber
from zlocus.sensors.earth_frame import WGS84, WGS84_EARTH, EarthSpace, FrameSpace, Space
from zlocus.sensors.linescan import FocalLine, LineScanModel, LineTimes, RectifiedModel
from zlocus.sensors.trajectory import Trajectory


def _known(crs: str) -> str:
    try:
        known = is_on_earth(CRS.from_user_input(crs))
    except CRSError:
        known = False
    if not known:
        raise ValueError("is no CRS; write it as EPSG:n")
    return crs


# Smaller times (s), focal lengths (mm) and areas of a pixel (m2) count as 0.
MIN_POSITIVE = 1e-12
CrsName = Annotated[str, AfterValidator(_known)]


class RegularTimes(StrictModel):
    """Equally spaced exposures of rows.

    start : time of the middle of row 0, s; interval : time from row to row, s, negative where row 0 was exposed last.
    """

    start: FiniteNumber
    interval: FiniteNumber

    @model_validator(mode="after")
    def _moving(self) -> RegularTimes:
        if abs(self.interval) < MIN_POSITIVE:
            raise ValueError("interval is the time from row to row, which is not 0")
        return self


class Rectification(StrictModel):
    """The plane to which a level 1 image was resampled.

    height : of the plane, ellipsoidal m; transform : a, b, c, d, e, f as in GeoTIFF, x = a column + b row + c and
    y = d column + e row + f, counted from the outer corner of the first pixel; crs : of x and y, by default the
    scene's; rows : number of rows of the raw image; trajectory : the one used for the resampling, if the camera's has
    been corrected since. Both trajectories have the same crs, lever arm and boresight.
    """

    height: FiniteNumber
    transform: tuple[FiniteNumber, FiniteNumber, FiniteNumber, FiniteNumber, FiniteNumber, FiniteNumber]
    crs: CrsName | None = None
    rows: WholeNumber = Field(gt=1)
    trajectory: str | None = None

    @model_validator(mode="after")
    def _turns_back(self) -> Rectification:
        if not abs(Affine(*self.transform).determinant) > MIN_POSITIVE:
            raise ValueError("transform flattens the image to a line; give a, b, c, d, e, f with a e - b d not 0")
        return self


class LineScanCamera(CameraEntry):
    """A line scanner. For its files see `read_calibration`, `read_trajectory` and `read_times`.

    line : name of the line in the calibration file; first_column : detector of the image's first column; rays : whether
    rays are straight in space ("earth") or in the scene's frame ("frame"); lever_arm : m to the right, forward and up
    of the platform; boresight : omega, phi, kappa, degrees.
    """

    kind: Literal["linescan"] = "linescan"
    calibration: str
    line: str | None = None
    focal_mm: FiniteNumber = Field(gt=MIN_POSITIVE)
    first_column: WholeNumber = Field(default=0, ge=0)
    trajectory: str
    crs: CrsName | None = None
    rays: Rays = "earth"
    times: RegularTimes | str
    lever_arm: Vector = (0.0, 0.0, 0.0)
    boresight: Vector = (0.0, 0.0, 0.0)
    rectification: Rectification | None = None

    def read(self, folder: Path, image: Path) -> LineScanSource:
        """See `CameraEntry`."""
        files = [folder / self.calibration, folder / self.trajectory]
        with open_raster(image) as source:
            shape = (source.height, source.width)
        line = read_calibration(files[0], self.line, self.focal_mm)
        n_rows, n_cols = shape if self.rectification is None else (self.rectification.rows, None)
        line = self._cut(line, n_cols, files[0], image)
        if isinstance(self.times, str):
            files.append(folder / self.times)
            lines = read_times(files[-1], n_rows)
        else:
            lines = LineTimes.regular(self.times.start, self.times.interval, n_rows)
        crs, n_own = None if self.crs is None else CRS.from_user_input(self.crs), len(files)
        if self.rectification is not None and self.rectification.trajectory is not None:
            files.append(folder / self.rectification.trajectory)
        mounted = crs, self.rays, np.array(self.boresight), np.array(self.lever_arm)
        trajectory, *others = (read_trajectory(file, *mounted) for file in (files[1], *files[n_own:]))
        _check_covered(trajectory, lines, n_rows, files[1], image)
        plane_trajectory = others[0] if others else trajectory
        return LineScanSource(
            line, lines, trajectory, plane_trajectory, self.rays, crs, self.rectification, tuple(files)
        )

    def with_default_crs(self, crs: str | None) -> LineScanCamera:
        """See `CameraEntry`. Only a trajectory in the scene's frame takes its CRS from it."""
        takes = self.rays == "frame" and self.crs is None and crs is not None
        return self.model_copy(update={"crs": crs}) if takes else self

    def _cut(self, line: FocalLine, n_cols: int | None, file: Path, image: Path) -> FocalLine:
        """The detectors of the image's columns; n_cols None: all detectors from the first column on."""
        n = len(line.xy_mm)
        end = n if n_cols is None else self.first_column + n_cols
        if end > n or end - self.first_column < 2:
            raise InputError(
                f"{image} begins at column {self.first_column} of the line in {file} and would end at {end - 1}, but "
                f"columns go from 0 to {n - 1}. Check first_column, and that both belong together."
            )
        return FocalLine(line.xy_mm[self.first_column : end], line.focal_mm)


def _check_covered(trajectory: Trajectory, lines: LineTimes, n_rows: int, file: Path, image: Path) -> None:
    first, last = np.sort(lines.time(np.array([0.0, n_rows - 1.0])))
    start, end = trajectory.times[0], trajectory.times[-1]
    if first < start or last > end:
        raise InputError(
            f"The rows of {image} were exposed from {first:.6f} to {last:.6f} s, but the trajectory {file} goes from "
            f"{start:.6f} to {end:.6f} s. Check times, and give a trajectory that runs on at both ends."
        )


@dataclass(frozen=True, eq=False)
class LineScanSource:
    """A line scanner that has been read; see `LineScanCamera`.

    plane_trajectory : the trajectory with which a level 1 image was resampled.
    """

    line: FocalLine
    lines: LineTimes
    trajectory: Trajectory
    plane_trajectory: Trajectory
    rays: Rays
    crs: CRS | None
    rectification: Rectification | None
    files: tuple[Path, ...]

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """See `OpenedCamera`; the place below the camera at the middle row. None with rays straight in the frame."""
        if self.rays == "frame":
            return None
        middle = self.trajectory.pose(self.lines.time(self.lines.rows[[0, -1]].mean(keepdims=True)))[9:]
        lon, lat, _ = WGS84_EARTH.geographic_from_cartesian(middle.T)[0]
        return float(lon), float(lat)

    def sensor(self, crs: CRS) -> SensorModel:
        """See `OpenedCamera`.

        Raises
        ------
        InputError
            Rays are straight in another frame than the scene's, or the scene has no place on the Earth.
        """
        raw = LineScanModel(self.line, self.lines, self.trajectory, self._space(crs))
        if self.rectification is None:
            return raw
        plane_crs, over_plane = self.rectification.crs, raw
        if plane_crs is not None or self.plane_trajectory is not self.trajectory:
            space = self._space(crs if plane_crs is None else CRS.from_user_input(plane_crs))
            over_plane = LineScanModel(self.line, self.lines, self.plane_trajectory, space)
        # GeoTIFF counts from the outer corner of the first pixel.
        plane_from_image = Affine(*self.rectification.transform) * Affine.translation(0.5, 0.5)
        return RectifiedModel(raw, over_plane, self.rectification.height, plane_from_image)

    def _space(self, crs: CRS) -> Space:
        if self.rays == "earth":
            if is_local(crs):
                raise InputError(
                    f"The trajectory {self.files[1]} knows its place on the Earth, but frame is local. Write frame: "
                    "{crs: EPSG:n}, or rays: frame for a trajectory in the frame's own coordinates."
                )
            return EarthSpace(crs, WGS84)
        if self.crs is not None and self.crs.to_2d() != crs:
            raise InputError(
                f"With rays: frame the trajectory {self.files[1]} in {self.crs.to_string()} cannot be seen in "
                f"{crs.to_string()}. Give the same CRS to both, or rays: earth."
            )
        return FrameSpace()
