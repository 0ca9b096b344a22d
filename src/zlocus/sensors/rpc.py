"""Rational polynomial camera (RPC00B): ratios of cubic polynomials from longitude, latitude and height to the image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer

from zlocus.core.sensor_model import FloatArray
from zlocus.sensors.rpc_kernel import ground_positions, positions

GEOGRAPHIC = CRS.from_epsg(4979)
TOLERANCE_PX = 1e-7
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

    @cached_property
    def by_term(self) -> FloatArray:
        """Coefficients (20, 4) of the four polynomials, those of each term side by side."""
        return np.ascontiguousarray(self.matrix.T)

    @cached_property
    def slopes_by_term(self) -> FloatArray:
        """Coefficients (2, 10, 4) of their derivatives by longitude and by latitude, see `slopes`."""
        return np.ascontiguousarray(np.moveaxis(self.slopes.reshape(2, 4, 10), 1, 2))

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
        xy = np.empty((len(lon), 2))
        positions(rpc.by_term, *self._normalised(lon, lat, height), xy)
        xy *= [rpc.samp_scale, rpc.line_scale]
        xy += [rpc.samp_off, rpc.line_off]
        return xy

    def geographic_from_image(self, xy: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Longitudes and latitudes (degrees) where the rays of xy (n, 2) px meet heights z (n,) m.

        Newton's method with exact derivatives starts at the centre of the RPC's box. A step is limited to half the box,
        so that crops far from the centre of a large box converge too. NaN where it does not reach `TOLERANCE_PX`.
        """
        rpc = self.rpc
        scale = np.array([rpc.samp_scale, rpc.line_scale])
        target = np.ascontiguousarray((xy - [rpc.samp_off, rpc.line_off]) / scale)
        height, found = (z - rpc.height_off) / rpc.height_scale, np.empty((len(xy), 2))
        ground_positions(rpc.by_term, rpc.slopes_by_term, target, height, TOLERANCE_PX / np.abs(scale), found)
        lon_deg = np.remainder(found[:, 0] * rpc.lon_scale + rpc.lon_off + 180.0, 360.0) - 180.0
        return lon_deg, found[:, 1] * rpc.lat_scale + rpc.lat_off

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
