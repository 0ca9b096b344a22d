"""Calibrates the standard deviations of `sigma.tif`, and judges them.

    python benchmarks/precision.py fit [FOLDER ...] [--views 6 3 2] [--calibration FILE] [--fewest N] [-o OUT]
    python benchmarks/precision.py judge [FOLDER ...] [--views 6 3 2] [-o OUT]

`fit` renders the scenes of TRAINING, or takes the FOLDERs given, runs `zlocus dsm` on them with six, three and two
views, without smoothing by planes, and writes src/zlocus/matching/precision_calibration.py, or FILE. Runs with fewer
than N cells of a kind (seen by a pair, or by more images) do not count. `judge` runs `zlocus dsm` on folders with
img_*.tif, truth_dsm.tif and truth_class.tif (default: the scenes of JUDGED, never used to calibrate) and prints, for
all cells, ground, roofs and trees, the share of true errors within one and two sigma (68 and 95 % of a normal
distribution); the share within one sigma in each quintile of sigma; and how many of the errors above 1 m are gone once
the tenth of the cells with the largest sigma is dropped. Draws calibration.png.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import rasterio
from scipy.optimize import minimize

from judging import rendered_scene, run_here
from workplace import CannotRun, ended
from zlocus.evaluation.alignment import best_shift
from zlocus.evaluation.frame import Points
from zlocus.evaluation.heights import read_heights
from zlocus.evaluation.truth import CLASS_NAMES, TruthBlocks, read_classes, truth_blocks
from zlocus.matching import finest_level, tile
from zlocus.matching.precision import is_split
from zlocus.pipeline import tile_run
from zlocus.synthetic.troubles import TROUBLES

CALIBRATION = Path(__file__).resolve().parents[1] / "src" / "zlocus" / "matching" / "precision_calibration.py"
SIZE, POINTING_PX = 520, 2.0
# (kind, seed): those that calibrate, and those that judge.
# Towns with a trouble teach how sigma grows with the distance from all agreement.
TRAINING = (
    ("city", 61), ("city", 62), ("city", 63), ("hills", 61), ("hills", 62), *(("real", seed) for seed in range(61, 67)),
    *((trouble, seed) for trouble in ("lake", "calm-lake", "snow", "square", "terrace") for seed in (61, 62)),
)  # fmt: skip
JUDGED = (("city", 16), ("city", 20), ("hills", 43), ("hills", 50), ("real", 71), ("real", 72))
# Realistic scenes have no b2; s1 is their sixth view.
VIEWS = {6: ("n1", "f1", "b1", "n2", "f2", "b2", "s1"), 3: ("n1", "f1", "b1"), 2: ("n1", "f1")}
MARGIN_M, LARGE_ERROR_M = 10.0, 1.0
KNOTS, SMOOTHNESS, LEAST_ERROR_STEPS = 9, 0.02, 1e-3
# Bounds of the logarithm of the error that displaced lines leave, as a share of their displacement.
LOG_OF_LINES = (-4.0, 1.5)
# What is asked of one and of two sigma, and what each weighs; of each run at least and at most so many cells, each
# class so much.
# Predictors that may only raise sigma (1) or lower it (-1).
DIRECTION = {
    "noise": 1, "group_distance": 1, "roughness": 1, "cell_roughness": 1, "spread": 1, "refinement": 1,
    "distance": 1, "curvature": -1, "ncc": -1, "uniqueness": -1, "texture": -1,
}  # fmt: skip
ASKED = ((0.68, 0.0, 1.0), (0.94, float(np.log(2.0)), 2.0))
FEWEST, CELLS, CLASS_WEIGHT = 5000, 30000, {"ground": 1.0, "building": 0.4, "tree": 0.05}


@dataclass(frozen=True)
class Sample:
    """Cells of a run with known errors: predictors, error_m, kind (index in CLASS_NAMES), (n,) each.

    step_m : height step of the run; line_shift_steps : see `MatchScene`.
    """

    predictors: dict[str, np.ndarray]
    is_refined: np.ndarray
    error_m: np.ndarray
    kind: np.ndarray
    step_m: float
    line_shift_steps: float = 0.0


@dataclass(frozen=True)
class Judged:
    """Errors and their predicted sigma, m, and kinds, all (n,)."""

    error_m: np.ndarray
    sigma_m: np.ndarray
    kind: np.ndarray


@contextmanager
def watched(found: list[tuple[Any, ...]]):
    """Add (window, core window, predictors, is_refined, match scene) of every tile that is matched to `found`."""
    predict, refine, match = finest_level.sigma_steps, tile.refined_surface, tile_run.match_tile
    last: dict[str, Any] = {}

    def predicted(predictors, refined, line_shift_steps):
        last.update(predictors=predictors, is_refined=refined.is_refined)
        return predict(predictors, refined, line_shift_steps)

    def refined(tile_inputs, result, *rest):
        last["window"] = result.level.window
        return refine(tile_inputs, result, *rest)

    def matched(match_scene, core_window, *rest):
        last.clear()
        result = match(match_scene, core_window, *rest)
        if "window" in last:
            found.append((last["window"], core_window, last["predictors"], last["is_refined"], match_scene))
        return result

    finest_level.sigma_steps, tile.refined_surface, tile_run.match_tile = predicted, refined, matched
    try:
        yield
    finally:
        finest_level.sigma_steps, tile.refined_surface, tile_run.match_tile = predict, refine, match


def run(folder: Path, views: tuple[str, ...], out: Path, is_smoothed: bool = True) -> list[tuple[Any, ...]]:
    """`zlocus dsm` of a scene over the ground with truth, and what was seen of its tiles.

    is_smoothed : whether heights are smoothed by planes.
    """
    options = out.with_name("options.toml")
    options.write_text("" if is_smoothed else "[refine]\nmax_plane_side = 0\n", encoding="utf-8")
    with rasterio.open(folder / "truth_dsm.tif") as file:
        bounds, crs, cell = file.bounds, file.crs.to_string(), 2 * file.res[0]
    found: list[tuple[Any, ...]] = []
    images = [str(path) for name in views if (path := folder / f"img_{name}.tif").exists()]
    with watched(found):
        run_here(["dsm", *images, "-o", str(out), "--crs", crs, "--resolution", str(cell), "--bounds",
                  *map(str, bounds), "--config", str(options), "--overwrite", "--workers", "1",
                  "--no-report"])  # fmt: skip
    return found


def errors_of(folder: Path, dsm: Path) -> tuple[TruthBlocks, np.ndarray, np.ndarray]:
    """Blocks of truth, where each is looked up in the surface (n, 2), and the errors there (n,) m, NaN where empty.

    A common shift of the ground, which no matcher can see, is removed where the RPCs have pointing errors (all but
    those of towns).
    """
    surface, heights = read_heights(dsm), read_heights(folder / "truth_dsm.tif")
    truth = truth_blocks(heights, MARGIN_M, read_classes(folder / "truth_class.tif", heights))
    xy = truth.xy
    if "city" in folder.name or "town" in folder.name:
        return truth, xy, truth.errors(surface.nearest(xy))
    xy = xy + np.array(best_shift(surface, truth, Points(xy)))
    errors = truth.errors(surface.bilinear(xy))
    return truth, xy, errors - np.nanmedian(errors)


def kinds(truth: TruthBlocks) -> np.ndarray:
    """Index of the class of every block in CLASS_NAMES."""
    return np.argmax([truth.members(name) for name in CLASS_NAMES], axis=0)


def sample(folder: Path, views: tuple[str, ...], out: Path) -> Sample:
    """The cells of a run without smoothing whose errors are known."""
    tiles = run(folder, views, out, is_smoothed=False)
    truth, xy, errors = errors_of(folder, out / "dsm.tif")
    kind = kinds(truth)
    parts = []
    for window, core, predictors, is_refined, scene in tiles:
        col = np.floor((xy[:, 0] - scene.anchor[0]) / scene.cell_size).astype(int)
        row = np.floor((scene.anchor[1] - xy[:, 1]) / scene.cell_size).astype(int)
        inside = np.isfinite(errors)
        for at, first, n in ((row, core.row, core.rows), (col, core.col, core.cols),
                             (row, window.row, window.rows), (col, window.col, window.cols)):  # fmt: skip
            inside &= (at >= first) & (at < first + n)
        cell = row[inside] - window.row, col[inside] - window.col
        parts.append(({k: v[cell] for k, v in predictors.items()}, is_refined[cell], errors[inside], kind[inside]))
    return Sample(
        {k: np.concatenate([part[0][k] for part in parts]) for k in parts[0][0]},
        *(np.concatenate([part[i] for part in parts]) for i in (1, 2, 3)),
        tiles[0][4].height_step, tiles[0][4].line_shift_steps,
    )  # fmt: skip


def hats(values: np.ndarray, first: float, spacing: float) -> np.ndarray:
    """Hat functions at equally spaced knots, constant beyond both ends, (n, KNOTS)."""
    x = np.clip((values - first) / spacing, 0, KNOTS - 1)
    return np.maximum(1 - np.abs(x[:, None] - np.arange(KNOTS)), 0)


def rising(names: list[str], n: int) -> tuple[np.ndarray, list[tuple[float | None, float | None]]]:
    """What turns a first knot and the steps from knot to knot into curves, (n, n), and bounds of those steps."""
    whole, bounds = np.eye(n), [(None, None)] * n
    for i, name in enumerate(names):
        at = slice(i * KNOTS, (i + 1) * KNOTS)
        whole[at, at] = np.tril(np.ones((KNOTS, KNOTS)))
        direction = DIRECTION.get(name, 0)
        bounds[at.start + 1 : at.stop] = [{1: (0, None), -1: (None, 0), 0: (None, None)}[direction]] * (KNOTS - 1)
    return whole, bounds


def fit(samples: list[Sample], fewest: int = FEWEST) -> dict[str, Any]:
    """Models of cells where groups of images can be told apart, and of single pairs.

    fewest : cells of a kind that a run must have to count.

    Raises
    ------
    CannotRun
        Where no run has as many cells of one of the two kinds.
    """
    split = [is_split(one.predictors) for one in samples]
    return {
        "SPLIT": fit_model(enough(samples, split, fewest, "more than a pair of images")),
        "PAIR": fit_model(enough(samples, [~rows for rows in split], fewest, "a single pair of images")),
    }


def enough(samples: list[Sample], rows: list[np.ndarray], fewest: int, kind: str) -> list[Sample]:
    """Some cells of each sample, of those samples that have enough of them.

    rows : (n,) bool for each sample; kind : what sees these cells, for the message.

    Raises
    ------
    CannotRun
        Where no sample has as many.
    """
    parts = [part(one, chosen) for one, chosen in zip(samples, rows, strict=True)]
    parts = [one for one in parts if len(one.error_m) >= fewest]
    if not parts:
        raise CannotRun(
            f"No run has {fewest} cells of known error seen by {kind}: give larger scenes and --views 6 2, or a lower "
            "--fewest."
        )
    return parts


def part(one: Sample, rows: np.ndarray) -> Sample:
    """Some cells of a sample."""
    predictors = {k: v[rows] for k, v in one.predictors.items()}
    return Sample(predictors, one.is_refined[rows], one.error_m[rows], one.kind[rows], one.step_m, one.line_shift_steps)


def fit_model(samples: list[Sample]) -> dict[str, Any]:
    """Curves of the additive model: least sum of the quantile losses of log |error| at one and two sigma."""
    rng = np.random.default_rng(0)
    chosen, weights = [], []
    for one in samples:
        few = rng.choice(len(one.error_m), min(CELLS, len(one.error_m)), replace=False)
        chosen.append(few)
        share = np.bincount(one.kind[few], minlength=3) / len(few)
        factor = np.array(list(CLASS_WEIGHT.values())) / np.maximum(share, 0.01)
        weights.append(factor[one.kind[few]])
    rows = list(zip(samples, chosen, strict=True))
    pooled = {k: np.concatenate([s.predictors[k][r] for s, r in rows]) for k in samples[0].predictors}
    refined = np.concatenate([s.is_refined[r] for s, r in rows])
    target = np.concatenate([np.log(np.abs(s.error_m[r]) / s.step_m + LEAST_ERROR_STEPS) for s, r in rows])
    displaced = np.concatenate([np.full(len(r), s.line_shift_steps) for s, r in rows])
    weight = np.concatenate(weights)
    weight /= weight.mean()
    grid = {k: np.quantile(v, [0.005, 0.995]) for k, v in pooled.items()}
    grid = {k: (float(a), float(max(b - a, 1e-3) / (KNOTS - 1))) for k, (a, b) in grid.items()}
    columns = [hats(v, *grid[k]) for k, v in pooled.items()]
    flags = [np.ones(len(target)), ~refined]
    design = np.column_stack([*columns, *flags]).astype(np.float32)
    bend = np.zeros((len(grid) * (KNOTS - 2), design.shape[1]))
    for i in range(len(grid)):
        for k in range(KNOTS - 2):
            bend[i * (KNOTS - 2) + k, i * KNOTS + k : i * KNOTS + k + 3] = [1, -2, 1]

    whole, bounds = rising(list(grid), design.shape[1])

    def loss(unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        b, of_lines = whole @ unknowns[:-1], np.exp(unknowns[-1])
        of_cells = np.exp(2 * (design @ b.astype(np.float32)))
        of_both = of_cells + (of_lines * displaced) ** 2
        predicted, share_of_cells = 0.5 * np.log(of_both), of_cells / of_both
        value, slope = 0.0, np.zeros(len(target))
        for asked, above, share in ASKED:
            r = target - predicted - above
            soft = 0.05
            value += share * float(np.mean(weight * (asked * r + soft * np.logaddexp(0, -r / soft))))
            slope += share * (asked - 1 / (1 + np.exp(np.clip(r / soft, -50, 50))))
        bent, slope = bend @ b, weight * slope
        gradient = -(design.T @ (slope * share_of_cells).astype(np.float32)) / len(target)
        gradient = gradient + 2 * SMOOTHNESS * bend.T @ bent + 2e-5 * b
        by_lines = -float(np.mean(slope * (1 - share_of_cells)))
        return value + SMOOTHNESS * bent @ bent + 1e-5 * b @ b, np.append(whole.T @ gradient, by_lines)

    start, bounds = np.append(np.zeros(design.shape[1]), -1.0), [*bounds, LOG_OF_LINES]
    unknowns = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 800}).x
    b = whole @ unknowns[:-1]
    curves = {k: (*grid[k], b[i * KNOTS : (i + 1) * KNOTS]) for i, k in enumerate(grid)}
    return {"curves": curves, "constant": b[-2], "not_refined": b[-1], "of_lines": float(np.exp(unknowns[-1]))}


def write(model: dict[str, Any], path: Path) -> None:
    """Write the calibration as a module."""
    lines = [
        '"""Curves of the precision model, made by benchmarks/precision.py; not to be edited."""', "",
        "from __future__ import annotations", "",
        "# fmt: off",
        "# The logarithm of sigma: a constant; what is added where a height was not refined; the error that displaced",
        "# lines leave, as a share of their displacement, whose square is added; and for each predictor the position",
        "# of the first knot, the spacing of the knots, and the logarithm of the factor at each knot.",
        "Model = tuple[float, float, float, dict[str, tuple[float, float, tuple[float, ...]]]]",
    ]  # fmt: skip
    for kind, one in model.items():
        lines.append(f"{kind}: Model = ({one['constant']:.4f}, {one['not_refined']:.4f}, {one['of_lines']:.4f}, {{")
        for name, (first, spacing, curve) in one["curves"].items():
            if not np.isfinite([first, spacing, *curve]).all():
                raise ValueError(f"The curve of {name} is not finite: look at its values before anything is written.")
            lines.append(f'    "{name}": ({first:.5g}, {spacing:.5g}, ({", ".join(f"{v:.4f}" for v in curve)})),')
        lines.append("})")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def predicted_sigma(model: dict[str, Any], one: Sample) -> np.ndarray:
    """Sigma of a sample by a model, m (n,)."""
    split, total, left = is_split(one.predictors), np.zeros(len(one.error_m)), np.zeros(len(one.error_m))
    for kind, rows in (("SPLIT", split), ("PAIR", ~split)):
        total[rows] = model[kind]["constant"] + np.where(one.is_refined[rows], 0, model[kind]["not_refined"])
        for name, (first, spacing, curve) in model[kind]["curves"].items():
            total[rows] += hats(one.predictors[name][rows], first, spacing) @ curve
        left[rows] = model[kind]["of_lines"] * one.line_shift_steps
    return np.hypot(np.exp(total), left) * one.step_m


def share_within(judged: Judged, times: float, classes: Sequence[str]) -> float:
    """Share of the errors of some classes within so many standard deviations."""
    rows = np.isin(judged.kind, [list(CLASS_NAMES).index(name) for name in classes])
    return float((np.abs(judged.error_m) < times * judged.sigma_m)[rows].mean())


def share_in_worst_tenth(judged: Judged) -> float:
    """Share of the errors above LARGE_ERROR_M that lies in the tenth of the cells with the largest sigma."""
    worst = np.argsort(-judged.sigma_m, kind="stable")[: len(judged.sigma_m) // 10]
    is_large = np.abs(judged.error_m) > LARGE_ERROR_M
    return float(is_large[worst].sum() / max(is_large.sum(), 1))


def judgement(judged: Judged) -> str:
    """The figures of a run on one line."""
    size, sigma = np.abs(judged.error_m), judged.sigma_m
    of_class = {name: (judged.kind == i).sum() for i, name in enumerate(CLASS_NAMES)}
    groups = {"all": list(CLASS_NAMES), **{name: [name] for name, n in of_class.items() if n > 100}}
    parts = [
        f"{name} {share_within(judged, 1, classes):.3f}/{share_within(judged, 2, classes):.3f}"
        for name, classes in groups.items()
    ]
    quintile = np.digitize(sigma, np.quantile(sigma, [0.2, 0.4, 0.6, 0.8]))
    parts.append("quintiles " + " ".join(f"{(size < sigma)[quintile == q].mean():.2f}" for q in range(5)))
    is_large = (size > LARGE_ERROR_M).mean()
    parts.append(f"worst tenth holds {share_in_worst_tenth(judged):.2f} of {is_large:.4f} > 1 m")
    parts.append(f"median {np.median(sigma):.3f} m")
    return "; ".join(parts)


def judge(folder: Path, views: tuple[str, ...], out: Path) -> Judged:
    """Errors and sigma of a run, from its products."""
    run(folder, views, out)
    truth, xy, errors = errors_of(folder, out / "dsm.tif")
    sigma = read_heights(out / "sigma.tif").nearest(xy)
    known = np.isfinite(errors) & np.isfinite(sigma)
    return Judged(errors[known], sigma[known], kinds(truth)[known])


def draw(judged: dict[str, Judged], path: Path) -> None:
    """Share of errors within one and two sigma against sigma, of all runs."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    for name, one in judged.items():
        edges = np.quantile(one.sigma_m, np.linspace(0, 1, 21))
        place = np.clip(np.digitize(one.sigma_m, edges[1:-1]), 0, 19)
        middle = [np.median(one.sigma_m[place == k]) for k in range(20)]
        for axis, times in zip(axes, (1, 2), strict=True):
            share = [(np.abs(one.error_m) < times * one.sigma_m)[place == k].mean() for k in range(20)]
            axis.semilogx(middle, share, marker=".", label=name)
    for axis, times, asked in zip(axes, (1, 2), (0.683, 0.954), strict=True):
        axis.axhline(asked, color="0.4", lw=0.8, ls="--")
        axis.set(xlabel="sigma, m", ylabel=f"errors within {times} sigma", ylim=(0.4, 1.0))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=110)


def rendered(kind: str, seed: int, out: Path) -> Path:
    """A scene, rendered unless it is there. kind : city, hills, real, or the name of a trouble."""
    folder = out / (f"town-{kind}-{seed}" if kind in TROUBLES else f"{kind}-{seed}")
    if not folder.exists():
        pointing = ["--pointing", str(POINTING_PX)] if kind == "hills" else []
        size = [] if kind == "real" or kind in TROUBLES else ["--size", str(SIZE), "--views", "6"]
        subject = ["--trouble" if kind in TROUBLES else "--kind", kind]
        command = [*subject, "--seed", str(seed), *size, *pointing]
        subprocess.run([sys.executable, "-m", "zlocus.synthetic", "-o", str(folder), *command], check=True)
    return folder


def with_views(folders: Sequence[Path], views: Sequence[int]) -> list[tuple[Path, int]]:
    """Each folder with each number of views, where it has as many images."""
    n_images = {folder: len(list(folder.glob("img_*.tif"))) for folder in folders}
    return [(folder, n) for folder in folders for n in views if n <= n_images[folder]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("fit", "judge"))
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--views", nargs="+", type=int, choices=tuple(VIEWS), default=tuple(VIEWS))
    parser.add_argument("--calibration", type=Path, default=CALIBRATION, metavar="FILE", help="module that fit writes")
    parser.add_argument("--fewest", type=int, default=FEWEST, metavar="N", help="cells of a kind that a run must have")
    parser.add_argument("-o", "--out", type=Path, default=Path("precision"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    scenes = JUDGED if args.action == "judge" else TRAINING
    folders = [*map(rendered_scene, args.folders)] or [rendered(kind, seed, args.out) for kind, seed in scenes]
    if args.action == "fit":
        samples = {(f.name, n): sample(f, VIEWS[n], args.out / "run") for f, n in with_views(folders, args.views)}
        model = fit(list(samples.values()), args.fewest)
        write(model, args.calibration)
        for (name, n), one in samples.items():
            print(f"{name}, {n} views:", judgement(Judged(one.error_m, predicted_sigma(model, one), one.kind)))
        return
    judged = {}
    for folder, n in with_views(folders, args.views):
        judged[f"{folder.name}, {n} views"] = judge(folder, VIEWS[n], args.out / "run")
        print(f"{folder.name}, {n} views:", judgement(judged[f"{folder.name}, {n} views"]), flush=True)
    draw(judged, args.out / "calibration.png")


if __name__ == "__main__":
    ended(main)
