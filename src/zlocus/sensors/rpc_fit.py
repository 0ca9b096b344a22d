"""Rational polynomial coefficients fitted to any sensor model by least squares on a grid of ground points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from scipy.linalg import lstsq

from zlocus.core.errors import GeometryError
from zlocus.core.sensor_model import FloatArray, SensorModel
from zlocus.sensors.rpc import GEOGRAPHIC, RpcCoefficients, RpcModel, rpc_terms

GRID_POINTS = 11
GRID_HEIGHTS = 5
RIDGE = 1e-9


@dataclass(frozen=True)
class RpcFit:
    """Coefficients and their largest difference from the camera.

    max_error_px : largest distance from the exact camera, over points between those of the fit; infinite where the RPC
    fails.
    """

    rpc: RpcCoefficients
    max_error_px: float


def fit_rpc(sensor: SensorModel, shape: tuple[int, int], crs: CRS, z_range: tuple[float, float]) -> RpcFit:
    """Fit an RPC to `sensor` over an image of `shape` (rows, columns) and a range of heights (m).

    Each axis is solved separately, linear in its 39 coefficients. The denominators of near-parallel and airborne rays
    stay near 1, so weighting by them changes nothing and is left out. The ridge keeps terms that the points cannot
    distinguish near zero. Source: Tao & Hu (2001), "A comprehensive study of the rational function model for
    photogrammetric processing", the direct least-squares solution.

    Raises
    ------
    GeometryError
        Where the sensor maps none of the image, or the heights are not a range.
    """
    if not z_range[1] > z_range[0]:
        raise GeometryError(f"An RPC needs a range of heights, not {z_range[0]} to {z_range[1]} m: give low < high.")
    xy, lon_lat_h = _correspondences(sensor, shape, crs, z_range, GRID_POINTS, GRID_HEIGHTS)
    if not np.isfinite(lon_lat_h).all():
        raise GeometryError(f"The sensor does not map all of its {shape[0]} x {shape[1]} image: no RPC fits it.")
    low, high = lon_lat_h.min(axis=0), lon_lat_h.max(axis=0)
    offset, scale = (low + high) / 2, (high - low) / 2
    image_offset = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    image_scale = np.array([shape[1] / 2, shape[0] / 2])
    terms = rpc_terms(*((lon_lat_h - offset) / scale).T).T
    target = (xy - image_offset) / image_scale
    samp_num, samp_den = _fit_ratio(terms, target[:, 0])
    line_num, line_den = _fit_ratio(terms, target[:, 1])
    rpc = RpcCoefficients(
        line_off=float(image_offset[1]), samp_off=float(image_offset[0]), lat_off=float(offset[1]),
        lon_off=float(offset[0]), height_off=float(offset[2]), line_scale=float(image_scale[1]),
        samp_scale=float(image_scale[0]), lat_scale=float(scale[1]), lon_scale=float(scale[0]),
        height_scale=float(scale[2]), line_num=line_num, line_den=line_den, samp_num=samp_num, samp_den=samp_den,
    )  # fmt: skip
    xy, lon_lat_h = _correspondences(sensor, shape, crs, z_range, 2 * GRID_POINTS, GRID_HEIGHTS + 1)
    fitted = RpcModel(rpc, crs).image_from_geographic(*lon_lat_h.T)
    error = np.hypot(*(fitted - xy).T)
    return RpcFit(rpc, float(np.where(np.isnan(error), np.inf, error).max()))


def _correspondences(
    sensor: SensorModel, shape: tuple[int, int], crs: CRS, z_range: tuple[float, float], n_points: int, n_heights: int
) -> tuple[FloatArray, FloatArray]:
    """Image positions (n, 2) px over the whole image, and the longitudes, latitudes and heights (n, 3) that they
    see."""
    cols = np.linspace(-0.5, shape[1] - 0.5, n_points)
    rows = np.linspace(-0.5, shape[0] - 0.5, n_points)
    z, row, col = (a.ravel() for a in np.meshgrid(np.linspace(*z_range, n_heights), rows, cols, indexing="ij"))
    xy = np.column_stack([col, row])
    xyz = sensor.ground_from_image(xy, z)
    to_geographic = Transformer.from_crs(crs.to_2d(), GEOGRAPHIC.to_2d(), always_xy=True)
    lon, lat = to_geographic.transform(xyz[:, 0], xyz[:, 1])
    return xy, np.column_stack([lon, lat, z])


def _fit_ratio(terms: FloatArray, target: FloatArray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Numerator and denominator (20 each, the denominator's first is 1) with numerator / denominator = target (n,)."""
    design = np.hstack([terms, -target[:, None] * terms[:, 1:]])
    ridge = RIDGE * np.sqrt(len(terms)) * np.eye(design.shape[1])
    solution = lstsq(np.vstack([design, ridge]), np.append(target, np.zeros(len(ridge))), lapack_driver="gelsy")[0]
    return tuple(map(float, solution[:20])), (1.0, *map(float, solution[20:]))
