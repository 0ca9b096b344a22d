"""Whether surfaces have the same bytes on other processors: libraries and kernels are told to run as on older ones.

    python benchmarks/processors.py [-o OUT] [--scene FOLDER] [--settings NAME ...]

A processor is imitated by variables that switch off instructions: kernels are compiled for another one
(NUMBA_CPU_NAME), and OpenCV, NumPy, OpenBLAS and the C library of GNU take the code that they have for another one.
Each setting makes the surface of each scene once, in a process of its own, and its rasters are compared with those of
the usual run. Kernels for another processor are compiled once per name, into OUT: minutes. Scenes are a rendered town
seen by four satellite images, and a rendered block of drone images; `--scene` names another one, a folder with a
`scene.yaml` or with images with RPC.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio

from zlocus.io.run_record import processor_name
from zlocus.synthetic.drone_block import render_drone_block, small_drone_block_spec
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.scenes import city_spec

RASTERS = ("dsm", "sigma", "quality", "views", "ortho")
# Variables of each setting. Those of NumPy from 2.4 on are groups of instructions, before they were single ones.
NUMPY_V4 = "X86_V4 AVX512_ICL AVX512_SPR AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL"
NUMPY_V3 = f"{NUMPY_V4} X86_V3 AVX2 FMA3"
OPENCV_V4, OPENCV_V3 = "AVX512-SKX,AVX512-ICL", "AVX512-SKX,AVX512-ICL,AVX2,FMA3,FP16,AVX"
LIBM_V4, LIBM_V3 = "-AVX512F,-AVX512VL,-AVX512DQ", "-AVX512F,-AVX512VL,-AVX512DQ,-AVX2,-FMA,-FMA4,-AVX"
# Without further features a kernel has those of the named processor; otherwise it would have those of this one.
CPUS = ("haswell", "skylake-avx512", "x86-64")
V3, V2 = "as AVX2 and FMA: ", "as SSE4: "
SETTINGS: dict[str, dict[str, str]] = {
    **{f"kernels for {name}": {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": ""} for name in CPUS},
    f"{V3}OpenBLAS": {"OPENBLAS_CORETYPE": "Haswell"},
    f"{V3}OpenCV": {"OPENCV_CPU_DISABLE": OPENCV_V4},
    f"{V3}NumPy": {"NPY_DISABLE_CPU_FEATURES": NUMPY_V4},
    f"{V3}C library": {"GLIBC_TUNABLES": f"glibc.cpu.hwcaps={LIBM_V4}"},
    f"{V2}OpenBLAS": {"OPENBLAS_CORETYPE": "Prescott"},
    f"{V2}OpenCV": {"OPENCV_CPU_DISABLE": OPENCV_V3},
    f"{V2}NumPy": {"NPY_DISABLE_CPU_FEATURES": NUMPY_V3},
    f"{V2}C library": {"GLIBC_TUNABLES": f"glibc.cpu.hwcaps={LIBM_V3}"},
}
for _level in (V3, V2):
    _parts = [variables for name, variables in SETTINGS.items() if name.startswith(_level)]
    SETTINGS[f"{_level}all libraries"] = {name: text for part in _parts for name, text in part.items()}
SIZE, DRONE = 112, {"position_error_m": 0.5, "angle_error_deg": 0.1}


@dataclass(frozen=True)
class Difference:
    """How a surface differs from the usual one.

    rasters : names of those with other bytes; changed, changed_1_mm : shares of the cells with another height, and with
    one that differs by more than a millimetre or is there in one surface only; within_m : difference that 99 of 100
    cells with two heights do not exceed; largest_m : largest difference.
    """

    rasters: tuple[str, ...]
    changed: float
    changed_1_mm: float
    within_m: float
    largest_m: float

    @property
    def cells(self) -> str:
        """The cells of a table's row."""
        if not self.rasters:
            return "none | 0 % | 0 % | 0 m | 0 m |"
        shares = f"{100 * self.changed:.3g} % | {100 * self.changed_1_mm:.3g} %"
        return f"{', '.join(self.rasters)} | {shares} | {self.within_m:.2g} m | {self.largest_m:.2g} m |"


def usable(variables: Mapping[str, str]) -> bool:
    """Whether this machine can run with these variables: it has the instructions of the kernels' processor."""
    from llvmlite.binding import get_host_cpu_features

    name, features = variables.get("NUMBA_CPU_NAME", ""), get_host_cpu_features()
    needed = {"": (), "x86-64": ("sse2",), "haswell": ("avx2", "fma", "bmi2")}.get(name, ("avx512bw", "avx512vl"))
    return all(features.get(feature) for feature in needed)


def run(inputs: Sequence[str], out: Path, variables: Mapping[str, str], kernels: Path) -> None:
    """Make a surface in a process with these variables. kernels : folder for kernels of other processors."""
    environment = {**os.environ, "ZLOCUS_RATES": "", **variables}
    if "NUMBA_CPU_NAME" in variables:
        environment["NUMBA_CACHE_DIR"] = str(kernels / variables["NUMBA_CPU_NAME"])
    words = [sys.executable, "-m", "zlocus", "dsm", *inputs, "-o", str(out), "--workers", "1", "--no-report"]
    words += ["--products", "none", "--overwrite"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"{dict(variables)}: {done.stderr}")


def difference(usual: Path, other: Path) -> Difference:
    """How the surface in a folder differs from the usual one."""
    rasters = tuple(
        name for name in RASTERS if (usual / f"{name}.tif").read_bytes() != (other / f"{name}.tif").read_bytes()
    )
    heights = []
    for folder in (usual, other):
        with rasterio.open(folder / "dsm.tif") as source:
            heights.append((source.read(1), source.transform))
    (one, place), (two, other_place) = heights
    if one.shape != two.shape or place != other_place:
        return Difference(rasters, 1.0, 1.0, float("nan"), float("nan"))
    is_gap = np.isnan(one) != np.isnan(two)
    off = np.abs(one.astype(float) - two)
    both = off[np.isfinite(off)]
    changed, changed_1_mm = (float(((np.nan_to_num(off) > least) | is_gap).mean()) for least in (0.0, 1e-3))
    within_m, largest_m = (float(np.quantile(both, share)) for share in (0.99, 1.0))
    return Difference(rasters, changed, changed_1_mm, within_m, largest_m)


def rendered_scenes(folder: Path) -> dict[str, list[str]]:
    """Inputs of the rendered scenes, by name; what is there already is used again."""
    town, block = folder / "town", folder / "block"
    if not town.exists():
        render_scene(replace(city_spec(16), size=SIZE), town)
    if not (block / "scene.yaml").exists():
        render_drone_block(small_drone_block_spec(5, **DRONE), block)
    return {
        "town": [str(town / f"img_{view}.tif") for view in ("n1", "f1", "b1", "n2")],
        "drone block": [str(block / "scene.yaml")],
    }


def inputs_of(folder: Path) -> list[str]:
    """The scene file of a folder, or its images."""
    scene = folder / "scene.yaml"
    return [str(scene)] if scene.exists() else [str(path) for path in sorted(folder.glob("img_*.tif"))]


def measured(
    out: Path, scenes: Mapping[str, Sequence[str]], settings: Sequence[str]
) -> dict[tuple[str, str], Difference]:
    """Differences by scene and setting; prints the rows of a table as they are found."""
    print("| scene | setting | other bytes in | heights that differ | by more than 1 mm | 99 % within | largest |")
    print("|---|---|---|---|---|---|---|")
    found = {}
    for scene, inputs in scenes.items():
        usual = out / scene.replace(" ", "_") / "usual"
        run(inputs, usual, {}, out / "kernels")
        for setting in settings:
            other = usual.with_name(setting.replace(" ", "_").replace(":", ""))
            run(inputs, other, SETTINGS[setting], out / "kernels")
            found[scene, setting] = difference(usual, other)
            print(f"| {scene} | {setting} | {found[scene, setting].cells}", flush=True)
    return found


def main() -> dict[tuple[str, str], Difference]:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument(
        "-o", "--out", type=Path, help="folder for scenes, surfaces and kernels; default: a temporary one"
    )
    parser.add_argument("--scene", type=Path, help="folder of another scene in place of the rendered ones")
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), help="default: all that this machine can run")
    options = parser.parse_args()
    settings = [name for name in options.settings or SETTINGS if usable(SETTINGS[name])]
    print(f"Processor: {processor_name()}")
    with tempfile.TemporaryDirectory() as temporary:
        out = options.out or Path(temporary)
        scenes = {options.scene.name: inputs_of(options.scene)} if options.scene else rendered_scenes(out)
        return measured(out, scenes, settings)


if __name__ == "__main__":
    main()
