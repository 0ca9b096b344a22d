"""footprints.geojson and footprints.png: ground that the images show, and where they overlap."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer

from zlocus.core.scene import is_local
from zlocus.io.atomic_write import write_atomically

SIDE_PX, MARGIN_PX, CAPTION_PX = 900, 24, 40
INK, PAPER, ONE_IMAGE_GREY = (40, 40, 40), (255, 255, 255), (225, 225, 225)
MAX_NAMES = 40
DEGREE_DIGITS = 8
Feature = tuple[Any, dict[str, Any]]


def write_footprints(path: Path, features: Sequence[Feature], crs: CRS) -> None:
    """Write polygons with their properties as GeoJSON (RFC 7946: longitude, latitude).

    Coordinates of a local frame stay in metres, and a member `frame` says so. Anything that is not a polygon becomes a
    null geometry.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if is_local(crs):
        collection["frame"] = "local, m"
    collection["features"] = [
        {"type": "Feature", "properties": properties, "geometry": _geometry(polygon, crs)}
        for polygon, properties in features
    ]
    text = json.dumps(collection, indent=1, allow_nan=False) + "\n"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def footprints_picture(path: Path, outlines: Sequence[Any], names: Sequence[str]) -> None:
    """Write a PNG of the outlines with their names; north is up.

    Ground that one image shows is grey; ground that several show is coloured by their number, from dark to bright.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    drawn = [(np.array(outline.exterior.coords), name) for outline, name in _polygons(outlines, names)]
    corners = np.concatenate([ring for ring, _ in drawn]) if drawn else np.array([[0.0, 0.0], [1.0, 1.0]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = (SIDE_PX - 2 * MARGIN_PX) / max(*(high - low), 1e-9)
    cols, rows = (np.ceil((high - low) * scale).astype(int) + 2 * MARGIN_PX).tolist()
    rings = [
        np.round(np.column_stack([ring[:, 0] - low[0], high[1] - ring[:, 1]]) * scale + MARGIN_PX).astype(np.int32)
        for ring, _ in drawn
    ]
    count = np.zeros((rows, cols), np.int32)
    for ring in rings:
        count += cv2.fillPoly(np.zeros((rows, cols), np.uint8), [ring], 1)
    picture = overlap_colours(count)
    for ring, (_, name) in zip(rings, drawn, strict=True):
        cv2.polylines(picture, [ring], True, INK, 1, cv2.LINE_AA)
        if len(drawn) <= MAX_NAMES:
            at = (int(ring[:, 0].min()) + 4, int(ring[ring[:, 0].argmin(), 1]))
            (width, height), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
            cv2.rectangle(picture, (at[0] - 2, at[1] - height - 2), (at[0] + width + 2, at[1] + 4), PAPER, cv2.FILLED)
            cv2.putText(picture, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    strip = np.full((CAPTION_PX, max(cols, 420), 3), 255, np.uint8)
    text = f"covered by 1 image: grey; by 2 to {max(int(count.max()), 2)}: dark to bright"
    cv2.putText(strip, text, (6, CAPTION_PX - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
    wide = np.full((rows, strip.shape[1], 3), 255, np.uint8)
    wide[:, :cols] = picture
    done, png = cv2.imencode(".png", np.vstack([strip, wide]))
    assert done, "encoding fails only where memory is short"
    write_atomically(path, lambda part: part.write_bytes(png.tobytes()))


def overlap_colours(count: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Colours (r, c, 3) uint8, in OpenCV's order, of the number of images (r, c) that cover a place."""
    # The scale starts above the darkest blue, on which outlines could not be distinguished.
    share = 0.25 + 0.75 * np.clip((count - 2) / max(int(count.max()) - 2, 1), 0.0, 1.0)
    colours = np.asarray(cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS))
    colours[count == 1] = ONE_IMAGE_GREY
    colours[count == 0] = 255
    return colours


def _polygons(outlines: Sequence[Any], names: Sequence[str]) -> list[tuple[Any, str]]:
    return [(o, name) for o, name in zip(outlines, names, strict=True) if o.geom_type == "Polygon" and not o.is_empty]


def _geometry(polygon: Any, crs: CRS) -> dict[str, Any] | None:
    if polygon.geom_type != "Polygon" or polygon.is_empty:
        return None
    from shapely.geometry.polygon import orient

    ring = np.array(orient(polygon).exterior.coords)[:, :2]
    if not is_local(crs):
        to_wgs84 = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        ring = np.column_stack(to_wgs84.transform(*ring.T))
    return {"type": "Polygon", "coordinates": [np.round(ring, DEGREE_DIGITS).tolist()]}
