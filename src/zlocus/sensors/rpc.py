"""Rational polynomial camera (RPC00B): ratios of cubic polynomials from longitude, latitude and height to the image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer

from zlocus.core.sensor_model import FloatArray

GEOGRAPHIC = CRS.from_epsg(4979)
MAX_ITERATIONS = 30
TOLERANCE_PX = 1e-7
# Largest Newton step, in half sizes of the RPC's box.
MAX_STEP = 0.5
# The cubic terms (see `rpc_terms`) as products of a quadratic and a linear one.
CUBICS = (
    (10, 6, 1), (11, 7, 1), (12, 8, 1), (13, 9, 1), (14, 7, 2), (15, 8, 2), (16, 9, 2), (17, 7, 3), (18, 8, 3),
    (19, 9, 3),
)  # fmt: skip
# Derivatives of the terms by longitude and by latitude: term, factor, and the term that it is a multiple of.
BY_LON = (
    (1, 1, 0), (4, 1, 2), (5, 1, 3), (7, 2, 1), (10, 1, 6), (11, 3, 7), (12, 1, 8), (13, 1, 9), (14, 2, 4), (17, 2, 5),
)  # fmt: skip
BY_LAT = (
    (2, 1, 0), (4, 1, 1), (6, 1, 3), (8, 2, 2), (10, 1, 5), (12, 2, 4), (14, 1, 7), (15, 3, 8), (16, 1, 9), (18, 2, 6),
)  # fmt: skip


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
        """Coefficients (4, 20) float64 of the terms: line numerator, line denominator, sample numerator and
        denominator."""
        return np.array([self.line_num, self.line_den, self.samp_num, self.samp_den])

    @cached_property
    def slopes(self) -> FloatArray:
        """Coefficients (8, 10) float64 of the quadratic terms in the derivatives of the four polynomials, by longitude,
        then by latitude."""
        slopes = np.zeros((2, 4, 10))
        for axis, rules in enumerate((BY_LON, BY_LAT)):
            for term, factor, quadratic in rules:
                slopes[axis, :, quadratic] = factor * self.matrix[:, term]
        return slopes.reshape(8, 10)

    def moved(self, column: float, row: float) -> RpcCoefficients:
        """The RPC with its image positions increased by `column` and `row` pixels."""
        return replace(self, samp_off=self.samp_off + column, line_off=self.line_off + row)


def rpc_terms(lon: FloatArray, lat: FloatArray, height: FloatArray) -> FloatArray:
    """The 20 monomials of RPC00B. Normalised coordinates (n,) -> (20, n); the first ten are those of a quadratic.

    Source: NIMA STDI-0002 (2000), appendix E, RPC00B: L longitude, P latitude, H height.
    """
    terms = np.empty((20, len(lon)))
    terms[0], terms[1], terms[2], terms[3] = 1.0, lon, lat, height
    factors = ((lon, lat), (lon, height), (lat, height), (lon, lon), (lat, lat), (height, height))
    for term, (one, other) in enumerate(factors, 4):
        np.multiply(one, other, out=terms[term])
    for term, quadratic, factor in CUBICS:
        np.multiply(terms[quadratic], terms[factor], out=terms[term])
    return terms


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
        """Image positions (n, 2) px of longitudes, latitudes (degrees, WGS84) and ellipsoidal heights (m), (n,) each.

        NaN beyond a pole of the rational function (far outside the RPC's box), where its value means nothing.
        """
        rpc = self.rpc
        with np.errstate(all="ignore"):
            values = rpc.matrix @ rpc_terms(*self._normalised(lon, lat, height))
        xy = np.ascontiguousarray(self._ratios(values).T)
        xy *= [rpc.samp_scale, rpc.line_scale]
        xy += [rpc.samp_off, rpc.line_off]
        return xy

    def geographic_from_image(self, xy: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Longitudes and latitudes (degrees) where the rays of xy (n, 2) px meet heights z (n,) m.

        Newton's method with exact derivatives starts at the centre of the RPC's box. A step is limited to half the box,
        so that crops far from the centre of a large box converge too. NaN where it does not reach `TOLERANCE_PX`.
        """
        rpc = self.rpc
        scale = np.array([[rpc.samp_scale], [rpc.line_scale]])
        target = (xy.T - np.array([[rpc.samp_off], [rpc.line_off]])) / scale
        height = (z - rpc.height_off) / rpc.height_scale
        lon, lat = np.zeros(len(xy)), np.zeros(len(xy))
        done = np.zeros(len(xy), bool)
        active = np.arange(len(xy))
        for _ in range(MAX_ITERATIONS):
            with np.errstate(all="ignore"):
                terms = rpc_terms(lon[active], lat[active], height[active])
                values = rpc.matrix @ terms
            residual = target[:, active] - self._ratios(values)
            reached = (np.abs(residual * scale) < TOLERANCE_PX).all(axis=0)
            going = np.isfinite(residual).all(axis=0) & ~reached
            done[active[reached]] = True
            if not going.any():
                break
            active = active[going]
            step_lon, step_lat = self._newton_step(terms[:10, going], values[:, going], residual[:, going])
            lon[active] += step_lon
            lat[active] += step_lat
        lon_deg = np.remainder(lon * rpc.lon_scale + rpc.lon_off + 180.0, 360.0) - 180.0
        lat_deg = lat * rpc.lat_scale + rpc.lat_off
        return np.where(done, lon_deg, np.nan), np.where(done, lat_deg, np.nan)

    def _normalised(
        self, lon: FloatArray, lat: FloatArray, height: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normalised coordinates of the RPC of degrees and metres; longitudes across the date line are neighbours."""
        rpc = self.rpc
        # Points pyproj could not project are infinite; they become NaN.
        with np.errstate(invalid="ignore", over="ignore"):
            from_centre = np.remainder(lon - rpc.lon_off + 180.0, 360.0) - 180.0
            return (
                from_centre / rpc.lon_scale,
                (lat - rpc.lat_off) / rpc.lat_scale,
                (height - rpc.height_off) / rpc.height_scale,
            )

    def _ratios(self, values: FloatArray) -> FloatArray:
        """Normalised (sample, line) (2, n) of the four polynomials (4, n), in the order of `RpcCoefficients.matrix`."""
        line_num, line_den, samp_num, samp_den = values
        with np.errstate(all="ignore"):
            ratios = np.stack([samp_num / samp_den, line_num / line_den])
            # The constant term is the denominator at the centre of the box: another sign means a pole in between.
            usable = (line_den * self.rpc.line_den[0] > 0) & (samp_den * self.rpc.samp_den[0] > 0)
        ratios[:, ~(usable & np.isfinite(ratios).all(axis=0))] = np.nan
        return ratios

    def _newton_step(self, terms: FloatArray, values: FloatArray, residual: FloatArray) -> FloatArray:
        """Normalised step (longitude, latitude) (2, n) that removes a residual (2, n), limited to `MAX_STEP`.

        terms : (10, n), the quadratic ones; values : (4, n), the polynomials there.
        """
        line_num, line_den, samp_num, samp_den = values
        with np.errstate(all="ignore"):
            sample, line, slopes = samp_num / samp_den, line_num / line_den, []
            for d_line_num, d_line_den, d_samp_num, d_samp_den in (self.rpc.slopes @ terms).reshape(2, 4, -1):
                by_sample, by_line = d_samp_num - sample * d_samp_den, d_line_num - line * d_line_den
                slopes.append((by_sample / samp_den, by_line / line_den))
            (samp_lon, line_lon), (samp_lat, line_lat) = slopes
            determinant = samp_lon * line_lat - line_lon * samp_lat
            step = np.stack(
                [
                    (residual[0] * line_lat - residual[1] * samp_lat) / determinant,
                    (samp_lon * residual[1] - line_lon * residual[0]) / determinant,
                ]
            )
        return np.asarray(np.clip(np.nan_to_num(step, nan=np.inf), -MAX_STEP, MAX_STEP))
