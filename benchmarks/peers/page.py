"""The page of results and its pictures, made from results.json; nothing on it is written by hand."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import PIL.Image
import yaml

mpl.use("Agg")
import matplotlib.pyplot as plt

from peers.environments import CONFIGURATIONS
from peers.verdicts import (
    HEADINGS,
    OWN,
    figure,
    judged,
    of_scene,
    succeeded,
    verdict_lines,
    with_means_of_seeds,
)

CARS, MICMAC = "CARS", "MicMac"
# Acceptance bars: these programs need at least this many times the CPU of zlocus per million cells.
LESS_CPU = {CARS: 50.0, MICMAC: 10.0}
COLOURS = {
    OWN: "#b3261e",
    CARS: "#1f5f8b",
    "OpenCV SGBM": "#6b8e23",
    "Pandora": "#c77d0a",
    "s2p": "#6a4c93",
    MICMAC: "#555555",
    "SETSM": "#00a6a6",
}
NAMES = {"opencv": "OpenCV", "libsgm": "libSGM", "pandora": "Pandora"}
MARKS = "osD^v<>ph*XP"
# Share of wrong or empty cells at which a surface without any is drawn.
LEAST_WRONG_PERCENT = 0.01
PLAIN = "{x:g}"
PICTURES = ("peers_accuracy.png", "peers_cost.png")
HEAD = """# Comparison with other programs

<!-- Written by `python benchmarks/peers --page docs/reference` from benchmarks/peers/results.json: do not edit. -->

    make peers                                                     # all of it, a night: build/peers/peers.md
    python benchmarks/peers --scenes town --programs zlocus CARS   # one scene, two programs
    python benchmarks/peers --micmac /opt/micmac/bin/mm3d          # a program that no registry has
    python benchmarks/peers --page docs/reference                  # this page, from benchmarks/peers/results.json

All programs get the same images, area, grid and cores.

- Programs are installed from the package registry into environments of their own. Their configurations follow their
  documentation; they are in `benchmarks/peers/configurations`, with the reasons.
- Programs that match pairs get every pair whose rays meet at no more than 30 degrees, and merge the pairs themselves.
- CARS also gets a terrain model with cells of 30 m. It is made from the truth (a low height of each cell); for the
  Pleiades triplet it is made from the surface of s2p, for the Pleiades pair it is SRTM. Around its tie points CARS
  searches the whole height range.
- OpenCV and Pandora match rectified rows and have no cameras. For them the images are resampled onto a plane, the
  height range is that of the truth, a cell takes the median of all pairs, and a gap takes the nearest height. Where
  cameras have pointing errors (Pleiades, WorldView, realistic scenes) they get the corrections of zlocus. Code of this
  comparison does that; its CPU and memory count as theirs.
- s2p matches the first image with each other one, corrects their pointing itself and finds its ranges by tie points. Of
  nineteen images it matches the same pairs as other programs of pairs, and a cell takes the median. SETSM gets the
  area and the height range, corrects the pointing of each pair itself, and a cell takes the median of the pairs.
- Realistic scenes are rendered images that lie as real ones do. `rendered-real-a` and `-b` were made by other code than
  the scenes of fresh seeds. They are judged after the common height of the ground was removed.
- JAX_068 are nineteen WorldView-3 images of ten months with a laser surface, judged after the best shift was removed,
  by the protocol of the papers on it. Programs of pairs get pairs of consecutive dates.
- zlocus gets the images, the area and the grid, and writes no report. Its options were chosen on other scenes of the
  same renderer.

CPU, wall time and memory are those of all processes of a program (shared pages count once), after a run on another
scene that fills caches. zlocus runs three times, and the median counts. Shares are shares of the cells with a truth,
without a rim of 10 m; an empty cell is not within 1 m, and at an edge of the truth both sides are right. NMAD, RMSE
and LE90 count cells with a height. The best figure of a column is bold.

A program that leaves doubtful cells empty is judged on fewer cells by NMAD, RMSE and LE90: its share of complete cells
stands beside them.

Aerial frames are rendered blocks with a lens distortion and exact cameras, for zlocus, OpenCV and Pandora. The parallax
of frames is not linear in height, which is accounted for where OpenCV and Pandora match. Real frames at hand have no
truth that is better than the surface of another program.
"""
# Share of the cores used by other processes from which on the page mentions it.
BESIDE = 0.05


def write_page(results: Path, folder: Path) -> Path:
    """Write peers.md and its pictures; return the path of the page. results : results.json of a comparison."""
    found = json.loads(results.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    for draw, name in ((draw_accuracy, PICTURES[0]), (draw_cost, PICTURES[1])):
        draw_if_changed(draw, found, folder / name)
    page = folder / "peers.md"
    page.write_text(page_of(found), encoding="utf-8")
    return page


def draw_if_changed(draw: Callable[[dict[str, Any], Path], None], found: dict[str, Any], path: Path) -> None:
    """Draw a picture, unless it is there and was drawn from the same results: other versions draw otherwise."""
    if path.exists():
        with PIL.Image.open(path) as picture:
            if picture.info.get("Description") == picture_metadata(found)["Description"]:
                return
    draw(found, path)


def picture_metadata(found: dict[str, Any]) -> dict[str, str | None]:
    """What a picture says of itself: the digest of the results that it shows, and no version of the software."""
    digest = hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()
    return {"Software": None, "Description": f"results.json {digest[:16]}"}


def page_of(found: dict[str, Any]) -> str:
    """Text of the page."""
    found = with_means_of_seeds(found)
    parts = [HEAD, "\n".join(builds()), "\n".join(where(found)), *verdicts(found), "\n".join(pictures())]
    parts += scene_tables(found)
    parts += [*difference_tables(found), *kernel_table(found), *middlebury_table(found), "\n".join(versions(found))]
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


def builds() -> Iterator[str]:
    """Lines on the programs that no registry has: which build was tried, or what failed."""
    yield (
        "Programs that no registry has are measured where a build is given (`--s2p`, `--micmac`, `--setsm`). "
        "What was tried:"
    )
    yield ""
    said = yaml.safe_load((CONFIGURATIONS / "builds.yaml").read_text(encoding="utf-8"))
    yield from (f"- {program}: {' '.join(sentence.split())}" for program, sentence in said.items())


def where(found: dict[str, Any]) -> Iterator[str]:
    """Lines on the machine, the dates, the commits, the judges and the load of the machine."""
    it, rows = found["machine"], [row for part in PARTS for row in found[part]]
    cores = f"{len(it['cores'])} of {it['of_cores']} cores"
    computer = f"{cores} of {it['processor']}, {it['memory_gb']} GB, {it['system']}"
    dates, commits = (sorted({row[what] for row in rows}) for what in ("when", "commit"))
    span = " to ".join(dict.fromkeys(date[:10] for date in (dates[:1] + dates[-1:])))
    judges = sorted({row["judge"] for row in rows if "judge" in row})
    # Rows of an earlier day may come from another machine; only the last one is recorded.
    where_from = "last on" if " to " in span else "on"
    yield f"Measured {span} {where_from} {computer}; commit {', '.join(commits)}; judged by {', '.join(judges)}."
    busy = [row for row in rows if row.get("beside", 0.0) > BESIDE]
    if busy:
        scenes = ", ".join(dict.fromkeys(row["scene"] for row in busy))
        yield (
            f"Other processes used up to {max(row['beside'] for row in busy):.0%} of the cores while these "
            f"scenes were measured: {scenes}. Their wall times are too long, and their CPU slightly."
        )


PARTS = ("surfaces", "differences", "kernels", "middlebury")


def per_million(found: dict[str, Any], row: dict[str, Any], what: str = "cpu_s") -> float:
    return float(row[what] / found["scenes"][row["scene"]]["million_cells"])


def verdicts(found: dict[str, Any]) -> Iterator[str]:
    """Who wins on each scene, where and why, the heaviest loss of zlocus first; and what the others' CPU costs."""
    names = judged(found)
    if not names:
        return
    yield "## Who wins, where and why"
    yield (
        "Losses first, in the order of their weight. Each cell names the program that is first and the next one, or, "
        "in bold, the program that is ahead of zlocus."
    )
    lines = [f"| scene | {' | '.join(HEADINGS.values())} | where zlocus loses, and why |", "|" + 5 * "---|"]
    yield "\n".join([*lines, *(f"| {' | '.join(cells)} |" for cells in verdict_lines(found))])
    yield "## CPU of the others over that of zlocus"
    lines = ["| scene | CPU over zlocus' |", "|---|---|"]
    yield "\n".join([*lines, *(f"| {name} | {ratios(succeeded(of_scene(found, name)))} |" for name in names)])
    bars = ", ".join(f"{bar:g} for {program}" for program, bar in LESS_CPU.items())
    yield f"Bars: {bars}, 1 for the others; a ratio below its bar is bold."


def ratios(rows: dict[str, dict[str, Any]]) -> str:
    """CPU of each other program over that of zlocus, as text."""
    if OWN not in rows:
        return ""
    found = []
    for program, row in rows.items():
        if program != OWN:
            ratio = row["cpu_s"] / rows[OWN]["cpu_s"]
            text = f"{program} {ratio:.1f}"
            found.append(f"**{text}**" if ratio < LESS_CPU.get(program, 1.0) else text)
    return ", ".join(found)


def pictures() -> Iterator[str]:
    yield f"![Share within 1 m and NMAD of each program on each scene]({PICTURES[0]})"
    yield ""
    yield f"![CPU for a million cells, and shares of all cells more than 1 m off, by program and scene]({PICTURES[1]})"


# Columns of the table of a scene: format, class (None: a figure of the row itself; times are per million cells),
# figure, and whether a low (1) or a high (-1) value is good.
Column = tuple[str, str | None, str, int]
COSTS: dict[str, Column] = {
    "CPU, s / M cells": ("{:.1f}", None, "cpu_s", 1), "wall, s / M cells": ("{:.1f}", None, "wall_s", 1),
    "peak, GB": ("{:.2f}", None, "peak_gb", 1), "complete": ("{:.3f}", "all", "completeness", -1),
}  # fmt: skip


def shares(*classes: str) -> dict[str, Column]:
    """Columns of the shares within 1 m of classes of cells."""
    return {f"within 1 m: {name}" if name == "all" else name: ("{:.3f}", name, "within", -1) for name in classes}


COLUMNS: dict[str, Column] = {
    **COSTS, **shares("all"), "aligned: all": ("{:.3f}", "all", "within_aligned", -1),
    **shares("ground", "building", "tree"),
    "NMAD, m": ("{:.3f}", "all", "nmad", 1), "NMAD ground, m": ("{:.3f}", "ground", "nmad", 1),
    "RMSE, m": ("{:.2f}", "all", "rmse", 1), "LE90, m": ("{:.2f}", "all", "le90", 1),
}  # fmt: skip
ABSOLUTE: dict[str, Column] = {"as it lies: all": ("{:.3f}", "all", "within_absolute", -1)}
WRONG: dict[str, Column] = {
    "off by > 3 m": ("{:.3f}", "all", "off3", 1), "> 10 m": ("{:.3f}", "all", "off10", 1),
    "RMSE, m": ("{:.2f}", "all", "rmse", 1), "NMAD, m": ("{:.3f}", "all", "nmad", 1),
}  # fmt: skip
# Realistic scenes are judged after the common height of the ground was removed, JAX_068 after the best shift was; the
# share within 1 m as the surface lies stands beside.
COLUMNS_OF = {
    "real": {**COSTS, **shares("all"), **ABSOLUTE, **shares("ground", "road", "building", "tree", "field"), **WRONG},
    "registered": {
        **COSTS, **shares("all"), **ABSOLUTE, **shares("ground", "building", "tree"),
        "MAE, m": ("{:.2f}", "all", "mae", 1), "median, m": ("{:.2f}", "all", "median", 1),
        "RMSE, m": ("{:.2f}", "all", "rmse", 1), "off by > 3 m": ("{:.3f}", "all", "off3", 1),
    },
}  # fmt: skip


def scene_tables(found: dict[str, Any]) -> Iterator[str]:
    """A heading and a table for each scene with a truth."""
    for name in judged(found):
        about = found["scenes"][name]
        pairs = f"{about['pairs']} pair" + ("s" if about["pairs"] > 1 else "")
        yield f"## {name[0].upper()}{name[1:]}: {about['million_cells']:.2f} M cells, {pairs}"
        rows = of_scene(found, name)
        columns = COLUMNS_OF.get(about["kind"], COLUMNS)
        lines = [f"| program | {' | '.join(columns)} |", "|" + (len(columns) + 1) * "---|"]
        texts: dict[str, list[str]] = {program: [] for program in rows}
        for column in columns.values():
            for program, text in column_of(found, succeeded(rows), *column).items():
                texts[program].append(text)
        for program, row in rows.items():
            cells = [failure(row), *[""] * (len(columns) - 1)] if "failed" in row else texts[program]
            lines.append(f"| {' | '.join([program, *cells])} |")
        yield "\n".join(lines)


def failure(row: dict[str, Any]) -> str:
    """Reason why there are no figures, for a cell of a table."""
    return f"failed: {row['failed']}".replace("|", "/").replace("\n", " ")


def column_of(
    found: dict[str, Any], rows: dict[str, dict[str, Any]], form: str, kind: str | None, what: str, sign: int
) -> dict[str, str]:
    """Texts of a column by program; the best one is bold."""
    if kind is not None:
        values = {program: figure(row, kind, what) for program, row in rows.items()}
    elif what == "peak_gb":
        values = {program: row[what] for program, row in rows.items()}
    else:
        values = {program: per_million(found, row, what) for program, row in rows.items()}
    texts = {program: "" if value is None else form.format(value) for program, value in values.items()}
    known = [sign * value for value in values.values() if value is not None]
    best = form.format(sign * min(known)) if known else ""
    return {
        program: f"**{text}**" if text and text == best and len(known) > 1 else text for program, text in texts.items()
    }


def difference_tables(found: dict[str, Any]) -> Iterator[str]:
    """Differences between the surfaces of each scene without a truth."""
    for name in (name for name, scene in found["scenes"].items() if not scene["truth"]):
        rows = [row for row in found["differences"] if row["scene"] == name]
        if not rows:
            continue
        about = found["scenes"][name]
        yield f"## {name}: {about['million_cells']:.2f} M cells, no truth"
        yield "Differences of each two surfaces (second less first); none of them is the truth."
        lines = [
            "| first | second | median, m | NMAD, m | within 1 m | second's cells where the first has heights |",
            "|---|---|---|---|---|---|",
        ]
        for row in rows:
            if "failed" in row:
                lines.append(f"| {row['first']} | {row['second']} | {failure(row)} | | | |")
                continue
            figures = (f"{row['median']:+.3f}", *(f"{row[what]:.3f}" for what in ("nmad", "within", "completeness")))
            lines.append(f"| {' | '.join([row['first'], row['second'], *figures])} |")
        yield "\n".join(lines)
        yield "\n".join(work_lines(found, of_scene(found, name).values()))


def work_lines(found: dict[str, Any], rows: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Cost of the programs on a scene without a truth."""
    yield "| program | CPU, s / M cells | wall, s / M cells | peak, GB |"
    yield "|---|---|---|---|"
    for row in rows:
        if "failed" in row:
            yield f"| {row['program']} | {failure(row)} | | |"
        else:
            cpu, wall = (per_million(found, row, what) for what in ("cpu_s", "wall_s"))
            yield f"| {row['program']} | {cpu:.1f} | {wall:.1f} | {row['peak_gb']:.2f} |"


def kernel_table(found: dict[str, Any]) -> Iterator[str]:
    """Table of the semi-global aggregation."""
    if not found["kernels"]:
        return
    heights = sorted({row["heights"] for row in found["kernels"]})
    yield "## Semi-global aggregation only"
    yield (
        "Million cell-steps (cells x heights, all eight paths) per second on one core, best of all turns. The time "
        "of OpenCV includes its costs and minima, which cannot be timed separately."
    )
    lines = [f"| program | form | {' | '.join(f'{n} heights' for n in heights)} |", "|---|---|" + "---|" * len(heights)]
    speeds: dict[tuple[str, str], dict[int, float]] = {}
    for row in found["kernels"]:
        speeds.setdefault((row["program"], row["form"]), {})[row["heights"]] = row["million_cell_steps_per_s"]
    for (program, form), by_height in sorted(speeds.items(), key=lambda item: -max(item[1].values())):
        cells = [NAMES.get(program, program), form, *(f"{by_height[n]:.0f}" if n in by_height else "" for n in heights)]
        lines.append(f"| {' | '.join(cells)} |")
    yield "\n".join(lines)


def middlebury_table(found: dict[str, Any]) -> Iterator[str]:
    """Table of the rectified photographs."""
    if not found["middlebury"]:
        return
    programs = list(dict.fromkeys(row["program"] for row in found["middlebury"]))
    bad: dict[str, dict[str, float]] = {}
    for row in found["middlebury"]:
        bad.setdefault(row["case"], {})[row["program"]] = row["bad_percent"]
    yield "## Rectified photographs (Middlebury)"
    yield "Share of the pixels seen by both images whose disparity is wrong by more than 1 px, or missing."
    lines = [f"| photographs | {' | '.join(programs)} |", "|---|" + "---|" * len(programs)]
    lines += [
        f"| {case} | {' | '.join(f'{of[program]:.2f} %' if program in of else '' for program in programs)} |"
        for case, of in bad.items()
    ]
    yield "\n".join(lines)


def versions(found: dict[str, Any]) -> Iterator[str]:
    """List of the versions."""
    yield "## Versions"
    yield ""
    for program, parts in found["programs"].items():
        named = (f"{name} {version}" for name, version in parts.items() if name != "configuration")
        yield f"- {program}: {', '.join(named)}"
    yield f"- kernels and photographs of zlocus, and the comparison: Python {found['machine']['python']}"


def draw_accuracy(found: dict[str, Any], path: Path) -> None:
    """Plot the share within 1 m and the NMAD, one column of points for each scene."""
    metadata, found = picture_metadata(found), with_means_of_seeds(found)
    names = judged(found)
    picture, axes = plt.subplots(2, 1, figsize=(10, 7), sharex=True, layout="constrained")
    for axis, (what, label) in zip(axes, (("within", "share within 1 m"), ("nmad", "NMAD, m")), strict=True):
        for k, program in enumerate(found["programs"]):
            at = [(i, succeeded(of_scene(found, scene)).get(program)) for i, scene in enumerate(names)]
            points = [(i, figure(row, "all", what)) for i, row in at if row is not None]
            x = [i + 0.08 * (k - (len(found["programs"]) - 1) / 2) for i, _ in points]
            axis.plot(
                x, [value for _, value in points], MARKS[k % len(MARKS)], label=program, color=COLOURS.get(program)
            )
        axis.set_ylabel(label)
        axis.grid(axis="y", alpha=0.3)
    axes[1].set_xticks(range(len(names)), names, rotation=35, ha="right")
    axes[0].legend(ncols=max(len(found["programs"]), 1), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    picture.savefig(path, dpi=110, metadata=metadata)
    plt.close(picture)


def draw_cost(found: dict[str, Any], path: Path) -> None:
    """Plot CPU against the share of wrong or empty cells; low values of both are good.

    A surface without such cells is drawn at LEAST_WRONG_PERCENT, because the axis is logarithmic.
    """
    metadata, found = picture_metadata(found), with_means_of_seeds(found)
    picture, axis = plt.subplots(figsize=(10, 5.5), layout="constrained")
    marks = dict(zip(judged(found), MARKS, strict=False))
    for program in found["programs"]:
        for scene, mark in marks.items():
            row = succeeded(of_scene(found, scene)).get(program)
            if row is not None:
                wrong = 100.0 * (1.0 - (figure(row, "all", "within") or 0.0))
                at = per_million(found, row), max(wrong, LEAST_WRONG_PERCENT)
                axis.plot(*at, mark, color=COLOURS.get(program), markersize=9, alpha=0.85)
    axis.set(
        xscale="log", yscale="log", xlabel="CPU, s for a million cells", ylabel="cells more than 1 m off or empty, %"
    )
    for each in (axis.xaxis, axis.yaxis):
        each.set_major_formatter(PLAIN)
    axis.yaxis.set_minor_formatter(PLAIN)
    axis.grid(which="both", alpha=0.25)
    keys = [plt.Line2D([], [], marker="s", ls="", color=COLOURS.get(name), label=name) for name in found["programs"]]
    keys += [plt.Line2D([], [], marker=mark, ls="", color="grey", label=scene) for scene, mark in marks.items()]
    axis.legend(handles=keys, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    picture.savefig(path, dpi=110, metadata=metadata)
    plt.close(picture)
