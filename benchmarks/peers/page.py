"""The page of results and its pictures, from the file that a run leaves: nothing on it is written by hand."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

OWN, CARS, MICMAC = "zlocus", "CARS", "MicMac"
# Of the acceptance: so many times less CPU per million cells than these programs.
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
PLAIN = "{x:g}"
PICTURES = ("peers_accuracy.png", "peers_cost.png")
HEAD = """# Beside other programs

<!-- Made by `python benchmarks/peers --page docs/reference` from benchmarks/peers/results.json: change those, not this page. -->

    make peers                                                     # all of it, some hours: build/peers/peers.md
    python benchmarks/peers --scenes town --programs zlocus CARS   # one scene, two programs
    python benchmarks/peers --micmac /opt/micmac/bin/mm3d          # a program that no registry has
    python benchmarks/peers --page docs/reference                  # this page, from benchmarks/peers/results.json

The same images, area, grid and cores for all. Programs are installed from the package registry into environments
of their own; their configurations stand in `benchmarks/peers/configurations`, as their documents recommend them,
each with its reason. Programs for pairs get every pair whose rays meet at no more than 30 degrees, and merge them
by their own means. CARS gets a terrain model with cells of 30 m besides (made of the truth, low in each cell; of the
Pleiades triplet made of s2p's surface, of the pair SRTM). Around its tie points it searches as far as the heights
reach apart. OpenCV and Pandora are matchers of rectified rows without cameras: for them images are resampled onto a
plane, the range of heights is that of the truth, a cell gets the median of all pairs and gaps the nearest height;
of Pleiades they get the pointing corrections that zlocus found. That is done by code of this comparison, and counts
in their CPU and memory. zlocus gets images, area and grid; its page about a run is not asked for. Options of zlocus
were chosen on other scenes of the same renderer.

CPU and wall times are those of all processes a program starts, memory that of all of them together (shared pages
once), after a run on another scene that fills caches; zlocus is run three times and the median counts. Shares are
of the cells with a truth less a rim of 10 m, and an empty one is not within 1 m; where the truth has an edge, either
side is right. NMAD, RMSE and LE90 are of the cells with a height. The best figure of a column is bold.
"""
# Other work on the cores from which on it is told, as a share of them.
BESIDE = 0.05


def write_page(results: Path, folder: Path) -> Path:
    """Writes peers.md and its pictures. results : what a run left."""
    found = json.loads(results.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    draw_accuracy(found, folder / PICTURES[0])
    draw_cost(found, folder / PICTURES[1])
    page = folder / "peers.md"
    page.write_text(page_of(found), encoding="utf-8")
    return page


def page_of(found: dict[str, Any]) -> str:
    """The text."""
    parts = [HEAD, "\n".join(where(found)), *verdicts(found), "\n".join(pictures()), *scene_tables(found)]
    parts += [*difference_tables(found), *kernel_table(found), *middlebury_table(found), "\n".join(versions(found))]
    return "\n\n".join(part.strip("\n") for part in parts if part) + "\n"


def where(found: dict[str, Any]) -> Iterator[str]:
    """Machine, dates, states of the code, judges, and what else the machine did."""
    it, rows = found["machine"], [row for part in PARTS for row in found[part]]
    cores = f"{len(it['cores'])} of {it['of_cores']} cores"
    computer = f"{cores} of {it['processor']}, {it['memory_gb']} GB, {it['system']}"
    dates, commits = (sorted({row[what] for row in rows}) for what in ("when", "commit"))
    span = " to ".join(dict.fromkeys(date[:10] for date in (dates[:1] + dates[-1:])))
    judges = sorted({row["judge"] for row in rows if "judge" in row})
    yield f"Measured {span} on {computer}; commit {', '.join(commits)}; judged by {', '.join(judges)}."
    busy = [row for row in rows if row.get("beside", 0.0) > BESIDE]
    if busy:
        listed = ", ".join(f"{row['program']} on {row['scene']} ({row['beside']:.0%} of the cores)" for row in busy)
        yield f"The machine did other work beside {listed}: wall times there are too long, CPU a little."


PARTS = ("surfaces", "differences", "kernels", "middlebury")


def of_scene(found: dict[str, Any], scene: str) -> dict[str, dict[str, Any]]:
    """What was measured on a scene, by program; programs in the order in which they first came."""
    order = list(found["programs"])
    rows = [row for row in found["surfaces"] if row["scene"] == scene]
    return {row["program"]: row for row in sorted(rows, key=lambda row: order.index(row["program"]))}


def judged(found: dict[str, Any]) -> list[str]:
    """Scenes with a truth that were measured."""
    return [name for name, scene in found["scenes"].items() if scene["truth"] and of_scene(found, name)]


def per_million(found: dict[str, Any], row: dict[str, Any], what: str = "cpu_s") -> float:
    return float(row[what] / found["scenes"][row["scene"]]["million_cells"])


def succeeded(rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {name: row for name, row in rows.items() if "failed" not in row}


def figure(row: dict[str, Any], kind: str, what: str) -> float | None:
    """Of a class of cells; nothing where the scene has none of it, of which judges give no count, or zero."""
    figures = row["classes"].get(kind, {})
    return figures.get(what) if figures.get("n") else None


def verdicts(found: dict[str, Any]) -> Iterator[str]:
    """Who is first on each scene, and how much less CPU zlocus takes."""
    names = judged(found)
    if not names:
        return
    yield "## Who is first"
    lines = ["| scene | lowest NMAD, m | next | largest share within 1 m | next | CPU over zlocus' |", "|" + 6 * "---|"]
    for name in names:
        rows = succeeded(of_scene(found, name))
        cells = [name, *ranked(rows, "nmad", 1.0), *ranked(rows, "within", -1.0), ratios(rows)]
        lines.append(f"| {' | '.join(cells)} |")
    yield "\n".join(lines)
    bars = ", ".join(f"{bar:g} for {program}" for program, bar in LESS_CPU.items())
    yield (
        f"Bold: zlocus is not alone in the first place. Bars of CPU over zlocus': {bars}, 1 for others; what falls "
        "short of them is bold."
    )


def ranked(rows: dict[str, dict[str, Any]], what: str, sign: float) -> list[str]:
    """The first and the next as cells of a table, of all cells; sign : 1 where little is good, -1 where much is."""
    pairs = [(figure(row, "all", what), program) for program, row in rows.items()]
    pairs = sorted((pair for pair in pairs if pair[0] is not None), key=lambda pair: sign * pair[0])
    cells = [f"{program} {value:.3f}" for value, program in pairs[:2]]
    if cells and (pairs[0][1] != OWN or (len(pairs) > 1 and pairs[1][0] == pairs[0][0])):
        cells[0] = f"**{cells[0]}**"
    return [*cells, "", ""][:2]


def ratios(rows: dict[str, dict[str, Any]]) -> str:
    """CPU of each other program over that of zlocus."""
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


# Columns of a scene's table: what is written, of which class and figure (none: of the row, for a million cells where it
# is a time), and whether little (1) or much (-1) is good.
COLUMNS = {
    "CPU, s / M cells": ("{:.1f}", None, "cpu_s", 1), "wall, s / M cells": ("{:.1f}", None, "wall_s", 1),
    "peak, GB": ("{:.2f}", None, "peak_gb", 1), "complete": ("{:.3f}", "all", "completeness", -1),
    "within 1 m: all": ("{:.3f}", "all", "within", -1), "ground": ("{:.3f}", "ground", "within", -1),
    "building": ("{:.3f}", "building", "within", -1), "tree": ("{:.3f}", "tree", "within", -1),
    "NMAD, m": ("{:.3f}", "all", "nmad", 1), "NMAD ground, m": ("{:.3f}", "ground", "nmad", 1),
    "RMSE, m": ("{:.2f}", "all", "rmse", 1), "LE90, m": ("{:.2f}", "all", "le90", 1),
}  # fmt: skip


def scene_tables(found: dict[str, Any]) -> Iterator[str]:
    """A table for each scene with truth."""
    for name in judged(found):
        about = found["scenes"][name]
        pairs = f"{about['pairs']} pair" + ("s" if about["pairs"] > 1 else "")
        yield f"## {name[0].upper()}{name[1:]}: {about['million_cells']:.2f} M cells, {pairs}"
        rows = of_scene(found, name)
        lines = [f"| program | {' | '.join(COLUMNS)} |", "|" + (len(COLUMNS) + 1) * "---|"]
        texts = {program: [] for program in rows}
        for column in COLUMNS.values():
            for program, text in column_of(found, succeeded(rows), *column).items():
                texts[program].append(text)
        for program, row in rows.items():
            cells = [failure(row), *[""] * (len(COLUMNS) - 1)] if "failed" in row else texts[program]
            lines.append(f"| {' | '.join([program, *cells])} |")
        yield "\n".join(lines)


def failure(row: dict[str, Any]) -> str:
    """Why there are no figures, for a cell of a table."""
    return f"failed: {row['failed']}".replace("|", "/").replace("\n", " ")


def column_of(
    found: dict[str, Any], rows: dict[str, dict[str, Any]], form: str, kind: str | None, what: str, sign: int
) -> dict[str, str]:
    """A column's texts by program, the best one bold."""
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
    """Scenes without truth: what their surfaces differ by."""
    for name in (name for name, scene in found["scenes"].items() if not scene["truth"]):
        rows = [row for row in found["differences"] if row["scene"] == name]
        if not rows:
            continue
        about = found["scenes"][name]
        yield f"## {name}: {about['million_cells']:.2f} M cells, no truth"
        yield "Differences of each two surfaces (second less first); none of them is the truth, so nobody wins."
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
    """What the programs took, where nothing is judged."""
    yield "| program | CPU, s / M cells | wall, s / M cells | peak, GB |"
    yield "|---|---|---|---|"
    for row in rows:
        if "failed" in row:
            yield f"| {row['program']} | {failure(row)} | | |"
        else:
            cpu, wall = (per_million(found, row, what) for what in ("cpu_s", "wall_s"))
            yield f"| {row['program']} | {cpu:.1f} | {wall:.1f} | {row['peak_gb']:.2f} |"


def kernel_table(found: dict[str, Any]) -> Iterator[str]:
    """Semi-global aggregation."""
    if not found["kernels"]:
        return
    heights = sorted({row["heights"] for row in found["kernels"]})
    yield "## Semi-global aggregation alone"
    yield (
        "Million cell-steps (cells x heights, all eight paths) a second on one core, the best of all turns; OpenCV's "
        "time holds its costs and minima too, which it does not separate."
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
    """Rectified photographs."""
    if not found["middlebury"]:
        return
    programs = list(dict.fromkeys(row["program"] for row in found["middlebury"]))
    bad: dict[str, dict[str, float]] = {}
    for row in found["middlebury"]:
        bad.setdefault(row["case"], {})[row["program"]] = row["bad_percent"]
    yield "## Rectified photographs (Middlebury)"
    yield "Pixels off by more than 1 px of disparity or without one, of those that both images see."
    lines = [f"| photographs | {' | '.join(programs)} |", "|---|" + "---|" * len(programs)]
    lines += [
        f"| {case} | {' | '.join(f'{of[program]:.2f} %' if program in of else '' for program in programs)} |"
        for case, of in bad.items()
    ]
    yield "\n".join(lines)


def versions(found: dict[str, Any]) -> Iterator[str]:
    """What computed."""
    yield "## Versions"
    yield ""
    for program, parts in found["programs"].items():
        named = (f"{name} {version}" for name, version in parts.items() if name != "configuration")
        yield f"- {program}: {', '.join(named)}"
    yield f"- kernels and photographs of zlocus, and what compares: Python {found['machine']['python']}"


def draw_accuracy(found: dict[str, Any], path: Path) -> None:
    """Share within 1 m and NMAD, a column of points for each scene."""
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
    axes[1].set_xticks(range(len(names)), [name.replace(", ", ",\n") for name in names])
    axes[0].legend(ncols=max(len(found["programs"]), 1), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    picture.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(picture)


def draw_cost(found: dict[str, Any], path: Path) -> None:
    """CPU against what is missed; left and low is good."""
    picture, axis = plt.subplots(figsize=(10, 5.5), layout="constrained")
    marks = dict(zip(judged(found), MARKS, strict=False))
    for program in found["programs"]:
        for scene, mark in marks.items():
            row = succeeded(of_scene(found, scene)).get(program)
            if row is not None:
                at = per_million(found, row), 100.0 * (1.0 - (figure(row, "all", "within") or 0.0))
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
    picture.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(picture)
