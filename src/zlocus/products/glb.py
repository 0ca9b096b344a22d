"""Write binary glTF 2.0 files (.glb): one textured mesh each. Source: Khronos Group, glTF 2.0 specification."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from zlocus import __version__
from zlocus.core.sensor_model import FloatArray

MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_INT, ARRAY_BUFFER, ELEMENT_BUFFER = 5126, 5125, 34962, 34963
LINEAR, CLAMP = 9729, 33071
JPEG_QUALITY = 90
# From east, north, up to the axes of glTF: x to the right, y up, z towards the viewer.
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh with its texture.

    xyz : (n, 3) m, east, north, up from the tile's own origin; uv : (n, 2) texture coordinates, (0, 0) is the upper
    left corner; triangles : (t, 3) numbers of vertices, counter-clockwise from outside; texture : (r, c, 3) uint8;
    origin : (3,) m of the tile in the frame of all tiles.
    """

    xyz: FloatArray
    uv: FloatArray
    triangles: NDArray[np.integer]
    texture: NDArray[np.uint8]
    origin: tuple[float, float, float]


def glb_bytes(name: str, textured_mesh: TexturedMesh, extras: dict[str, Any]) -> bytes:
    """The bytes of a .glb file. name : of the mesh; extras : of the asset."""
    xyz = (textured_mesh.xyz @ Y_UP.T).astype("<f4")
    parts = [xyz.tobytes(), textured_mesh.uv.astype("<f4").tobytes(), textured_mesh.triangles.astype("<u4").tobytes()]
    parts.append(_jpeg(textured_mesh.texture))
    views: list[dict[str, Any]] = []
    binary = b""
    for part, target in zip(parts, (ARRAY_BUFFER, ARRAY_BUFFER, ELEMENT_BUFFER, None), strict=True):
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(part)}
        views.append(view if target is None else view | {"target": target})
        binary += part + b"\0" * (-len(part) % 4)
    n = len(xyz)
    accessors = [
        {"bufferView": 0, "componentType": FLOAT, "count": n, "type": "VEC3",
         "min": xyz.min(axis=0).tolist(), "max": xyz.max(axis=0).tolist()},
        {"bufferView": 1, "componentType": FLOAT, "count": n, "type": "VEC2"},
        {"bufferView": 2, "componentType": UNSIGNED_INT, "count": textured_mesh.triangles.size, "type": "SCALAR"},
    ]  # fmt: skip
    document = {
        "asset": {"version": "2.0", "generator": f"zlocus {__version__}", "extras": extras},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0, "translation": (Y_UP @ np.array(textured_mesh.origin)).tolist()}],
        "meshes": [{
            "name": name,
            "primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}],
        }],
        "materials": [{
            "name": "images", "doubleSided": True, "extensions": {"KHR_materials_unlit": {}},
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0},
        }],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}],
        "images": [{"bufferView": 3, "mimeType": "image/jpeg"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }  # fmt: skip
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    header = struct.pack("<3I", MAGIC, VERSION, length) + struct.pack("<2I", len(text), JSON_CHUNK)
    return header + text + struct.pack("<2I", len(binary), BINARY_CHUNK) + binary


def _jpeg(texture: NDArray[np.uint8]) -> bytes:
    blue_first = np.ascontiguousarray(texture[..., ::-1])
    _, content = cv2.imencode(".jpg", blue_first, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(content)
