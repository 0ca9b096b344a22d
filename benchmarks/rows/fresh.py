"""Rows of the acceptance table on scenes that follow from the last commit, so that nothing was chosen on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import rasterio

from rows.rendered import CITY_BARS, HILLS_NMAD_BAR_M, POINTING_PX, VIEWS, surfaces_of
from seeds import fresh_seeds, over_seeds
from workplace import RENDERED_VIEWS, ZLOCUS, Figure, Workplace, render, rendered_images, run
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import Evaluation, evaluate
from zlocus.evaluation.statistics import ErrorStatistics

SIDE_CELLS = 400
# A height that is off by more than the first limit is wrong, by more than the second grossly wrong.
WRONG_M, GROSSLY_WRONG_M = 3.0, 10.0
# Faults that make the figures miss their bars, by class and for the NMAD.
FAULTS = {
    "all": "false heights, or empty cells",
    "ground": "ground beside houses gets the height of roofs",
    "building": "roofs without texture are lost, or outlines grow",
    "nmad": "heights below a step are noisy, or cameras stay shifted",
}


def fresh_city(workplace: Workplace) -> list[Figure]:
    """Ten rendered towns with six, three and two views, on the grid of the images, judged as they are and aligned."""
    return over_fresh_seeds(workplace, "city", VIEWS)


def fresh_hills(workplace: Workplace) -> list[Figure]:
    """Ten rendered hills seen by six wrongly pointed cameras, judged as they are and after their common shift."""
    return over_fresh_seeds(workplace, "hills", {"six": RENDERED_VIEWS})


def over_fresh_seeds(workplace: Workplace, kind: str, views: dict[str, tuple[str, ...]]) -> list[Figure]:
    """Mean and spread of the figures over the fresh seeds. kind : of `zlocus.synthetic`; views : by their number."""
    seeds = fresh_seeds()
    workplace.inputs["seeds"] = seeds
    return over_seeds(seeds, lambda seed: on_seed(workplace.out, kind, seed, views))


def on_seed(out: Path, kind: str, seed: int, views: dict[str, tuple[str, ...]]) -> list[Figure]:
    """Figures of the scene of one seed, for each number of views."""
    scene, figures = out / f"{kind}{seed}", []
    render(scene, kind, SIDE_CELLS, "--seed", seed, "--pointing", POINTING_PX[kind])
    with rasterio.open(scene / "truth_dsm.tif") as truth:
        crs = truth.crs.to_string()
    for name, images in views.items():
        dsm = out / f"{kind}{seed}-{name}"
        command = [ZLOCUS, "dsm", *rendered_images(scene, images), "-o", dsm, "--resolution", 0.5, "--crs", crs]
        run([*command, "--no-report", "--overwrite"])
        figures += seed_figures(name, dsm / "dsm.tif", scene, kind)
    return figures


def seed_figures(views: str, dsm: Path, scene: Path, kind: str) -> list[Figure]:
    """Accuracy of a surface as it is and aligned.

    The bars, of the means over the seeds, are those of `CITY_BARS` for towns as they are. Hills have one for the ground
    after alignment, because their cameras point elsewhere.
    """
    figures: list[Figure] = []
    for label, is_aligned in ((views, False), (f"{views}, aligned", True)):
        found = evaluate(
            dsm,
            Comparison(
                scene / "truth_dsm.tif",
                classes=scene / "truth_class.tif",
                align=is_aligned,
                more_thresholds_m=(WRONG_M, GROSSLY_WRONG_M),
            ),
        )
        bars = {} if is_aligned else CITY_BARS[views]
        if kind == "hills":
            bars = {"nmad": HILLS_NMAD_BAR_M} if is_aligned else {}
        # Aligned figures stand side by side with the others in a table of their own on the page.
        figures += [
            replace(figure, is_detail=is_aligned and not figure.bar) for figure in accuracy(label, found, kind, bars)
        ]
    return figures


def accuracy(label: str, found: Evaluation, kind: str, bars: dict[str, float]) -> list[Figure]:
    """Shares within 1 m, share off by more, RMSE of all cells, and NMAD of the ground. bars : as in `CITY_BARS`."""
    classes: dict[str, ErrorStatistics] = {"all": found.statistics, **found.class_statistics}
    figures = [
        Figure(f"{label}, within 1 m: {name}", classes[name].within, at_least=bars.get(name), fails_when=FAULTS[name])
        for name in surfaces_of(kind)
    ]
    shares = found.statistics.as_dict()["within_m"]
    for limit_m in (WRONG_M, GROSSLY_WRONG_M):
        off = found.statistics.completeness - shares[f"{limit_m:g}"]
        figures.append(Figure(f"{label}, off by more than {limit_m:g} m", off))
    return [
        *figures,
        Figure(f"{label}, RMSE", found.statistics.rmse, "m"),
        Figure(
            f"{label}, NMAD ground", classes["ground"].nmad, "m", at_most=bars.get("nmad"), fails_when=FAULTS["nmad"]
        ),
    ]
