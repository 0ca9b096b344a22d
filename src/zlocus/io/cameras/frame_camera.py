"""Frame cameras of a `scene.yaml`: interior orientation, distortion, and pose in a map or a local frame."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)
from pyproj import CRS
from pyproj.exceptions import CRSError

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.quoting import quoted
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import SensorModel
from zlocus.io.cameras.camera_entry import CameraEntry, Vector
from zlocus.io.crs import checked_crs
from zlocus.io.open_raster import open_raster
from zlocus.io.schema import FiniteNumber, StrictModel
from zlocus.sensors.distortion import BrownDistortion, Distortion, FisheyeDistortion
from zlocus.sensors.earth_frame import between
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.rolling_shutter import RollingShutter

ORTHONORMAL_TOLERANCE = 1e-4
# Larger than any camera on or above the Earth needs. A larger number is a sign of damage, and could overflow later.
MAX_COORDINATE_M = 1e9
MAX_CAMERA_PX = 1e7
# A smaller focal length counts as 0.
MIN_FOCAL_PX = 1e-6
# No camera reads its rows more slowly, and nothing that carries one flies faster.
MAX_READOUT_S, MAX_VELOCITY_M_S = 1.0, 1000.0

Coordinate = Annotated[FiniteNumber, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Pixels = Annotated[FiniteNumber, Field(ge=-MAX_CAMERA_PX, le=MAX_CAMERA_PX)]
FocalLength = Annotated[FiniteNumber, Field(gt=MIN_FOCAL_PX, le=MAX_CAMERA_PX)]
Velocity = Annotated[FiniteNumber, Field(ge=-MAX_VELOCITY_M_S, le=MAX_VELOCITY_M_S)]


def _pair(value: Any) -> Any:
    """The focal lengths of both directions; a single number holds for both."""
    return (value, value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _one_or_pair(pair: tuple[float, float]) -> float | list[float]:
    return pair[0] if pair[0] == pair[1] else list(pair)


FocalLengths = Annotated[
    tuple[FocalLength, FocalLength], BeforeValidator(_pair), PlainSerializer(_one_or_pair, when_used="json")
]


class EntryWithoutDefaults(StrictModel):
    """Base class of entries that are written without values that equal their defaults; `kind` comes first."""

    @model_serializer(mode="wrap")
    def _without_defaults(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values, fields = write(self), type(self).model_fields
        kept = {key: value for key, value in values.items() if key != "kind" and value != fields[key].default}
        return ({"kind": values["kind"]} if "kind" in values else {}) | kept


class BrownEntry(EntryWithoutDefaults):
    """Coefficients of `BrownDistortion`; those that are left out are 0."""

    kind: Literal["brown"] = "brown"
    k1: FiniteNumber = 0.0
    k2: FiniteNumber = 0.0
    p1: FiniteNumber = 0.0
    p2: FiniteNumber = 0.0
    k3: FiniteNumber = 0.0
    k4: FiniteNumber = 0.0
    k5: FiniteNumber = 0.0
    k6: FiniteNumber = 0.0

    def model(self) -> BrownDistortion | None:
        """The distortion; None where all coefficients are 0."""
        distortion = BrownDistortion(self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6)
        return None if distortion == BrownDistortion() else distortion


class FisheyeEntry(EntryWithoutDefaults):
    """Coefficients of `FisheyeDistortion`; those that are left out are 0."""

    kind: Literal["fisheye"] = "fisheye"
    k1: FiniteNumber = 0.0
    k2: FiniteNumber = 0.0
    k3: FiniteNumber = 0.0
    k4: FiniteNumber = 0.0

    def model(self) -> FisheyeDistortion:
        """The distortion."""
        return FisheyeDistortion(self.k1, self.k2, self.k3, self.k4)


def distortion_entry(distortion: Distortion | None) -> BrownEntry | FisheyeEntry | None:
    """The entry of a lens distortion; None for an ideal lens."""
    if distortion is None:
        return None
    assert isinstance(distortion, BrownDistortion | FisheyeDistortion), "no other distortion has an entry"
    entry = BrownEntry if isinstance(distortion, BrownDistortion) else FisheyeEntry
    return entry(**{each.name: getattr(distortion, each.name) for each in fields(distortion)})


class RollingShutterEntry(StrictModel):
    """Motion of a camera during the read-out of its image; see `RollingShutter`.

    readout_s : s, time in which all rows are read; negative where the last row is read first; velocity_m_s : of the
    projection centre, in the axes of `rotation` (the map's or the frame's).
    """

    readout_s: Annotated[FiniteNumber, Field(ge=-MAX_READOUT_S, le=MAX_READOUT_S)]
    velocity_m_s: tuple[Velocity, Velocity, Velocity]

    def model(self, rows: int) -> RollingShutter:
        """The motion over an image of so many rows."""
        return RollingShutter(self.readout_s, self.velocity_m_s, rows)


def rolling_shutter_entry(rolling_shutter: RollingShutter | None) -> RollingShutterEntry | None:
    """The entry of the motion of a camera; None for one that takes all rows at once."""
    if rolling_shutter is None:
        return None
    return RollingShutterEntry(readout_s=rolling_shutter.readout_s, velocity_m_s=rolling_shutter.velocity)


class Interior(EntryWithoutDefaults):
    """Interior orientation.

    focal : px, one number, or two (along rows, along columns); principal_point : (column, row) px, with (0, 0) at the
    centre of the first pixel; skew : px added to the column per unit of y.
    """

    focal: FocalLengths
    principal_point: tuple[Pixels, Pixels]
    skew: Pixels = 0.0
    distortion: Annotated[BrownEntry | FisheyeEntry, Field(discriminator="kind")] | None = None


class FrameCamera(CameraEntry, Interior):
    """A frame camera; see `FrameModel`, and `rotation_from_angles` for `angles` (omega, phi, kappa).

    crs : of the centre; the default is that of the scene's frame. earth : with `curved`, the default, rays are straight
    in space and the pose is relative to the axes of the map at the centre; with `flat` the map is taken as Cartesian.
    rolling_shutter : None is a camera that takes all rows at once.
    """

    kind: Literal["frame"] = "frame"
    centre: tuple[Coordinate, Coordinate, Coordinate]
    rotation: tuple[Vector, Vector, Vector] | None = None
    angles: Vector | None = None
    crs: str | None = None
    earth: Literal["curved", "flat"] | None = None
    rolling_shutter: RollingShutterEntry | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> FrameCamera:
        if (self.rotation is None) == (self.angles is None):
            raise ValueError("give either rotation, the rows of a matrix, or angles, omega, phi and kappa in degrees")
        if self.rotation is not None:
            matrix = np.clip(np.array(self.rotation), -2.0, 2.0)
            if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < ORTHONORMAL_TOLERANCE and np.linalg.det(matrix) > 0):
                raise ValueError("the rows of a rotation are at right angles, of length 1, and right-handed")
        return self

    def read(self, folder: Path, image: Path) -> FrameSource:
        """See `CameraEntry`."""
        rotation = self.rotation or rotation_from_angles(*(self.angles or (0.0, 0.0, 0.0)))
        model = FrameModel(
            self.centre, rotation, self.focal[0], self.principal_point, self.focal[1] / self.focal[0], self.skew,
            None if self.distortion is None else self.distortion.model(),
        )  # fmt: skip
        if self.rolling_shutter is not None:
            with open_raster(image) as source:
                model = replace(model, rolling_shutter=self.rolling_shutter.model(source.height))
        return FrameSource(model, image, None if self.crs is None else map_crs(self.crs, image), self.earth != "flat")

    def with_default_crs(self, crs: str | None) -> FrameCamera:
        """See `CameraEntry`."""
        return self if self.crs is not None or crs is None else self.model_copy(update={"crs": crs})


def map_crs(text: str, image: Path) -> CRS:
    """The CRS of the camera of an image.

    Raises
    ------
    InputError
        The text is no CRS.
    ConfigError
        The CRS is not projected in metres.
    """
    try:
        return checked_crs(CRS.from_user_input(text))
    except CRSError as error:
        raise InputError(
            f"The camera of {image} is given in {quoted(text)}, which is no CRS. Write it as EPSG:n."
        ) from error
    except ConfigError as error:
        raise ConfigError(f"The camera of {image}: {error}") from error


@dataclass(frozen=True)
class FrameSource:
    """A frame camera that has been read.

    given : CRS of its pose, None for that of the scene's frame; curved : see `FrameCamera`.
    """

    sensor_in_own_crs: FrameModel
    image: Path
    given: CRS | None = None
    curved: bool = True
    files: tuple[Path, ...] = ()

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """See `OpenedCamera`; the place below the projection centre, wherever the camera looks."""
        if self.given is None:
            return None
        lon, lat = between(self.given, CRS.from_epsg(4326)).transform(*self.sensor_in_own_crs.centre[:2])
        return (float(lon), float(lat)) if np.isfinite(lon) and np.isfinite(lat) else None

    def sensor(self, crs: CRS) -> SensorModel:
        """See `OpenedCamera`.

        Raises
        ------
        ConfigError
            The camera takes another map than the scene's as Cartesian.
        InputError
            The projection centre is no place in its CRS.
        """
        if is_local(crs):
            return self.sensor_in_own_crs
        given = self.given or crs
        if not self.curved:
            if given != crs:
                raise ConfigError(
                    f"The camera of {self.image} has earth: flat, which holds in {given.to_string()} only, not in "
                    f"{crs.to_string()}. Leave --crs out, or write earth: curved."
                )
            return self.sensor_in_own_crs
        model = self.sensor_in_own_crs.on_earth(given, crs)
        if not np.isfinite([*model.centre, *model.camera_from_ground[0]]).all():
            at = ", ".join(f"{v:.12g}" for v in self.sensor_in_own_crs.centre)
            raise InputError(
                f"The camera of {self.image} stands at {at}, which is no place in {given.to_string()}. Check its "
                "centre and the CRS."
            )
        return model
