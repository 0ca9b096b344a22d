"""The interface of all kinds of camera in a `scene.yaml`: reading one, and building its sensor model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Protocol

from pyproj import CRS

from zlocus.core.sensor_model import SensorModel
from zlocus.io.schema import FiniteNumber, StrictModel

Vector = tuple[FiniteNumber, FiniteNumber, FiniteNumber]


class OpenedCamera(Protocol):
    """A camera that has been read, before the CRS of the scene is known."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files from which it was read, besides the image."""
        ...

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """Longitude and latitude (degrees) of the image's centre; None for a camera without a place on the Earth.

        shape : rows and columns of the image.
        """
        ...

    def sensor(self, crs: CRS) -> SensorModel:
        """The sensor model in the frame of the scene, whose CRS is `crs`."""
        ...


class CameraEntry(StrictModel, ABC):
    """The `camera` entry of a view: its kind, and the keys of that kind."""

    @abstractmethod
    def read(self, folder: Path, image: Path) -> OpenedCamera:
        """Read the camera of an image. folder : of the scene file, where relative paths start."""

    def with_default_crs(self, crs: str | None) -> CameraEntry:
        """The entry with `crs`, that of the scene file's frame, filled in where it names no CRS itself."""
        return self
