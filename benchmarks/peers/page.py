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
CLASSES = ("all", "ground", "building", "tree")
# Of the acceptance: so many times less CPU per million cells than these programs.
LESS_CPU = {CARS: 50.0, MICMAC: 10.0}
COLOURS = {
    OWN: "#b3261e",
    CARS: "#1f5f8b",
    "OpenCV SGBM": "#6b8e23",
    "Pandora": "#c77d0a",
    "s2p": "#6a4c93",
    MICMAC: "#555555",
}
NAMES = {"opencv": "OpenCV", "libsgm": "libSGM", "pandora": "Pandora"}
PICTURES = ("peers_accuracy.png", "peers_cost.png")
HEAD = """# Beside other programs

<!-- Made by `python benchmarks/peers --page docs` from benchmarks/peers/results.json: change those, not this page. -->

    make peers                                                     # all of it, some hours
    python benchmarks/peers --scenes town --programs zlocus CARS   # one scene, two programs
    python benchmarks/peers --micmac /opt/micmac/bin/mm3d          # a program that no registry has

The same images, area, grid and cores for all. Programs are installed from the package registry into environments
of their own; their configurations stand in `benchmarks/peers/configurations`, as their documents recommend them,
each with its reason. Programs for pairs get every pair whose rays meet at no more than 30 degrees, and merge them
by their own means. OpenCV and Pandora are matchers of rectified rows without cameras: images are resampled onto a
plane for them, the range of heights is told them, a cell gets the median of all pairs and gaps the nearest height.
CARS gets a terrain model with cells of 30 m. zlocus gets images, area and grid.

CPU and wall times are those of all processes a program starts, memory that of all of them together (shared pages
once), after a run on another scene that fills caches; zlocus is run three times and the median counts. Shares are
of all cells, an empty one is not within 1 m; where the truth has an edge, either side is right. Scenes are
rendered with seeds that no option was chosen by.
"""


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
    """Machine and date."""
    it = found["machine"]
    dates = sorted(row["when"][:10] for part in PARTS for row in found[part])
    span = dates[0] if dates[:1] == dates[-1:] else f"{dates[0]} to {dates[-1]}"
    cores = f"{len(it['cores'])} of {it['of_cores']} cores"
    computer = f"{cores} of {it['processor']}, {it['memory_gb']} GB, {it['system']}"
    yield f"Measured {span} on {computer}; commit {it['commit']}."


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


def verdicts(found: dict[str, Any]) -> Iterator[str]:
    """Who is first on each scene, and how much less CPU zlocus takes."""
    names = judged(found)
    if not names:
        return
    yield "## Who is first"
    lines = [
        "| scene | lowest NMAD, m | next | largest share within 1 m | next | CPU over zlocus' |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        rows = succeeded(of_scene(found, name))
        every = {program: row["classes"]["all"] for program, row in rows.items()}
        nmad = sorted(((of["nmad"], program) for program, of in every.items()), key=lambda pair: pair[0])
        share = sorted(((of["within"], program) for program, of in every.items()), key=lambda pair: -pair[0])
        cells = [name, *ranked(nmad), *ranked(share), ratios(rows)]
        lines.append(f"| {' | '.join(cells)} |")
    yield "\n".join(lines)
    bars = ", ".join(f"{bar:g} for {program}" for program, bar in LESS_CPU.items())
    yield f"Bold: zlocus is not first there. Bars of CPU over zlocus': {bars}; what falls short of them is bold."


def ranked(pairs: list[tuple[float, str]]) -> list[str]:
    """The first and the next as cells of a table."""
    cells = [f"{program} {value:.3f}" for value, program in pairs[:2]]
    cells[0] = cells[0] if pairs[0][1] == OWN else f"**{cells[0]}**"
    return [*cells, ""][:2]


def ratios(rows: dict[str, dict[str, Any]]) -> str:
    """CPU of each other program over that of zlocus."""
    if OWN not in rows:
        return ""
    found = []
    for program, row in rows.items():
        if program != OWN:
            ratio = row["cpu_s"] / rows[OWN]["cpu_s"]
            text = f"{program} {ratio:.1f}"
            found.append(f"**{text}**" if ratio < LESS_CPU.get(program, 0.0) else text)
    return ", ".join(found)


def pictures() -> Iterator[str]:
    yield f"![Share within 1 m and NMAD of each program on each scene]({PICTURES[0]})"
    yield ""
    yield f"![CPU for a million cells, and shares of all cells more than 1 m off, by program and scene]({PICTURES[1]})"


def scene_tables(found: dict[str, Any]) -> Iterator[str]:
    """A table for each scene with truth."""
    for name in judged(found):
        about = found["scenes"][name]
        pairs = f"{about['pairs']} pair" + ("s" if about["pairs"] > 1 else "")
        yield f"## {name[0].upper()}{name[1:]}: {about['million_cells']:.2f} M cells, {pairs}"
        lines = [
            "| program | CPU, s / M cells | wall, s / M cells | peak, GB | complete | within 1 m: all | ground "
            "| building | tree | NMAD, m | NMAD ground, m | RMSE, m | LE90, m |",
            "|" + 13 * "---|",
        ]
        lines += [surface_line(found, row) for row in of_scene(found, name).values()]
        yield "\n".join(lines)


def surface_line(found: dict[str, Any], row: dict[str, Any]) -> str:
    """One program on one scene."""
    if "failed" in row:
        return f"| {row['program']} | failed: {row['failed']} |" + " |" * 11
    classes = row["classes"]
    every = classes["all"]
    within = (f"{classes[name]['within']:.3f}" if name in classes else "" for name in CLASSES)
    took = (f"{per_million(found, row, what):.1f}" for what in ("cpu_s", "wall_s"))
    cells = [
        row["program"], *took, f"{row['peak_gb']:.2f}", f"{every['completeness']:.3f}", *within,
        f"{every['nmad']:.3f}", f"{classes['ground']['nmad']:.3f}", f"{every['rmse']:.2f}", f"{every['le90']:.2f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


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
                lines.append(f"| {row['first']} | {row['second']} | {row['failed']} | | | |")
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
            yield f"| {row['program']} | failed: {row['failed']} | | |"
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
        yield f"- {program}: {', '.join(f'{name} {version}' for name, version in parts.items())}"
    yield f"- everything else: Python {found['machine']['python']}"


def draw_accuracy(found: dict[str, Any], path: Path) -> None:
    """Share within 1 m and NMAD, a group of bars for each scene."""
    figure, axes = plt.subplots(2, 1, figsize=(10, 7), sharex=True, layout="constrained")
    names = judged(found)
    programs = [name for name in found["programs"] if any(name in succeeded(of_scene(found, scene)) for scene in names)]
    width = 0.8 / max(len(programs), 1)
    for axis, (what, label) in zip(axes, (("within", "share within 1 m"), ("nmad", "NMAD, m")), strict=True):
        for k, program in enumerate(programs):
            at = [(i, of_scene(found, scene).get(program)) for i, scene in enumerate(names)]
            bars = [(i, row["classes"]["all"][what]) for i, row in at if row is not None and "failed" not in row]
            x = [i + (k - (len(programs) - 1) / 2) * width for i, _ in bars]
            axis.bar(x, [value for _, value in bars], width, label=program, color=COLOURS.get(program))
        axis.set_ylabel(label)
        axis.grid(axis="y", alpha=0.3)
    axes[0].set_ylim(lowest_share(found, names), 1.0)
    axes[1].set_xticks(range(len(names)), [name.replace(", ", ",\n") for name in names])
    axes[0].legend(ncols=len(programs), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)


def lowest_share(found: dict[str, Any], names: list[str]) -> float:
    """Where the axis of shares begins: a step below the lowest bar."""
    shares = [row["classes"]["all"]["within"] for name in names for row in succeeded(of_scene(found, name)).values()]
    return max(0.0, round(min(shares, default=0.0) - 0.06, 1))


def draw_cost(found: dict[str, Any], path: Path) -> None:
    """CPU against what is missed; left and low is good."""
    figure, axis = plt.subplots(figsize=(10, 5.5), layout="constrained")
    marks = dict(zip(judged(found), "osD^v<>ph*XP", strict=False))
    for program in found["programs"]:
        for scene, mark in marks.items():
            row = succeeded(of_scene(found, scene)).get(program)
            if row is not None:
                at = per_million(found, row), 100.0 * (1.0 - row["classes"]["all"]["within"])
                axis.plot(*at, mark, color=COLOURS.get(program), markersize=9, alpha=0.85)
    axis.set(
        xscale="log", yscale="log", xlabel="CPU, s for a million cells", ylabel="cells more than 1 m off or empty, %"
    )
    axis.grid(which="both", alpha=0.25)
    keys = [plt.Line2D([], [], marker="s", ls="", color=COLOURS.get(name), label=name) for name in found["programs"]]
    keys += [plt.Line2D([], [], marker=mark, ls="", color="grey", label=scene) for scene, mark in marks.items()]
    axis.legend(handles=keys, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)
