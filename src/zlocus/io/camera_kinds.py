"""The kinds of camera a `scene.yaml` can name. A new kind is one class, in a file of its own, and a line in `KINDS`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from pydantic import Field, FiniteFloat, model_validator
from pyproj import CRS

from zlocus.io.cameras import find_sidecar, read_rpc
from zlocus.io.strict import StrictModel
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.frame import FrameModel, rotation_from_angles
from zlocus.sensors.model import SensorModel
from zlocus.sensors.rpc import RpcCoefficients, RpcModel

ORTHONORMAL = 1e-4


class CameraSource(Protocol):
    """A camera that has been read, before the scene's CRS is known."""

    @property
    def files(self) -> tuple[Path, ...]:
        """What it was read from, besides the image."""
        ...

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """Longitude and latitude (degrees) of the image's centre; None for a camera that knows only its own frame."""
        ...

    def sensor(self, crs: CRS) -> SensorModel:
        """The sensor model in the scene's frame."""
        ...


class Camera(StrictModel, ABC):
    """The `camera` entry of a view: `kind` and what that kind needs."""

    @abstractmethod
    def read(self, folder: Path, image: Path) -> CameraSource:
        """The camera of an image; relative paths start at `folder`, that of the scene file."""


@dataclass(frozen=True)
class RpcSource:
    """An RPC, the shift (column, row) px laid over it, and the files it stands in where that is not the image."""

    rpc: RpcCoefficients
    shift: tuple[float, float] | None = None
    files: tuple[Path, ...] = ()

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """See `CameraSource`; at the RPC's height offset."""
        xy = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
        # The CRS plays no part in the geographic direction.
        model = RpcModel(self.rpc, CRS.from_epsg(3857))
        lon, lat = model.geographic_from_image(xy, np.array([self.rpc.height_off]))
        return (float(lon[0]), float(lat[0])) if np.isfinite(lon[0]) else None

    def sensor(self, crs: CRS) -> SensorModel:
        """See `CameraSource`."""
        model = RpcModel(self.rpc, crs)
        return model if self.shift is None else ShiftedModel(model, column=self.shift[0], row=self.shift[1])


class RpcCamera(Camera):
    """An RPC: from `file`, else found beside or in the image. shift: pixels (column, row) added to what it projects."""

    kind: Literal["rpc"] = "rpc"
    file: str | None = None
    shift: tuple[FiniteFloat, FiniteFloat] | None = None

    def read(self, folder: Path, image: Path) -> RpcSource:
        """See `Camera`."""
        file = find_sidecar(image) if self.file is None else folder / self.file
        return RpcSource(read_rpc(image, file), self.shift, () if file is None else (file,))


@dataclass(frozen=True)
class FrameSource:
    """A frame camera, given in the scene's frame."""

    model: FrameModel
    files: tuple[Path, ...] = ()

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """See `CameraSource`: it knows only its own frame."""
        return None

    def sensor(self, crs: CRS) -> SensorModel:
        """See `CameraSource`."""
        return self.model


Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class FrameCamera(Camera):
    """An ideal pinhole camera; see `FrameModel`, and `rotation_from_angles` for `angles` (omega, phi, kappa)."""

    kind: Literal["frame"] = "frame"
    focal: FiniteFloat = Field(gt=0)
    principal_point: tuple[FiniteFloat, FiniteFloat]
    centre: Vector
    rotation: tuple[Vector, Vector, Vector] | None = None
    angles: Vector | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> FrameCamera:
        if (self.rotation is None) == (self.angles is None):
            raise ValueError("give either rotation, the rows of a matrix, or angles, omega, phi and kappa in degrees")
        if self.rotation is not None:
            matrix = np.array(self.rotation)
            if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < ORTHONORMAL and np.linalg.det(matrix) > 0):
                raise ValueError("the rows of a rotation are at right angles, of length 1, and right-handed")
        return self

    def read(self, folder: Path, image: Path) -> FrameSource:
        """See `Camera`."""
        rotation = self.rotation or rotation_from_angles(*(self.angles or (0.0, 0.0, 0.0)))
        return FrameSource(FrameModel(self.centre, rotation, self.focal, self.principal_point))


KINDS: dict[str, type[Camera]] = {"rpc": RpcCamera, "frame": FrameCamera}
