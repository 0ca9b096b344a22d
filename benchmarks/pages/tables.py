"""Tables of the pages that are made from results files, by the name in `<!-- table: NAME -->`.

A new table is a function with `@table("name")` that takes all results by row and returns the table in Markdown. A table
that a script printed and that `recording.py` kept needs none: its name is `ROW-N`, the N-th table of that results file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

from result_files import NOT_RECORDED, Results
from rows.registry import ROWS
from workplace import CannotRun, Figure

AllResults = Mapping[str, Results]
Maker = Callable[[AllResults], str]
MAKERS: dict[str, Maker] = {}
CLASSES = ("all", "ground", "building", "tree")


class Tables(Mapping[str, Maker]):
    """All makers of tables by name: those of this module, and the printed tables of the results files as `ROW-N`."""

    def __getitem__(self, name: str) -> Maker:
        if name in MAKERS:
            return MAKERS[name]
        row, _, number = name.rpartition("-")
        if not (row and number.isdigit()):
            raise KeyError(name)
        return lambda results: printed_table(of_row(results, row), int(number))

    def __iter__(self) -> Iterator[str]:
        return iter(MAKERS)

    def __len__(self) -> int:
        return len(MAKERS)


TABLES = Tables()


def table(name: str) -> Callable[[Maker], Maker]:
    """Register a function under the name of its table."""

    def register(maker: Maker) -> Maker:
        MAKERS[name] = maker
        return maker

    return register


def of_row(results: AllResults, row: str) -> Results:
    """Results of a row.

    Raises
    ------
    CannotRun
        The row has no results file.
    """
    if row not in results:
        raise CannotRun(f"benchmarks/results/{row}.json is missing, and a table needs it: `make measure {row}`.")
    return results[row]


def markdown(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown. A bar in a cell would end the cell, so it is escaped."""
    rows = [[cell.replace("|", "\\|") for cell in line] for line in (head, *lines)]
    text = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([text[0], "|" + "---|" * len(head), *text[1:]])


def printed_table(results: Results, number: int) -> str:
    """A table that a script printed. number : from 1.

    Raises
    ------
    CannotRun
        The results file has fewer tables.
    """
    if not 1 <= number <= len(results.tables):
        raise CannotRun(
            f"benchmarks/results/{results.row}.json has {len(results.tables)} tables, and a page asks for number "
            f"{number}. Correct the name in the page."
        )
    head, *lines = results.tables[number - 1]
    return markdown(head, lines)


def number(figure: Figure) -> str:
    """A figure with its unit, as the tables show it."""
    value, unit = figure.value, f" {figure.unit}" if figure.unit else ""
    if math.isnan(value):
        return "none"
    if value == round(value) and abs(value) < 1e6:
        return f"{value:.0f}{unit}"
    if not figure.unit and abs(value) < 2:
        return f"{value:.4f}" if abs(value) >= 1e-4 else f"{value:.1e}"
    if abs(value) >= 100:
        return f"{value:.0f}{unit}"
    return f"{value:.3g}{unit}"


@table("accuracy")
def accuracy(results: AllResults) -> str:
    """Every figure of the acceptance table, in the order of the registry; details only where they miss their bar."""
    lines = []
    for row in (name for name, row in ROWS.items() if row.is_recorded):
        if row not in results:
            lines.append([row, "not measured yet", "", "", ""])
            continue
        for figure in results[row].figures:
            misses = bool(figure.bar) and not figure.passes
            if figure.is_detail and not misses:
                continue
            shown = number(figure) + (" (short)" if misses else "")
            lines.append([row, figure.what, figure.bar, shown, figure.fails_when if figure.bar else ""])
    return markdown(["row", "what", "bar", "figure", "the figure would miss the bar if"], lines)


@table("measurements")
def measurements(results: AllResults) -> str:
    """When, where and at which commit every results file was measured."""
    ordered = [row for row in ROWS if row in results] + [row for row in results if row not in ROWS]
    lines = []
    for row in ordered:
        it = results[row]
        seconds = NOT_RECORDED if it.seconds is None else f"{it.seconds:.0f} s"
        command = it.command if it.command == NOT_RECORDED else f"`{it.command}`"
        lines.append([row, it.date[:10], it.commit, processor(it), seconds, command, it.note])
    return markdown(["row", "date", "commit", "processor", "time", "command", "remark"], lines)


def processor(results: Results) -> str:
    """The machine of a measurement, in a few words."""
    name, cores = results.machine.get("processor", NOT_RECORDED), results.machine.get("cores")
    return name if not cores else f"{len(cores)} cores of {name}"


@table("fresh-scenes")
def fresh_scenes(results: AllResults) -> str:
    """Means over the fresh seeds with their standard deviations, and the worst share of all cells within 1 m."""
    lines = []
    for row, scene in (("fresh-city", "towns"), ("fresh-hills", "hills")):
        it = of_row(results, row)
        for views in ("six", "three", "two"):
            for name, label in ((views, "as it is"), (f"{views}, aligned", "aligned")):
                if any(figure.what == f"{name}, RMSE, mean" for figure in it.figures):
                    lines.append([f"{scene}, {views} views, {label}", *seed_cells(it, name)])
    head = ["scenes", *(f"within 1 m: {kind}" for kind in CLASSES[:3]), "worst: all", "off by > 3 m", "off by > 10 m"]
    return markdown([*head, "RMSE, m", "NMAD ground, m"], lines)


def seed_cells(it: Results, name: str) -> list[str]:
    """Cells of a line of the fresh scenes: mean and standard deviation of each figure."""

    def spread(what: str, digits: int) -> str:
        return seed_spread(it, f"{name}, {what}", digits)

    return [
        *(spread(f"within 1 m: {kind}", 3) for kind in CLASSES[:3]),
        f"{it.value(f'{name}, within 1 m: all, worst'):.3f}",
        spread("off by more than 3 m", 4),
        spread("off by more than 10 m", 4),
        spread("RMSE", 2),
        spread("NMAD ground", 3),
    ]


def seed_spread(it: Results, what: str, digits: int) -> str:
    """Mean and standard deviation over the seeds of a figure; empty where it was not measured."""
    known = {figure.what: figure.value for figure in it.figures}
    mean, deviation = (known.get(f"{what}, {which}") for which in ("mean", "standard deviation"))
    return "" if mean is None or deviation is None else f"{mean:.{digits}f} ± {deviation:.{digits}f}"


@table("demo")
def demo(results: AllResults) -> str:
    """Accuracy of the demo by class, as it is and aligned."""
    value = of_row(results, "demo").value
    lines = [
        [
            kind,
            f"{value(f'blocks: {kind}'):.0f}",
            f"{value(f'with a height: {kind}'):.4f}",
            *(f"{value(f'{way}within 1 m: {kind}'):.4f}" for way in ("", "aligned, ")),
            *(f"{value(f'{way}NMAD: {kind}'):.3f}" for way in ("", "aligned, ")),
        ]
        for kind in CLASSES
    ]
    return markdown(
        ["class", "blocks", "with a height", "within 1 m", "within 1 m, aligned", "NMAD, m", "NMAD, aligned, m"], lines
    )


@table("flights")
def flights(results: AllResults) -> str:
    """The ground of the demo from other images: raw ones, and those of a steady flight."""
    value = of_row(results, "demo").value
    lines = [
        [
            "level 1, unsteady (`make demo`)",
            f"{value('within 1 m: ground'):.4f}",
            f"{value('within 1 m: building'):.4f}",
            f"{value('NMAD: ground'):.4f}",
            "",
        ]
    ]
    for name, what in (
        ("raw, unsteady (`--level 0`)", "raw images"),
        ("level 1, steady (`--steady`)", "steady flight"),
        ("the same through RPC fitted to it", "steady flight through RPC"),
    ):
        lines.append(
            [
                name,
                f"{value(f'{what}, within 1 m: ground'):.4f}",
                f"{value(f'{what}, within 1 m: building'):.4f}",
                f"{value(f'{what}, NMAD: ground'):.4f}",
                f"{value(f'{what}, CPU'):.0f}",
            ]
        )
    return markdown(
        ["images", "ground within 1 m", "roofs within 1 m", "NMAD of ground, m", "CPU of `zlocus dsm`, s"], lines
    )


@table("sensors")
def sensors(results: AllResults) -> str:
    """One ground seen by three kinds of sensor, alone and together."""
    value = of_row(results, "mixed").value
    names = {"linescan": "line scanner", "frame": "frame", "rpc": "RPC", "mixed": "all nine"}
    lines = [
        [
            title,
            *(
                ", ".join(f"{value(f'{name}: within {limit} m: {kind}'):.3f}" for kind in CLASSES)
                for limit in ("0.42", "1")
            ),
            f"{value(f'{name}: NMAD ground'):.4f}",
        ]
        for name, title in names.items()
    ]
    head = ["images", "within 0.42 m: all, ground, building, tree", "within 1 m", "NMAD of ground, m"]
    return markdown(head, lines)


@table("middlebury")
def middlebury(results: AllResults) -> str:
    """Wrong pixels on rectified photographs, beside OpenCV."""
    it = of_row(results, "middlebury")
    end = ": bad > 1 px"
    cases = [figure.what.removesuffix(end) for figure in it.figures if figure.what.endswith(end)]
    lines = [
        [
            case,
            f"{it.value(f'{case}{end}'):.2f} %",
            f"{it.value(f'{case}: OpenCV, bad > 1 px'):.2f} %",
            f"{it.value(f'{case}: left empty before gaps are filled'):.2f} %",
        ]
        for case in cases
    ]
    return markdown(["scene", "zlocus", "OpenCV", "left empty before gaps are filled"], lines)


@table("more-images")
def more_images(results: AllResults) -> str:
    """Errors with a growing number of images: a line for each scene."""
    errors: dict[str, dict[int, str]] = {}
    for figure in of_row(results, "more-images").figures:
        scene, _, what = figure.what.rpartition(": ")
        if what.endswith(" images"):
            errors.setdefault(scene, {})[int(what.split()[0])] = f"{figure.value:.3g}"
    counts = sorted({n for of_scene in errors.values() for n in of_scene})
    lines = [[scene, *(of_scene.get(n, "") for n in counts)] for scene, of_scene in errors.items()]
    return markdown(["scene, error", *(f"{n} images" for n in counts)], lines)


@table("choice-of-images")
def choice_of_images(results: AllResults) -> str:
    """Error, share within 1 m and CPU time of every choice of images: a line for each scene."""
    scenes: dict[str, dict[str, dict[str, float]]] = {}
    for figure in of_row(results, "choice-of-images").figures:
        place, _, quantity = figure.what.rpartition(": ")
        scene, _, choice = place.rpartition(", ")
        if quantity in ("error", "spread of the error", "within 1 m", "CPU"):
            scenes.setdefault(scene, {}).setdefault(choice, {})[quantity] = figure.value
    choices = list(dict.fromkeys(choice for of_scene in scenes.values() for choice in of_scene))
    lines = [
        [scene, *(of_choice(of_scene[choice]) if choice in of_scene else "" for choice in choices)]
        for scene, of_scene in scenes.items()
    ]
    return markdown(["scene", *choices], lines)


def of_choice(values: Mapping[str, float]) -> str:
    """What a choice of images gave on a scene: error (with its spread over seeds), share within 1 m, CPU time."""
    spread = f" ± {values['spread of the error']:.2g}" if "spread of the error" in values else ""
    within = [f"{values['within 1 m']:.3f}"] if "within 1 m" in values else []
    return ", ".join([f"{values['error']:.3g}{spread}", *within, f"{values['CPU']:.0f} s"])


@table("departures")
def departures(results: AllResults) -> str:
    """What the surface loses where a departure from the papers is taken back: a line for each, columns of scenes."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for figure in of_row(results, "departures").figures:
        place, _, quantity = figure.what.rpartition(": ")
        scene, separator, departure = place.rpartition(", without ")
        if separator:
            found.setdefault(departure, {}).setdefault(scene, {})[quantity] = figure.value
    scenes = list(dict.fromkeys(scene for of_departure in found.values() for scene in of_departure))
    lines = [
        [name, *(what_is_lost(of_departure[scene]) if scene in of_departure else "" for scene in scenes)]
        for name, of_departure in found.items()
    ]
    return markdown(["taken back", *(f"{scene}: lost within 1 m; RMSE added" for scene in scenes)], lines)


def what_is_lost(values: Mapping[str, float]) -> str:
    """What is lost on some scenes: share within 1 m, with its standard error and the number of scenes, and RMSE."""
    several = "standard error of what is lost" in values
    error = f" ± {values['standard error of what is lost']:.4f}" if several else ""
    number = f", on {values['scenes that lose']:.0f} scenes" if several else ""
    return f"{values['lost within 1 m']:.4f}{error}{number}; {values['RMSE added']:+.2f} m"


# As published for JAX_068: mean absolute error, RMSE and median (m), share within 1 m, machine and time, protocol.
PUBLISHED_ON_JACKSONVILLE = {
    "S2P": ("2.09", "4.60", "", "", "CPU", "pairs of images"),
    "Sat-NeRF": ("1.27", "2.38", "0.66", "0.65", "GPU, dozens of hours", "the script of EOGS++"),
    "EO-NeRF": ("1.16", "2.20", "", "", "GPU, about a day", "other masks"),
    "EOGS": ("1.08", "2.32", "0.49", "0.75", "GPU, a few minutes", "the script of EOGS++, six seeds"),
    "EOGS++": ("0.99", "2.13", "0.40", "0.76", "GPU (RTX 3090), minutes", "the script of EOGS++, six seeds"),
    "HLC-GS": ("0.74", "1.91", "", "", "GPU, not given", "other masks"),
}


@table("neural-methods")
def neural_methods(results: AllResults) -> str:
    """Published figures of neural methods on nineteen WorldView-3 images of Jacksonville, and those of zlocus."""
    it = of_row(results, "many-images")
    parts = [(*figure.what.partition(": "), figure.value) for figure in it.figures]
    ours = {quantity: value for stack, _, quantity, value in parts if stack == "nineteen"}
    errors = ("mean absolute error", "RMSE", "median", "within 1 m")
    where = f"{ours['CPU']:.0f} s of CPU on {it.machine['processor']}, no GPU"
    line = [
        "**zlocus**",
        *(f"{ours[quantity]:.2f}" for quantity in errors),
        where,
        "half of the laser cells",
    ]
    lines = [[name, *values] for name, values in PUBLISHED_ON_JACKSONVILLE.items()]
    head = ["method", "MAE, m", "RMSE, m", "median, m", "within 1 m", "machine and time", "protocol"]
    return markdown(head, [*lines, line])


@table("kernels")
def kernels(results: AllResults) -> str:
    """Time of a unit of work of every benchmark of a kernel."""
    it = of_row(results, "kernels")
    lines = []
    for figure in it.figures:
        name, _, unit = figure.what.rpartition(", per ")
        if name:
            lines.append([f"`{name}`", unit, f"{figure.value:.3g}", f"{1e3 / figure.value:.3g}"])
    return markdown(["benchmark", "unit of work", "ns per unit", "million units per second"], lines)
