"""Rational polynomial camera (RPC00B): ratios of cubics from longitude, latitude, height to image row, column."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer

from zlocus.sensors.model import FloatArray

GEOGRAPHIC = CRS.from_epsg(4979)
MAX_ITERATIONS = 30
TOLERANCE_PX = 1e-7
MAX_STEP = 0.5  # of the RPC's box, per Newton iteration


@dataclass(frozen=True)
class RpcCoefficients:
    """The 90 numbers of an RPC in the RPC00B term order, offsets with (0, 0) at the centre of the first pixel.

    line_num, line_den, samp_num, samp_den : (20,) float64. Scales and offsets: pixels, degrees, metres.
    """

    line_off: float
    samp_off: float
    lat_off: float
    lon_off: float
    height_off: float
    line_scale: float
    samp_scale: float
    lat_scale: float
    lon_scale: float
    height_scale: float
    line_num: tuple[float, ...]
    line_den: tuple[float, ...]
    samp_num: tuple[float, ...]
    samp_den: tuple[float, ...]

    @cached_property
    def matrix(self) -> FloatArray:
        """(20, 4) float64: line numerator and denominator, sample numerator and denominator."""
        return np.column_stack([self.line_num, self.line_den, self.samp_num, self.samp_den])

    def moved(self, column: float, row: float) -> RpcCoefficients:
        """The RPC whose image positions are `column` and `row` pixels larger."""
        return replace(self, samp_off=self.samp_off + column, line_off=self.line_off + row)


def rpc_terms(lon: FloatArray, lat: FloatArray, height: FloatArray) -> FloatArray:
    """The 20 monomials of RPC00B. Normalised coordinates (n,) -> (n, 20).

    Source: NIMA STDI-0002 (2000), appendix E, RPC00B: L longitude, P latitude, H height.
    """
    one = np.ones_like(lon)
    ll, pp, hh = lon * lon, lat * lat, height * height
    return np.stack(
        [
            one, lon, lat, height, lon * lat, lon * height, lat * height, ll, pp, hh,
            lat * lon * height, ll * lon, lon * pp, lon * hh, ll * lat, pp * lat, lat * hh, ll * height, pp * height,
            hh * height,
        ]
    ).T  # fmt: skip


def rpc_term_slopes(lon: FloatArray, lat: FloatArray, height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `rpc_terms` by longitude and by latitude. Normalised coordinates (n,) -> 2 x (n, 20)."""
    zero, one = np.zeros_like(lon), np.ones_like(lon)
    ll, pp, hh, lp = lon * lon, lat * lat, height * height, lon * lat
    by_lon = [
        zero, one, zero, zero, lat, height, zero, 2 * lon, zero, zero,
        lat * height, 3 * ll, pp, hh, 2 * lp, zero, zero, 2 * lon * height, zero, zero,
    ]  # fmt: skip
    by_lat = [
        zero, zero, one, zero, lon, zero, height, zero, 2 * lat, zero,
        lon * height, zero, 2 * lp, zero, ll, 3 * pp, hh, zero, 2 * lat * height, zero,
    ]  # fmt: skip
    return np.stack(by_lon).T, np.stack(by_lat).T


@dataclass(frozen=True)
class RpcModel:
    """An RPC as a `SensorModel` in a projected CRS (ellipsoidal heights)."""

    rpc: RpcCoefficients
    crs: CRS
    _to_geographic: Transformer = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        transformer = Transformer.from_crs(self.crs.to_2d(), GEOGRAPHIC.to_2d(), always_xy=True)
        object.__setattr__(self, "_to_geographic", transformer)

    def image_from_ground(self, xyz: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        xyz = np.asarray(xyz, float)
        lon, lat = self._to_geographic.transform(xyz[:, 0], xyz[:, 1])
        return self.image_from_geographic(np.asarray(lon), np.asarray(lat), xyz[:, 2])

    def ground_from_image(self, xy: FloatArray, z: FloatArray) -> FloatArray:
        """See `SensorModel`."""
        z = np.broadcast_to(np.asarray(z, float), (len(xy),))
        lon, lat = self.geographic_from_image(np.asarray(xy, float), z)
        x, y = self._to_geographic.transform(lon, lat, direction="INVERSE")
        xyz = np.column_stack([x, y, z])
        xyz[~np.isfinite(xyz).all(axis=1)] = np.nan
        return xyz

    def height_bounds(self) -> tuple[float, float]:
        """See `SensorModel`: the RPC's height box."""
        return self.rpc.height_off - self.rpc.height_scale, self.rpc.height_off + self.rpc.height_scale

    def image_from_geographic(self, lon: FloatArray, lat: FloatArray, height: FloatArray) -> FloatArray:
        """Longitude, latitude (degrees, WGS84) and ellipsoidal height (m), each (n,) -> xy (n, 2) px.

        NaN beyond a pole of the rational function (far outside the RPC's box), where its value means nothing.
        """
        rpc = self.rpc
        xy = self._ratios(*self._normalised(lon, lat, height))
        xy *= [rpc.samp_scale, rpc.line_scale]
        xy += [rpc.samp_off, rpc.line_off]
        return xy

    def geographic_from_image(self, xy: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Longitude and latitude (degrees) where the rays of xy (n, 2) px meet height z (n,) m.

        Newton with the exact derivative from the centre of the RPC's box, damped by at most half the box a step so that
        crops far from the centre of a large box converge too. NaN where it does not reach `TOLERANCE_PX`.
        """
        rpc = self.rpc
        scale = np.array([rpc.samp_scale, rpc.line_scale])
        target = (xy - np.array([rpc.samp_off, rpc.line_off])) / scale
        height = (z - rpc.height_off) / rpc.height_scale
        lon, lat = np.zeros(len(xy)), np.zeros(len(xy))
        done = np.zeros(len(xy), bool)
        active = np.arange(len(xy))
        for _ in range(MAX_ITERATIONS):
            residual = target[active] - self._ratios(lon[active], lat[active], height[active])
            reached = (np.abs(residual * scale) < TOLERANCE_PX).all(axis=1)
            lost = ~np.isfinite(residual).all(axis=1)
            done[active[reached]] = True
            active, residual = active[~(reached | lost)], residual[~(reached | lost)]
            if not active.size:
                break
            step = self._newton_step(lon[active], lat[active], height[active], residual)
            lon[active] += step[:, 0]
            lat[active] += step[:, 1]
        lon_deg = np.remainder(lon * rpc.lon_scale + rpc.lon_off + 180.0, 360.0) - 180.0
        lat_deg = lat * rpc.lat_scale + rpc.lat_off
        return np.where(done, lon_deg, np.nan), np.where(done, lat_deg, np.nan)

    def _normalised(
        self, lon: FloatArray, lat: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Degrees and metres -> the RPC's normalised coordinates; longitudes across the date line are neighbours."""
        rpc = self.rpc
        # Points pyproj could not project are infinite; they become NaN.
        with np.errstate(invalid="ignore", over="ignore"):
            from_centre = np.remainder(lon - rpc.lon_off + 180.0, 360.0) - 180.0
            return (
                from_centre / rpc.lon_scale,
                (lat - rpc.lat_off) / rpc.lat_scale,
                (height - rpc.height_off) / rpc.height_scale,
            )

    def _ratios(self, lon: FloatArray, lat: FloatArray, height: FloatArray) -> FloatArray:
        """Normalised ground (n,) -> normalised (sample, line) (n, 2)."""
        with np.errstate(all="ignore"):
            line_num, line_den, samp_num, samp_den = (rpc_terms(lon, lat, height) @ self.rpc.matrix).T
            ratios = np.column_stack([samp_num / samp_den, line_num / line_den])
            # The constant term is the denominator at the centre of the box: another sign means a pole in between.
            beyond = ~((line_den * self.rpc.line_den[0] > 0) & (samp_den * self.rpc.samp_den[0] > 0))
        ratios[beyond | ~np.isfinite(ratios).all(axis=1)] = np.nan
        return ratios

    def _newton_step(self, lon: FloatArray, lat: FloatArray, height: FloatArray, residual: FloatArray) -> FloatArray:
        """Normalised (longitude, latitude) step (n, 2) that removes residual (n, 2), each at most `MAX_STEP`."""
        matrix = self.rpc.matrix
        with np.errstate(all="ignore"):
            line_num, line_den, samp_num, samp_den = (rpc_terms(lon, lat, height) @ matrix).T
            slopes = []
            for term_slopes in rpc_term_slopes(lon, lat, height):
                d_line_num, d_line_den, d_samp_num, d_samp_den = (term_slopes @ matrix).T
                samp = (d_samp_num - samp_num / samp_den * d_samp_den) / samp_den
                line = (d_line_num - line_num / line_den * d_line_den) / line_den
                slopes.append((samp, line))
            (samp_lon, line_lon), (samp_lat, line_lat) = slopes
            determinant = samp_lon * line_lat - line_lon * samp_lat
            step = np.column_stack(
                [
                    (residual[:, 0] * line_lat - residual[:, 1] * samp_lat) / determinant,
                    (samp_lon * residual[:, 1] - line_lon * residual[:, 0]) / determinant,
                ]
            )
        return np.asarray(np.clip(np.nan_to_num(step, nan=np.inf), -MAX_STEP, MAX_STEP))
