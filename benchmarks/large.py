"""Growth of time and memory with area, number of images and workers, on a rendered town that is repeated as needed.

    python benchmarks/large.py area --million 4 16 100
    python benchmarks/large.py workers --million 16
    python benchmarks/large.py views --million 1 --images 2 4 8
    python benchmarks/large.py block --side 4 8 16
    python benchmarks/large.py frames --frames 100 300 1000
    python benchmarks/large.py draw [--picture FILE]

One period of the town is rendered per image by a parallel camera, so that the image of the repeated town is
the repeated image. CPU is the CPU of all processes, from `run.json`; memory is the largest memory of one worker, from
`events.jsonl`. Measured rows replace rows of the same kind in `growth.csv`, or in the table that `--table` names.
`draw` plots them as docs/development/experiments/growth.png. `--period` sets the side of the town and of the images of
a block. `frames` plans whole blocks of frames, matches a part of each (`frame_block.py`), and prints tables.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning
from rasterio.rpc import RPC
from rasterio.windows import Window

from frame_block import Survey, measure_frames
from workplace import CannotRun, ended, table_line
from zlocus.sensors.rpc import RpcCoefficients
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.render import Optics, expose, render
from zlocus.synthetic.scenes import build_ground, city_spec, exposures_of, steady
from zlocus.synthetic.terrain import SyntheticGround

ROOT = Path(__file__).parents[1]
KEPT, PICTURE = ROOT / "benchmarks" / "growth.csv", ROOT / "docs" / "development" / "experiments" / "growth.png"
PERIOD_PX, GSD_M = 1024, 0.5
# Distance of the camera, at which rays are parallel to a thousandth of a pixel over the largest scene.
FAR_M = 1e9
UTM = CRS.from_epsg(32632)
BLOCK = 256
# View angles along and across, degrees: the first image is vertical, the others come in pairs from all sides.
LOOKS = (1.0, -1.0), (16.0, 2.0), (-16.0, -2.0), (8.0, 12.0), (-8.0, -12.0), (4.0, -18.0)
IMAGES = (2, 4, 8, 16, 32, 64)
# Frames of whole blocks, and side of the part of each that is matched, m.
FRAMES, PART_M = (100, 300, 1000), 500.0


@dataclass(frozen=True)
class Town:
    """One period of a repeated town: its ground with copies around it, and its position.

    period_px : side in pixels of `GSD_M`.
    """

    ground: SyntheticGround
    west_m: float
    north_m: float
    z: tuple[float, float]
    period_px: int


def town(period_px: int = PERIOD_PX) -> Town:
    """Render one period of a town, surrounded by copies of itself."""
    spec = replace(steady(city_spec(7)), size=period_px, gsd_m=GSD_M)
    ground = build_ground(spec, exposures_of(spec))
    n = round(period_px * GSD_M / ground.step)
    row, col = round((ground.y0 - spec.north_m) / ground.step), round((spec.west_m - ground.x0) / ground.step)
    one = (slice(row, row + n), slice(col, col + n))
    whole = SyntheticGround(
        spec.west_m - n * ground.step, spec.north_m + n * ground.step, ground.step,
        np.tile(ground.planes[one], (3, 3, 1)), np.tile(ground.material[one], (3, 3)), ground.materials,
        ground.textures, ground.texel_m,
    )  # fmt: skip
    return Town(whole, spec.west_m, spec.north_m, ground.height_range, period_px)


def looks(n_views: int) -> list[tuple[float, float]]:
    """View angles (along, across) of n_views images, degrees: first those of `LOOKS`, then angles between them."""
    rng = np.random.default_rng(3)
    return [*LOOKS, *((float(a), float(b)) for a, b in rng.uniform(-18.0, 18.0, (max(n_views, 6) - 6, 2)))][:n_views]


def write_views(folder: Path, at: Town, n_views: int, side: int) -> list[Path]:
    """Write images of the repeated town, `side` pixels along each side, all of the same ground."""
    paths = []
    for number, look in enumerate(looks(n_views)):
        paths.append(folder / f"v{number:02d}.tif")
        write_repeated(paths[-1], pixels(at, look, number), side, rpc_of(at, look, (0, 0), side))
    return paths


def write_block(folder: Path, at: Town, side: int) -> list[Path]:
    """Write a block of side x side images; each shows one period of the town and overlaps its neighbours by half."""
    period, paths = at.period_px, []
    step = period // 2
    made = [pixels(at, look, number) for number, look in enumerate(LOOKS)]
    for row, col in product(range(side), range(side)):
        # Neighbours on all sides get different view angles.
        number = (row * 2 + col) % len(LOOKS)
        numbers = np.roll(made[number], (-step * (row % 2), -step * (col % 2)), (0, 1))
        paths.append(folder / f"b{row:02d}_{col:02d}.tif")
        write_repeated(paths[-1], numbers, period, rpc_of(at, LOOKS[number], (row * step, col * step), period))
    return paths


def camera(at: Town, look: tuple[float, float], first: tuple[int, int]) -> SatelliteCamera:
    """The camera of an image that begins at pixel `first` (row, column) of the repeated town."""
    # The first corner of the town is the corner of a pixel, not the centre of one.
    centre = (-0.5 - first[1], -0.5 - first[0])
    return SatelliteCamera((at.west_m, at.north_m, sum(at.z) / 2), centre, GSD_M, *look, altitude_m=FAR_M)


def pixels(at: Town, look: tuple[float, float], number: int) -> NDArray[np.integer]:
    """One period of the image of the repeated town, (period_px, period_px)."""
    shape = (at.period_px, at.period_px)
    seen = render(at.ground, camera(at, look, (0, 0)), shape, exposures_of(steady(city_spec(7)))[0].view.sun)
    return expose(seen, Optics(), np.random.default_rng([5, number]))


def rpc_of(at: Town, look: tuple[float, float], first: tuple[int, int], side: int) -> RpcCoefficients:
    """The RPC of an image of `side` pixels each way."""
    return fit_rpc(camera(at, look, first), (side, side), UTM, (at.z[0] - 20.0, at.z[1] + 20.0)).rpc


def write_repeated(path: Path, numbers: NDArray[np.integer], side: int, rpc: RpcCoefficients) -> None:
    """Write an image (r, c) repeated to `side` pixels along each side; it is never whole in memory."""
    tags = RPC(
        height_off=rpc.height_off, height_scale=rpc.height_scale, lat_off=rpc.lat_off, lat_scale=rpc.lat_scale,
        line_den_coeff=list(rpc.line_den), line_num_coeff=list(rpc.line_num), line_off=rpc.line_off,
        line_scale=rpc.line_scale, long_off=rpc.lon_off, long_scale=rpc.lon_scale, samp_den_coeff=list(rpc.samp_den),
        samp_num_coeff=list(rpc.samp_num), samp_off=rpc.samp_off, samp_scale=rpc.samp_scale,
    )  # fmt: skip
    period = len(numbers)
    # The image has no georeference except its RPC, on purpose.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        file = rasterio.open(
            path, "w", driver="GTiff", height=side, width=side, count=1, dtype=numbers.dtype, nodata=0, tiled=True,
            blockxsize=BLOCK, blockysize=BLOCK, rpcs=tags, BIGTIFF="IF_SAFER",
        )  # fmt: skip
    with file:
        for row in range(0, side, period):
            for col in range(0, side, period):
                part = numbers[: side - row, : side - col]
                file.write(part, 1, window=Window(col, row, part.shape[1], part.shape[0]))


@dataclass(frozen=True)
class Growth:
    """Time and memory of a run.

    wall_s, cpu_s : of the whole run with all processes; match_s, match_cpu_s : of the matching alone; worker_mb,
    command_mb : largest memory of one worker, and of the command itself.
    """

    million: float
    n_views: int
    workers: int
    n_tiles: int
    wall_s: float
    orient_s: float
    match_s: float
    products_s: float
    match_cpu_s: float
    cpu_s: float
    worker_mb: float
    command_mb: float
    filled: float

    @property
    def cpu_s_per_million(self) -> float:
        """CPU seconds of the whole run per million cells."""
        return self.cpu_s / self.million

    def row(self) -> str:
        """A line of the table below `HEAD`."""
        cells = (
            f"{self.million:.1f}", self.n_views, self.workers, self.n_tiles, f"{self.wall_s:.0f}",
            f"{self.orient_s:.1f}", f"{self.match_s:.1f}", f"{self.products_s:.1f}",
            f"{self.match_cpu_s / self.million:.2f}", f"{self.cpu_s_per_million:.2f}", f"{self.worker_mb:.0f}",
            f"{self.command_mb:.0f}", f"{100 * self.filled:.1f}",
        )  # fmt: skip
        return table_line(cells)


HEAD = (
    "| M cells | images | workers | tiles | wall, s | orientation, s | matching, s | products, s | "
    "matching, CPU s / M cells | all, CPU s / M cells | worker, MB | command, MB | filled, % |\n" + "|---" * 13 + "|"
)


def measured(images: Sequence[Path], out: Path, workers: int, memory_gb: float) -> Growth:
    """Run `zlocus dsm` with default options over the whole area of the images, and measure it."""
    words = [
        sys.executable, "-m", "zlocus", "dsm", *map(str, images), "-o", str(out), "--overwrite", "--crs", "EPSG:32632",
        "--resolution", str(GSD_M), "--workers", str(workers), "--memory", str(memory_gb),
    ]  # fmt: skip
    start = time.perf_counter()
    subprocess.run(words, check=True, stdout=sys.stderr)
    wall = time.perf_counter() - start
    run = record_of(out)
    events = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    stages = {stage["name"]: stage for stage in run["stages"]}
    tiles = [event for event in events if event["event"] == "tile"]
    return Growth(
        million=run["grid"]["shape"][0] * run["grid"]["shape"][1] / 1e6,
        n_views=len(images),
        workers=workers,
        n_tiles=len(tiles),
        wall_s=wall,
        orient_s=stages["orient"]["wall_s"],
        match_s=stages["match"]["wall_s"],
        products_s=sum(
            stage["wall_s"] for name, stage in stages.items() if name not in ("open", "orient", "setup", "match")
        ),
        match_cpu_s=stages["match"]["cpu_s"],
        # Processes of workers count too.
        cpu_s=sum(stage["cpu_s"] for stage in run["stages"]),
        worker_mb=max(event["peak_mb"] for event in tiles),
        command_mb=max(stage["peak_mb"] for name, stage in stages.items() if name != "match"),
        filled=run["coverage"],
    )


def kept(what: str, found: Sequence[Growth], path: Path = KEPT) -> None:
    """Replace the rows of a kind in a table."""
    rows = [] if not path.exists() else [row for row in read_kept(path) if row["what"] != what]
    rows += [{"what": what, **{name: f"{value:.6g}" for name, value in asdict(one).items()}} for one in found]
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, ["what", *(f.name for f in fields(Growth))], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def read_kept(path: Path = KEPT) -> list[dict[str, str]]:
    """All rows of a table written by `kept`."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def draw(path: Path, table: Path = KEPT) -> None:
    """Plot the table: against area, and against the number of images of a block."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    def lines(what: str, **only: float) -> dict[str, np.ndarray]:
        chosen = [
            row for row in read_kept(table) if row["what"] == what and all(float(row[k]) == v for k, v in only.items())
        ]
        if not chosen:
            wanted = "".join(f" with {v:g} {k}" for k, v in only.items())
            raise CannotRun(f"`{table}` has no rows of `{what}`{wanted}: measure them first.")
        found = {name: np.array([float(row[name]) for row in chosen]) for name in chosen[0] if name != "what"}
        order = np.lexsort((found["workers"], found["n_views"], found["million"]))
        return {name: values[order] for name, values in found.items()}

    ink, accent, second = "#222222", "#c0392b", "#1f618d"
    style = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": ink}
    with mpl.rc_context(style):
        figure, axes = plt.subplots(1, 3, figsize=(10.0, 3.0), layout="constrained")
        area = lines("workers", workers=2)
        for values, colour, label in ((area["cpu_s"], accent, "all"), (area["match_cpu_s"], second, "matching")):
            axes[0].semilogx(area["million"], values / area["million"], "o-", color=colour, label=label)
        axes[0].set(xlabel="million cells, six images", ylabel="CPU, s per million cells", ylim=(0, None))
        axes[1].semilogx(area["million"], area["worker_mb"] / 1e3, "o-", color=accent, label="a worker")
        axes[1].semilogx(area["million"], area["command_mb"] / 1e3, "o-", color=second, label="the command")
        axes[1].set(xlabel="million cells, six images", ylabel="most memory, GB", ylim=(0, None))
        block = lines("block")
        axes[2].semilogx(
            block["n_views"], block["orient_s"] / block["n_views"], "o-", color=accent, label="orientation, s per image"
        )
        axes[2].semilogx(
            block["n_views"],
            block["match_cpu_s"] / block["million"],
            "o-",
            color=second,
            label="matching, CPU s per million cells",
        )
        axes[2].set(xlabel="images of a growing block", ylim=(0, None), xticks=block["n_views"])
        for axis in axes:
            axis.xaxis.set_major_formatter("{x:g}")
            axis.minorticks_off()
            axis.legend(frameon=False)
        figure.savefig(path, dpi=100, metadata={"Software": None})


def record_of(out: Path) -> dict[str, Any]:
    """The run.json of a run."""
    return dict(json.loads((out / "run.json").read_text(encoding="utf-8")))


def plans(asked: argparse.Namespace) -> Iterator[tuple[int, int, int]]:
    """Side in pixels, number of images and number of workers of each run; for a block, images along each side."""
    if asked.what == "block":
        yield from ((asked.period, side, asked.workers) for side in asked.side)
        return
    for million in asked.million:
        side = round((million * 1e6) ** 0.5)
        if asked.what == "area":
            yield side, 6, asked.workers
        elif asked.what == "workers":
            yield from ((side, 6, n) for n in range(1, asked.workers + 1))
        else:
            yield from ((side, n, asked.workers) for n in asked.images)


def main() -> None:
    """Measure the runs that the command line names, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("area", "workers", "views", "block", "frames", "draw"))
    parser.add_argument("--million", type=float, nargs="+", default=[4.0], help="cells")
    parser.add_argument("--side", type=int, nargs="+", default=[4, 8], help="images along each side of a block")
    parser.add_argument("--images", type=int, nargs="+", default=IMAGES, help="numbers of images, for views")
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES, help="numbers of frames, for frames")
    parser.add_argument("--part", type=float, default=PART_M, metavar="M", help="side of the part that is matched")
    parser.add_argument("--enlarged", type=int, default=1, metavar="N", help="enlarge frames by this after rendering")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--memory", type=float, default=8.0, help="GB of all workers together")
    parser.add_argument("--scratch", type=Path, default=Path(tempfile.gettempdir()), help="images and surfaces")
    parser.add_argument("--period", type=int, default=PERIOD_PX, metavar="PX", help="side of the town that is repeated")
    parser.add_argument("--table", type=Path, default=KEPT, metavar="FILE", help="where measured rows are kept")
    parser.add_argument("--picture", type=Path, default=PICTURE, metavar="FILE", help="what draw writes")
    asked = parser.parse_args()
    if asked.what == "draw":
        draw(asked.picture, asked.table)
        return
    folder = Path(tempfile.mkdtemp(prefix="large-", dir=asked.scratch))
    try:
        at, made, found = town(asked.period), {}, []
        if asked.what == "frames":
            survey = Survey(at.ground, at.west_m, at.north_m, GSD_M, at.period_px, asked.enlarged)
            measure_frames(folder, survey, asked.frames, asked.part, asked.workers)
            return
        print(HEAD, flush=True)
        for side, n, workers in plans(asked):
            if (side, n) not in made:
                made[side, n] = (
                    write_block(folder, at, n) if asked.what == "block" else write_views(folder, at, n, side)
                )
            found.append(measured(made[side, n], folder / "out", workers, asked.memory))
            print(found[-1].row(), flush=True)
        kept(asked.what, found, asked.table)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    ended(main)
