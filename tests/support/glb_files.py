"""Read .glb files by plain steps of the glTF 2.0 specification, checking on the way what it demands."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from places import ROOT

NODE_MODULES = ROOT / "build" / "npm"
VALIDATOR = "gltf-validator@2.0.0-dev.3.10"
NPM_S = 60.0
SCRIPT = """
const validator = require(process.argv[1] + '/node_modules/gltf-validator'), fs = require('fs');
Promise.all(process.argv.slice(2).map((path) => validator.validateBytes(new Uint8Array(fs.readFileSync(path)))))
    .then((reports) => console.log(JSON.stringify(reports.map((report) => report.issues))));
"""


@dataclass(frozen=True)
class ReadMesh:
    """A mesh: vertices (n, 3) in the frame of all tiles, east, north, up; uv (n, 2); triangles (t, 3); texture (r, c,
    3); the JSON document."""

    xyz: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray
    texture: np.ndarray
    document: dict


def read_glb(path: Path) -> ReadMesh:
    content = path.read_bytes()
    magic, version, length = struct.unpack("<4s2I", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    n, kind = struct.unpack("<I4s", content[12:20])
    assert kind == b"JSON"
    assert n % 4 == 0
    document = json.loads(content[20 : 20 + n])
    m, kind = struct.unpack("<I4s", content[20 + n : 28 + n])
    assert kind == b"BIN\0"
    assert 28 + n + m == len(content)
    assert m - document["buffers"][0]["byteLength"] in range(4)
    binary = content[28 + n :]

    def part(number):
        view = document["bufferViews"][number]
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= m
        return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def array(number, dtype, width):
        accessor = document["accessors"][number]
        values = np.frombuffer(part(accessor["bufferView"]), dtype).reshape(-1, width)
        assert accessor["count"] == len(values)
        if "min" in accessor:
            assert accessor["min"] == values.min(axis=0).tolist()
            assert accessor["max"] == values.max(axis=0).tolist()
        return values

    (primitive,) = document["meshes"][0]["primitives"]
    xyz = array(primitive["attributes"]["POSITION"], "<f4", 3)
    uv = array(primitive["attributes"]["TEXCOORD_0"], "<f4", 2)
    triangles = array(primitive["indices"], "<u4", 1).reshape(-1, 3)
    assert triangles.max() < len(xyz) == len(uv)
    assert uv.min() >= 0.0
    assert uv.max() <= 1.0
    (image,) = document["images"]
    texture = cv2.imdecode(np.frombuffer(part(image["bufferView"]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    placed = xyz + np.array(document["nodes"][0]["translation"])
    # y is up and z points to the south.
    return ReadMesh(np.column_stack([placed[:, 0], -placed[:, 2], placed[:, 1]]), uv, triangles, texture, document)


def meshes(out: Path) -> tuple[dict, list[ReadMesh]]:
    """The record of an exported mesh, and its tiles."""
    record = json.loads((out / "export.json").read_text())
    return record, [read_glb(out / tile["file"]) for tile in record["tiles"]]


def why_no_validator() -> str:
    """Why npm's gltf-validator cannot be had; empty where it is there. It is installed once, below build/."""
    if (NODE_MODULES / "node_modules" / "gltf-validator").is_dir() and shutil.which("node"):
        return ""
    if not (shutil.which("node") and shutil.which("npm")):
        return "node or npm is not installed"
    words = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(NODE_MODULES), VALIDATOR]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=NPM_S)
    except subprocess.TimeoutExpired:
        return "npm did not answer"
    return "" if done.returncode == 0 else f"npm: {done.stderr.strip().splitlines()[-1:]}"


def validator_issues(paths) -> list[dict]:
    """What npm's gltf-validator says of files."""
    words = ["node", "-e", SCRIPT, str(NODE_MODULES), *map(str, paths)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=NPM_S, check=True)
    return json.loads(done.stdout)


def check_valid(paths) -> None:
    """Assert that npm's gltf-validator finds no error and no warning in files; skips where it cannot be had."""
    why = why_no_validator()
    if why:
        pytest.skip(f"npm's gltf-validator cannot be had: {why}")
    for issues in validator_issues(paths):
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
