"""Programs that no package registry has: s2p, MicMac and SETSM, used if a path to a build is given.

Written from their documentation; the machine of the published results had no builds of them. See `configurations/`.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import shutil
import subprocess
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import rasterio
import yaml
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning

from peers.environments import CONFIGURATIONS, Missing, digest_of
from peers.measuring import Failed, Usage, measured
from peers.scenes import RESOLUTION_M, Scene
from rectifying import gridded
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.cameras.rpc_text import write_rpc_txt
from zlocus.sensors.rpc import RpcCoefficients

ANSWER_S = 60.0


def recommended(name: str) -> dict:
    """The recommended options in `configurations/NAME.yaml`."""
    return dict(yaml.safe_load((CONFIGURATIONS / f"{name}.yaml").read_text(encoding="utf-8")))


def digest(name: str) -> dict[str, str]:
    """Fingerprint of a configuration."""
    return {"configuration": digest_of([CONFIGURATIONS / f"{name}.yaml"])}


def working(program: Path) -> Path:
    """Path of the program; raises `Missing` if there is none."""
    found = shutil.which(program)
    if found is None:
        raise Missing(f"{program} is no program that can be run: give the path to the command of a build")
    return Path(found).resolve()


def said_version(program: Path, *asks: str) -> str:
    """The version in the output of a program, or an empty text."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        said = subprocess.run([program, *asks], capture_output=True, text=True, errors="replace", timeout=ANSWER_S)
        found = re.search(r"\d+\.\d+[\w.+-]*|\b[0-9a-f]{7,40}\b", said.stdout + said.stderr)
        return found.group() if found else "unknown"
    return "unknown"


@dataclass(frozen=True)
class S2p:
    """Pairs of the first image with each other one, matched by MGM, averaged on a grid (de Franchis et al. 2014)."""

    program: Path
    name: str = "s2p"

    def versions(self) -> dict[str, str]:
        return {"s2p": said_version(self.program, "--version")} | digest("s2p")

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        out.mkdir(parents=True, exist_ok=True)
        config = recommended("s2p") | {
            "out_dir": str(out / "s2p"), "temporary_dir": str(out / "tmp"),
            "images": [{"img": str(path)} for path in scene.images.values()],
            "dsm_resolution": RESOLUTION_M, "max_processes": len(cores),
        }  # fmt: skip
        (out / "config.json").write_text(json.dumps(config, indent=1))
        used = measured([self.program, out / "config.json"], cores, out / "s2p.log", out)
        return out / "s2p" / "dsm.tif", used


@dataclass(frozen=True)
class MicMac:
    """All images at once on a ground grid by Malt (Rupnik et al. 2017), with the orientation as it is given."""

    program: Path
    name: str = "MicMac"

    def versions(self) -> dict[str, str]:
        return {"mm3d": said_version(self.program, "CheckDependencies")} | digest("micmac")

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        # The patterns of MicMac match every TIFF of a folder.
        work = out / "work"
        work.mkdir(parents=True, exist_ok=True)
        for view, path in scene.images.items():
            (work / path.name).symlink_to(path.resolve())
            write_rpc_txt(work / f"{path.stem}.txt", corrected(read_rpc(path), scene.shift(view)))
        (work / "ground.xml").write_text(SYSTEM_OF_COORDINATES.format(proj_string(scene.crs)))
        box = ",".join(map(str, scene.bounds))
        given = {"program": self.program, "resolution": RESOLUTION_M, "cores": len(cores), "box": box}
        used = Usage()
        for step in recommended("micmac")["steps"]:
            command = [self.program, *(str(word).format(**given) for word in step), "@ExitOnBrkp"]
            used += measured(command, cores, out / f"{step[0]}.log", work)
        return georeferenced(work / "MEC-Malt", scene, out / "dsm.tif"), used


def corrected(rpc: RpcCoefficients, shift: tuple[float, float]) -> RpcCoefficients:
    """RPC whose image positions are moved by a pointing correction (column, row) px."""
    return replace(rpc, samp_off=rpc.samp_off + shift[0], line_off=rpc.line_off + shift[1])


# Format of MicMac: a projection by a definition of PROJ.
SYSTEM_OF_COORDINATES = """<SystemeCoord>
  <BSC>
    <TypeCoord> eTC_Proj4 </TypeCoord>
    <AuxR> 1 </AuxR> <AuxR> 1 </AuxR> <AuxR> 1 </AuxR>
    <AuxStr> {} </AuxStr>
  </BSC>
</SystemeCoord>
"""


def proj_string(crs: str) -> str:
    """A UTM zone in the form of MicMac; raises `Failed` for other systems."""
    zone = CRS(crs).utm_zone
    if zone is None:
        raise Failed(f"MicMac is given UTM zones only, and {crs} is none")
    south = " +south" if zone.endswith("S") else ""
    return f"+proj=utm +zone={zone[:-1]}{south} +ellps=WGS84 +datum=WGS84 +units=m +no_defs"


def georeferenced(folder: Path, scene: Scene, path: Path) -> Path:
    """Write the last surface of Malt as a georeferenced raster in metres, without the cells that Malt masks."""
    steps = sorted(folder.glob("Z_Num*_DeZoom1_STD-MALT.tif"), key=lambda each: int(re.findall(r"\d+", each.name)[0]))
    if not steps or not steps[-1].with_suffix(".xml").exists():
        raise Failed(f"MicMac left no surface in {folder}")
    frame = ElementTree.parse(steps[-1].with_suffix(".xml")).getroot()

    def numbers(name: str) -> list[float]:
        return [float(word) for word in (frame.findtext(f".//{name}") or "").split()]

    z = pixels(steps[-1]) * numbers("ResolutionAlti")[0] + numbers("OrigineAlti")[0]
    masks = sorted(folder.glob("AutoMask_STD-MALT_Num_*.tif")) or sorted(folder.glob("Masq_STD-MALT_DeZoom1.tif"))
    if masks:
        z = np.where(pixels(masks[-1]) > 0, z, np.nan)
    (x, y), (right, down) = numbers("OriginePlani"), numbers("ResolutionPlani")
    # The centre of the first cell, as in the world files of MicMac.
    transform = rasterio.Affine(right, 0.0, x - right / 2, 0.0, down, y - down / 2)
    with rasterio.open(
        path, "w", driver="GTiff", height=z.shape[0], width=z.shape[1], count=1, dtype="float32", crs=scene.crs,
        transform=transform, nodata=np.nan,
    ) as file:  # fmt: skip
        file.write(z.astype(np.float32), 1)
    return path


def pixels(path: Path) -> np.ndarray:
    """Values (r, c) of a raster without georeference."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            return np.asarray(file.read(1))


@dataclass(frozen=True)
class Setsm:
    """Pairs of images on a refined TIN (Noh and Howat 2015); pairs are merged by the median of each cell."""

    program: Path
    name: str = "SETSM"

    def versions(self) -> dict[str, str]:
        return {"setsm": said_version(self.program, "-help")} | digest("setsm")

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        out.mkdir(parents=True, exist_ok=True)
        for name, path in scene.images.items():
            (out / f"{name}.tif").symlink_to(path.resolve())
            write_isd(out / f"{name}.xml", read_rpc(path))
        low, high = scene.heights
        options = [*itertools.chain(*recommended("setsm")["options"].items()), "-outres", RESOLUTION_M]
        used, surfaces = Usage(), []
        for left, right in scene.pairs:
            pair = out / f"{left}-{right}"
            command = [self.program, "-image", out / f"{left}.tif", "-image", out / f"{right}.tif", "-outpath", pair]
            command += [*options, "-minH", low, "-maxH", high]
            used += measured(command, cores, out / f"{pair.name}.log", out)
            surfaces.append(on_grid(only(pair, "*_dem.tif"), scene))
        return write_median(surfaces, scene, out / "dsm.tif"), used


def write_isd(path: Path, rpc: RpcCoefficients) -> None:
    """Write the RPC as XML of DigitalGlobe, which SETSM reads beside an image of the same name."""
    root = ElementTree.Element("isd")
    block = ElementTree.SubElement(root, "RPB")
    ElementTree.SubElement(block, "SATID").text = "WV01"
    image = ElementTree.SubElement(block, "IMAGE")
    scalars = {
        "LINEOFFSET": rpc.line_off, "SAMPOFFSET": rpc.samp_off, "LATOFFSET": rpc.lat_off, "LONGOFFSET": rpc.lon_off,
        "HEIGHTOFFSET": rpc.height_off, "LINESCALE": rpc.line_scale, "SAMPSCALE": rpc.samp_scale,
        "LATSCALE": rpc.lat_scale, "LONGSCALE": rpc.lon_scale, "HEIGHTSCALE": rpc.height_scale,
    }  # fmt: skip
    for name, value in scalars.items():
        ElementTree.SubElement(image, name).text = repr(float(value))
    terms = {
        "LINENUMCOEF": rpc.line_num,
        "LINEDENCOEF": rpc.line_den,
        "SAMPNUMCOEF": rpc.samp_num,
        "SAMPDENCOEF": rpc.samp_den,
    }
    for name, values in terms.items():
        listed = ElementTree.SubElement(ElementTree.SubElement(image, f"{name}List"), name)
        listed.text = " ".join(repr(float(value)) for value in values)
    ElementTree.ElementTree(root).write(path)


def only(folder: Path, pattern: str) -> Path:
    """The file that matches a pattern; raises `Failed` if there is none."""
    found = sorted(folder.glob(pattern))
    if not found:
        raise Failed(f"no {pattern} was left in {folder}")
    return found[0]


def on_grid(path: Path, scene: Scene) -> np.ndarray:
    """Heights (r, c) m of a surface on the grid of the scene, NaN without a height."""
    with rasterio.open(path) as file:
        if file.crs is None or file.crs.to_epsg() != CRS(scene.crs).to_epsg():
            raise Failed(f"{path} is in {file.crs}, not in {scene.crs}")
        z = file.read(1, masked=True).astype(float).filled(np.nan)
        rows, cols = np.nonzero(np.isfinite(z) & (np.abs(z) < 9000))
        x, y = file.transform * (cols + 0.5, rows + 0.5)
    return gridded(scene, np.column_stack([x, y, z[rows, cols]]))


def write_median(surfaces: list[np.ndarray], scene: Scene, path: Path) -> Path:
    """Write the median of surfaces (r, c) m on the grid of the scene, NaN where none has a height."""
    stacked = np.ma.masked_invalid(np.stack(surfaces))
    merged = np.ma.median(stacked, axis=0).filled(np.nan).astype(np.float32)
    west, _, _, north = scene.bounds
    step = RESOLUTION_M
    with rasterio.open(
        path, "w", driver="GTiff", height=merged.shape[0], width=merged.shape[1], count=1, dtype="float32",
        crs=scene.crs, transform=rasterio.transform.from_origin(west, north, step, step), nodata=np.nan,
    ) as file:  # fmt: skip
        file.write(merged, 1)
    return path
