"""What every kind of camera in a `scene.yaml` offers: how it is read, and its sensor model once the frame is known."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Protocol

from pyproj import CRS

from zlocus.core.sensor_model import SensorModel
from zlocus.io.schema import FiniteNumber, StrictModel

Vector = tuple[FiniteNumber, FiniteNumber, FiniteNumber]


class OpenedCamera(Protocol):
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


class CameraEntry(StrictModel, ABC):
    """The `camera` entry of a view: `kind` and what that kind needs."""

    @abstractmethod
    def read(self, folder: Path, image: Path) -> OpenedCamera:
        """The camera of an image; relative paths start at `folder`, that of the scene file."""

    def with_default_crs(self, crs: str | None) -> CameraEntry:
        """The camera whose coordinates, where it names no CRS of its own, are in that of the scene file's frame."""
        return self
