"""Scripts of benchmarks/, run in this process as their command lines run them, and the tables that they print."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from places import ROOT

BENCHMARKS = ROOT / "benchmarks"


def run_script(monkeypatch: pytest.MonkeyPatch, script: ModuleType, *arguments: Any) -> Any:
    """What the main function of a script returns for these arguments of its command line."""
    monkeypatch.setattr(sys, "argv", [f"{script.__name__}.py", *map(str, arguments)])
    return script.main()


def printed_table(text: str, number: int = 0) -> list[dict[str, str]]:
    """Rows of a table in Markdown, each by the headings of the columns. number : of the table, of several in a text."""
    lines = text.splitlines()
    rules = [at for at, line in enumerate(lines) if line.startswith("|---") and at]
    heading, found = cells_of(lines[rules[number] - 1]), []
    for line in lines[rules[number] + 1 :]:
        if not line.startswith("|"):
            break
        found.append(dict(zip(heading, cells_of(line), strict=True)))
    return found


def cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def share_of(cell: str) -> float:
    """A share from a cell that says it in per cent."""
    assert cell.endswith("%"), cell
    return float(cell.rstrip("% ")) / 100


# Of the photographs: how far left the ground lies in the second, and the box before it.
DISPARITY_PX, BOX = (9, 14), np.s_[20:60, 40:70]


def write_photographs(folder: Path) -> None:
    """A rectified pair as the scene "teddy" has it: texture at two distances, and the truth of both images."""
    rng = np.random.default_rng(4)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (80, 160)).astype(np.uint8), (3, 3), 0)
    true = np.full((80, 120), DISPARITY_PX[0])
    true[BOX] = DISPARITY_PX[1]
    row, col = np.mgrid[:80, :120]
    first = scene[row, col]
    first[BOX] = rng.integers(0, 256, first[BOX].shape)
    first[BOX] = cv2.GaussianBlur(first[BOX], (3, 3), 0)
    second = scene[row, col + DISPARITY_PX[0]]
    rows, cols = BOX
    nearer = slice(cols.start - DISPARITY_PX[1], cols.stop - DISPARITY_PX[1])
    second[rows, nearer] = first[BOX]
    true_second = np.full((80, 120), DISPARITY_PX[0])
    true_second[rows, nearer] = DISPARITY_PX[1]
    folder.mkdir(parents=True)
    for name, values in (("im2", first), ("im6", second), ("disp2", 4 * true), ("disp6", 4 * true_second)):
        cv2.imwrite(str(folder / f"{name}.png"), values.astype(np.uint8))
