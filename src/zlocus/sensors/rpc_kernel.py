"""The rational polynomials of an RPC, point by point: from normalised ground coordinates to the image, and back.

In plain NumPy the way back takes six times as long for the few hundred points of a pair of images, and 2.7 times as
long for a hundred thousand, see `benchmarks/bench_orientation.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zlocus.core.jit import kernel

N_TERMS = 20
MAX_ITERATIONS = 30
# Largest Newton step, in half sizes of the RPC's box.
MAX_STEP = 0.5


class FourSums(NamedTuple):
    """Values or derivatives of the four polynomials of an RPC at one point."""

    line_num: float  # f8: numerator of the line
    line_den: float  # f8: denominator of the line
    samp_num: float  # f8: numerator of the sample
    samp_den: float  # f8: denominator of the sample


class ImagePosition(NamedTuple):
    """Normalised image position, or its derivative."""

    sample: float  # f8: along the columns
    line: float  # f8: along the rows


# f8, f8, f8, (20,) f8 -> None
@kernel
def write_terms(lon, lat, height, terms):
    """Write the 20 monomials of RPC00B, see `zlocus.sensors.rpc.rpc_terms`."""
    terms[0], terms[1], terms[2], terms[3] = 1.0, lon, lat, height
    terms[4], terms[5], terms[6] = lon * lat, lon * height, lat * height
    lon_squared, lat_squared, height_squared = lon * lon, lat * lat, height * height
    terms[7], terms[8], terms[9] = lon_squared, lat_squared, height_squared
    terms[10], terms[11], terms[12] = terms[6] * lon, lon_squared * lon, lat_squared * lon
    terms[13], terms[14], terms[15] = height_squared * lon, lon_squared * lat, lat_squared * lat
    terms[16], terms[17], terms[18] = height_squared * lat, lon_squared * height, lat_squared * height
    terms[19] = height_squared * height


# (t,4) f8, (20,) f8 -> FourSums
@kernel
def four_sums(coefficients, terms):
    """Sums of the first t terms, each times its four coefficients."""
    one, two, three, four = 0.0, 0.0, 0.0, 0.0
    for t in range(coefficients.shape[0]):
        term = terms[t]
        one += coefficients[t, 0] * term
        two += coefficients[t, 1] * term
        three += coefficients[t, 2] * term
        four += coefficients[t, 3] * term
    return FourSums(one, two, three, four)


# (20,4) f8, FourSums -> ImagePosition
@kernel
def position(coefficients, sums):
    """Image position of a point at which the polynomials are known; NaN beyond a pole.

    The constant term is the denominator at the centre of the box: another sign means a pole in between.
    """
    sample, line = sums.samp_num / sums.samp_den, sums.line_num / sums.line_den
    is_usable = sums.line_den * coefficients[0, 1] > 0.0 and sums.samp_den * coefficients[0, 3] > 0.0
    if is_usable and np.isfinite(sample) and np.isfinite(line):
        return ImagePosition(sample, line)
    return ImagePosition(np.nan, np.nan)


# (20,4) f8, (n,) f8, (n,) f8, (n,) f8, (n,2) f8 -> None
@kernel
def positions(coefficients, lon, lat, height, out):
    """Write the normalised image positions (n, 2), sample and line, of normalised ground coordinates.

    coefficients : see `RpcCoefficients.by_term`.
    """
    terms = np.empty(N_TERMS)
    for j in range(out.shape[0]):
        write_terms(lon[j], lat[j], height[j], terms)
        found = position(coefficients, four_sums(coefficients, terms))
        out[j, 0], out[j, 1] = found.sample, found.line


# FourSums, FourSums, ImagePosition -> ImagePosition
@kernel
def position_slope(sums, slopes, here):
    """Derivative of an image position. sums, slopes : the polynomials and their derivatives there."""
    by_sample = (slopes.samp_num - here.sample * slopes.samp_den) / sums.samp_den
    return ImagePosition(by_sample, (slopes.line_num - here.line * slopes.line_den) / sums.line_den)


# f8 -> f8
@kernel
def limited(step):
    """A step of no more than `MAX_STEP`; as much where it is not known."""
    return MAX_STEP if np.isnan(step) else min(max(step, -MAX_STEP), MAX_STEP)


# (20,4) f8, (2,10,4) f8, (n,2) f8, (n,) f8, (2,) f8, (n,2) f8 -> None
@kernel
def ground_positions(coefficients, slopes, target, height, tolerance, out):
    """Write the normalised longitudes and latitudes (n, 2) whose image positions are the target; NaN where Newton's
    method does not reach it.

    coefficients, slopes : see `RpcCoefficients.by_term` and `slopes_by_term`; target : normalised samples and lines;
    tolerance : of these two. Steps are limited, so that crops far from the centre of a large box converge too.
    """
    terms = np.empty(N_TERMS)
    for j in range(out.shape[0]):
        out[j] = np.nan
        lon, lat = 0.0, 0.0
        for _ in range(MAX_ITERATIONS):
            write_terms(lon, lat, height[j], terms)
            sums = four_sums(coefficients, terms)
            here = position(coefficients, sums)
            to_sample, to_line = target[j, 0] - here.sample, target[j, 1] - here.line
            if abs(to_sample) < tolerance[0] and abs(to_line) < tolerance[1]:
                out[j, 0], out[j, 1] = lon, lat
                break
            if not (np.isfinite(to_sample) and np.isfinite(to_line)):
                break
            by_lon = position_slope(sums, four_sums(slopes[0], terms), here)
            by_lat = position_slope(sums, four_sums(slopes[1], terms), here)
            determinant = by_lon.sample * by_lat.line - by_lon.line * by_lat.sample
            lon += limited((to_sample * by_lat.line - to_line * by_lat.sample) / determinant)
            lat += limited((by_lon.sample * to_line - by_lon.line * to_sample) / determinant)
