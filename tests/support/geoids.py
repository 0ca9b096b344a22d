"""Geoid rasters for tests, in the formats that users have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

STEP_DEG = 0.25


def write_geoid(path: Path, posts: np.ndarray, transform, crs: str = "EPSG:4326", **profile) -> Path:
    """A raster of undulations, (r, c) m."""
    units = profile.pop("units", None)
    with rasterio.open(
        path, "w", driver="GTiff", height=posts.shape[0], width=posts.shape[1], count=1, dtype=posts.dtype,
        transform=transform, crs=crs, **profile,
    ) as file:  # fmt: skip
        file.write(posts, 1)
        if units is not None:
            file.units = (units,)
    return path


def around_the_earth(west: float = -180.0) -> np.ndarray:
    """Undulations on posts 15 minutes apart, from the pole down and from `west` on: smooth, and the same at the poles
    and once around. (721, 1440) float32 m."""
    lat = np.deg2rad(90.0 - STEP_DEG * np.arange(721))[:, None]
    lon = np.deg2rad(west + STEP_DEG * np.arange(1440))
    return (20.0 * np.sin(lat) + 60.0 * np.cos(lat) ** 2 * np.cos(2.0 * lon + 0.3)).astype(np.float32)


def write_proj_grid(path: Path, posts: np.ndarray | None = None) -> Path:
    """A world-wide grid as PROJ's own are: 15 minutes, posts on the poles and on 180 degrees west."""
    posts = around_the_earth() if posts is None else posts
    with rasterio.open(
        path, "w", driver="GTiff", width=1440, height=721, count=1, dtype="float32", crs="EPSG:4326", nodata=-32768,
        transform=from_origin(-180 - STEP_DEG / 2, 90 + STEP_DEG / 2, STEP_DEG, STEP_DEG),
    ) as file:  # fmt: skip
        file.write(posts, 1)
        file.update_tags(AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
        file.set_band_description(1, "geoid_undulation")
        file.units = ("metre",)
    return path
