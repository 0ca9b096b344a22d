"""All rows of the acceptance table, by name. A new row is one line here, and its function in a module of the folder."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from result_files import PACKAGE, RENDERER
from workplace import Figure, Workplace

WITH_RENDERER = (PACKAGE, RENDERER)
# Rows on real images are measured by these scripts too.
WITHOUT_TRUTH = (PACKAGE, *(f"benchmarks/{n}.py" for n in ("independent_surfaces", "lines_of_sight", "reprojection")))


@dataclass(frozen=True)
class Row:
    """A row of the acceptance table.

    function : "module:name" of the function that measures it; the module is imported when the row is measured.
    code : measured parts of the source; the file of the function is always one more. is_slow : left out unless it is
    asked for by name or by `--slow`. is_recorded : whether it has a results file of its own.
    """

    function: str
    code: tuple[str, ...] = (PACKAGE,)
    is_slow: bool = False
    is_recorded: bool = True

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts of the source whose change makes the results file of the row older than the code."""
        module = self.function.partition(":")[0]
        return (*self.code, f"benchmarks/{module.replace('.', '/')}.py")

    def measure(self, workplace: Workplace) -> list[Figure]:
        """Figures of the row, measured now."""
        module, _, name = self.function.partition(":")
        return getattr(importlib.import_module(module), name)(workplace)


# In the order of the table of docs/reference/accuracy.md.
ROWS: dict[str, Row] = {
    "fresh-city": Row("rows.fresh:fresh_city", WITH_RENDERER, is_slow=True),
    "fresh-hills": Row("rows.fresh:fresh_hills", WITH_RENDERER, is_slow=True),
    "fresh-realistic": Row("rows.realistic:fresh_realistic", WITH_RENDERER, is_slow=True),
    "realistic": Row("rows.realistic:realistic"),
    "troubles": Row("rows.troubles:troubles", WITH_RENDERER, is_slow=True),
    "water": Row("rows.water:water", WITH_RENDERER, is_slow=True),
    "clouds": Row("rows.clouds:clouds", WITH_RENDERER, is_slow=True),
    "align": Row("rows.alignment:align", WITH_RENDERER),
    "mosaic": Row("rows.joined:mosaic", WITH_RENDERER, is_slow=True),
    "change": Row("rows.joined:change", WITH_RENDERER, is_slow=True),
    "redo": Row("rows.redo:redo", WITH_RENDERER),
    "precision": Row("rows.standard_deviations:precision", (*WITH_RENDERER, "benchmarks/precision.py"), is_slow=True),
    "flags": Row("rows.flags:flags", (*WITH_RENDERER, "benchmarks/precision.py"), is_slow=True),
    "departures": Row("rows.departures:departures", (*WITH_RENDERER, "benchmarks/precision.py"), is_slow=True),
    # How hard the recipe is for other programs: from benchmarks/peers/results.json.
    "hardness": Row("rows.realistic:hardness", is_recorded=False),
    "calanques": Row("rows.satellite:calanques"),
    "ventoux": Row("rows.satellite:ventoux"),
    "ventoux-grid": Row("rows.location_grids:ventoux_grid"),
    "datum": Row("rows.satellite:datum"),
    "dmc": Row("rows.photographs:dmc"),
    "tuniu": Row("rows.photographs:tuniu"),
    "drone-block": Row("rows.drone_block:drone_block", WITH_RENDERER, is_slow=True),
    "self-calibration": Row("rows.self_calibration:self_calibration", WITH_RENDERER, is_slow=True),
    "herzjesu": Row("rows.photographs:herzjesu"),
    "pairs-of-triplet": Row("rows.real_images:pairs_of_triplet", WITHOUT_TRUTH),
    "independent-surfaces": Row("rows.real_images:independent_surfaces", WITHOUT_TRUTH),
    "left-out-views": Row("rows.real_images:left_out_views", WITHOUT_TRUTH),
    "many-images": Row("rows.many_images:many_images"),
    "more-images": Row("rows.many_images:more_images", WITHOUT_TRUTH, is_slow=True),
    "choice-of-images": Row("rows.choice_of_images:choice_of_images", (*WITHOUT_TRUTH, RENDERER), is_slow=True),
    "middlebury": Row("rows.methods:middlebury"),
    "selection": Row("rows.methods:selection"),
    "city": Row("rows.rendered:city"),
    "city-views": Row("rows.rendered:city_views"),
    "hills": Row("rows.rendered:hills"),
    "joint": Row("rows.rendered:joint"),
    "demo": Row("rows.demo:demo", WITH_RENDERER),
    "mixed": Row("rows.demo:mixed", WITH_RENDERER),
    "ortho": Row("rows.rendered:ortho"),
    "ortho-images": Row("rows.ortho_images:ortho_images", WITH_RENDERER, is_slow=True),
    "ortho-control": Row("rows.ortho_images:ortho_control", WITH_RENDERER, is_slow=True),
    "features": Row("rows.methods:features", WITH_RENDERER),
    "kernels": Row("rows.resources:kernels"),
    "speed": Row("rows.resources:speed", WITH_RENDERER, is_slow=True),
    "start-up": Row("rows.resources:start_up", WITH_RENDERER),
    "memory": Row("rows.resources:memory", WITH_RENDERER, is_slow=True),
    "inspect": Row("inspecting:inspect", WITH_RENDERER),
    "inspect-large": Row("inspecting:inspect_large", WITH_RENDERER, is_slow=True),
    "halo": Row("rows.large_areas:halo", WITH_RENDERER),
    "growth": Row("rows.large_areas:growth", WITH_RENDERER, is_slow=True),
    "signals": Row("rows.resources:signals"),
    "clone": Row("rows.resources:clone", WITH_RENDERER, is_slow=True),
    # Its figures are those of benchmarks/peers/results.json, and stand on a page of their own.
    "peers": Row("rows.other_programs:peers", is_recorded=False),
}
