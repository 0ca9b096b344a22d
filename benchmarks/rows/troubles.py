"""Row of the acceptance table on painted troubles: one thing at a time that misleads matching, in three clean towns."""

from __future__ import annotations

import statistics
import sys
from itertools import product
from pathlib import Path

from marked_cells import marked_errors
from workplace import COVERAGE_SHORT, RENDERED_VIEWS, ZLOCUS, Figure, Workplace, rendered_images, run
from zlocus.synthetic.scenes import TROUBLE_SEEDS
from zlocus.synthetic.troubles import TROUBLES

VIEWS = {"two": RENDERED_VIEWS[:2], "three": RENDERED_VIEWS[:3]}
OFF_M = (3.0, 10.0)


def troubles(workplace: Workplace) -> list[Figure]:
    """Heights in the cells of each painted trouble, from two and from three views: the mean of three towns."""
    found: dict[str, list[float]] = {}
    for trouble, seed in product(TROUBLES, TROUBLE_SEEDS):
        scene = workplace.out / f"{trouble}-{seed}"
        run([sys.executable, "-m", "zlocus.synthetic", "-o", scene, "--trouble", trouble, "--seed", seed])
        for name, views in VIEWS.items():
            out = workplace.out / f"{trouble}-{seed}-{name}"
            for what, value in trouble_shares(f"{trouble}, {name} views", scene, views, out).items():
                found.setdefault(what, []).append(value)
    return [Figure(what, statistics.fmean(values), is_detail=True) for what, values in found.items()]


def trouble_shares(label: str, scene: Path, views: tuple[str, ...], out: Path) -> dict[str, float]:
    """Share of a trouble's cells with a height, and shares of these heights that are wrong. out : folder of the run."""
    images = rendered_images(scene, views)
    options = ["--resolution", 0.5, "--crs", "EPSG:32632", "--no-report", "--overwrite"]
    run([ZLOCUS, "dsm", *images, "-o", out, *options], accept=(0, COVERAGE_SHORT))
    found = marked_errors(out / "dsm.tif", scene)
    return {
        f"{label}: with a height": found.with_height,
        **{f"{label}: off by more than {limit_m:g} m": found.off_by_more(limit_m) for limit_m in OFF_M},
    }
