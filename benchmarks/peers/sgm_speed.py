"""Semi-global aggregation on one core: `python sgm_speed.py PROGRAM SIDE HEIGHTS ROUNDS` prints CPU seconds.

Runs in the environment of the program. All programs get SIDE x SIDE cells with HEIGHTS heights (disparities), eight
paths and constant penalties; the best of ROUNDS rounds counts. OpenCV has no separate aggregation, so its time includes
costs and minima.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

P1, P2 = 8, 32
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (-1, -1), (-1, 1))


def best(call: Callable[[], object], rounds: int) -> float:
    """CPU seconds of all threads in the fastest of some calls, after one call that warms up."""
    call()
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    return min(seconds)


def costs(side: int, heights: int) -> np.ndarray:
    """A cost volume (r, c, k) uint8."""
    return np.random.default_rng(5).integers(0, 25, (side, side, heights)).astype(np.uint8)


def pair(side: int, heights: int) -> tuple[np.ndarray, np.ndarray]:
    """Two textured images with `side` columns that both images see at all disparities."""
    import cv2

    right = np.random.default_rng(2).integers(0, 256, (side, side + heights)).astype(np.uint8)
    right = cv2.GaussianBlur(right, (5, 5), 0)
    return np.roll(right, heights // 3, axis=1), right


def zlocus(side: int, heights: int) -> Iterator[tuple[str, Callable[[], object]]]:
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from zlocus.matching.height_lattice import HeightLattice
    from zlocus.matching.kernels.mgm import sweep_quarter
    from zlocus.matching.kernels.sgm import sweep

    block = 32
    blocks = (-(-side // block),) * 2
    lattice = HeightLattice(
        0.0, 1.0, (side, side), block, np.zeros(blocks, np.int64), np.full(blocks, heights, np.int64)
    )
    # All cells have the same number of heights, so the order of the blocks does not matter for the time.
    cost = costs(side, heights).reshape(-1)
    p2 = np.full((4, side, side), P2, np.uint16)
    total = np.zeros(lattice.size, np.uint16)

    def one() -> None:
        for sign in (1, -1):
            sweep(cost, lattice.layout, p2, np.uint16(P1), sign, total)

    def two() -> None:
        for turn in range(4):
            sweep_quarter(cost, lattice.layout, p2, np.uint16(P1), turn, total)

    yield "one predecessor (sgm)", one
    yield "two predecessors (mgm, the default)", two


def opencv(side: int, heights: int) -> Iterator[tuple[str, Callable[[], object]]]:
    import cv2

    cv2.setNumThreads(1)
    left, right = pair(side, heights)
    matcher = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=heights, blockSize=3, P1=72, P2=288, mode=cv2.STEREO_SGBM_MODE_HH
    )
    yield "StereoSGBM, MODE_HH, costs and minima included", lambda: matcher.compute(left, right)


def libsgm(side: int, heights: int) -> Iterator[tuple[str, Callable[[], object]]]:
    from c_libsgm import sgm_api

    segments = np.ones((side, side), np.float32)
    directions = np.array(DIRECTIONS, np.int32)
    for kind in (np.uint8, np.float32):
        volume = costs(side, heights).astype(kind)
        p1, p2 = (np.full((side, side, 8), value, kind) for value in (P1, P2))

        def call(volume: np.ndarray = volume, p1: np.ndarray = p1, p2: np.ndarray = p2) -> object:
            return sgm_api(volume, p1, p2, directions, 255, segments, False, False)

        yield f"sgm_api, {np.dtype(kind).name} costs", call


def pandora(side: int, heights: int) -> Iterator[tuple[str, Callable[[], object]]]:
    from pandora import check_conf, import_plugin
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.optimization import AbstractOptimization
    from pandora.state_machine import PandoraMachine

    import_plugin()
    options = Path(__file__).parent / "configurations" / "pandora.json"
    recommended = json.loads(options.read_text(encoding="utf-8"))["pipeline"]
    left, right = written(side, heights)
    images = {
        "left": {"img": left, "disp": [-(heights - 1), 0], "nodata": -9999},
        "right": {"img": right, "disp": [0, heights - 1], "nodata": -9999},
    }
    steps = {step: recommended[step] for step in ("matching_cost", "optimization", "disparity")}
    machine = PandoraMachine()
    config = check_conf({"input": images, "pipeline": steps}, machine)
    machine.run_prepare(config, *(create_dataset_from_inputs(config["input"][name]) for name in ("left", "right")))
    machine.run("matching_cost", config)
    step = AbstractOptimization(machine.left_img, **config["pipeline"]["optimization"])
    volume = machine.left_cv["cost_volume"].data.copy()

    def call() -> object:
        machine.left_cv["cost_volume"].data = volume.copy()
        return step.optimize_cv(machine.left_cv, machine.left_img, machine.right_img)

    yield "optimization step: libSGM in its frame", call


def written(side: int, heights: int) -> list[str]:
    """Write both images as TIFF into a folder that is removed with the process."""
    import atexit
    import shutil
    import tempfile

    import cv2

    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    paths = [f"{folder}/{name}.tif" for name in ("left", "right")]
    for path, image in zip(paths, pair(side, heights), strict=True):
        cv2.imwrite(path, image[:, :side].astype(np.float32))
    return paths


PROGRAMS = {"zlocus": zlocus, "opencv": opencv, "libsgm": libsgm, "pandora": pandora}


def main() -> None:
    name, side, heights, rounds = sys.argv[1], *map(int, sys.argv[2:])
    found = {form: best(call, rounds) for form, call in PROGRAMS[name](side, heights)}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
