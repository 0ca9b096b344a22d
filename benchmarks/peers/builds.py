"""Programs that no package registry has: s2p, MicMac and SETSM, used if a path to a build is given.

`configurations/builds.yaml` says which builds they were tried against.
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

from peers.environments import CONFIGURATIONS, Environment, Missing, digest_of
from peers.isd import metadata, write_isd, write_plain
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


# Packages of s2p that compute.
S2P_PACKAGES = ("s2p", "plyflatten", "rpcm", "numpy")


@dataclass(frozen=True)
class S2p:
    """The first image with each other one, matched by MGM, averaged on a grid (de Franchis et al. 2014).

    Where not all images make pairs with the first one (images of many dates), each pair has a surface of its own, and
    a cell takes their median (Facciolo et al. 2017). program : the command in the environment of a build.
    """

    program: Path
    name: str = "s2p"

    def versions(self) -> dict[str, str]:
        try:
            found = Environment(self.program.parents[1]).versions(*S2P_PACKAGES)
        except (OSError, subprocess.CalledProcessError):
            found = {"s2p": "unknown"}
        return found | digest("s2p")

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        together = together_with_first(scene)
        if len(together) == 1:
            return self.matched(scene, together[0], out, len(cores), cores)
        used, surfaces = Usage(), []
        for views in together:
            surface, cost = self.matched(scene, views, out / "-".join(views), len(cores), cores)
            used += cost
            surfaces.append(on_grid(surface, scene))
        return write_median(surfaces, scene, out / "dsm.tif"), used

    def matched(
        self, scene: Scene, views: Sequence[str], out: Path, workers: int, cores: Sequence[int]
    ) -> tuple[Path, Usage]:
        """Path of the surface of some views, and the cost."""
        out.mkdir(parents=True, exist_ok=True)
        config = recommended("s2p") | {
            "out_dir": str(out / "s2p"), "temporary_dir": str(out / "tmp"), "out_crs": scene.crs,
            "images": [{"img": str(scene.images[view])} for view in views],
            "dsm_resolution": RESOLUTION_M, "max_processes": workers,
        }  # fmt: skip
        (out / "config.json").write_text(json.dumps(config, indent=1))
        used = measured([self.program, out / "config.json"], cores, out / "s2p.log", out)
        return out / "s2p" / "dsm.tif", used


def together_with_first(scene: Scene) -> list[tuple[str, ...]]:
    """Groups of views that s2p matches at once: all, if each makes a pair with the first one, or the pairs."""
    first, *others = scene.images
    usable = [set(pair) for pair in scene.pairs]
    return [tuple(scene.images)] if all({first, other} in usable for other in others) else [*scene.pairs]


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
            write_plain(path, work / path.name)  # it reads no compressed images
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
    zone = utm_zone(crs, "MicMac")
    south = " +south" if zone.endswith("S") else ""
    return f"+proj=utm +zone={zone[:-1]}{south} +ellps=WGS84 +datum=WGS84 +units=m +no_defs"


def utm_zone(crs: str, program: str) -> str:
    """Number and hemisphere of a UTM zone, such as 31N; raises `Failed` for other systems."""
    zone = CRS(crs).utm_zone
    if zone is None:
        raise Failed(f"{program} is given UTM zones only, and {crs} is none")
    return str(zone)


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
        for name, of_image in metadata(scene).items():
            write_plain(scene.images[name], out / f"{name}.tif")
            write_isd(out / f"{name}.xml", of_image)
        given = recommended("setsm")["options"] | options_of(scene) | {"-threads": len(cores)}
        used, surfaces = Usage(), []
        for left, right in scene.pairs:
            pair = out / f"{left}-{right}"
            command = [self.program, "-image", out / f"{left}.tif", "-image", out / f"{right}.tif", "-outpath", pair]
            command += itertools.chain(*given.items())
            used += measured(command, cores, out / f"{pair.name}.log", out)
            # A height of SETSM belongs to the upper left corner of its cell.
            surfaces.append(on_grid(only(pair, f"{pair.name}_dem.tif"), scene, at=0.0))
        return write_median(surfaces, scene, out / "dsm.tif"), used


def options_of(scene: Scene) -> dict[str, object]:
    """Options of SETSM that a scene decides: zone, heights, and the area, whose corner is the first height."""
    west, south, east, north = (edge + RESOLUTION_M / 2 for edge in scene.bounds)
    zone = utm_zone(scene.crs, "SETSM")
    return {
        "-utm_zone": zone[:-1], "-North": int(zone.endswith("N")), "-outres": RESOLUTION_M,
        "-boundary_min_X": west, "-boundary_min_Y": south, "-boundary_max_X": east, "-boundary_max_Y": north,
        "-minH": scene.heights[0], "-maxH": scene.heights[1],
    }  # fmt: skip


def only(folder: Path, pattern: str) -> Path:
    """The file that matches a pattern; raises `Failed` if there is none."""
    found = sorted(folder.glob(pattern))
    if not found:
        raise Failed(f"no {pattern} was left in {folder}")
    return found[0]


def on_grid(path: Path, scene: Scene, at: float = 0.5) -> np.ndarray:
    """Heights (r, c) m of a surface on the grid of the scene, NaN without a height. at : their place in a cell."""
    with rasterio.open(path) as file:
        if file.crs is None or file.crs.to_epsg() != CRS(scene.crs).to_epsg():
            raise Failed(f"{path} is in {file.crs}, not in {scene.crs}")
        z = file.read(1, masked=True).astype(float).filled(np.nan)
        rows, cols = np.nonzero(np.isfinite(z) & (np.abs(z) < 9000))
        x, y = file.transform * (cols + at, rows + at)
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
