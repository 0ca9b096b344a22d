"""zlocus from Python: a surface as one Dataset, and its stages on arrays.

    >>> import zlocus
    >>> surface = zlocus.match("img_1.tif", "img_2.tif", "img_3.tif", resolution=0.5)
    >>> surface.height.rio.to_raster("dsm.tif")

Needs xarray and rioxarray: `pip install '.[xarray]'` in the clone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.options import OrientationOptions, PyramidOptions, RunConfig, SemiGlobalOptions
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.requests import DsmRequest
from zlocus.core.scene import ImageSource, Scene
from zlocus.io import scene_file
from zlocus.matching import true_ortho as ortho
from zlocus.matching.height_lattice import HeightLattice
from zlocus.matching.match_scene import height_step, reference_first
from zlocus.matching.occlusion import coverage
from zlocus.matching.quality import Quality
from zlocus.matching.radiometry import GreyScale
from zlocus.matching.semiglobal import SemiGlobalHeights, aggregate, penalties
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.matching.tile_views import pixel_window, read_pixels, tile_views
from zlocus.orientation.orientation import Orientation
from zlocus.pipeline.setup import orient_views, requested_crs

if TYPE_CHECKING:
    import xarray as xr

PathLikes = str | PathLike[str]
# Names in the Dataset, and what CF calls them.
VARIABLES = {
    "height": ("dsm.tif", "height of the surface at the cell's centre"),
    "sigma": ("sigma.tif", "standard deviation of the height"),
    "quality": ("quality.tif", "reasons why a height is missing or doubtful"),
    "views": ("views.tif", "images used"),
    "ortho": ("ortho.tif", "grey value or colours of the view that shows the cell best"),
}
# Costs of one step of NCC, as the kernels count them, and the largest that they hold.
COST_UNIT, MOST_COST = 64.0, 255.0
COLOURS = ("red", "green", "blue")
ALL_VALID = 1e-3  # rounding of weights
# Variance of a window, of that of the whole image, below which it has no texture: rounding.
LEAST_TEXTURE = 1e-9


def open_scene(*inputs: PathLikes, crs: str | CRS | None = None) -> Scene:
    """Images with their cameras, in one frame.

    inputs : two images or more with RPC, or one `scene.yaml`. crs : of the frame, projected in metres; by default that
    of the file, else the WGS84 UTM zone of the scene's centre.

    Raises
    ------
    InputError, ConfigError
        See `zlocus.io.scene_file.open_scene`.
    """
    requested = crs if crs is None or isinstance(crs, CRS) else requested_crs(crs)
    return scene_file.open_scene([Path(path) for path in inputs], requested)


def orient(
    scene: Scene,
    options: OrientationOptions | None = None,
    *,
    heights: tuple[float, float] | None = None,
    progress: Progress | None = None,
) -> Orientation:
    """Tie points and corrections of the cameras; `orientation.apply(scene)` is the corrected scene, `orientation.xyz`
    the ties (n, 3) m.

    heights : (zmin, zmax) m above the ellipsoid between which ties are looked for; None: all that the cameras allow.

    Raises
    ------
    GeometryError
        Where images share too little ground, or their pointing is worse than can be corrected.
    """
    scene = replace(scene, heights=heights or scene.heights)
    return orient_views(scene, options or OrientationOptions(), progress or SilentProgress())


def match(
    *inputs: PathLikes,
    out: PathLikes | None = None,
    config: RunConfig | None = None,
    progress: Progress | None = None,
    **asked: Any,
) -> xr.Dataset:
    """The surface of a scene: what `zlocus dsm` writes, as a Dataset (see `open_surface`).

    inputs : two images or more with RPC, or one `scene.yaml`. out : folder for the products, which are then read from
    there when they are needed; None: none are kept, and the Dataset is in memory. A folder that holds the same surface
    already, finished, is opened; one that holds another run is refused, unless `overwrite=True` is given. asked :
    fields of `zlocus.core.requests.DsmRequest`, such as resolution, bounds, heights, workers; those that name files
    take paths.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError, StoppedError, CoverageError
        As `zlocus dsm`. OutputError: `out` holds another run. CoverageError: too few cells have a height; what was
        found lies in `out`.
    """
    from zlocus.pipeline.dsm import run_dsm

    known = {field for field in DsmRequest.__dataclass_fields__ if field not in ("inputs", "out")}
    if unknown := sorted(set(asked) - known):
        raise ConfigError(f"match() does not know {', '.join(unknown)}. Known are {', '.join(sorted(known))}.")
    for name in ("like", "area", "mask", "dem"):
        if asked.get(name) is not None:
            asked[name] = Path(asked[name])
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "surface" if out is None else Path(out)
        if out is None:  # nobody would see them
            asked = {"products": (), "report": False} | asked
        request = DsmRequest(inputs=tuple(Path(path) for path in inputs), out=folder, **asked)
        run_dsm(request, config or RunConfig(), progress or SilentProgress())
        surface = open_surface(folder)
        return surface.load() if out is None else surface


def open_surface(folder: PathLikes) -> xr.Dataset:
    """The result of `zlocus dsm` in a folder: height, sigma (m), quality (bit flags), views and ortho over y and x, the
    ortho-image of colour images over band (red, green, blue) too.

    NaN is a missing height; `zlocus.matching.quality.Quality` names the flags. Cells are read when they are needed. The
    CRS is that of the `rio` accessor: `surface.rio.crs`.

    Raises
    ------
    InputError
        Where the folder holds no such result, or xarray and rioxarray are not installed.
    """
    try:
        import rioxarray
        import xarray as xr
    except ImportError as error:
        raise InputError(
            f"{error.name} is not installed. Install it with pip, or all that is needed with `pip install '.[xarray]'` "
            "in the clone of zlocus."
        ) from error
    folder = Path(folder)
    found = {}
    for name, (file, long_name) in VARIABLES.items():
        if not (folder / file).is_file():
            raise InputError(f"{folder} holds no {file}. Give the folder that a finished `zlocus dsm` wrote.")
        raster = rioxarray.open_rasterio(folder / file)
        assert isinstance(raster, xr.DataArray)
        nodata = raster.rio.nodata
        if raster.sizes["band"] == 1:
            raster = raster.squeeze("band", drop=True)
        else:
            raster = raster.assign_coords(band=list(COLOURS))
        raster.attrs = {"long_name": long_name, **({"units": "m"} if name in ("height", "sigma") else {})}
        found[name] = raster if nodata is None else raster.rio.write_nodata(nodata)
    flags = [flag for flag in Quality if flag.name]
    found["quality"].attrs |= {
        "flag_masks": [int(flag) for flag in flags],
        "flag_meanings": " ".join(str(flag.name) for flag in flags),
    }
    return xr.Dataset(found)


@dataclass(frozen=True)
class LocusStack:
    """What every image shows along the vertical lines of some cells.

    grey : (i, h, r, c) float32, grey value of image i where cell (r, c) would be if it were at height h; NaN where the
    image does not show it. heights : (h,) m. x, y : (c,), (r,) m, of the cells' centres. names : of the images.
    """

    grey: NDArray[np.float32]
    heights: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    names: tuple[str, ...]

    def __repr__(self) -> str:
        """In a line, without the arrays."""
        return (
            f"LocusStack(grey {self.grey.shape} of images, heights, rows, columns; {self.heights.min():g} to "
            f"{self.heights.max():g} m; {', '.join(self.names)})"
        )


def locus_stack(
    scene: Scene, bounds: tuple[float, float, float, float], resolution: float, heights: Sequence[float]
) -> LocusStack:
    """Images of a scene resampled (cubic) along the vertical lines of the cells of an area: its vertical line loci.

    For looking at loci and for measures of one's own; the matcher itself never holds so much. bounds : (xmin, ymin,
    xmax, ymax) m in the scene's frame; resolution : m; heights : (h,) m above the ellipsoid. Source: Ji et al. (2014),
    section 2 (MVLL).

    Raises
    ------
    ConfigError
        Where there are no cells or no heights.
    """
    across, down = (round((bounds[k + 2] - bounds[k]) / resolution) for k in (0, 1))
    if min(across, down, len(heights)) < 1:
        raise ConfigError(f"{down} x {across} cells at {len(heights)} heights hold nothing. Give more of each.")
    x = np.asarray(bounds[0] + (np.arange(across) + 0.5) * resolution, np.float64)
    y = np.asarray(bounds[3] - (np.arange(down) + 0.5) * resolution, np.float64)
    column, row = np.meshgrid(x, y)
    grey = np.full((len(scene.views), len(heights), down, across), np.nan, np.float32)
    for i, view in enumerate(scene.views):
        for h, z in enumerate(heights):
            xyz = np.column_stack([column.ravel(), row.ravel(), np.full(row.size, float(z))])
            grey[i, h] = _sampled(view.image, view.sensor.image_from_ground(xyz).reshape(down, across, 2))
    return LocusStack(grey, np.asarray(heights, float), x, y, tuple(view.name for view in scene.views))


def _sampled(image: ImageSource, xy: NDArray[np.float64]) -> NDArray[np.float32]:
    """Cubic values (r, c) of an image at (r, c, 2) px, NaN outside and beside pixels that are not valid."""
    import cv2

    out = np.full(xy.shape[:2], np.nan, np.float32)
    rows, cols = image.shape
    inside: NDArray[np.bool_] = np.all((xy >= 0) & (xy <= (cols - 1, rows - 1)), axis=-1)
    if not inside.any():
        return out
    # Only the part that is needed, with what the weights of cubic interpolation reach.
    low = np.maximum(np.floor(xy[inside].min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(xy[inside].max(axis=0)).astype(int) + 3, (cols, rows))
    part = image.read(int(low[1]), int(low[0]), int(high[1] - low[1]), int(high[0] - low[0]))
    at = np.where(inside[..., None], xy - low, 0.0).astype(np.float32)
    grey = cv2.remap(part.pixels, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    known = cv2.remap(part.valid.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    shown = inside & (known > 1 - ALL_VALID)
    out[shown] = grey[shown]
    return out


def ncc_cost(grey: NDArray[np.floating], *, window: int = 5, reference: int | None = None) -> NDArray[np.float32]:
    """How unlike images are around every cell at every height: 1 - NCC, averaged over pairs of images.

    grey : (i, h, r, c), as of `locus_stack`, NaN where an image does not show a place. window : side of the square of
    cells that is correlated, odd. reference : number of the image that the others are compared with, whose mean is the
    SNCC of Ji et al. (2014), section 2.1; None: all pairs are. Returns (r, c, h) float32, in the units of `semiglobal`;
    NaN where fewer than two images show the whole window. A window without texture is unlike every other: 1.

    The matcher's own cost adds grey differences, and knows which images are hidden: `zlocus.matching.cost_volume`.

    Raises
    ------
    ConfigError
        Where the array or the window do not fit.
    """
    if grey.ndim != 4 or len(grey) < 2:
        raise ConfigError(f"The images are {grey.shape}. Give (images, heights, rows, columns) of two images or more.")
    if window < 3 or window % 2 == 0 or (reference is not None and not 0 <= reference < len(grey)):
        raise ConfigError(
            f"A window of {window} and reference {reference} do not fit {len(grey)} images. Give an odd window of 3 or "
            f"more, and a reference of 0 to {len(grey) - 1}."
        )
    pairs = [pair for pair in combinations(range(len(grey)), 2) if reference is None or reference in pair]
    costs = [_cost_of_pairs(np.asarray(grey[:, h], np.float64), window, pairs) for h in range(grey.shape[1])]
    return np.stack(costs, axis=-1)


def _cost_of_pairs(images: NDArray[np.float64], window: int, pairs: Sequence[tuple[int, int]]) -> NDArray[np.float32]:
    """Mean of 1 - NCC (r, c) over pairs of images (i, r, c) at a height, NaN where no pair shows the window."""
    from scipy.ndimage import uniform_filter

    def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(uniform_filter(values, (0, window, window) if values.ndim == 3 else window, mode="constant"))

    known = np.isfinite(images)
    # Beyond the rim nothing is known.
    shown = mean(known.astype(np.float64)) > 1 - ALL_VALID / window**2
    # About their own mean: squares of large values would cancel.
    grey = np.where(known, images - np.mean(images, where=known), 0.0) if known.any() else np.zeros_like(images)
    middle = mean(grey)
    variance = np.maximum(mean(grey**2) - middle**2, 0.0)
    least = max(LEAST_TEXTURE * float(np.mean(grey**2)), np.finfo(float).tiny)
    total, count = np.zeros(images.shape[1:]), np.zeros(images.shape[1:])
    for a, b in pairs:
        both = shown[a] & shown[b]
        has_texture = np.minimum(variance[a], variance[b]) > least
        scale = np.sqrt(np.where(has_texture, variance[a] * variance[b], 1.0))
        ncc = np.where(has_texture, (mean(grey[a] * grey[b]) - middle[a] * middle[b]) / scale, 0.0)
        total += np.where(both, 1.0 - np.clip(ncc, -1.0, 1.0), 0.0)
        count += both
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)


def true_ortho(
    scene: Scene, height: NDArray[np.floating], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float32]:
    """What the images show of a surface, each cell from the image that shows it on most pixels, of those from which the
    surface does not hide it: grey values (r, c) float32, NaN where there is no height and where no image sees it. What
    stands beside the area hides nothing, and every image keeps its own grey values, which a run levels.

    scene : oriented; height : (r, c) m above the ellipsoid, NaN where there is none; x, y : (c,), (r,) m, of the
    cells' centres, evenly spaced, y from north to south.

    Raises
    ------
    ConfigError
        Where the arrays do not fit.
    GeometryError
        Where all images look along the same line, or bend too much for the cells.
    """
    shape = (len(y), len(x))
    if height.shape != shape or min(shape) < 2 or not np.isfinite(height).any():
        raise ConfigError(
            f"Heights of {height.shape} cells, with {len(x)} x and {len(y)} y, show nothing. Give (rows, columns) of "
            "two or more each, and some heights."
        )
    cell_m, lowest, highest = float(x[1] - x[0]), float(np.nanmin(height)), float(np.nanmax(height))
    leading = reference_first(scene, (lowest + highest) / 2, None)
    options = PyramidOptions()
    step_m = height_step(leading, (lowest + highest) / 2, cell_m, options.max_shift_px)
    origin_m, n_steps = lowest - step_m, int(np.ceil((highest - lowest) / step_m)) + 3
    z_range = (origin_m, origin_m + n_steps * step_m)
    transform = Affine(cell_m, 0, x[0] - cell_m / 2, 0, -cell_m, y[0] + cell_m / 2)
    across, down = np.linspace(0, shape[1], 5), np.linspace(0, shape[0], 5)
    corners = np.array([transform * (c, r) for c in across for r in down])
    parts = [(view, pixel_window(view, corners, z_range, 1)) for view in leading]
    pixels = [read_pixels(view, part, 1, GreyScale(0.0, 1.0)) for view, part in parts if part is not None]
    if not pixels:
        return np.full(shape, np.nan, np.float32)
    views = tile_views(pixels, 0, transform, shape, options.block, (origin_m, step_m), z_range, 0)
    blocks = (-(-shape[0] // views.block), -(-shape[1] // views.block))
    lattice = HeightLattice(
        origin_m, step_m, shape, views.block, np.zeros(blocks, np.int64), np.full(blocks, n_steps, np.int64)
    )
    index = ((np.where(np.isfinite(height), height, lowest) - origin_m) / step_m).astype(np.float32)
    seen = coverage(views, SlopeSurface.flat(shape, views.block), lattice)
    shown = ortho.true_ortho(pixels, views, seen, index)
    shown[~np.isfinite(height)] = np.nan
    return shown


def semiglobal(
    cost: NDArray[np.floating],
    *,
    ortho: NDArray[np.float32] | None = None,
    options: SemiGlobalOptions | None = None,
    step_cells: float = 1.0,
) -> SemiGlobalHeights:
    """The semi-global constraint on a measure of one's own.

    cost : (r, c, h) in units of 1 - NCC, 0 where all images agree and NaN where nothing is known (there it is 1); the
    penalties are chosen for those units. ortho : (r, c) grey values, at whose edges heights may jump. step_cells : a
    height step over the side of a cell. Heights come back as indices into h; `vertex` is the one between steps.

    Raises
    ------
    ConfigError
        Where the arrays do not fit.
    """
    if cost.ndim != 3 or min(cost.shape) < 1:
        raise ConfigError(f"The cost has the shape {cost.shape}. Give one of (rows, columns, heights).")
    shape = cost.shape[:2]
    if ortho is not None and ortho.shape != shape:
        raise ConfigError(f"The ortho-image has {ortho.shape} cells, the cost {shape}. Give both on one grid.")
    options = options or SemiGlobalOptions()
    counted = np.rint(np.where(np.isfinite(cost), cost, 1.0) * COST_UNIT).clip(0, MOST_COST).astype(np.uint8)
    lattice = HeightLattice(
        0.0, 1.0, shape, max(shape), np.zeros((1, 1), np.int64), np.full((1, 1), cost.shape[2], np.int64)
    )
    p2 = penalties(ortho, shape, 0, options)
    return aggregate(np.ascontiguousarray(counted).ravel(), lattice, p2, step_cells, options)
