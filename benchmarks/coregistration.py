"""Co-registration of `zlocus evaluate` and of xdem, an independent program, on planted shifts.

    python benchmarks/coregistration.py [--steps N]

Both implement the method of Nuth and Kääb (2011). xdem (`pip install xdem`) is not a dependency of zlocus, because its
pinned requirements would hold other packages back; without it the command ends with a sentence. Surfaces lie on the
grid of their reference, as xdem requires. The rendered hills and the mountain come from `ZLOCUS_TEST_DATA`; without it
they are left out.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject, transform_bounds
from scipy.ndimage import map_coordinates

from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate

Heights = NDArray[np.float64]
CRS = "EPSG:32632"
NOISE_M, GROSS_M, GROSS_SHARE, HOLE_SHARE = 0.3, 20.0, 0.05, 0.1
HEAD = "| ground | planted | zlocus | xdem |\n|---|---|---|---|"


@dataclass(frozen=True)
class Case:
    """A reference and the surface made from it by a planted shift (east, north, up) m."""

    name: str
    reference: Heights
    surface: Heights
    cell_m: float
    planted: tuple[float, float, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20, help="most steps of xdem (its default: 10)")
    steps = parser.parse_args().steps
    if find_spec("xdem") is None:
        sys.exit("xdem is not installed, so there is nothing to compare with: pip install xdem.")
    print(HEAD)
    for case in cases():
        with tempfile.TemporaryDirectory() as folder:
            paths = Path(folder) / "surface.tif", Path(folder) / "reference.tif"
            for path, z in zip(paths, (case.surface, case.reference), strict=True):
                write(path, z, case.cell_m)
            ours, theirs = evaluated(*paths, case.cell_m), by_xdem(*paths, steps)
        print(f"| {case.name} | {said(case.planted)} | {said(ours)} | {said(theirs)} |", flush=True)


def cases() -> Iterator[Case]:
    """Analytic ground without and with errors, then the shared grounds if they are there."""
    x, y = np.meshgrid((np.arange(400) + 0.5) * 0.5, (np.arange(400) + 0.5) * 0.5)
    planted = (2.1, -1.7, 5.0)
    shifted = rolling(x - planted[0], y + planted[1]) + planted[2]
    yield Case("rolling, exact", rolling(x, y), shifted, 0.5, planted)
    yield Case("rolling, noise, gross errors, holes", rolling(x, y), spoilt(shifted), 0.5, planted)
    data = os.environ.get("ZLOCUS_TEST_DATA")
    if not data:
        return
    with rasterio.open(Path(data) / "rendered-hills-biased" / "truth_dsm.tif") as source:
        hills = source.read(1)[::2, ::2].astype(float)
    yield Case("rendered hills with trees", hills, moved(hills, 0.5, (0.8, 1.3, -2.0)), 0.5, (0.8, 1.3, -2.0))
    spoilt_hills = spoilt(moved(hills, 0.5, (0.8, 1.3, -2.0)))
    yield Case("the same, noise, gross errors, holes", hills, spoilt_hills, 0.5, (0.8, 1.3, -2.0))
    mountain, planted = (
        srtm(Path(data) / "pleiades_pair_ventoux/reference/srtm3_v2_egm96_heights.tif"),
        (35.0, -52.0, 8.0),
    )
    yield Case("SRTM of Mont Ventoux, cells of 90 m", mountain, moved(mountain, 90, planted), 90, planted)


def rolling(x: Heights, y: Heights) -> Heights:
    """Heights of analytic ground with slopes of up to about 40 degrees; x east, y south, m."""
    return np.asarray(100 + 6 * np.sin(x / 17) + 5 * np.cos(y / 15) + 3 * np.sin((x + 2 * y) / 40))


def moved(z: Heights, cell_m: float, shift: tuple[float, float, float]) -> Heights:
    """Heights moved by a shift, interpolated by cubic splines."""
    row, col = np.indices(z.shape, float)
    at = row + shift[1] / cell_m, col - shift[0] / cell_m
    return np.asarray(map_coordinates(z, at, order=3, mode="nearest")) + shift[2]


def spoilt(z: Heights) -> Heights:
    """Heights with noise, gross errors and holes."""
    rng = np.random.default_rng(8)
    z = z + rng.normal(0, NOISE_M, z.shape)
    z[rng.random(z.shape) < GROSS_SHARE] += GROSS_M
    z[rng.random(z.shape) < HOLE_SHARE] = np.nan
    return z


def srtm(path: Path) -> Heights:
    """A real mountain, on a grid in metres that lies within it."""
    with rasterio.open(path) as source:
        west, south, east, north = transform_bounds(source.crs, "EPSG:32631", *source.bounds)
        inset = 400.0  # Corners of the map lie this far outside the raster in degrees.
        shape = int((north - south - 2 * inset) / 90), int((east - west - 2 * inset) / 90)
        z = np.full(shape, np.nan)
        at = from_origin(west + inset, north - inset, 90, 90)
        reproject(rasterio.band(source, 1), z, dst_transform=at, dst_crs="EPSG:32631", resampling=Resampling.cubic)
    assert (z > 0).all()
    return z


def write(path: Path, z: Heights, cell_m: float) -> None:
    """Write a raster of float64, because xdem computes in the dtype of its input."""
    at = Affine(cell_m, 0, 500_000, 0, -cell_m, 5_200_000)
    profile = {"driver": "GTiff", "height": z.shape[0], "width": z.shape[1], "count": 1, "dtype": "float64"}
    with rasterio.open(path, "w", crs=CRS, transform=at, nodata=-9999.0, **profile) as sink:
        sink.write(np.where(np.isfinite(z), z, -9999.0), 1)


def evaluated(surface: Path, reference: Path, cell_m: float) -> tuple[float, float, float]:
    """Shift of the surface by zlocus, (east, north, up) m."""
    shift = evaluate(surface, Comparison(reference, coregister="nuth-kaab", margin_m=4 * cell_m)).shift
    assert shift is not None
    return shift.east_m, shift.north_m, shift.up_m


def by_xdem(surface: Path, reference: Path, steps: int) -> tuple[float, float, float]:
    """Shift of the surface by xdem, (east, north, up) m: the negative of the correction that xdem returns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import xdem

        method = xdem.coreg.NuthKaab(max_iterations=steps)
        fit: Callable[..., object] = method.fit
        fit(xdem.DEM(str(reference)), xdem.DEM(str(surface)), random_state=1)
    found = method.meta["outputs"]["affine"]
    return -float(found["shift_x"]), -float(found["shift_y"]), -float(found["shift_z"])


def said(shift: tuple[float, float, float]) -> str:
    return ", ".join(f"{part:+.3f}" for part in shift)


if __name__ == "__main__":
    main()
