"""Compare the rasters of two results of `zlocus dsm`, `demo` or `cloud`: pixels, masks, no-data values and grid.

    python benchmarks/same_pixels.py FOLDER OTHER [--rasters NAME ...]

Compares dsm.tif, sigma.tif, quality.tif, views.tif, ortho.tif and the maps of each image that `zlocus cloud` writes, or
the rasters of the given NAMEs. Prints one sentence for each difference. The exit status is 0 if there is none, 1 if
there is a difference, and 2 if the folders hold no such raster. Compression, tiling, overviews and metadata may differ.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

RASTERS = ("dsm", "sigma", "quality", "views", "ortho")
# Ends of the names of the maps that `zlocus cloud` writes of each image.
MAPS = ("height", "depth", "disparity", "quality")
# Rows that are compared at a time, so that large rasters need little memory.
ROWS_AT_ONCE = 1024


def names_of(*folders: Path) -> list[str]:
    """Names, without the suffix, of the rasters and maps that at least one of the folders has."""
    maps = {path.stem for folder in folders for what in MAPS for path in folder.glob(f"*_{what}.tif")}
    return [n for n in (*RASTERS, *sorted(maps)) if any((folder / f"{n}.tif").exists() for folder in folders)]


def differences(folder: Path, other: Path, names: Sequence[str]) -> list[str]:
    """One sentence for each difference between the rasters of two folders.

    names : of the rasters, without the suffix. A raster that is in neither folder is no difference.
    """
    found = []
    for name in names:
        first, second = folder / f"{name}.tif", other / f"{name}.tif"
        missing = [path for path in (first, second) if not path.exists()]
        if len(missing) == 1:
            found.append(f"{missing[0]} is missing.")
        elif not missing:
            found += [f"{name}.tif: {sentence}" for sentence in raster_differences(first, second)]
    return found


def raster_differences(first: Path, second: Path) -> Iterator[str]:
    """One sentence for each difference between two rasters: of grid, type and no-data value, then of masks and pixels.

    Masks and pixels are compared only where shape, number of bands and type are equal.
    """
    with rasterio.open(first) as a, rasterio.open(second) as b:
        yield from profile_differences(a, b)
        if (a.shape, a.count, a.dtypes) == (b.shape, b.count, b.dtypes):
            yield from value_differences(a, b)


def profile_differences(a: rasterio.DatasetReader, b: rasterio.DatasetReader) -> Iterator[str]:
    """One sentence for each difference of shape, number of bands, type, no-data value, transform and CRS."""
    for what, of_a, of_b in (
        ("the shape differs", a.shape, b.shape),
        ("the number of bands differs", a.count, b.count),
        ("the types of the bands differ", a.dtypes, b.dtypes),
        # repr() makes two NaN equal.
        ("the no-data values differ", repr(a.nodatavals), repr(b.nodatavals)),
        ("the transform differs", tuple(a.transform), tuple(b.transform)),
        ("the CRS differs", a.crs and a.crs.to_wkt(), b.crs and b.crs.to_wkt()),
    ):
        if of_a != of_b:
            yield f"{what}: {of_a} and {of_b}."


def value_differences(a: rasterio.DatasetReader, b: rasterio.DatasetReader) -> Iterator[str]:
    """Sentences on the masks and on the pixels of each band. Pixels are compared as bytes, so NaN equals NaN."""
    n_masks, n_pixels, largest = np.zeros(a.count, int), np.zeros(a.count, int), np.zeros(a.count)
    for row in range(0, a.height, ROWS_AT_ONCE):
        window = Window(0, row, a.width, min(ROWS_AT_ONCE, a.height - row))
        n_masks += (a.read_masks(window=window) != b.read_masks(window=window)).sum(axis=(1, 2))
        of_a, of_b = a.read(window=window), b.read(window=window)
        differs = of_a.view(f"u{of_a.itemsize}") != of_b.view(f"u{of_b.itemsize}")
        n_pixels += differs.sum(axis=(1, 2))
        apart = np.where(differs, np.abs(of_a.astype(float) - of_b), 0.0)
        largest = np.fmax(largest, np.fmax.reduce(apart, axis=(1, 2)))
    for band in range(a.count):
        which = f" of band {band + 1}" if a.count > 1 else ""
        if n_masks[band]:
            yield f"the mask{which} differs in {n_masks[band]} of {a.height * a.width} pixels."
        if n_pixels[band]:
            yield (f"{n_pixels[band]} of {a.height * a.width} pixels{which} differ, by {largest[band]:g} at most.")


def main() -> int:
    """Compare the folders that the command line names, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="a folder of results")
    parser.add_argument("other", type=Path, metavar="OTHER", help="the folder to compare it with")
    parser.add_argument("--rasters", nargs="+", metavar="NAME", help="names without .tif; default: all that are there")
    options = parser.parse_args()
    names = names_of(options.folder, options.other)
    if not names:
        print(f"{options.folder} and {options.other} hold no rasters of a result.", file=sys.stderr)
        return 2
    found = differences(options.folder, options.other, options.rasters or names)
    for sentence in found:
        print(sentence)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
