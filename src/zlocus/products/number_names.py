"""Names of the numbers in a raster, such as those of runs or images, as a tag of its band."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

# Tags of the rasters of a mosaic of surfaces, and of a mosaic of ortho-images.
RUNS, IMAGES = "RUNS", "IMAGES"


def number_tag(names: Sequence[str]) -> str:
    """The text of a tag: `1 north; 2 south`. names : of the numbers from 1 on."""
    return "; ".join(f"{number} {name}" for number, name in enumerate(names, 1))


def numbered_names(text: str) -> dict[int, str]:
    """The names in the text of a tag, by their numbers; names with a semicolon may be cut."""
    parts = re.split(r"(?:^|; )(\d+) ", text)
    return {int(number): name for number, name in zip(parts[1::2], parts[2::2], strict=True)}


def short_names(paths: Sequence[str]) -> list[str]:
    """Paths without the folders that all of them lie in."""
    parts = [Path(path).parts for path in paths]
    n_shared = len(list(takewhile(lambda level: len(set(level)) == 1, zip(*parts, strict=False))))
    n = min(n_shared, *(len(each) - 1 for each in parts))
    return [str(Path(*each[n:])) for each in parts]
