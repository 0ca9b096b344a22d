"""Rectified photographs with truth (Scharstein and Szeliski 2002, 2003): matchers of pairs and `zlocus cloud`."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import middlebury as cases
from peers.environments import CONFIGURATIONS, Environment
from peers.measuring import Failed, measured
from peers.results import Results

MATCHERS = {"OpenCV SGBM": "opencv", "Pandora": "pandora"}
HERE = Path(__file__).parent


def middlebury(results: Results, out: Path, environments: dict[str, Environment], cores: Sequence[int]) -> None:
    """Measure the share of bad pixels: of all programs with two views, and of zlocus also with more.

    Cases whose photographs are missing are left out.
    """
    data = Path(os.environ.get("ZLOCUS_TEST_DATA", "")) / "middlebury_multiview"
    for name, case in cases.CASES.items():
        if not (data / case.folder).is_dir():
            continue
        truth = cases.true_disparity(data / case.folder, case)
        if not results.has("middlebury", case=name, program="zlocus"):
            found, _ = cases.zlocus_disparity(data / case.folder, case, out / name.replace(", ", "-").replace(" ", "-"))
            row = {"case": name, "program": "zlocus", "bad_percent": cases.bad(found, truth)}
            results.add("middlebury", row, "case", "program")
        if len(case.views) > 2 or "matchers" not in environments:
            continue
        for program, script in MATCHERS.items():
            if results.has("middlebury", case=name, program=program):
                continue
            folder = out / f"{case.folder}-{script}"
            try:
                found = matched(data / case.folder, case, script, folder, environments["matchers"], cores)
            except Failed as failure:
                print(failure, file=sys.stderr)
                continue
            row = {"case": name, "program": program, "bad_percent": cases.bad(found, truth)}
            results.add("middlebury", row, "case", "program")


def matched(
    folder: Path, case: cases.Case, script: str, out: Path, environment: Environment, cores: Sequence[int]
) -> np.ndarray:
    """Disparity (r, c) px of the first two views, NaN where there is none.

    Every pixel counts, so gaps are filled by the means of the matcher (`dense` of its configuration).
    """
    out.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = json.loads((CONFIGURATIONS / f"{script}.json").read_text(encoding="utf-8"))
    changed = options.get("pipeline", options)
    changed.update(options.pop("dense"))
    pair = {"disparity": str(out / "0.npy"), "first": 0, "count": 16 * -(-(case.most_px + 1) // 16)}
    for side, (file, _) in zip(("left", "right"), case.views[:2], strict=True):
        pair[side] = str(out / f"{side}.tif")
        cv2.imwrite(pair[side], cv2.imread(str(folder / file), cv2.IMREAD_GRAYSCALE))
    job = out / "job.json"
    job.write_text(json.dumps({"pairs": [pair], "options": options, "threads": len(cores)}, indent=1))
    measured([environment.python, HERE / f"match_{script}.py", job], cores, out / "match.log")
    return np.asarray(np.load(pair["disparity"]))
