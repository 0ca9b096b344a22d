"""The kinds of camera in a `scene.yaml`. A new kind is one class in its own file, and a line in `CAMERA_KINDS`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pyproj import CRS

from zlocus.core.sensor_model import SensorModel
from zlocus.io.cameras.camera_entry import CameraEntry
from zlocus.io.cameras.frame_camera import FrameCamera
from zlocus.io.cameras.linescan import LineScanCamera
from zlocus.io.cameras.location_grid import LocationGridCamera
from zlocus.io.cameras.rpc import find_sidecar, read_rpc
from zlocus.io.schema import FiniteNumber
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.rpc import RpcCoefficients, RpcModel


@dataclass(frozen=True)
class RpcSource:
    """An RPC that has been read.

    shift : (column, row) px added to its positions; files : files of the RPC, none where it is in the image.
    """

    rpc: RpcCoefficients
    shift: tuple[float, float] | None = None
    files: tuple[Path, ...] = ()

    def centre(self, shape: tuple[int, int]) -> tuple[float, float] | None:
        """See `OpenedCamera`; computed at the height offset of the RPC."""
        xy = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
        # Any CRS will do, because the result is geographic.
        model = RpcModel(self.rpc, CRS.from_epsg(3857))
        lon, lat = model.geographic_from_image(xy, np.array([self.rpc.height_off]))
        return (float(lon[0]), float(lat[0])) if np.isfinite(lon[0]) else None

    def sensor(self, crs: CRS) -> SensorModel:
        """See `OpenedCamera`."""
        model = RpcModel(self.rpc, crs)
        return model if self.shift is None else ShiftedModel(model, column=self.shift[0], row=self.shift[1])


class RpcCamera(CameraEntry):
    """An RPC: from `file`, else found beside or in the image. shift : (column, row) px added to its positions."""

    kind: Literal["rpc"] = "rpc"
    file: str | None = None
    shift: tuple[FiniteNumber, FiniteNumber] | None = None

    def read(self, folder: Path, image: Path) -> RpcSource:
        """See `CameraEntry`."""
        file = find_sidecar(image) if self.file is None else folder / self.file
        return RpcSource(read_rpc(image, file), self.shift, () if file is None else (file,))


CAMERA_KINDS: dict[str, type[CameraEntry]] = {
    "rpc": RpcCamera, "frame": FrameCamera, "linescan": LineScanCamera, "location_grid": LocationGridCamera,
}  # fmt: skip
