"""Polygons on the ground as an image sees them, for masks whose coordinates are those of a CRS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from zlocus.core.errors import InputError
from zlocus.core.scene import is_local
from zlocus.core.sensor_model import SensorModel

# Edges are straight in the CRS of their file. Before they are projected each is cut into pieces of at most this
# fraction of the ground that the image shows, so that they keep their course.
MIN_PIECES_PER_IMAGE = 200
# Polygons are cut off at this share of its size beyond the image: a camera may not map what lies far beside it.
MARGIN_SHARE = 0.25
# Points along each side of an image whose ground says how far it reaches.
POINTS_PER_SIDE = 9


@dataclass(frozen=True)
class GroundView:
    """How an image sees the ground.

    sensor : in the frame of the scene, whose CRS is `crs`; shape : rows and columns of the image; mean_height : of the
    ground, ellipsoidal m, where the camera says it.
    """

    sensor: SensorModel
    crs: CRS
    shape: tuple[int, int]
    mean_height: float | None

    def pixels_of(
        self, polygons: NDArray[np.object_], crs: CRS, height: float | None, path: Path
    ) -> NDArray[np.object_]:
        """Polygons (n,) in pixels of the image, with (0, 0) at the centre of the first one.

        polygons : x before y, in a CRS; height : at which they lie, ellipsoidal m, None: the mean height of the camera;
        path : of their file, for messages.

        Raises
        ------
        InputError
            There is no height, the frame has no place on the Earth, or the camera cannot map the polygons.
        """
        if is_local(self.crs):
            raise InputError(
                f"{path} has polygons on the Earth, and frame is local. Give them with coordinates: pixels."
            )
        z = self.mean_height if height is None else height
        if z is None:
            raise InputError(
                f"{path} has polygons on the ground, and this camera does not say at which height. Give `height` (m "
                "above the ellipsoid), or polygons with coordinates: pixels."
            )
        if not len(polygons):
            return polygons
        xmin, ymin, xmax, ymax = box = self._shown_box(z, crs, path)
        near = shapely.clip_by_rect(_valid(polygons), *box)
        near = shapely.segmentize(near[~shapely.is_empty(near)], max(xmax - xmin, ymax - ymin) / MIN_PIECES_PER_IMAGE)
        to_frame = Transformer.from_crs(crs.to_2d(), self.crs.to_2d(), always_xy=True)

        def in_image(xy: NDArray[np.float64]) -> NDArray[np.float64]:
            x, y = to_frame.transform(*xy.T)
            return self.sensor.image_from_ground(np.column_stack([x, y, np.full(len(xy), z)]))

        projected = np.asarray(shapely.transform(near, in_image))
        if not np.isfinite(shapely.get_coordinates(projected)).all():
            raise InputError(
                f"The camera does not map all polygons of {path} at {z:g} m. Give another `height`, or polygons with "
                "coordinates: pixels."
            )
        return projected

    def _shown_box(self, z: float, crs: CRS, path: Path) -> tuple[float, float, float, float]:
        """Bounds of the ground that the image shows at a height, with a margin, in another CRS."""
        across, down = (np.linspace(-0.5, n - 0.5, POINTS_PER_SIDE) for n in reversed(self.shape))
        xy = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        ground = self.sensor.ground_from_image(xy, np.full(len(xy), z))[:, :2]
        ground = ground[np.isfinite(ground).all(axis=1)]
        if not len(ground):
            raise InputError(
                f"The camera shows no ground at {z:g} m, where {path} has polygons. Give another `height`."
            )
        from_frame = Transformer.from_crs(self.crs.to_2d(), crs.to_2d(), always_xy=True)
        shown = np.column_stack(from_frame.transform(*ground.T))
        low, high = shown.min(axis=0), shown.max(axis=0)
        margin = MARGIN_SHARE * float((high - low).max())
        return float(low[0] - margin), float(low[1] - margin), float(high[0] + margin), float(high[1] + margin)


def _valid(polygons: NDArray[np.object_]) -> NDArray[np.object_]:
    """Polygons that do not cross themselves, which can be cut."""
    parts = np.array(polygons, object)
    wrong = ~shapely.is_valid(parts)
    parts[wrong] = shapely.make_valid(parts[wrong])
    parts = shapely.get_parts(shapely.get_parts(parts))
    return np.asarray(parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON])
