"""Accuracy of dtm.tif on a rendered scene: `python benchmarks/terrain.py SCENE [SURFACE]`.

SCENE : folder written by `python -m zlocus.synthetic`; SURFACE : folder written by `zlocus dsm` from its images.
Without SURFACE the true surface is filtered, so that all errors are errors of the filter. The true ground below roofs
and trees is interpolated linearly (Delaunay) between the cells of ground around them.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from odc.geo.geobox import GeoBox
from rasterio.warp import Resampling, reproject
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_dilation

from judging import rendered_scene
from workplace import ended
from zlocus.core.options import ProductOptions
from zlocus.evaluation.statistics import error_statistics
from zlocus.evaluation.truth import CLASS_NAMES
from zlocus.io.rasters import write_cog
from zlocus.products.dtm import write_dtm

NEAR_M = 1.0
# Cells of ground around an object, from which the ground below it is interpolated.
RIM_CELLS = 3


def true_ground(z, is_ground):
    """True heights (r, c) with the ground below objects interpolated."""
    rim = is_ground & binary_dilation(~is_ground, iterations=RIM_CELLS)
    known, unknown = np.argwhere(rim), np.argwhere(~is_ground)
    below = LinearNDInterpolator(known, z[rim])(unknown)
    nearest = NearestNDInterpolator(known, z[rim])(unknown)  # at the rim of the scene
    ground = z.astype(float)
    ground[~is_ground] = np.where(np.isnan(below), nearest, below)
    return ground


def on_grid(values, source, target, resampling, nodata):
    """Values of one raster on the grid of another."""
    out = np.full(target.shape, nodata, values.dtype)
    reproject(values, out, src_transform=source.transform, src_crs=source.crs, dst_transform=target.transform,
              dst_crs=target.crs, resampling=resampling, dst_nodata=nodata, init_dest_nodata=True)  # fmt: skip
    return out


def main():
    """Print the figures of the scene and the surface that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE")
    parser.add_argument("surface", type=Path, nargs="?", metavar="SURFACE")
    asked = parser.parse_args()
    show(rendered_scene(asked.scene), asked.surface)


def show(scene, surface=None):
    """Print the figures of a scene's terrain, from a surface or else from the true one."""
    with rasterio.open(scene / "truth_dsm.tif") as truth, rasterio.open(scene / "truth_class.tif") as classes:
        # Counted from 1, so that 0 can mean none.
        z, kinds, source = truth.read(1), classes.read(1) + np.uint8(1), truth
        ground = true_ground(z, np.isin(kinds - 1, CLASS_NAMES["ground"]))
        with tempfile.TemporaryDirectory() as folder:
            if surface is None:
                surface = Path(folder)
                box = GeoBox(z.shape, truth.transform, truth.crs)
                write_cog(surface / "dsm.tif", z, box, nodata=np.nan)
                write_cog(surface / "quality.tif", np.zeros(z.shape, np.uint16), box)
            write_dtm(surface / "dsm.tif", surface / "quality.tif", Path(folder) / "dtm.tif", ProductOptions())
            with rasterio.open(Path(folder) / "dtm.tif") as terrain, rasterio.open(surface / "dsm.tif") as heights:
                found, dsm = terrain.read(1), heights.read(1)
                ground = on_grid(ground, source, terrain, Resampling.average, np.nan)
                kinds = on_grid(kinds, source, terrain, Resampling.nearest, 0)
    print(
        f"{'class':<10}{'cells':>9}{'with height':>13}{'within 1 m':>12}{'median':>9}{'NMAD':>8}   before: within 1 m"
    )
    for name, members in CLASS_NAMES.items():
        chosen = np.isin(kinds, np.add(members, 1)) & np.isfinite(ground)
        if chosen.any():
            after, before = (error_statistics((v - ground)[chosen], NEAR_M) for v in (found, dsm))
            print(f"{name:<10}{after.n:>9}{100 * after.completeness:>11.1f} %{100 * after.within:>10.1f} %"
                  f"{after.median:>7.2f} m{after.nmad:>6.2f} m{100 * before.within:>17.1f} %")  # fmt: skip
    is_ground = np.isin(kinds, np.add(CLASS_NAMES["ground"], 1)) & np.isfinite(dsm)
    print(f"{100 * (found == dsm)[is_ground].mean():.1f} % of the ground cells with a height keep it")


if __name__ == "__main__":
    ended(main)
