"""Scenes of the comparison that are as hard as real images, and the judges of their surfaces.

`rendered-real-a`, `rendered-real-b` and JAX_068 come from `ZLOCUS_TEST_DATA`; other scenes of the realistic recipe are
rendered from seeds. Matchers are given the height range and the pointing corrections that zlocus found.
"""

from __future__ import annotations

import csv
import importlib.util
import os
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

import judging
from peers.scenes import RANGE_MARGIN_M, Scene, write_terrain

REALISTIC, REGISTERED = "real", "registered"
VIEWS = ("n1", "f1", "b1", "n2", "f2")
N_VIEWS = (2, 3)
SHARED = ("rendered-real-a", "rendered-real-b")
JAX = "worldview3_jax068"
# Images of one pass, and the largest number of pairs of consecutive dates that programs of pairs get of all images.
JAX_ONE_PASS, JAX_PAIRS = ("001", "002"), 10
JAX_MIN_ANGLE_DEG = 5.0


@dataclass(frozen=True)
class RealisticScene(Scene):
    """A scene that has a judge of its own. folder : with truth_dsm.tif and truth_class.tif."""

    folder: Path = Path()


def shared_scenes(folder: Path) -> list[Scene]:
    """`rendered-real-a` and `-b` with two and three views; empty without `ZLOCUS_TEST_DATA`."""
    data = os.environ.get("ZLOCUS_TEST_DATA")
    where = [Path(data) / name for name in SHARED] if data else []
    return [scene for path in where if path.is_dir() for scene in realistic_scenes(path.name, path, folder)]


def seed_scenes(seeds: Sequence[int], folder: Path) -> list[Scene]:
    """Scenes of the realistic recipe with two and three views, rendered where that is not done yet."""
    found = []
    for seed in seeds:
        where = folder / f"real-{seed}"
        if not (where / "scene.json").exists():
            command = [sys.executable, "-m", "zlocus.synthetic", "-o", where, "--kind", "real", "--seed", seed]
            done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{where} could not be rendered: {done.stderr.strip().splitlines()[-1]}")
        found += realistic_scenes(f"realistic {seed}", where, folder)
    return found


def realistic_scenes(name: str, where: Path, folder: Path) -> list[Scene]:
    """A rendered realistic scene with two and with three views. folder : for its coarse terrain model."""
    folder.mkdir(parents=True, exist_ok=True)
    with rasterio.open(where / "truth_dsm.tif") as file:
        heights, crs, bounds = file.read(1), file.crs.to_string(), tuple(file.bounds)
        terrain = write_terrain(heights, file.transform, crs, folder / f"{where.name}_terrain.tif")
    reach = float(np.nanmin(heights)) - RANGE_MARGIN_M, float(np.nanmax(heights)) + RANGE_MARGIN_M
    return [
        RealisticScene(
            f"{name}, {number} views", REALISTIC, {view: where / f"img_{view}.tif" for view in VIEWS[:number]},
            crs, bounds, reach, terrain, where / "truth_dsm.tif", where / "truth_class.tif", folder=where,
        )
        for number in N_VIEWS
    ]  # fmt: skip


def judged_realistic(scene: Path, dsm: Path) -> dict[str, Any]:
    """Accuracy by class of a surface of a realistic scene, by the independent judge; the ground's shift is removed.

    Beside the figures after the common height of the ground was removed (`within`, `off3`, `off10`, `rmse`), each
    class has `within_absolute`: the share within 1 m of the surface as it lies.
    """
    found = judge_of("judge_real").judge(str(scene), str(dsm))
    absolute = judging.judged(dsm, scene / "truth_dsm.tif", scene / "truth_class.tif")
    classes = {name: dict(of) for name, of in found.items() if isinstance(of, dict)}
    for name, of in classes.items():
        of |= {"completeness": of.pop("complete"), "n": absolute["all"]["n"]}
        if name in absolute:
            of["within_absolute"] = absolute[name]["within"]
    classes["all"] |= {"rmse": found["rmse"], "shift_up_m": found["shift"]}
    classes["all"] |= {name: absolute["all"][name] for name in ("nmad", "le90")}
    return classes


def judged_registered(reference: Path, classes: Path, dsm: Path) -> dict[str, Any]:
    """Accuracy by class against the laser surface of JAX_068, by the protocol of its papers, and as it lies."""
    found = judge_of("judge_registered").judge(str(reference), str(dsm), str(classes))
    absolute = judging.judged(dsm, reference, classes)
    named = {name: dict(of) for name, of in found.items() if isinstance(of, dict)}
    for of in named.values():
        of |= {"completeness": of.pop("complete"), "within": of.pop("within1"), "n": of.pop("cells")}
    named["all"] |= {"within_absolute": absolute["all"]["within"], "nmad": absolute["all"]["nmad"],
                     "shift_up_m": found["shift_m"]}  # fmt: skip
    return named


def judge_of(name: str) -> ModuleType:
    """A judge of the shared tools as a module. The judges share no code with zlocus.

    Raises
    ------
    workplace.CannotRun
        The judge is not there.
    """
    from workplace import CannotRun

    script = judging.DATA.parent / "tools" / f"{name}.py"
    if not script.exists():
        raise CannotRun(f"{script} is missing: set ZLOCUS_TEST_DATA to the folder of the shared scenes")
    described = importlib.util.spec_from_file_location(name, script)
    assert described is not None
    assert described.loader is not None
    module = importlib.util.module_from_spec(described)
    described.loader.exec_module(module)
    return module


def jax_scenes(folder: Path) -> list[Scene]:
    """JAX_068 with the two images of one pass, and with all nineteen; empty without `ZLOCUS_TEST_DATA`.

    The images are written with one band, because not all programs read colours. Of all images, programs of pairs get
    those pairs of consecutive dates whose rays meet at an angle that is usual for pairs.
    """
    data = os.environ.get("ZLOCUS_TEST_DATA")
    where = Path(data) / JAX if data else None
    if where is None or not where.is_dir():
        return []
    reference, classes = (where / "reference" / f"{name}_half_utm17n.tif" for name in ("lidar_dsm", "classes"))
    with rasterio.open(reference) as file:
        heights, crs, bounds = file.read(1), file.crs.to_string(), tuple(file.bounds)
        terrain = write_terrain(heights, file.transform, crs, folder / "jax068_terrain.tif")
    reach = float(np.nanmin(heights)) - RANGE_MARGIN_M, float(np.nanmax(heights)) + RANGE_MARGIN_M
    with (where / "dates.csv").open(encoding="utf-8") as file:
        rows = sorted(csv.DictReader(file), key=lambda row: list(row.values())[1])
    by_date = [next(iter(row.values()))[8:11] for row in rows]
    images = {name: one_band(where / f"JAX_068_{name}_RGB.tif", folder / f"jax068_{name}.tif") for name in by_date}
    common = (crs, bounds, reach, terrain, reference, classes)
    one_pass = {name: images[name] for name in JAX_ONE_PASS}
    return [
        RealisticScene("JAX_068, one pass, 2 views", REGISTERED, one_pass, *common, folder=where),
        ManyDates("JAX_068, 19 views", REGISTERED, images, *common, folder=where),
    ]


@dataclass(frozen=True)
class ManyDates(RealisticScene):
    """Images of many dates, in the order of their dates."""

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Pairs of consecutive dates with usual angles, at most JAX_PAIRS of them."""
        order = list(self.images)
        usual = self.angles_deg()
        near = [(a, b) for a, b in super().pairs if abs(order.index(a) - order.index(b)) <= 2]
        return [pair for pair in near if usual(pair) >= JAX_MIN_ANGLE_DEG][:JAX_PAIRS]

    def angles_deg(self) -> Callable[[tuple[str, str]], float]:
        """Function that gives the angle between the rays of a pair."""
        rays = dict(zip(self.images, self.rays(), strict=True))
        return lambda pair: float(np.degrees(np.arccos(np.clip(rays[pair[0]] @ rays[pair[1]], -1.0, 1.0))))


def one_band(image: Path, path: Path) -> Path:
    """Write the mean of the bands of an image, with its RPC."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(image) as source:
                grey, profile, rpcs = source.read().mean(axis=0), source.profile, source.rpcs
            profile |= {"count": 1, "dtype": "uint16", "photometric": "minisblack"}
            with rasterio.open(path, "w", rpcs=rpcs, **profile) as file:
                # Sixteen grey values for each of the 8 bits of a band keep the mean of three bands.
                file.write(np.rint(16.0 * grey).astype(np.uint16), 1)
    return path


def judged_scene(scene: Scene, dsm: Path) -> dict[str, Any]:
    """Accuracy by class of a surface of any scene that has a truth, by the judge of its kind."""
    assert scene.truth is not None
    assert scene.classes is not None
    if isinstance(scene, RealisticScene):
        if scene.kind == REALISTIC:
            return judged_realistic(scene.folder, dsm)
        return judged_registered(scene.truth, scene.classes, dsm)
    classes = judging.judged(dsm, scene.truth, scene.classes)
    aligned = judging.judged(dsm, scene.truth, scene.classes, align=True)
    for name, of in classes.items():
        # The judge of the project itself also tells its thresholds and datums.
        if isinstance(of, dict) and "within" in of:
            of["within_aligned"] = aligned[name]["within"]
    return classes
